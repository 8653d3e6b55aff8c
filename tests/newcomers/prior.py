"""A prior of one's own: whatever it is asked, the edit is one plain colour."""

from dataclasses import dataclass

import torch
from dreamcatalyst.config import Colour
from dreamcatalyst.diffusion.api import PRIORS, Prior
from dreamcatalyst.diffusion.noise import stable_diffusion_schedule


@PRIORS.add("plain")
class Plain(Prior):
    """It believes in this colour where there is an instruction, and in the image itself where there is none."""

    @dataclass(frozen=True)
    class Config:
        colour: Colour = (1.0, 0.0, 0.0)  # RGB in [0,1]

    def __init__(self, config=None, device="cpu"):
        self.colour = 2.0 * torch.tensor((config or self.Config()).colour, device=device)[:, None, None] - 1.0
        self.alphas_cumprod = stable_diffusion_schedule()

    def encode(self, images, noise=None):
        return 2.0 * images - 1.0

    def decode(self, latents):
        return ((latents.detach() + 1.0) / 2.0).clamp(0.0, 1.0)

    def condition(self, images):
        return self.encode(images).detach()

    def embed(self, prompts):
        return [prompt or None for prompt in prompts]

    @torch.no_grad()
    def predict_noise(self, rows, timestep):
        abar = float(self.alphas_cumprod[timestep])
        clean = [self.colour if row.text else 0.0 if row.image is None else row.image for row in rows]
        return [(row.noisy - abar**0.5 * x) / (1.0 - abar) ** 0.5 for row, x in zip(rows, clean, strict=True)]
