"""Noise levels and guidance scales: the forward process, the rules' gradients and their weights against float64."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from dreamcatalyst.diffusion.api import Row
from dreamcatalyst.diffusion.closed_form import ClosedForm, ClosedFormConfig
from dreamcatalyst.diffusion.combine import Branch, predict_difference
from dreamcatalyst.diffusion.noise import add_noise, keyed_noise, stable_diffusion_schedule
from dreamcatalyst.errors import ConfigError, NumericalError, PriorError
from dreamcatalyst.guidance.ddim import denoise, sample_rule
from dreamcatalyst.guidance.distill import distillation_gradient
from dreamcatalyst.guidance.rules import get_rule, gradient_rules, pds_coefficients, pds_coefficients_from_betas
from torch import Tensor

from .cases import Case, Check, compare, refused, worst

ABAR = stable_diffusion_schedule()
T = len(ABAR)
SHAPE = (1, 3, 5, 4)
GRADIENT_RULES = gradient_rules()
PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def images(seed: int = 0) -> tuple[Tensor, Tensor]:
    """A source and an edited image [1,3,5,4] in [0,1], float64."""
    generator = torch.Generator().manual_seed(seed)
    source = torch.rand(SHAPE, generator=generator, dtype=torch.float64)
    return source, (source + 0.2 * torch.randn(SHAPE, generator=generator, dtype=torch.float64)).clamp(0, 1)


class Rounding(ClosedForm):
    """The exact prior, which is given its noisy latents in float32 but answers in float64."""

    def predict_noise(self, rows: Sequence[Row], timestep: int) -> list[Tensor]:
        return super().predict_noise([replace(row, noisy=row.noisy.float().double()) for row in rows], timestep)


class Half(ClosedForm):
    """The exact prior, which answers in fp16."""

    def predict_noise(self, rows: Sequence[Row], timestep: int) -> list[Tensor]:
        return [prediction.half() for prediction in super().predict_noise(rows, timestep)]


def gradient(rule: str, timestep: int, dtype: torch.dtype, rounded: torch.dtype | None, abar: Tensor = ABAR, **changes):
    """g of a rule in `dtype`, of images and noise that were first rounded to `rounded` (None: not; otherwise what the
    prior sees is rounded to float32, too)."""
    tensors = [*images(), keyed_noise(0, 0, 0, SHAPE, torch.float64) * (1 + 1e-10)]
    source, render, noise = (t.to(rounded or t.dtype).to(dtype) for t in tensors)
    options = {"s": 0.05, "s_image": 0.4, "s_null": 0.9, "mu": 0.2, **changes.pop("prior", {})}
    kind = Rounding if rounded is not None and dtype == torch.float64 else ClosedForm
    prior = kind(ClosedFormConfig(**options), alphas_cumprod=abar)
    text = prior.embed(["Make it sunset"])[0]
    named = get_rule(rule, **changes.pop("parameters", {}))
    given = {"guidance_scale": 7.5, "image_guidance_scale": 1.5, "text": text, **changes}
    return distillation_gradient(
        prior,
        named,
        prior.encode(render),
        prior.encode(source),
        image=prior.condition(source),
        timestep=timestep,
        noise=noise,
        **given,
    )


def at_levels(
    rule: str, timesteps: Sequence[int] = range(T), precision: str = "fp32", abar: Tensor = ABAR, **changes: Any
) -> Callable[[], list[Check]]:
    """A case: the gradient of a rule at these timesteps (those below the gap of PDS left out); the worst one counts."""

    def run() -> list[Check]:
        low = PRECISIONS[precision]
        used = [t for t in timesteps if rule != "pds" or t >= 2]

        def one(t: int) -> Check:
            truth = gradient(rule, t, torch.float64, None, abar, **changes)
            rounded = gradient(rule, t, torch.float64, low, abar, **changes)
            return compare(f"t={t}", gradient(rule, t, low, low, abar, **changes), truth, rounded)

        return [worst("gradient", {f"t={t}": one(t) for t in used})]

    return run


def noised(precision: str) -> Callable[[], list[Check]]:
    """A case: x_t at every timestep."""

    def run() -> list[Check]:
        low, x, noise = PRECISIONS[precision], images()[0] * 2 - 1, keyed_noise(0, 0, 0, SHAPE, torch.float64)
        checks = {}
        for t in range(T):
            abar = float(ABAR[t])
            rounded = add_noise(x.to(low).double(), noise.to(low).double(), abar)
            got = add_noise(x.to(low), noise.to(low), abar)
            checks[f"t={t}"] = compare("x_t", got, add_noise(x, noise, abar), rounded)
        return [worst("x_t", checks)]

    return run


def ended(low: float | None = None, high: float | None = None) -> Tensor:
    """Stable Diffusion's schedule whose first level is `low` and whose last is `high`, where given."""
    abar = ABAR.clone()
    if low is not None:
        abar[0] = low
    if high is not None:
        abar[-1] = high
    return abar


def nothing_new(scale: float) -> Callable[[], list[Check]]:
    """A case: an instruction that changes nothing, of a prior as sure of it as of the image. Whatever its scale, the
    guided prediction is the one without text."""

    def run() -> list[Check]:
        prior = ClosedForm(ClosedFormConfig(s=0.4, s_image=0.4, s_null=0.9))

        def predicted(dtype: torch.dtype, rounded: torch.dtype, guidance: float) -> Tensor:
            x, noise = images()[0].to(rounded).to(dtype), keyed_noise(0, 0, 0, SHAPE).to(rounded).to(dtype)
            condition, text = prior.condition(x), prior.embed(["Make it sunset"])[0]
            condition._edited[text.name] = condition.latents.clone()
            noisy = add_noise(x, noise, float(ABAR[500]))
            return predict_difference(prior, Branch(noisy, text, condition, guidance, 1.5), None, 500)

        truth, rounded = predicted(torch.float64, torch.float64, 0.0), predicted(torch.float64, torch.float32, 0.0)
        return [compare("prediction", predicted(torch.float32, torch.float32, scale), truth, rounded)]

    return run


def pds_in_float32() -> list[Check]:
    """PDS's weights from float32 betas at every timestep, in units of their size: Phi goes from 20 down
    to 0.004, Psi from 1 to 0.08."""
    betas = 1 - ABAR / torch.cat([torch.ones(1, dtype=torch.float64), ABAR[:-1]])
    half, checks = betas.float(), {}
    for t in range(2, T):
        truth = torch.stack(pds_coefficients_from_betas(betas, t))
        rounded = torch.stack(pds_coefficients_from_betas(half.double(), t)) / truth
        got = torch.stack(pds_coefficients_from_betas(half, t)).double() / truth
        checks[f"t={t}"] = compare("weights", got, torch.ones(2, dtype=torch.float64), rounded)
    return [worst("weights", checks)]


def refusals() -> dict[str, Callable[[], list[Check]]]:
    """Cases of what is not defined at the ends of a schedule, or not held by a precision."""
    zero, prior = ended(high=0.0), ClosedForm(ClosedFormConfig(s_image=0.4), alphas_cumprod=ended(high=0.0))
    x = images()[0] * 2 - 1
    given = {"image": prior.condition(images()[0]), "text": None, "guidance_scale": 1.0, "image_guidance_scale": 1.5}

    def overflowing() -> None:
        source, prior = images()[0].half(), Half(ClosedFormConfig(s=1e-3, s_image=0.4))
        far = {"image": prior.condition(source), "text": prior.embed(["Make it sunset"])[0], "timestep": 3}
        distillation_gradient(prior, get_rule("dds"), source * 6e4, source, noise=source, guidance_scale=7.5, **far)

    return {
        "zero terminal SNR: weights of PDS": lambda: [
            refused(ConfigError, "signal", lambda: pds_coefficients(zero, T - 1))
        ],
        "zero terminal SNR: DDIM from the last level": lambda: [
            refused(PriorError, "signal", lambda: denoise(prior, x, [T - 1, 500], **given))
        ],
        "zero terminal SNR: a rule as a sampler": lambda: [
            refused(
                PriorError,
                "signal",
                lambda: sample_rule(prior, get_rule("dds"), x, [T - 1, 500], lambda i: torch.zeros_like(x), **given),
            )
        ],
        "PDS at and below its gap": lambda: [
            refused(ConfigError, "noiseless", lambda t=t: pds_coefficients(ABAR, t)) for t in (0, 1)
        ],
        "timesteps outside of the schedule": lambda: [
            refused(PriorError, "outside", lambda t=t: gradient("dds", t, torch.float32, None)) for t in (-1, T)
        ],
        "predictions that fp16 cannot hold": lambda: [refused(NumericalError, "not finite", overflowing)],
    }


ENDS = (0, T - 1)
SOME = (0, 1, 2, 3, 5, 10, 21, 50, 101, 201, 301, 501, 701, 901, 950, T - 1)
CASES = [
    Case("noise", name, run)
    for name, run in {
        **{f"noise added at every t, {name}": noised(name) for name in PRECISIONS},
        **{f"{rule}, every t": at_levels(rule) for rule in GRADIENT_RULES},
        **{f"dreamcatalyst, {name}": at_levels("dreamcatalyst", SOME, name) for name in ("bf16", "fp16")},
        **{f"pds, {name}": at_levels("pds", SOME, name) for name in ("bf16", "fp16")},
        **{
            f"guidance scale {w:g}, {rule}": at_levels(rule, SOME, guidance_scale=w)
            for w in (0.0, 1e-6, 1e3, 1e6)
            for rule in ("dreamcatalyst", "pds")
        },
        "guidance scale 1e6, bf16": at_levels("dreamcatalyst", SOME, "bf16", guidance_scale=1e6),
        "both scales 1e6": at_levels("dreamcatalyst", SOME, guidance_scale=1e6, image_guidance_scale=1e6),
        "guidance scale 1e3 of an instruction that changes nothing": nothing_new(1e3),
        "guidance scale 1e6 of an instruction that changes nothing": nothing_new(1e6),
        "weights of PDS in float32, every t": pds_in_float32,
        **{
            f"pds with an implicit step of {h:g}": at_levels("pds", SOME, parameters={"implicit_step": h})
            for h in (1e-6, 1.0, 1e6)
        },
        "abar to 1: 1 - 1e-12 at the first level": at_levels("dds", ENDS, abar=ended(low=1 - 1e-12)),
        "abar of 1 at the first level": at_levels("dreamcatalyst", ENDS, abar=ended(low=1.0)),
        "abar to 0: 1e-12 at the last level": at_levels("dreamcatalyst", ENDS, abar=ended(high=1e-12)),
        "abar to 0: weights of PDS at 1e-12": at_levels("pds", ENDS, abar=ended(high=1e-12)),
        "abar of 0 at the last level": at_levels("dds", ENDS, abar=ended(high=0.0)),
        "a prior that is sure to 1e-6": at_levels("dreamcatalyst", SOME, prior={"s": 1e-6}),
        "a prior that knows nothing, spread 1e6": at_levels("dreamcatalyst", SOME, prior={"s": 1e6}),
        **refusals(),
    }.items()
]
