"""Error against seconds over several seeds: median and spread, the time to reach an error, and ratios of such times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

NEAR = 0.1  # dB: who comes this close to an error has reached it


@dataclass(frozen=True)
class Track:
    """One method on one edit. By row of the runs: steps; seconds, the median over seeds; the error in dB (PSNR, so the
    larger the better), median, lowest and highest. outside: PSNR to the source where nothing should change, median at
    the end, None for an edit of everything. runs: seeds that came to their end; failed: those that did not."""

    steps: tuple[int, ...]
    seconds: tuple[float, ...]
    error: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    outside: float | None
    runs: int
    failed: int = 0

    @property
    def points(self) -> list[tuple[float, float]]:
        """(seconds, dB)."""
        return list(zip(self.seconds, self.error, strict=True))

    @property
    def per_step(self) -> float:
        """Seconds that a step takes in the second half of the run, when no first visit of a view is left."""
        half = (len(self.steps) - 1) // 2
        return (self.seconds[-1] - self.seconds[half]) / (self.steps[-1] - self.steps[half])


def track(rows: Sequence[Mapping[str, Any]]) -> Track | None:
    """What the finished runs of several seeds have in common; None where none came to its end."""
    done = [row for row in rows if not row.get("failed")]
    if not done:
        return None
    steps = [step for step in done[0]["step"] if all(step in row["step"] for row in done)]

    def at(name: str) -> list[list[float]]:
        return [[row[name][row["step"].index(step)] for row in done] for step in steps]

    errors = at("error")
    outside = [row["outside"] for row in done if row.get("outside") is not None]
    return Track(
        steps=tuple(steps),
        seconds=tuple(median(values) for values in at("seconds")),
        error=tuple(median(values) for values in errors),
        low=tuple(min(values) for values in errors),
        high=tuple(max(values) for values in errors),
        outside=median(outside) if outside else None,
        runs=len(done),
        failed=len(rows) - len(done),
    )


def reach(curve: Track, level: float) -> float | None:
    """Seconds until the median first reaches `level` dB, between rows along a straight line; None: it never does."""
    before = None
    for seconds, error in curve.points:
        if error >= level:
            if before is None:
                return seconds
            share = (level - before[1]) / (error - before[1])
            return before[0] + share * (seconds - before[0])
        before = seconds, error
    return None


def levels(tracks: Sequence[Track], shares: Sequence[float] = (0.5, 0.75, 0.9)) -> list[float]:
    """Errors to be reached: these shares of the way, in dB, from the unedited scene to the best end of all."""
    start, end = tracks[0].error[0], max(curve.error[-1] for curve in tracks)
    return [start + share * (end - start) for share in shares]


def times(value: float) -> str:
    """A ratio in words: two digits, and no exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


@dataclass(frozen=True)
class Ratio:
    """How many times as long one takes as another. reached: else it is a lower bound, the whole run."""

    value: float
    reached: bool = True

    def __str__(self) -> str:
        return f"{'' if self.reached else '> '}{times(self.value)}"


def ratio(reference: Track, others: Sequence[Track]) -> Ratio | None:
    """Time of the fastest of `others` (lengths of one method) to come to what `reference` ends with, by the time that
    the latter takes to come there. None where the reference ends no better than it began."""
    target = reference.error[-1] - NEAR
    mine = reach(reference, target)
    if not mine:
        return None
    theirs = [seconds for curve in others if (seconds := reach(curve, target)) is not None]
    if theirs:
        return Ratio(min(theirs) / mine)
    return Ratio(max(curve.seconds[-1] for curve in others) / mine, reached=False)


def middle(ratios: Sequence[Ratio]) -> Ratio | None:
    """The median of ratios; a lower bound of it where it depends on how large those are that were never reached."""
    if not ratios:
        return None
    least = median(r.value for r in ratios)
    most = median(r.value if r.reached else math.inf for r in ratios)
    return Ratio(least, reached=least == most)
