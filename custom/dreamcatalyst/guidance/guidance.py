"""A prior, a rule and an instruction, put together: what the edit system asks for the loss of its renders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ..cache import ByteCache
from ..config import AtLeastOne, Count, DdimSteps, Fraction, NonNegative, Number, Seed, parse
from ..diffusion.api import PRIORS, Prior
from ..diffusion.noise import keyed_generator, keyed_noise
from ..errors import PriorError, choose
from .distill import check_prior, distillation_gradient, distillation_loss
from .edited_views import EditedViews
from .fixed_point import balanced, fixed_point
from .replace import edit_image, sample_rule
from .rules import SOURCE, Rule, get_rule
from .timesteps import Schedule

NOISES = ("independent", "alternating", "paired")
VIEW_BYTES = 2**30  # of latents and conditions of source views that are kept at most


@dataclass(frozen=True)
class GuidanceConfig:
    """Which prior is distilled by which rule, and how strongly."""

    prior_type: str = "closed-form"  # closed-form | ip2p | sd | world-truth
    prior: dict = field(default_factory=dict)  # the prior's own options
    rule: str = "dreamcatalyst"  # a row of guidance/rules.py
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


@dataclass(frozen=True)
class Step:
    """What the guidance gives for one step.

    loss: a scalar with a graph to the renders. timestep: index into the prior's schedule, -1 where the rule compares
    images. gradient: the rule's g on latents [B,C,h,w], or the difference of the images [B,H,W,3]; without graph.
    target: the images [B,H,W,3] that renders are compared with, None for a rule that delivers a gradient.
    """

    loss: Tensor
    timestep: int
    gradient: Tensor
    target: Tensor | None = None

    @property
    def gradient_rms(self) -> float:
        """Root mean square of the gradient over its elements."""
        return float(self.gradient.square().mean().sqrt())


def chosen_rule(config: GuidanceConfig) -> Rule:
    """The rule with its parameters. Raises ConfigError."""
    given = {name: getattr(config, name) for name in ("chi", "delta", "gamma", "gap", "implicit_step")}
    return get_rule(config.rule, config.preset, **{k: v for k, v in given.items() if v is not None})


def chosen_prior(config: GuidanceConfig) -> tuple[type[Prior], Any]:
    """The prior's class and its options; nothing is loaded. Raises ConfigError."""
    cls = PRIORS.get(config.prior_type, "system.guidance.prior_type")
    return cls, parse(cls.Config, config.prior, "system.guidance.prior")


def chosen_schedule(config: GuidanceConfig, rule: Rule) -> Schedule:
    """The timesteps of a run. Raises ConfigError."""
    policy = config.timesteps or rule.timesteps
    return Schedule(policy, config.min_step_percent, config.max_step_percent, config.seed, config.schedule_steps)


class Guidance:
    """See GuidanceConfig. Text is encoded once per prompt, source latents and conditions once per view.

    Everything that can be wrong with prior, rule or instruction is found by the constructor, before a scene is loaded.
    """

    def __init__(
        self, config: GuidanceConfig, prompt: str, source_prompt: str = "", device: torch.device | str = "cpu"
    ):
        self.config, self.prompt = config, prompt
        self.rule: Rule = chosen_rule(config)
        self.schedule = chosen_schedule(config, self.rule)
        choose("kind of noise", config.noise, NOISES, "system.guidance.noise")
        choose("reduction", config.reduction, ("mean", "sum"), "system.guidance.reduction")
        prior_class, options = chosen_prior(config)
        self.prior: Prior = prior_class(options, device=device)
        check_prior(self.rule, self.prior)
        if self.rule.delivers == "known edit" and not self.prior.exact:
            raise PriorError(
                f"rule '{self.rule.name}' compares with an edit that is known, which {config.prior_type} does not "
                "know: use prior_type closed-form, or another rule"
            )
        self.rule.weights(min(self.resting_timesteps), self.prior.alphas_cumprod)  # PDS has none below its gap
        if self.prior.exact:
            self.prior = balanced(self.prior, self.rule, self.resting_timesteps, *self.scales)
        self.text = self.prior.embed([prompt])[0]
        compared = source_prompt if self.rule.reference == SOURCE else ""  # other rules never look at it
        self.source_text = self.prior.embed([compared])[0] if compared else None
        self.edits = EditedViews(
            config.per_editing_step,
            config.edit_min_percent,
            config.edit_max_percent,
            config.seed,
            config.edit_begin_step,
            config.edit_until_step,
        )
        self._views, self._deviations = ByteCache(VIEW_BYTES), ByteCache(VIEW_BYTES)
        self.stage: Callable[[str], AbstractContextManager] = nullcontext  # around "encode" and "unet": for a clock

    @property
    def scales(self) -> tuple[float, float]:
        """(w_y, w_I)."""
        return self.config.guidance_scale, self.config.condition_scale

    @property
    def resting_timesteps(self) -> Sequence[int]:
        """The timesteps that a run comes to rest under: its last one, or all that a random policy draws."""
        return self.schedule.rest(self.prior.alphas_cumprod)

    @property
    def sampler_timesteps(self) -> list[int]:
        """The timesteps of `edit_by_rule`: as many as `diffusion_steps`, down between the limits of the schedule."""
        down, steps = Schedule("decreasing", *self.schedule.limits), self.config.diffusion_steps
        return [down.timestep(i, steps, self.prior.alphas_cumprod) for i in range(steps)]

    @torch.no_grad()
    def view(self, source: Tensor, index: int) -> tuple[Tensor, Any]:
        """Latents [1,C,h,w] (the posterior's mode, where the prior draws them at every use) and condition of a view's
        source render [H,W,3]; computed once for each `index`, as long as there is room (1 GiB)."""
        image = source.permute(2, 0, 1)[None]
        return self._views.get(index, lambda: (self.prior.encode(image), self.prior.condition_of(image, index)))

    def forget_views(self) -> None:
        """Encode source views anew: the source is drawn otherwise from here on."""
        self._views.clear()
        self._deviations.clear()

    def in_balance(self, mean: Tensor, given: Step) -> Tensor:
        """A loss that is a mean over its own elements, at the strength at which it keeps its balance with the rule's:
        as it is beside a mean, and as many times as large as the rule's loss is beside a sum."""
        summed = self.config.reduction == "sum" and self.rule.delivers == "gradient"
        return mean * given.gradient[0].numel() if summed else mean

    def step(
        self,
        rgb: Tensor,
        sources: Tensor | None,
        index: Sequence[int],
        step: int,
        max_steps: int,
        visits: Sequence[int] | None = None,
    ) -> Step:
        """The loss of renders rgb [B,H,W,3] of the views `index` against their source renders, at `step` of a run.

        sources [B,H,W,3]: None where prior and rule need none (sds on a text-to-image prior). visits: how often each
        view came before (alternating noise needs it). Noise and random timesteps are functions
        of seed, step and view. Raises NumericalError for a gradient that is not finite.
        """
        if self.rule.delivers != "gradient":
            return self._compare(rgb, sources, index, step)
        with self.stage("encode"):
            x_src, condition = self._sources(sources, index, step)
            x = self._encode(rgb, index, step)
        timestep = self.schedule.timestep(step, max_steps, self.prior.alphas_cumprod)
        noise, latents = self._step_noise(x, index, step, visits), x.detach()
        twice = len(noise) // len(latents) == 2
        if twice:
            latents, condition = torch.cat([latents, latents]), self.prior.stack([condition, condition])
            x_src = None if x_src is None else torch.cat([x_src, x_src])
        with self.stage("unet"):
            gradient = distillation_gradient(
                self.prior,
                self.rule,
                latents,
                x_src,
                image=condition,
                text=self.text,
                source_text=self.source_text,
                timestep=timestep,
                noise=noise,
                guidance_scale=self.config.guidance_scale,
                image_guidance_scale=self.config.condition_scale,
            )
        if twice:
            gradient = (gradient[: len(x)] + gradient[len(x) :]) / 2
        return Step(distillation_loss(x, gradient, self.config.reduction), timestep, gradient)

    def _encode(self, images: Tensor, index: Sequence[int], step: int) -> Tensor:
        """Latents [B,C,h,w] of renders [B,H,W,3], with a graph."""
        images = images.permute(0, 3, 1, 2)
        if not self.prior.draws_latents:
            return self.prior.encode(images)
        noise = [self._posterior_noise("edited", i, step, self.prior.latent_shape(images)) for i in index]
        return self.prior.encode(images, torch.stack(noise).to(images.device))

    @torch.no_grad()
    def _source_latents(self, source: Tensor, index: int, step: int) -> Tensor:
        """Latents [1,C,h,w] of a view's source render [H,W,3], of its posterior where the prior draws them."""
        mode = self.view(source, index)[0]
        if not self.prior.draws_latents:
            return mode
        deviation = self._deviations.get(index, lambda: self.prior.deviation(source.permute(2, 0, 1)[None]))
        return mode + deviation * self._posterior_noise("source", index, step, mode.shape[1:]).to(mode)

    def _posterior_noise(self, branch: str, index: int, step: int, shape: Sequence[int]) -> Tensor:
        generator = keyed_generator(self.config.seed, "posterior", branch, step, index)
        return torch.randn(tuple(shape), generator=generator)

    def _sources(self, sources: Tensor | None, index: Sequence[int], step: int) -> tuple[Tensor | None, Any]:
        if sources is None:
            return None, None
        views = list(zip(sources, index, strict=True))
        latents = [self._source_latents(source, i, step) for source, i in views]
        conditions = [self.view(source, i)[1] for source, i in views]
        return (latents[0], conditions[0]) if len(views) == 1 else (torch.cat(latents), self.prior.stack(conditions))

    def _noise(self, latents: Tensor, index: Sequence[int], step: int) -> Tensor:
        shape, dtype, device = latents.shape[1:], latents.dtype, latents.device
        return torch.stack([keyed_noise(self.config.seed, step, i, shape, dtype, device) for i in index])

    def _step_noise(self, latents: Tensor, index: Sequence[int], step: int, visits: Sequence[int] | None) -> Tensor:
        """The noise of a step, [B,C,h,w], or [2B,C,h,w] where it is paired. Antithetic noise cancels what is linear in
        it: within the step at twice the rows (paired), or over two visits of a view at no cost (alternating)."""
        if self.config.noise == "paired":
            noise = self._noise(latents, index, step)
            return torch.cat([noise, -noise])
        if self.config.noise == "alternating" and visits is not None:
            drawn = [self._noise(latents, [i], n // 2) * (-1) ** n for i, n in zip(index, visits, strict=True)]
            return torch.cat(drawn)
        return self._noise(latents, index, step)

    def _compare(self, rgb: Tensor, sources: Tensor, index: Sequence[int], step: int) -> Step:
        """Rules that deliver an image: the mean absolute difference from it."""
        targets = []
        for render, source, view in zip(rgb, sources, index, strict=True):
            if self.rule.delivers == "known edit":
                targets.append(self.known_edit(source, view))
                continue
            if self.edits.due(view, step):
                with self.stage("unet"):
                    self.edits.put(view, self.edit(render, source, view, step))
            targets.append(self.edits.get(view, like=rgb))
        target = torch.stack(targets)
        difference = rgb - target
        return Step(difference.abs().mean(), -1, difference.detach(), target)

    def edit_by_rule(self, render: Tensor, source: Tensor, index: int, step: int) -> Tensor:
        """A finished picture of one view, [H,W,3] in [0,1], in `diffusion_steps` steps: the rule as a sampler from the
        source on, or what the rule delivers where that is an image."""
        if self.rule.delivers == "known edit":
            return self.known_edit(source, index)
        if self.rule.delivers == "edit":
            return self.edit(render, source, index, step)
        x_src, condition = self._source_latents(source, index, step), self.view(source, index)[1]
        timesteps = self.sampler_timesteps
        edited = sample_rule(
            self.prior,
            self.rule,
            x_src,
            timesteps,
            lambda i: self._noise(x_src, [index], step * len(timesteps) + i),
            image=condition,
            text=self.text,
            source_text=self.source_text,
            guidance_scale=self.config.guidance_scale,
            image_guidance_scale=self.config.condition_scale,
        )
        return self._picture(edited, source)

    @torch.no_grad()
    def edit(self, render: Tensor, source: Tensor, index: int, step: int) -> Tensor:
        """Dataset update: the prior's edit of a render [H,W,3], noised to a level that is drawn, and conditioned on the
        source render of the view: [H,W,3] in [0,1]."""
        latents = self._encode(render[None], [index], step)
        timestep = self.edits.timestep(index, step, len(self.prior.alphas_cumprod))
        noise = self._noise(latents, [index], step)
        return self._edit_image(source, index, latents, noise, timestep=timestep, steps=self.config.diffusion_steps)

    def _edit_image(self, source: Tensor, index: int, latents: Tensor | None, noise: Tensor, **options: Any) -> Tensor:
        edited = edit_image(
            self.prior,
            latents,
            noise,
            image=self.view(source, index)[1],
            image_guidance_scale=self.config.condition_scale,
            set_alpha_to_one=self.config.set_alpha_to_one,
            **{"text": self.text, "guidance_scale": self.config.guidance_scale, **options},
        )
        return self._picture(edited, source)

    def _picture(self, latents: Tensor, source: Tensor) -> Tensor:
        """Latents [1,C,h,w] as an image [H,W,3] of the size of `source`."""
        return self.prior.decode(latents)[0].permute(1, 2, 0)[: source.shape[0], : source.shape[1]]

    def known_edit(self, source: Tensor, index: int) -> Tensor | None:
        """The edit that the prior knows of a view's source render, [H,W,3] in [0,1]; None for a prior that learned."""
        return self._known(source, index, self.text) if self.prior.exact else None

    def _known(self, source: Tensor, index: int, text: Any) -> Tensor:
        return self.prior.known_edit(self.view(source, index)[1], text)[0].permute(1, 2, 0)

    def expected(self, source: Tensor, index: int, timestep: int | None = None) -> Tensor | None:
        """Where the rule's mean gradient vanishes at `timestep` (None: where the schedule comes to rest), [H,W,3],
        clamped to [0,1]; None where it is not known or not stable."""
        if not self.prior.exact or self.rule.delivers != "gradient":
            return None
        timesteps = self.resting_timesteps if timestep is None else [timestep]
        rest = fixed_point(self.prior, self.rule, timesteps, *self.scales)
        if rest is None:
            return None
        edit = self._known(source, index, self.text) - self._known(source, index, self.source_text)
        from_mean = source - (self.prior.config.mu + 1.0) / 2.0
        return (source + rest.rho * edit + rest.drift * from_mean).clamp(0, 1)

    def sample(self, source: Tensor, index: int, prompt: str, guidance_scale: float, steps: int) -> Tensor:
        """The prior's own edit of a source render, without any rule: [H,W,3] in [0,1]."""
        text = self.text if prompt == self.prompt else self.prior.embed([prompt])[0]
        noise = self._noise(self.view(source, index)[0], [index], 0)
        return self._edit_image(source, index, None, noise, text=text, guidance_scale=guidance_scale, steps=steps)

    # --- what a checkpoint keeps

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs that is no function of seed and step: the edited pictures of in2n."""
        return {"edits": self.edits.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up the state of an earlier run."""
        self.edits.load_state_dict(state["edits"])
