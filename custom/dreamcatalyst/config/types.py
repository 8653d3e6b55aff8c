"""What a number of a config may be: annotations of fields. OmegaConf, and so the host, sees int and float."""

from __future__ import annotations

import math
from typing import Annotated


class Range:
    """Which numbers a field takes, as an interval: "[0, 1)" holds 0 and not 1. Infinity is never inside.

    Stands in an annotation, `rate: Annotated[float, Range("[0, inf)")]`, and goes for every number of the field: each
    element of a tuple, and each value of a schedule.
    """

    def __init__(self, interval: str):
        self.interval = interval
        low, high = interval[1:-1].split(",")
        self.low, self.high = float(low), float(high)
        self._open = interval[0] == "(", interval[-1] == ")"

    def __contains__(self, number: float) -> bool:
        above = number > self.low if self._open[0] else number >= self.low
        below = number < self.high if self._open[1] else number <= self.high
        return above and below and -math.inf < number < math.inf

    def __str__(self) -> str:
        if math.isinf(self.low) and math.isinf(self.high):
            return "a finite number"
        if math.isinf(self.high):
            return f"more than {self.low:g}" if self._open[0] else f"{self.low:g} or more"
        return f"a number in {self.interval}"


Number = Annotated[float, Range("(-inf, inf)")]
Positive = Annotated[float, Range("(0, inf)")]
NonNegative = Annotated[float, Range("[0, inf)")]
Fraction = Annotated[float, Range("[0, 1]")]
PositiveFraction = Annotated[float, Range("(0, 1]")]
BelowOne = Annotated[float, Range("[0, 1)")]
Between = Annotated[float, Range("(0, 1)")]
Colour = tuple[Fraction, Fraction, Fraction]  # RGB
Integer = Annotated[int, Range("(-inf, inf)")]
Count = Annotated[int, Range("[0, inf)")]
AtLeastOne = Annotated[int, Range("[1, inf)")]
Seed = Annotated[int, Range("[0, 4294967295]")]  # what all generators of random numbers take
DdimSteps = Annotated[int, Range("[1, 1000]")]  # a prior has no more noise levels
Side = Annotated[int, Range("[1, 32766]")]  # pixels; OpenCV resamples no longer sides

Scalar = Annotated[float, "schedule"]
"""A number or a schedule of it, [v0, v1, end], [start, v0, v1, end] or [start, v0, v1, s1, v2, s2, ...]; `value`."""
Rate = Annotated[Scalar, Range("[0, inf)")]
