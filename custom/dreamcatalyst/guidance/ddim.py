"""Images instead of gradients: the prior's own edits by DDIM, and a rule as a sampler on the latents of one view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion.api import Prior
from ..diffusion.combine import Branch, predict_difference
from ..diffusion.noise import abar_at, add_noise, signal_at
from ..errors import ConfigError
from .distill import distillation_gradient
from .rules import Rule


def ddim_timesteps(first: int, steps: int) -> list[int]:
    """`steps` timesteps from `first` evenly down, each a step of the run to clean latents: 999, 949, ..., 49 for
    (999, 20).

    Noise is to be added at the first of them: the published codes add it at a higher level than where they begin.
    Source: Lin et al. 2024, "Common diffusion noise schedules and sample steps are flawed" (trailing spacing).
    """
    if not 1 <= steps <= first + 1:
        raise ConfigError(f"diffusion_steps: got {steps}, expected 1 to {first + 1} steps from timestep {first}.")
    return [first - (first + 1) * i // steps for i in range(steps)]


@torch.no_grad()
def denoise(
    prior: Prior,
    noisy: Float[Tensor, "B C h w"],
    timesteps: Sequence[int],
    *,
    image: Any,
    text: Any,
    guidance_scale: float,
    image_guidance_scale: float,
    set_alpha_to_one: bool = True,
) -> Float[Tensor, "B C h w"]:
    """Deterministic DDIM (Song et al. 2021, equation 12, eta = 0) along `timesteps` to clean latents.

    noisy: latents at the noise level of timesteps[0]. set_alpha_to_one (as diffusers calls it): end at abar
    = 1, without noise; else at that of timestep 0, as Stable Diffusion's scheduler is configured.
    Raises PriorError at a level without signal.
    """
    x, end = noisy, 1.0 if set_alpha_to_one else abar_at(prior.alphas_cumprod, 0)
    for i, t in enumerate(timesteps):
        abar = signal_at(prior.alphas_cumprod, t)
        after = abar_at(prior.alphas_cumprod, timesteps[i + 1]) if i + 1 < len(timesteps) else end
        branch = Branch(x, text, image, guidance_scale, image_guidance_scale)
        eps = predict_difference(prior, branch, None, t).to(x.dtype)
        clean = (x - (1.0 - abar) ** 0.5 * eps) / abar**0.5
        x = add_noise(clean, eps, after)
    return x


@torch.no_grad()
def edit_image(
    prior: Prior,
    latents: Float[Tensor, "B C h w"] | None,
    noise: Float[Tensor, "B C h w"],
    *,
    image: Any,
    text: Any,
    timestep: int | None = None,
    steps: int = 20,
    guidance_scale: float = 7.5,
    image_guidance_scale: float = 1.5,
    set_alpha_to_one: bool = True,
) -> Float[Tensor, "B C h w"]:
    """The prior's edit, as latents: of `latents` noised to `timestep` (Haque et al. 2023), or, where there
    are none, from `noise` alone at the prior's last timestep (Brooks et al. 2023).

    noise: standard normal; image, text: conditions. steps: of DDIM, fewer where there are not as many
    timesteps. set_alpha_to_one: see `denoise`.
    """
    first = len(prior.alphas_cumprod) - 1 if timestep is None else timestep
    noisy = noise if latents is None else add_noise(latents, noise, abar_at(prior.alphas_cumprod, first))
    return denoise(
        prior,
        noisy,
        ddim_timesteps(first, min(steps, first + 1)),
        image=image,
        text=text,
        guidance_scale=guidance_scale,
        image_guidance_scale=image_guidance_scale,
        set_alpha_to_one=set_alpha_to_one,
    )


@torch.no_grad()
def sample_rule(
    prior: Prior,
    rule: Rule,
    x_src: Float[Tensor, "B C h w"],
    timesteps: Sequence[int],
    noise: Callable[[int], Float[Tensor, "B C h w"]],
    *,
    start: Float[Tensor, "B C h w"] | None = None,
    **conditions: Any,
) -> Float[Tensor, "B C h w"]:
    """A gradient rule as a sampler on latents, from `start` (the source latents x_src where None):

    x <- x - sqrt(1-abar)/sqrt(abar) [(eps_edit - eps_ref) + (b/a) (x - x_src)] at each of `timesteps`, high to low.
    Without the second term this is DreamCatalyst's equation 13, where eps_ref reproduces the noise.
    noise(i): the noise of step i (from 0). conditions: those of distillation_gradient (image, text, scales).
    Whether the steps shrink an error is known on the closed form: fixed_point.contraction.
    """
    x = x_src if start is None else start
    for i, t in enumerate(timesteps):
        abar, (a, _) = signal_at(prior.alphas_cumprod, t), rule.weights(t, prior.alphas_cumprod)
        if a == 0.0:
            raise ConfigError(f"rule '{rule.name}' has no weight on the edit at timestep {t}, so it cannot sample.")
        gradient = distillation_gradient(prior, rule, x, x_src, timestep=t, noise=noise(i), **conditions)
        x = x - (((1.0 - abar) / abar) ** 0.5 / a * gradient).to(x.dtype)
    return x
