"""Worlds that lie far from their origin, as geographic ones do: where they are moved to, so that float32 will do."""

from __future__ import annotations

import numpy as np

Origin = tuple[float, float, float]
ZERO: Origin = (0.0, 0.0, 0.0)
FAR = 1000.0  # times their own spread from which positions are moved: float32 then has lost three of its seven digits


def far_origin(positions: np.ndarray) -> Origin:
    """The point of the world that is to become (0,0,0) for these `positions` [N,3] float64: whole numbers near their
    median where that lies more than FAR times their spread (the median distance from it) from zero, else zero.

    What is read is moved by it in float64, before it becomes float32; what is written is moved back.
    """
    if len(positions) == 0:
        return ZERO
    middle = np.median(positions, axis=0)
    spread = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    if spread == 0.0 or not np.linalg.norm(middle) > FAR * spread:
        return ZERO
    x, y, z = np.round(middle).tolist()
    return x, y, z
