"""Splats that never change, and what a backend keeps of them from one call to the next."""

from __future__ import annotations

from operator import attrgetter

from ..cache import ByteCache
from ..scene.gaussians import Gaussians


class Frozen:
    """F splats without gradient, drawn together with those that are edited (`api.rasterize(..., frozen=)`).

    kept: what a backend keeps per view (a tile's list, an image), by everything that it depends on; anything that says
    how many `nbytes` it takes, at most `limit` bytes in all. A limit of 0 keeps nothing.
    scene shares memory with the splats given, which must not be changed in place. len() is F.
    """

    def __init__(self, scene: Gaussians, limit: int = 2**30):
        self.scene = scene.detach()
        self.kept = ByteCache(limit, size=attrgetter("nbytes"))

    def __len__(self) -> int:
        return len(self.scene)
