"""What a case of the stability table is, and how it is judged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

FACTOR, FLOOR = 10.0, 1e-5  # tolerance: FACTOR times what rounding the inputs does to the float64 reference, plus FLOOR


@dataclass(frozen=True)
class Check:
    """One line of the table. finite: whether all numbers are, None where none is meant to come out; error, tolerance:
    in the unit of 1 + the largest true number."""

    quantity: str
    finite: bool | None
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Finite where it has to be, and within the tolerance (an error that is NaN is not)."""
        return self.finite is not False and self.error <= self.tolerance


@dataclass(frozen=True)
class Case:
    """One place to add a stiff or extreme case: its group, what is extreme about it, and what finds out."""

    group: str
    name: str
    run: Callable[[], Iterable[Check]]


def distance(value: Tensor, truth: Tensor) -> float:
    """The largest difference, in units of 1 + the largest true number; 0 for tensors without numbers."""
    if truth.numel() == 0:
        return 0.0
    return float((value.double() - truth).abs().max() / (1.0 + truth.abs().max()))


def compare(quantity: str, value: Tensor, truth: Tensor, rounded: Tensor) -> Check:
    """What the product gives against the float64 reference, and that reference for inputs that were rounded."""
    tolerance = FACTOR * distance(rounded, truth) + FLOOR
    return Check(quantity, bool(value.isfinite().all()), distance(value, truth), tolerance)


def worst(quantity: str, checks: Mapping[str, Check]) -> Check:
    """One line for several: the check that is farthest beyond its tolerance, by its name; finite if all are."""
    name, check = max(checks.items(), key=lambda item: _excess(item[1]))
    finite = all(check.finite for check in checks.values())
    return Check(f"{quantity} ({name})", finite, check.error, check.tolerance)


def _excess(check: Check) -> float:
    return check.error / check.tolerance if check.error == check.error else float("inf")


def same(quantity: str, value: Tensor, other: Tensor) -> Check:
    """Equal to the bit."""
    return Check(quantity, bool(value.isfinite().all()), 0.0 if torch.equal(value, other) else 1.0, 0.0)


def bound(quantity: str, value: float, limit: float) -> Check:
    """A number that a theorem bounds."""
    return Check(quantity, value == value, value, limit)


def refused(kind: type[Exception], words: str, call: Callable[[], object]) -> Check:
    """What cannot be defined is a clear error: of this kind, saying these words."""
    try:
        call()
    except kind as error:
        return Check(f"refused: {kind.__name__}", None, 0.0 if words in str(error) else 1.0, 0.0)
    return Check(f"refused: {kind.__name__}", None, 1.0, 0.0)
