"""Numbers that stop being finite: found in the step where they appear, with their place, before they reach a splat."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..errors import NumericalError


def require_finite(stage: str, **tensors: Tensor) -> None:
    """Raise NumericalError, with the stage, the tensor's name and a count, where one of `tensors` is not finite."""
    for name, value in tensors.items():
        if torch.isfinite(value.detach().sum()):  # one pass where all is well
            continue
        bad = int((~torch.isfinite(value.detach())).sum())
        if bad:
            raise NumericalError(f"stage {stage}: {bad} of {value.numel()} elements of {name} are not finite")


def gradient_norms(parameters: Mapping[str, Tensor]) -> dict[str, float]:
    """The Euclidean norm of the gradient of each parameter that has elements, by name; 0 where there is no gradient.

    Raises NumericalError for a gradient that is not finite, and for one whose square is not: Adam's second moment
    would be infinite from then on, and the parameter stand still for good, without a word.
    """
    gradients = {name: value.grad for name, value in parameters.items() if value.grad is not None and value.numel()}
    norms = {name: 0.0 for name, value in parameters.items() if value.numel()}
    if gradients:
        lengths = torch.stack(torch._foreach_norm(list(gradients.values()))).tolist()  # waits for the device once
        norms |= dict(zip(gradients, lengths, strict=True))
    for name, norm in norms.items():
        if norm != norm or norm == float("inf"):
            require_finite("backward", **{f"the gradient of {name}": gradients[name]})
            raise NumericalError(f"stage backward: the gradient of {name} is so large that its square is not finite")
    return norms


def snapshot(parameters: Mapping[str, Tensor]) -> list[Tensor]:
    """Copies of the parameters, for `restore`."""
    return [value.detach().clone() for value in parameters.values()]


@torch.no_grad()
def restore(parameters: Mapping[str, Tensor], copies: list[Tensor]) -> None:
    """Make the parameters what they were at a `snapshot`."""
    for value, before in zip(parameters.values(), copies, strict=True):
        value.copy_(before)
