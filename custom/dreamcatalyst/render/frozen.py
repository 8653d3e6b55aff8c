"""Splats that never change, and what a backend keeps of them from one call to the next."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Protocol

from ..scene.gaussians import Gaussians


class Kept(Protocol):
    """Anything that says how many bytes it takes."""

    @property
    def nbytes(self) -> int: ...


class Frozen:
    """F splats without gradient, drawn together with those that are edited (`api.rasterize(..., frozen=)`).

    What a backend keeps per view (a tile's list, an image) stays here, at most `limit` bytes in all: what was not
    used for longest is dropped first, and what is larger than `limit` alone is not kept. A limit of 0 keeps nothing.
    scene shares memory with the splats given, which must not be changed in place. len() is F.
    """

    def __init__(self, scene: Gaussians, limit: int = 2**30):
        self.scene, self.limit = scene.detach(), limit
        self.held = 0  # bytes
        self._kept: OrderedDict[Hashable, Kept] = OrderedDict()

    def __len__(self) -> int:
        return len(self.scene)

    def get(self, key: Hashable) -> Kept | None:
        """What was kept under `key` (everything that it depends on), None where there is nothing."""
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    def put(self, key: Hashable, value: Kept) -> None:
        """Keep `value` under `key`, in place of what was there, as far as the limit allows."""
        if key in self._kept:
            self.held -= self._kept.pop(key).nbytes
        if value.nbytes > self.limit:
            return
        self._kept[key] = value
        self.held += value.nbytes
        while self.held > self.limit:
            self.held -= self._kept.popitem(last=False)[1].nbytes
