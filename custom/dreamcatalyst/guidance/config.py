"""What a YAML says of a guidance: its prior, its rule, and how strongly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ..config import AtLeastOne, Count, DdimSteps, Fraction, NonNegative, Number, Seed, parse
from ..diffusion.api import PRIORS, Prior
from ..errors import ConfigError
from .rules import Replacement, Rule, get_rule
from .timesteps import Schedule

NOISES = ("independent", "alternating", "paired")
REDUCTIONS = ("mean", "sum")


@dataclass(frozen=True)
class GuidanceConfig:
    """Which prior is distilled by which rule, and how strongly."""

    prior_type: str = "closed-form"  # a name in PRIORS (diffusion/api.py)
    prior: dict = field(default_factory=dict)  # the prior's own options
    rule: str = "dreamcatalyst"  # a name in RULES (guidance/rules.py)
    preset: str = "paper"  # chi, delta, gamma: paper (0.075, 0.2, 0.8) | published-3dgs (0.075, 0.05, 0.2)
    chi: NonNegative | None = None  # single ones replaced; null: the preset's
    delta: NonNegative | None = None
    gamma: NonNegative | None = None
    gap: AtLeastOne | None = None  # of PDS, in timesteps
    implicit_step: NonNegative | None = None  # length of a step that takes the identity term implicitly; 0: explicitly
    guidance_scale: Number = 7.5  # w_y, of the instruction
    condition_scale: Number = 1.5  # w_I, of the image
    timesteps: str | None = None  # policy (guidance/timesteps.py); null: the rule's own
    schedule_steps: AtLeastOne | None = None  # that the policy goes over, however long the run is; null: the run's
    reduction: str = "mean"  # of the loss over latent elements: mean | sum
    min_step_percent: Fraction | None = None  # lowest noise level, a fraction of T; null: the policy's (decreasing 0.2)
    max_step_percent: Fraction | None = None  # highest; null: the policy's (decreasing 0.9)
    diffusion_steps: DdimSteps = 20  # of the edits of single images that in2n makes
    set_alpha_to_one: bool = True  # these edits end without noise; false: with that of timestep 0, as published
    per_editing_step: Count = 10  # in2n: visits at its multiples edit the view anew; 0: only first visits edit
    edit_begin_step: Count = 0  # in2n: these edits anew take place after this step
    edit_until_step: Count | None = None  # and before this one; null: to the end
    edit_min_percent: Fraction = 0.02  # in2n: limits of the noise level of an edit, fractions of T
    edit_max_percent: Fraction = 0.98
    noise: str = "independent"  # alternating: e and -e on a view's visits in turn; paired: both in each step
    seed: Seed = 0  # of noise and random timesteps

    def __post_init__(self) -> None:
        if self.per_editing_step < 0:
            raise ConfigError(f"per_editing_step: got {self.per_editing_step}, expected 0 (first visits only) or more")
        lowest, highest = self.edit_min_percent, self.edit_max_percent
        if not 0.0 <= lowest <= highest < 1.0:
            raise ConfigError(
                f"edit_min_percent {lowest} and edit_max_percent {highest} must be fractions with 0 <= min <= max < 1"
            )
        begin, until = self.edit_begin_step, self.edit_until_step
        if begin < 0 or (until is not None and until < begin):
            raise ConfigError(
                f"edit_begin_step {begin} and edit_until_step {until} must be steps with 0 <= begin <= until, "
                "or until null"
            )


def chosen_rule(config: GuidanceConfig) -> Rule | Replacement:
    """The rule with its parameters. Raises ConfigError."""
    given = {name: getattr(config, name) for name in ("chi", "delta", "gamma", "gap", "implicit_step")}
    return get_rule(config.rule, config.preset, **{k: v for k, v in given.items() if v is not None})


def chosen_prior(config: GuidanceConfig) -> tuple[Callable[..., Prior], Any]:
    """The prior's class, called with (options, device=...), and its options; nothing is loaded. Raises ConfigError."""
    cls = PRIORS.get(config.prior_type, "system.guidance.prior_type")
    return cls, parse(cls.Config, config.prior, "system.guidance.prior")


def chosen_schedule(config: GuidanceConfig, rule: Rule | Replacement) -> Schedule:
    """The timesteps of a run. Raises ConfigError."""
    policy = config.timesteps or rule.timesteps
    return Schedule(policy, config.min_step_percent, config.max_step_percent, config.seed, config.schedule_steps)
