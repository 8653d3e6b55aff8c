"""Density control: strategies that add and remove splats while a run goes on, and when they are asked to.

A strategy is one class that is registered in DENSITY; `system.densify.strategy` names it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from ..config import BelowOne, Between, Count, Fraction, NonNegative, parse
from ..registry import Registry
from ..render.api import Render
from ..scene.generations import Generations
from ..scene.trainable import Splats

DENSITY = Registry("density strategy", __package__)
DENSITY.add("adaptive", ".densify:Adaptive")
DENSITY.add("mcmc", ".mcmc:Mcmc")


@dataclass(frozen=True)
class DensifyConfig:
    """When and how the number of splats changes. Steps count optimizer steps; lengths are fractions of the extent."""

    strategy: str = "adaptive"  # a name of DENSITY; adaptive: 3DGS's with GaussianEditor's top fraction | mcmc
    options: dict = field(default_factory=dict)  # a strategy's own; those of adaptive stand below
    every: Count = 100  # steps between two densifications; 0: never
    start: Count = 500  # first step at which splats may be added
    stop: Count = 15000  # no splat is added or removed from this step on
    grad_threshold: NonNegative = 2e-4  # mean screen gradient per half image side (NDC), from which on one is densified
    top_fraction: Fraction = 1.0  # of the splats with any gradient, the fraction (largest first) that may be densified
    dense_size: NonNegative = 0.01  # splats up to this size are cloned, larger ones split in two
    min_opacity: BelowOne = 0.005  # more transparent ones are removed
    max_size: NonNegative = 0.1  # larger ones are removed; 0: never
    max_radius: NonNegative = 0.0  # pixels: ones that were drawn larger since the last time are removed; 0: never
    max_splats: Count = 1_000_000  # cap on editable ones (908 MiB at SH degree 3), largest gradients go first; frozen
    # ones, which take a quarter of that each and never grow in number, do not count
    reset_every: Count = 0  # steps between two opacity resets; 0: never
    candidates: NonNegative = 0.0  # faint splats tried around the others each time, a fraction of the editable; 0: none
    candidates_least: Count = 200  # but no fewer than these
    candidates_until: Fraction = 0.7  # fraction of the run after which none is tried: a step must still judge them
    candidate_reach: NonNegative = 0.03  # standard deviation of their distance from a parent, a fraction of the extent
    candidate_opacity: Between = 0.05  # with which they begin: those that nothing asks for fade, and are removed

    def make(self) -> Density:
        """The strategy with its options. Raises ConfigError for a name or options that cannot be."""
        strategy = DENSITY.get(self.strategy, "system.densify.strategy")
        return strategy(self, parse(strategy.Config, self.options, "system.densify.options"))

    def times(self, max_steps: int) -> int:
        """How often a run of `max_steps` densifies: not at its end, where nothing could come of it."""
        if not self.every:
            return 0
        last = min(self.stop, max_steps) - 1
        return max(last // self.every - max(self.start - 1, 0) // self.every, 0)


@dataclass(frozen=True)
class Moment:
    """Where a run stands. step: updates so far, of max_steps. extent: the scene's size in world units. seed: the run's.
    generations: of the splats, where they are kept; a strategy that adds splats tells them (`Generations.newborn`)."""

    step: int
    max_steps: int
    extent: float
    seed: int
    generations: Generations | None = None


class Density:
    """A strategy of density control. Its order: begin, then in each step terms (of the loss), observe (after backward)
    and after_step (after the optimizer's update).

    Config: its own options. states: names of its per-splat tensors in `splats.state`, which move with the splats and
    are kept in checkpoints; `begin` makes them.
    """

    @dataclass(frozen=True)
    class Config:
        """No options."""

    states: tuple[str, ...] = ()

    def __init__(self, config: DensifyConfig, options: Config):
        self.config, self.options = config, options

    def begin(self, splats: Splats) -> None:
        """Make the per-splat state."""

    def terms(self, splats: Splats) -> dict[str, Tensor]:
        """What the strategy adds to the loss of a step, by name."""
        return {}

    def observe(self, splats: Splats, render: Render, loss_scale: float = 1.0) -> None:
        """Look at a step's gradients. loss_scale: what the loss was multiplied by before backward."""

    def after_step(self, splats: Splats, moment: Moment) -> None:
        """Densify when it is time to: what would be added in the last step, no step could improve."""
        config = self.config
        due = config.every and config.start <= moment.step < config.stop and moment.step % config.every == 0
        if due and moment.step < moment.max_steps:
            self.densify(splats, moment)

    def densify(self, splats: Splats, moment: Moment) -> None:
        """Add and remove splats (`Splats.rearrange`)."""
        raise NotImplementedError
