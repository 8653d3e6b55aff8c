"""The forward process: the noise schedule, noising, and random numbers that are a function of where they are used."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from ..errors import PriorError

# variable             symbol in Ho et al. 2020
# betas[t]             beta_{t+1}       (ours counts from 0, theirs from 1)
# alphas_cumprod[t]    bar alpha_{t+1}


def stable_diffusion_schedule(
    steps: int = 1000, beta_start: float = 0.00085, beta_end: float = 0.012
) -> Float64[Tensor, " {steps}"]:
    """alphas_cumprod of Stable Diffusion: beta is linear in its square root (Rombach et al. 2022)."""
    betas = torch.linspace(beta_start**0.5, beta_end**0.5, steps, dtype=torch.float64) ** 2
    return torch.cumprod(1.0 - betas, dim=0)


def abar_at(alphas_cumprod: Float[Tensor, " T"], timestep: int) -> float:
    """alphas_cumprod at index `timestep` as a number. Raises PriorError outside 0..T-1, where indexing would wrap."""
    if not 0 <= timestep < len(alphas_cumprod):
        raise PriorError(f"timestep {timestep} is outside the prior's schedule: 0..{len(alphas_cumprod) - 1}")
    return float(alphas_cumprod[timestep])


def signal_at(alphas_cumprod: Float[Tensor, " T"], timestep: int) -> float:
    """As `abar_at`, for those who divide by it. Raises PriorError where it is 0: with zero terminal SNR (Lin et al.
    2024), the last noisy latents hold nothing of the image, and a noise prediction says nothing about it."""
    abar = abar_at(alphas_cumprod, timestep)
    if abar <= 0.0:
        raise PriorError(
            f"timestep {timestep} of the prior's schedule holds no signal (abar = 0: zero terminal SNR), so that a "
            "noise prediction does not tell the image. Stay below it: lower max_step_percent (or edit_max_percent)"
        )
    return abar


def add_noise(latents: Float[Tensor, "*shape"], noise: Float[Tensor, "*shape"], abar: float) -> Float[Tensor, "*shape"]:
    """x_t = sqrt(abar) x_0 + sqrt(1 - abar) eps (Ho et al. 2020, equation 4)."""
    return abar**0.5 * latents + (1.0 - abar) ** 0.5 * noise


def keyed_generator(seed: int, *key: int | str) -> torch.Generator:
    """A CPU generator whose stream is a pure function of (seed, *key); different keys give unrelated streams."""
    # int() makes one of Python's, NumPy's and torch's integers, which print differently.
    parts = tuple(part if isinstance(part, str) else int(part) for part in (seed, *key))
    digest = hashlib.blake2b(repr(parts).encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little", signed=True))


def keyed_noise(
    seed: int,
    step: int,
    view: int,
    shape: Sequence[int],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Float[Tensor, ...]:
    """Standard normal noise of `shape`, a pure function of (seed, step, view).

    It is drawn on the CPU in float32 whatever the device and precision, so that a run gives the same noise on every
    machine, and a resumed run the noise that an uninterrupted one would have had. For several views, stack one draw of
    [C,h,w] per view: the result then does not depend on how views were batched.
    """
    noise = torch.randn(tuple(shape), generator=keyed_generator(seed, "noise", step, view))
    return noise.to(device=device, dtype=dtype)
