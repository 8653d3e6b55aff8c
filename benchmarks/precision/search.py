"""A small search for two settings that every method gets alike: the rates' common factor and the guidance scale.

A pattern search on a grid of powers (Hooke & Jeeves 1961): from the best point so far, neighbours are tried until the
trials are spent, or none is left.

Not a library's search: optuna's samplers fit a model to the scores, and three to five trials give it too little to fit.
These points need no seed and follow from the trials before them alone, so that a table goes on from any of its rows.
"""

from __future__ import annotations

from collections.abc import Mapping

RATE, SCALE = 3.0, 2.0  # a step of the grid multiplies by
Point = tuple[int, int]  # exponents: of RATE on all learning rates, of SCALE on the guidance scale
START: Point = (0, 0)  # as configured
STEPS: tuple[Point, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))


def propose(tried: Mapping[Point, float], trials: int, axes: int = 2) -> Point | None:
    """The next point to try; None where `trials` are spent or the best point has no untried neighbour.

    tried: points with their scores, the larger the better (-inf: failed), in the order in which they were tried.
    axes: 2, or 1 where only the rates are free.
    """
    if len(tried) >= trials:
        return None
    if not tried:
        return START
    rate, scale = best(tried)
    for step in STEPS:
        point = rate + step[0], scale + step[1]
        if point not in tried and not any(step[axes:]):
            return point
    return None


def best(tried: Mapping[Point, float]) -> Point:
    """The point with the highest score, of equal ones the first; where nothing was tried, as configured."""
    return max(tried, key=tried.__getitem__) if tried else START
