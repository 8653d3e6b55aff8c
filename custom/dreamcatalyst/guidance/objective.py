"""What a rule of either kind gives a run: the loss of a step, its timestep, and what a checkpoint keeps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..diffusion.api import Prior


@dataclass(frozen=True)
class Step:
    """What the guidance gives for one step.

    loss: with a graph to the renders. timestep: index into the prior's schedule, -1 where the rule compares
    images. gradient: the rule's g on latents [B,C,h,w], or the difference of the images [B,H,W,3]; without graph.
    target: the images that renders are compared with, None for a rule that delivers a gradient.
    """

    loss: Float[Tensor, ""]
    timestep: int
    gradient: Float[Tensor, "B ..."]
    target: Float[Tensor, "B H W 3"] | None = None

    @property
    def gradient_rms(self) -> float:
        """Root mean square of the gradient over its elements."""
        return float(self.gradient.square().mean().sqrt())


class Objective(ABC):
    """A rule at work on one prompted prior. Building it raises ConfigError or PriorError where the two do not match.

    gives_pictures: whether every `Step` has a target. network_rows, picture_rows: rows that the prior's network
    predicts for each view in every step, and for each finished picture.
    """

    gives_pictures: bool = False
    network_rows: int = 0
    picture_rows: int = 0

    @abstractmethod
    def step(
        self,
        rgb: Float[Tensor, "B H W 3"],
        sources: Float[Tensor, "B H W 3"] | None,
        index: Sequence[int],
        step: int,
        max_steps: int,
        visits: Sequence[int] | None = None,
    ) -> Step:
        """See `Guidance.step`."""

    def timestep(self, step: int, max_steps: int) -> int | None:
        """The prior's timestep at `step` of a run; None for a rule that compares pictures."""
        return None

    @abstractmethod
    def picture(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], index: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        """A finished picture of one view, in [0,1], of its render and its source render."""

    @abstractmethod
    def balanced(self) -> Prior:
        """An exact prior with those spreads that were left open."""

    def in_balance(self, mean: Float[Tensor, ""], given: Step) -> Float[Tensor, ""]:
        """A loss that is a mean over its own elements, at the strength at which it keeps its balance with `given`."""
        return mean

    def expected(
        self, source: Float[Tensor, "H W 3"], index: int, timestep: int | None = None
    ) -> Float[Tensor, "H W 3"] | None:
        """Where the rule comes to rest; None where that is not known or not stable."""
        return None

    def check_sampler(self) -> None:  # noqa: B027  (most have nothing that could diverge)
        """Raise ConfigError where `picture` is known to diverge."""

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs that is no function of seed and step."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # noqa: B027  (most keep nothing)
        """Take up `state_dict` of an earlier run."""
