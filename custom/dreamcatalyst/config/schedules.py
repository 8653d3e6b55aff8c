"""Scalars that follow a schedule: threestudio's `C`, clock rule included."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any, TypeGuard, cast

from omegaconf import OmegaConf

from ..errors import ConfigError, choose
from .types import Scalar

LARGEST = sys.float_info.max
FORMS = "[v0, v1, end], [start, v0, v1, end] or [start, v0, v1, s1, v2, s2, ...]"
EXPECTED = f"a number or a schedule {FORMS}"


def shown(raw: Any) -> str:
    """A value and its type, for messages."""
    plain = OmegaConf.to_container(raw) if OmegaConf.is_config(raw) else raw
    text = repr(plain)
    return f"{text if len(text) <= 80 else text[:77] + '...'} ({type(plain).__name__})"


def is_list(raw: Any) -> TypeGuard[Sequence[Any]]:
    """Whether this is a list or a tuple, or what OmegaConf makes of one."""
    return isinstance(raw, Sequence) and not isinstance(raw, (str, bytes))


def is_number(raw: Any) -> TypeGuard[int | float]:
    """Whether this is an int or a float, and no bool."""
    return isinstance(raw, (int, float)) and not isinstance(raw, bool)


def read_scalar(raw: Any, place: str) -> float | tuple[int | float, ...]:
    """A number as it is, a schedule as a tuple that keeps its ints and floats apart (they choose the clock). All are
    finite."""
    if is_number(raw):
        return _finite(raw, raw, place)
    wrong = ConfigError(f"{place}: got {shown(raw)}, expected {EXPECTED}.")
    if isinstance(raw, str):
        try:
            return _finite(float(raw), raw, place)
        except ValueError as error:
            raise wrong from error
    if not is_list(raw):
        raise wrong
    for item in raw:
        if not is_number(item):
            raise ConfigError(f"{place}: a schedule holds numbers only, and {shown(item)} is none: {list(raw)}.")
        _finite(item, raw, place)
    if len(raw) not in (3, 4) and (len(raw) < 6 or len(raw) % 2):
        raise ConfigError(f"{place}: a schedule of {len(raw)} numbers, expected {FORMS}.")
    times = [time for time, _ in _knots(raw)]
    if any(a >= b for a, b in zip(times, times[1:], strict=False)):
        raise ConfigError(f"{place}: the times of a schedule must increase, got {times} in {list(raw)} ({FORMS}).")
    return tuple(raw)


def _finite(number: int | float, raw: Any, place: str) -> int | float:
    """The number. Raises ConfigError where a float cannot hold it, or it is none."""
    if not -LARGEST <= number <= LARGEST:
        raise ConfigError(f"{place}: got {shown(raw)}, expected finite numbers.")
    return number


def _knots(schedule: Sequence[int | float]) -> list[tuple[int | float, int | float]]:
    """The (time, value) corners of a schedule: start and v0 first, then the others as they stand, (v, time)."""
    start, first, *rest = [0, *schedule] if len(schedule) == 3 else schedule
    return [(start, first)] + [(rest[i + 1], rest[i]) for i in range(0, len(rest), 2)]


def _corners(scalar: Any) -> list[tuple[int | float, int | float]]:
    """`_knots` of a schedule as it was given. Raises ConfigError."""
    return _knots(cast(tuple, read_scalar(scalar, "schedule")))


def value(scalar: Scalar | Sequence, epoch: int, step: int, interpolation: str = "linear") -> float:
    """The value of a number or schedule at `epoch` and global `step`; threestudio's `C`, clock rule included.

    Between the corners of a schedule the value goes linearly ("linear") or geometrically ("exp"); outside it stays.
    The piece is chosen by the step. The type of the number that ends the piece chooses the clock inside it: an int
    counts global steps, a float counts epochs.
    """
    if is_number(scalar):
        return scalar
    knots = _corners(scalar)
    piece = sum(step >= time for time, _ in knots[1:-1])
    (start, first), (end, last) = knots[piece : piece + 2]
    now = step if isinstance(end, int) else epoch
    t = min(max((now - start) / (end - start), 0.0), 1.0)
    if choose("interpolation", interpolation, ["linear", "exp"]) == "linear":
        return first + (last - first) * t
    if first <= 0 or last <= 0:
        raise ConfigError(f"schedule: 'exp' interpolation needs positive values, got {first} and {last}.")
    return math.exp(math.log(first) * (1 - t) + math.log(last) * t)


def values_of(scalar: Scalar | Sequence) -> list[float]:
    """The values at the corners of a schedule, between which it stays; of a number, that."""
    return [scalar] if is_number(scalar) else [v for _, v in _corners(scalar)]


def largest(scalar: Scalar | Sequence) -> float:
    """The largest value that a number or schedule takes."""
    return max(values_of(scalar))


def corners(scalar: Scalar | Sequence) -> list[int | float]:
    """The times at which the pieces of a schedule begin and end, in steps or epochs; [0] for a number."""
    return [0] if is_number(scalar) else [time for time, _ in _corners(scalar)]
