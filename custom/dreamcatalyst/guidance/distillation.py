"""A gradient rule at work: the distillation loss of renders, and the rule as a sampler."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion.api import Prior
from .ddim import sample_rule
from .distill import check_prior, distillation_gradient, distillation_loss, network_rows
from .fixed_point import balanced, check_sampler
from .objective import Objective, Step
from .oracle import resting_picture
from .prompted import PromptedPrior
from .rules import Rule
from .timesteps import Schedule


class Distillation(Objective):
    """The gradient of a `Rule` on the latents of renders."""

    def __init__(self, prompted: PromptedPrior, rule: Rule):
        check_prior(rule, prompted.prior)
        self.prompted, self.rule = prompted, rule
        rule.weights(min(self.resting_timesteps), prompted.prior.alphas_cumprod)  # PDS has none below its gap

    @property
    def network_rows(self) -> int:
        at = self.prompted
        rows = network_rows(at.prior, self.rule, at.text, at.source_text, *at.scales)
        return rows * (2 if at.config.noise == "paired" else 1)

    @property
    def resting_timesteps(self) -> Sequence[int]:
        """The timesteps that a run comes to rest under: its last one, or all that a random policy draws."""
        return self.prompted.schedule.rest(self.prompted.prior.alphas_cumprod)

    @property
    def sampler_timesteps(self) -> list[int]:
        """The timesteps of `picture`: as many as `diffusion_steps`, down between the limits of the schedule."""
        down, steps = Schedule("decreasing", *self.prompted.schedule.limits), self.prompted.config.diffusion_steps
        return [down.timestep(i, steps, self.prompted.prior.alphas_cumprod) for i in range(steps)]

    def timestep(self, step: int, max_steps: int) -> int:
        return self.prompted.schedule.timestep(step, max_steps, self.prompted.prior.alphas_cumprod)

    def balanced(self) -> Prior:
        return balanced(self.prompted.closed_form, self.rule, self.resting_timesteps, *self.prompted.scales)

    def check_sampler(self) -> None:
        if self.prompted.prior.exact:
            check_sampler(self.prompted.closed_form, self.rule, self.sampler_timesteps, *self.prompted.scales)

    def expected(
        self, source: Float[Tensor, "H W 3"], index: int, timestep: int | None = None
    ) -> Float[Tensor, "H W 3"] | None:
        timesteps = self.resting_timesteps if timestep is None else [timestep]
        return resting_picture(self.prompted, self.rule, source, index, timesteps)

    def in_balance(self, mean: Float[Tensor, ""], given: Step) -> Float[Tensor, ""]:
        """As it is beside a mean, and as many times as large as the rule's loss is beside a sum."""
        return mean * given.gradient[0].numel() if self.prompted.config.reduction == "sum" else mean

    def step(
        self,
        rgb: Float[Tensor, "B H W 3"],
        sources: Float[Tensor, "B H W 3"] | None,
        index: Sequence[int],
        step: int,
        max_steps: int,
        visits: Sequence[int] | None = None,
    ) -> Step:
        at = self.prompted
        with at.stage("encode"):
            x_src, condition = at.encode_sources(sources, index, step)
            x = at.encode(rgb, index, step)
        timestep = self.timestep(step, max_steps)
        noise, latents = self._noise(x, index, step, visits), x.detach()
        twice = len(noise) // len(latents) == 2
        if twice:
            latents, condition = torch.cat([latents, latents]), at.prior.stack([condition, condition])
            x_src = None if x_src is None else torch.cat([x_src, x_src])
        with at.stage("unet"):
            gradient = distillation_gradient(
                at.prior,
                self.rule,
                latents,
                x_src,
                image=condition,
                text=at.text,
                source_text=at.source_text,
                timestep=timestep,
                noise=noise,
                guidance_scale=at.config.guidance_scale,
                image_guidance_scale=at.config.condition_scale,
            )
        if twice:
            gradient = (gradient[: len(x)] + gradient[len(x) :]) / 2
        return Step(distillation_loss(x, gradient, at.config.reduction), timestep, gradient)

    def _noise(
        self, latents: Float[Tensor, "B C h w"], index: Sequence[int], step: int, visits: Sequence[int] | None
    ) -> Float[Tensor, "rows C h w"]:
        """The noise of a step, of B rows, or 2B where it is paired. Antithetic noise cancels what is linear in
        it: within the step at twice the rows (paired), or over two visits of a view at no cost (alternating)."""
        at, kind = self.prompted, self.prompted.config.noise
        if kind == "paired":
            noise = at.noise(latents, index, step)
            return torch.cat([noise, -noise])
        if kind == "alternating" and visits is not None:
            drawn = [at.noise(latents, [i], n // 2) * (-1) ** n for i, n in zip(index, visits, strict=True)]
            return torch.cat(drawn)
        return at.noise(latents, index, step)

    def picture(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], index: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        """The rule as a sampler from the source on, in `diffusion_steps` steps."""
        at, timesteps = self.prompted, self.sampler_timesteps
        x_src, condition = at.source_latents(source, index, step), at.encode_source(source, index)[1]
        edited = sample_rule(
            at.prior,
            self.rule,
            x_src,
            timesteps,
            lambda i: at.noise(x_src, [index], step * len(timesteps) + i),
            image=condition,
            text=at.text,
            source_text=at.source_text,
            guidance_scale=at.config.guidance_scale,
            image_guidance_scale=at.config.condition_scale,
        )
        return at.decode(edited, source)
