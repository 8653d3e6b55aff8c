"""Things taken away by one command: the system that a YAML names, and its sections."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .. import plugin
from ..config import Count, Fraction
from .deleting import DeleteMethod, DeleteParts
from .system import SplatSystem


@plugin.register("dreamcatalyst-delete-system")
class DeleteSystem(SplatSystem):
    """Takes away what the mask names, and heals the hole behind it."""

    Method = DeleteMethod
    Parts = DeleteParts

    @dataclass
    class Config(SplatSystem.Config):
        thing: str = ""  # what is taken away, in words: for the report, and to know a synthetic scene's truth
        mask: dict = field(default_factory=dict)  # which splats that is
        inpaint: dict = field(default_factory=dict)  # what fills the holes of single views
        heal: dict = field(default_factory=dict)  # what counts as a hole
        ssim_weight: Fraction = 0.2  # of D-SSIM in the loss, the rest is L1
        allow_coarse_fit: bool = False  # take from splats that were fitted to smaller pictures than those of this run
        first_fit: dict = field(default_factory=dict)  # the fit on the way, where there is no gs_source
        source_cache_mib: Count = 1024  # what is kept of renders of the source

    method: DeleteMethod

    def look_ahead(self, data: Any) -> None:
        super().look_ahead(data)
        self.method.load_inpainter()
