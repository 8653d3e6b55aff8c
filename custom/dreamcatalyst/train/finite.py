"""Numbers that stop being finite: found in the step where they appear, with their place, before they reach a splat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .. import plugin
from ..errors import NumericalError

if TYPE_CHECKING:
    from .system import SplatSystem


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
    given = {name: value.grad for name, value in parameters.items() if value.grad is not None and value.numel()}
    norms = {name: 0.0 for name, value in parameters.items() if value.numel()}
    if given:
        found = torch.stack(torch._foreach_norm(list(given.values()))).tolist()  # waits for the device once
        norms |= dict(zip(given, found, strict=True))
    for name, norm in norms.items():
        if norm != norm or norm == float("inf"):
            require_finite("backward", **{f"the gradient of {name}": given[name]})
            raise NumericalError(f"stage backward: the gradient of {name} is so large that its square is not finite")
    return norms


def kept_copy(parameters: Mapping[str, Tensor]) -> list[Tensor]:
    """What the parameters are now, for `give_back`."""
    return [value.detach().clone() for value in parameters.values()]


@torch.no_grad()
def give_back(parameters: Mapping[str, Tensor], kept: list[Tensor]) -> None:
    """Make the parameters what they were."""
    for value, before in zip(parameters.values(), kept, strict=True):
        value.copy_(before)


def leave_out(system: SplatSystem, error: NumericalError, batch: Mapping[str, Any], step: int) -> None:
    """End the run with the place of what is not finite, or where `system.nonfinite` is skip, leave the step out and
    count it. Nothing of the step has reached the splats. Raises NumericalError."""
    views, timestep = ", ".join(system.capture.views[i].name for i in batch["index"]), system.timestep(step)
    place = f"step {step}, {'' if timestep is None else f'timestep {timestep}, '}view {views}"
    if system.cfg.nonfinite == "stop":
        raise NumericalError(f"{place}: {error}. The splats are those of the step before.") from error
    record = system.record
    record.skipped, record.numbers = record.skipped + 1, {}
    if record.skipped.bit_count() == 1:  # said at the first, the second, the fourth, the eighth ... time
        plugin.warn(f"{place}: {error}. The step is left out, {record.skipped} so far.")
    if system.true_global_step == step:  # a step without gradients changes nothing, and is counted
        system.optimizers().zero_grad()
        system.optimizers().step()
