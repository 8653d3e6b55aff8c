"""What the compositing kernels take and give: arrays that belong together, with their shapes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .tiles import PIXELS


class Work(NamedTuple):
    """What is composited in one view of M packed splats."""

    packed: np.ndarray  # float32 [M,COLUMNS], as tiles.py lays them out
    extras: np.ndarray  # float32 [M,E], further channels
    spans: np.ndarray  # int64 [S,7], the tiles; `forward` moves each END to where its tile was finished
    entries: np.ndarray  # int32 [K,2], packed splat and slot
    width: int  # pixels
    height: int
    background: np.ndarray  # float32 [3]


class Images(NamedTuple):
    """What `forward` draws, or the derivatives in it."""

    rgb: np.ndarray  # float32 [H,W,3]
    alpha: np.ndarray  # float32 [H,W,1]
    extras: np.ndarray  # float32 [H,W,E]


class State(NamedTuple):
    """What the backward pass needs of the forward pass, for each of S tiles."""

    final: np.ndarray  # float32 [S,PIXELS], transmittance behind the entries before AFTER
    last: np.ndarray  # float32 [S,PIXELS], number of the last splat among them
    rest: np.ndarray  # float32 [S,4,PIXELS] where there are entries from AFTER on, else not touched, and S may be 0:
    # their colour and that of the background, and the transmittance behind everything

    @classmethod
    def empty(cls, tiles: int, rested: int) -> State:
        """Room for `tiles` tiles, of which the first `rested` have entries from AFTER on."""
        shapes = (tiles, PIXELS), (tiles, PIXELS), (rested, 4, PIXELS)
        return cls(*(np.empty(shape, np.float32) for shape in shapes))


class Slots(NamedTuple):
    """Derivatives by pair of splat and tile."""

    values: np.ndarray  # float32 [I,9+E]: in the mean (2), conic (3), opacity, colour (3) and extra channels
    used: np.ndarray  # uint8 [I]: whether there are any


class Gradients(NamedTuple):
    """Derivatives by splat."""

    means2d: np.ndarray  # float32 [N,2]
    conics: np.ndarray  # float32 [N,3]
    opacities: np.ndarray  # float32 [N]
    colors: np.ndarray  # float32 [N,3]
    extras: np.ndarray  # float32 [N,E]
