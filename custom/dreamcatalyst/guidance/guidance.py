"""A prior, a rule and an instruction, put together: what the edit system asks for the loss of its renders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import choose
from .config import NOISES, REDUCTIONS, GuidanceConfig, chosen_prior, chosen_rule, chosen_schedule
from .distillation import Distillation
from .objective import Objective, Step
from .oracle import known_edit
from .prompted import PromptedPrior
from .rules import Replacement, Rule


class Guidance(PromptedPrior):
    """See GuidanceConfig. Text is encoded once per prompt, source latents and conditions once per view.

    Everything that can be wrong with prior, rule or instruction is found by the constructor, before a scene is loaded.
    """

    def __init__(
        self, config: GuidanceConfig, prompt: str, source_prompt: str = "", device: torch.device | str = "cpu"
    ):
        self.rule: Rule | Replacement = chosen_rule(config)
        schedule = chosen_schedule(config, self.rule)
        choose("kind of noise", config.noise, NOISES, "system.guidance.noise")
        choose("reduction", config.reduction, REDUCTIONS, "system.guidance.reduction")
        prior_class, options = chosen_prior(config)
        super().__init__(config, prior_class(options, device=device), schedule, prompt)
        self.objective: Objective = self.begin(self.rule)
        if self.prior.exact:
            self.prior = self.objective.balanced()
        self.text = self.prior.embed([prompt])[0]
        compared = source_prompt if self.rule.reads_source_text else ""
        self.source_text = self.prior.embed([compared])[0] if compared else None

    def begin(self, rule: Rule | Replacement) -> Objective:
        """The rule at work here. Raises ConfigError or PriorError where it does not go with prior and timesteps."""
        return Distillation(self, rule) if isinstance(rule, Rule) else rule.objective(self, rule)

    def step(
        self,
        rgb: Float[Tensor, "B H W 3"],
        sources: Float[Tensor, "B H W 3"] | None,
        index: Sequence[int],
        step: int,
        max_steps: int,
        visits: Sequence[int] | None = None,
    ) -> Step:
        """The loss of renders rgb of the views `index` against their source renders, at `step` of a run.

        sources: None where prior and rule need none (sds on a text-to-image prior). visits: how often each
        view came before (alternating noise needs it). Noise and random timesteps are functions
        of seed, step and view. Raises NumericalError for a gradient that is not finite.
        """
        return self.objective.step(rgb, sources, index, step, max_steps, visits)

    def known_edit(self, source: Float[Tensor, "H W 3"], index: int) -> Float[Tensor, "H W 3"] | None:
        """The edit that the prior knows of a view's source render, in [0,1]; None for a prior that learned."""
        return known_edit(self, source, index)

    # --- what a checkpoint keeps

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs that is no function of seed and step."""
        return self.objective.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up the state of an earlier run."""
        self.objective.load_state_dict(state)
