"""Splats edited by one sentence: the system that a YAML names, and its sections."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import plugin
from ..config import Count
from .edit_config import EditParts
from .editing import EditMethod
from .system import SplatSystem


@plugin.register("dreamcatalyst-edit-system")
class EditSystem(SplatSystem):
    """Edits the splats of gs_source (or those that the capture carries) as the instruction says."""

    Method = EditMethod
    Parts = EditParts

    @dataclass
    class Config(SplatSystem.Config):
        mode: str = ""  # which entry of `steps` the YAML's trainer.max_steps takes: ${system.steps.${system.mode}}
        steps: dict = field(default_factory=dict)  # length of the run in each mode, such as fast and high-quality
        guidance: dict = field(default_factory=dict)
        prompt_processor: dict = field(default_factory=dict)
        preview: dict = field(default_factory=dict)
        original: str = ""  # a PLY of the scene before any edit, where gs_source is an edited one; empty: gs_source
        allow_coarse_fit: bool = False  # edit splats that were fitted to smaller pictures than those of this run
        mask: dict = field(default_factory=dict)  # where the edit may take place
        anchor: dict = field(default_factory=dict)  # what splats are held to, by generation
        first_fit: dict = field(default_factory=dict)  # the fit on the way, where there is no gs_source
        source_cache_mib: Count = 1024  # what is kept of renders of the source

    method: EditMethod

    def look_ahead(self, data: Any) -> None:
        super().look_ahead(data)
        self.method.load_prior()

    def preview(self, data: Any) -> list[Path]:
        """Write what the prior itself makes of one view, without a run."""
        self.enter(data, self.device)
        return self.method.preview()
