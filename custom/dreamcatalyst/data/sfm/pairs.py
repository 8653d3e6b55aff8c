"""Which photographs are compared with which."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

from .options import SfmOptions

Pair = tuple[int, int]  # of places in the order of the photographs, the smaller first
ALL = 60  # photographs up to which all are compared with all
ALIKE = 20  # photographs that look most alike, compared with each
LOOPS = 3  # of those far away in time, for each frame of a video
NEXT = 6  # neighbours in time of each frame, and those at distances of powers of two beyond them
BESIDE = 2  # neighbours in the order of photographs of which the order may mean something


def exhaustive(n: int) -> list[Pair]:
    """All with all."""
    return list(combinations(range(n), 2))


def neighbours(n: int, steps: Sequence[int]) -> list[Pair]:
    """Each with those so many places on."""
    return [(i, i + step) for i in range(n) for step in steps if i + step < n]


def sequential(n: int) -> list[Pair]:
    """Each with the next NEXT, and with those 2, 4, 8 ... times as far."""
    return neighbours(n, [*range(1, NEXT + 1), *(NEXT << i for i in range(1, n.bit_length()))])


def alike(likeness: np.ndarray, most: int, apart: int = 0) -> list[Pair]:
    """Each with the `most` that look most like it, of those more than `apart` places away."""
    n = len(likeness)
    found: set[Pair] = set()
    for i in range(n):
        order = [int(j) for j in np.argsort(-likeness[i], kind="stable") if abs(int(j) - i) > apart]
        found |= {(min(i, j), max(i, j)) for j in order[:most]}
    return sorted(found)


def choose_pairs(n: int, video: bool, options: SfmOptions, likeness: Callable[[], np.ndarray]) -> list[Pair]:
    """The pairs of `n` photographs, or of a video's frames in their order. likeness: makes [n,n] (retrieval.py), where
    it is asked for."""
    kind = options.pairs
    if kind == "auto":
        kind = "exhaustive" if n <= (ALL // 2 if video else ALL) else "sequential" if video else "retrieval"
    if kind == "exhaustive":
        return exhaustive(n)
    if kind == "sequential":  # where a walk comes back to what it has seen, that looks alike
        return sorted({*sequential(n), *alike(likeness(), LOOPS, apart=2 * NEXT)})
    return sorted({*alike(likeness(), ALIKE), *neighbours(n, range(1, BESIDE + 1))})
