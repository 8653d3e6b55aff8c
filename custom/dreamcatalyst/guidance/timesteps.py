"""Which timestep a step takes: policies that are functions of the run's progress, so that shorter, longer and resumed
runs all cover their whole schedule."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import no_type_check

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion.noise import keyed_generator
from ..errors import ConfigError
from ..registry import Registry

DDIM_STEPS = 500  # the published codes number timesteps i = 0..499 with t = 2 i + 1 of 1000
POLICIES = Registry("timestep policy", __package__)


@dataclass(frozen=True)
class Policy:
    """options(progress, alphas_cumprod, lowest, highest): the timesteps 0..T-1 that a step may take, all equally
    likely; one for a policy that draws nothing. progress is 0 at a run's first step and 1 at its last.
    lowest, highest: default limits, as fractions of the noise levels."""

    options: Callable[[float, Float[Tensor, " T"], float, float], Sequence[int]]
    lowest: float
    highest: float


def _index(limit: float) -> int:
    return math.floor(limit * DDIM_STEPS + 1e-9)  # 0.29 * 100 is 28.999...


@no_type_check  # numbers alone, asked for by the million: a check would cost tests more than the function
def _ddim(index: int, train_steps: int) -> int:
    """t = 2 i + 1 for T = 1000, scaled and kept inside 0..T-1 for others."""
    return min(index * train_steps // DDIM_STEPS + 1, train_steps - 1)


def decreasing(progress: float, alphas_cumprod: Float[Tensor, " T"], lowest: float, highest: float) -> list[int]:
    """From `highest` to `lowest` of 500 DDIM steps, rounded down, hence with repeats: 901 to 201 at 0.9 and 0.2.

    Source: the code published with DreamCatalyst, with progress in place of its count of calls.
    """
    index = highest * DDIM_STEPS + (lowest - highest) * DDIM_STEPS * progress
    return [_ddim(math.floor(index + 1e-9), len(alphas_cumprod))]


def decreasing_full(progress: float, alphas_cumprod: Float[Tensor, " T"], lowest: float, highest: float) -> list[int]:
    """From T - 1 to 0 evenly, as DreamCatalyst's text has it."""
    return [round((len(alphas_cumprod) - 1) * (highest + (lowest - highest) * progress))]


def uniform(progress: float, alphas_cumprod: Float[Tensor, " T"], lowest: float, highest: float) -> list[int]:
    """Any of the DDIM steps between the limits, the upper one left out: i = 10..489 of 500 at 0.02 and 0.98.

    Source: Poole et al. 2023 (limits); the code published with PDS (indices).
    """
    low = _index(lowest)
    return [_ddim(index, len(alphas_cumprod)) for index in range(low, max(_index(highest), low + 1))]


def non_increasing(progress: float, alphas_cumprod: Float[Tensor, " T"], lowest: float, highest: float) -> list[int]:
    """From high t to low, the time spent at t proportional to W(t) = W_d W_p, where W_d = sqrt((1 - abar_t) / abar_t)
    is the noise-to-signal ratio and W_p = exp(-(t - m)^2 / (2 s^2)) prefers the timesteps that make content.

    Source: DreamTime, Huang et al. 2024 (ICLR), with its m = 500 and s = 125 of 1000.
    """
    total = len(alphas_cumprod)
    t = torch.arange(total, dtype=torch.float64)
    snr_weight = ((1 - alphas_cumprod.double()) / alphas_cumprod.double().clamp(min=1e-12)).sqrt()
    prior_weight = torch.exp(-((t - 0.5 * total) ** 2) / (2 * (0.125 * total) ** 2))
    inside = (t >= _ddim(_index(lowest), total)) & (t <= _ddim(_index(highest), total))
    spent = torch.where(inside, snr_weight * prior_weight, 0.0).flip(0).cumsum(0)  # from the highest t down
    # Just inside the ends: at 0 and 1 themselves timesteps of weight zero beyond the limits would be found.
    reached = torch.searchsorted(spent, spent[-1] * min(max(progress, 1e-12), 1.0 - 1e-12))
    return [total - 1 - int(reached)]


POLICIES.add("decreasing", Policy(decreasing, 0.2, 0.9))
POLICIES.add("decreasing-full", Policy(decreasing_full, 0.0, 1.0))
POLICIES.add("uniform", Policy(uniform, 0.02, 0.98))
POLICIES.add("non-increasing", Policy(non_increasing, 0.02, 0.98))


def progress_of(step: int, max_steps: int) -> float:
    """How far `step` (from 0) is in a run of `max_steps`: 0 at the first, 1 at the last, at the only and beyond."""
    return min(step / (max_steps - 1), 1.0) if max_steps > 1 else 1.0


@dataclass(frozen=True)
class Schedule:
    """A policy with its limits. lowest, highest: fractions of the noise levels; None for the policy's own. steps: that
    the policy goes over, however long the run is; None: the run's. A shorter run then ends before the policy does, and
    a longer one stays where it ends."""

    policy: str = "decreasing"
    lowest: float | None = None
    highest: float | None = None
    seed: int = 0
    steps: int | None = None

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise ConfigError(f"system.guidance.schedule_steps: got {self.steps}, expected 1 or more, or null.")
        lowest, highest = self.limits
        if not 0.0 <= lowest <= highest <= 1.0:
            raise ConfigError(
                f"system.guidance: min_step_percent {lowest} and max_step_percent {highest} must be fractions with "
                "0 <= min <= max <= 1."
            )

    @property
    def limits(self) -> tuple[float, float]:
        """(lowest, highest) in use."""
        policy: Policy = POLICIES.get(self.policy, "system.guidance.timesteps")
        return (
            policy.lowest if self.lowest is None else self.lowest,
            policy.highest if self.highest is None else self.highest,
        )

    def options(self, progress: float, alphas_cumprod: Float[Tensor, " T"]) -> Sequence[int]:
        """The timesteps that a step at `progress` may take, all equally likely."""
        return POLICIES.get(self.policy).options(progress, alphas_cumprod, *self.limits)

    def timestep(self, step: int, max_steps: int, alphas_cumprod: Float[Tensor, " T"]) -> int:
        """The index 0..T-1 into alphas_cumprod that `step` (from 0) of `max_steps` takes: a pure function of these,
        and of the seed where the policy draws."""
        options = self.options(progress_of(step, self.steps or max_steps), alphas_cumprod)
        if len(options) == 1:
            return options[0]
        return options[int(torch.randint(len(options), (), generator=keyed_generator(self.seed, "timestep", step)))]

    def rest(self, alphas_cumprod: Float[Tensor, " T"]) -> Sequence[int]:
        """The timesteps that a run over the whole schedule comes to rest under: its last one, or all that a random
        policy draws."""
        return self.options(1.0, alphas_cumprod)
