"""Score distillation: the gradient that a rule gives on latents, and the loss that carries it."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion.api import Prior
from ..diffusion.combine import Branch, difference_rows, predict_difference
from ..diffusion.noise import abar_at, add_noise
from ..errors import ConfigError, NumericalError, PriorError
from .rules import EDIT_NULL, NOISE, SOURCE, SOURCE_NULL, Replacement, Rule


@torch.no_grad()
def distillation_gradient(
    prior: Prior,
    rule: Rule,
    x: Float[Tensor, "B C h w"],
    x_src: Float[Tensor, "B C h w"] | None,
    *,
    image: Any,
    text: Any,
    timestep: int,
    noise: Float[Tensor, "B C h w"],
    source_text: Any = None,
    guidance_scale: float = 7.5,
    image_guidance_scale: float = 1.5,
) -> Float[Tensor, "B C h w"]:
    """g = a(t) (eps_edit - eps_ref) + b(t) (x - x_src) on latents, without graph.

    x, x_src: latents of the edited and of the source render (x_src may be None for a rule without source).
    image: `prior.condition` of the source; text, source_text: from `prior.embed`, None for the null instruction
    (source_text is used by dds and pds). timestep: index 0..T-1. noise: the same for both branches.
    The result is float32, float64 where x is. Half-precision latents are noised in float32: at high noise all that x
    and x_src differ by is below the last digit of a half-precision x_t.
    A step with a(t) = 0 does not call the prior. Raises ConfigError where the rule lacks its source,
    PriorError where the prior cannot serve the rule, NumericalError where g is not finite.
    """
    check_prior(rule, prior)
    a, b = rule.weights(timestep, prior.alphas_cumprod)
    _check_latents(rule, x, x_src, noise, b)
    full = torch.promote_types(x.dtype, torch.float32)
    x, noise = x.to(full), noise.to(full)
    x_src = x if x_src is None else x_src.to(full)  # None: nothing below reads it, _check_latents has seen to that
    gradient = torch.zeros_like(x)
    if a != 0.0:
        abar = abar_at(prior.alphas_cumprod, timestep)
        scales = (guidance_scale, image_guidance_scale)
        edit = Branch(add_noise(x, noise, abar), text, image, *scales)
        reference = _reference(rule, edit, x_src, noise, abar, source_text)
        gradient += a * predict_difference(prior, edit, reference, timestep)
        if rule.reference == NOISE:
            gradient -= a * noise
    if b != 0.0:
        gradient += b * (x - x_src)
    _check_finite(rule, gradient, timestep)
    return gradient


def network_rows(
    prior: Prior, rule: Rule, text: Any, source_text: Any, guidance_scale: float, image_guidance_scale: float
) -> int:
    """How many rows one step of the rule asks of the prior for each view."""
    latents, other = torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)
    edit = Branch(latents, text, object(), guidance_scale, image_guidance_scale)
    reference = _reference(rule, edit, other, torch.zeros(1, 1, 1, 1), 0.5, source_text)
    return len(difference_rows(edit, reference, prior.takes_image))


def _reference(
    rule: Rule,
    edit: Branch,
    x_src: Float[Tensor, "B C h w"],
    noise: Float[Tensor, "B C h w"],
    abar: float,
    source_text: Any,
) -> Branch | None:
    """The branch of eps_ref, None where it is the injected noise."""
    scales = (edit.guidance_scale, edit.image_guidance_scale)
    if rule.reference == EDIT_NULL:
        return Branch(edit.noisy, None, edit.image, *scales)
    if rule.reference == SOURCE_NULL:
        return Branch(add_noise(x_src, noise, abar), None, edit.image, *scales)
    if rule.reference == SOURCE:
        return Branch(add_noise(x_src, noise, abar), source_text, edit.image, *scales)
    return None


def distillation_loss(
    x: Float[Tensor, "B C h w"], gradient: Float[Tensor, "B C h w"], reduction: str = "mean"
) -> Float[Tensor, ""]:
    """0.5 * mean of (x - stopgrad(x - g))^2, whose gradient in x is g divided by the number of elements of x.

    reduction "mean": the balance against other losses does not change with resolution. "sum": the sum divided by the
    batch size, gradient g / B, as the published 3DGS code has it. It is x - stopgrad(x) + g, where g does not round.
    """
    residual = x - x.detach() + gradient
    if reduction == "mean":
        return 0.5 * residual.square().mean()
    if reduction == "sum":
        return 0.5 * residual.square().sum() / x.shape[0]
    raise ConfigError(f"system.guidance.reduction: unknown reduction '{reduction}'. Known: mean, sum.")


def check_prior(rule: Rule | Replacement, prior: Prior) -> None:
    """Raise PriorError where `prior` cannot serve `rule`: cheap, to be asked before any long work."""
    if rule.needs_image and not prior.takes_image:
        raise PriorError(
            f"rule '{rule.name}' compares predictions with and without an image, which a text-to-image prior does not "
            "take. Use an image-editing prior (ip2p, closed-form), or the rule sds, dds or pds"
        )


def _check_latents(
    rule: Rule,
    x: Float[Tensor, "B C h w"],
    x_src: Float[Tensor, "B C h w"] | None,
    noise: Float[Tensor, "B C h w"],
    b: float,
) -> None:
    if x_src is None and (b != 0.0 or rule.reference in (SOURCE, SOURCE_NULL)):
        raise ConfigError(f"rule '{rule.name}' needs the latents of the source render and got none")
    for name, other in (("x_src", x_src), ("noise", noise)):
        if other is not None and other.shape != x.shape:
            raise PriorError(f"latents x {tuple(x.shape)} and {name} {tuple(other.shape)} must have one shape")


def _check_finite(rule: Rule, gradient: Float[Tensor, "B C h w"], timestep: int) -> None:
    bad = int((~torch.isfinite(gradient)).sum())
    if bad:
        raise NumericalError(
            f"guidance '{rule.name}': {bad} of {gradient.numel()} elements of the gradient are not finite at timestep "
            f"{timestep}. A half-precision prior overflows so: use fp32 or bf16, or a lower guidance scale"
        )
