"""Where the prior itself would act: where its prediction with the instruction differs from the one without.

After Mirzaei et al. 2023, "Watch Your Steps", whose relevance map is |eps(x_t, image, text) - eps(x_t, image, no text)|
of InstructPix2Pix, averaged over noise and robustly normalised. No further model is needed, and any prior will do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from .. import plugin
from ..diffusion.api import Row
from ..diffusion.noise import abar_at, add_noise, keyed_noise
from ..errors import ConfigError, PriorError, choose
from ..guidance.guidance import Guidance
from .api import MaskRequest, Segmenter
from .cache import stamp

UNMOVED = 0.02  # mean difference of predicted noise, in its standard deviations, below which a pixel is left alone
FENCE = 1.5  # interquartile ranges beyond the quartiles, from where on values are outliers (Tukey 1977)


@dataclass(frozen=True)
class Relevance(Segmenter):
    """Views differ in how much of the edit they show, so all are normalised together: a view in which the instruction
    changes nothing stays empty, where its own maximum would have been made 1."""

    lowest: float = 0.4  # noise levels that are looked at, as fractions of T: the lowest
    highest: float = 0.8  # and the highest
    timesteps: int = 3  # levels, evenly spread from lowest to highest
    draws: int = 2  # noise draws per level
    noise: str = "paired"  # each draw with both signs, where what is linear in it cancels; independent: as published
    threshold: float = 0.5  # of the normalised relevance, in (0,1)
    softness: float = 0.2  # width of the ramp of the mask around the threshold; 0: a step
    blur: float = 0.01  # standard deviation of a Gaussian blur before it, fraction of the view's longer side
    everywhere: float = 0.08  # an edit of all where the least tenth has this share of the 99th percentile; 1: never
    seed: int = 0  # of the noise

    def __post_init__(self) -> None:
        choose("kind of noise", self.noise, ("paired", "independent"), "noise")
        if not 0 < self.lowest <= self.highest < 1:
            raise ConfigError(
                f"lowest, highest: got {self.lowest} and {self.highest}, expected 0 < lowest <= highest < 1."
            )
        for name in ("timesteps", "draws"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name}: got {getattr(self, name)}, expected 1 or more.")
        if not 0 < self.threshold < 1 or self.softness < 0 or self.blur < 0:
            raise ConfigError("threshold must lie between 0 and 1, softness and blur must not be negative.")
        if not 0 < self.everywhere <= 1:
            raise ConfigError(f"everywhere: got {self.everywhere}, expected more than 0 and at most 1 (1: never).")

    def __call__(self, request: MaskRequest, views: Sequence[int]) -> dict[int, Tensor]:
        guidance = _guidance(request)
        maps = {view: self.difference(guidance, request.render(view), view) for view in views}
        if self.concerns_all(maps):
            return {view: torch.ones(request.cameras[view].height, request.cameras[view].width) for view in views}
        return {view: self.mask(values, request.cameras[view]) for view, values in normalised(maps).items()}

    def concerns_all(self, maps: dict[int, Tensor]) -> bool:
        """Whether the instruction changes everything, so that a mask would only leave out what changes least: night
        falls on what is dark already, too. Unpaired noise is everywhere, and says nothing. maps: of `difference`."""
        if self.noise != "paired":
            return False
        least, high = np.quantile(pooled(maps), [0.1, 0.99])
        if least <= max(self.everywhere * high, UNMOVED):
            return False
        plugin.info(
            "mask: the instruction changes everything (the least tenth of the relevance is "
            f"{least / high:.2f} of its 99th percentile); system.mask.options.everywhere=1 masks nevertheless"
        )
        return True

    def identity(self, request: MaskRequest) -> Any:
        prior = _guidance(request).prior
        return request.prompt, type(prior).__qualname__, prior.config, stamp(getattr(prior.config, "path", None))

    @torch.no_grad()
    def difference(self, guidance: Guidance, source: Tensor, view: int) -> Tensor:
        """|eps(text, image) - eps(no text, image)| of a source render [H,W,3], mean over channels, draws and levels:
        [h,w] of latents, cut to what lies in the image."""
        prior, (latents, condition) = guidance.prior, guidance.view(source, view)
        shape, kind = latents.shape[1:], (latents.dtype, latents.device)
        total = torch.zeros(shape[1:], dtype=torch.float32, device=latents.device)
        steps = len(prior.alphas_cumprod)
        for t in np.linspace(self.lowest, self.highest, self.timesteps):
            t = round(float(t) * (steps - 1))
            keys = range(t * self.draws, (t + 1) * self.draws)
            noise = torch.stack([keyed_noise(self.seed, key, view, shape, *kind) for key in keys])
            noise = torch.cat([noise, -noise]) if self.noise == "paired" else noise
            noisy = add_noise(latents.expand_as(noise), noise, abar_at(prior.alphas_cumprod, t))
            image = prior.stack([condition] * len(noise))
            with_text, without = prior.predict_noise([Row(noisy, guidance.text, image), Row(noisy, None, image)], t)
            apart = (with_text - without).float().unflatten(0, (-1, self.draws)).mean(dim=0)  # over both signs
            total += apart.abs().mean(dim=(0, 1))
        return total / self.timesteps

    def mask(self, relevance: Tensor, camera: Any) -> Tensor:
        """Normalised relevance [h,w] of latents as a mask [H,W] in [0,1] of the size of the view."""
        height, width = camera.height, camera.width
        factor = math.ceil(height / relevance.shape[0])  # latents may reach beyond the image on the right and below
        size = relevance.shape[1] * factor, relevance.shape[0] * factor
        large = cv2.resize(relevance.cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        if self.blur > 0:
            large = cv2.GaussianBlur(large, (0, 0), self.blur * max(width, height), borderType=cv2.BORDER_REPLICATE)
        ramp = (torch.from_numpy(np.ascontiguousarray(large)) - self.threshold) / max(self.softness, 1e-6)
        return (ramp + 0.5).clamp(0, 1)


def _guidance(request: MaskRequest) -> Guidance:
    if request.guidance is None:
        raise ConfigError("system.mask.kind: relevance asks an edit's prior, and there is none. Choose another kind")
    return request.guidance


def pooled(maps: dict[int, Tensor]) -> np.ndarray:
    """The values of all views. For numpy's quantiles, which take any number of values; torch.quantile only 2^24."""
    return np.concatenate([m.cpu().numpy().ravel() for m in maps.values()])


def normalised(maps: dict[int, Tensor]) -> dict[int, Tensor]:
    """Relevance of all views together to [0,1]: what lies more than 1.5 interquartile ranges beyond the quartiles is
    clipped, and the rest stretched from its least to its greatest.

    Nothing is clipped below half of the 99th percentile. Where the prior leaves most pixels exactly alone, the
    quartiles lie in rounding errors, and clipping at them would make a mask of those.
    Raises PriorError where the prior does not tell the instruction from none.
    """
    values = pooled(maps)
    first, third, high = np.quantile(values, [0.25, 0.75, 0.99])
    least = max(float(values.min()), float(first - FENCE * (third - first)))
    most = min(float(values.max()), max(float(third + FENCE * (third - first)), float(high) / 2))
    if not most - least > 1e-6 * max(most, 1e-6):
        raise PriorError(
            f"mask: the prior's prediction is everywhere the same with the instruction as without (differences from "
            f"{least:.3g} to {most:.3g}). Is the prompt empty? Another instruction, or another kind of mask, is needed"
        )
    return {view: ((m - least) / (most - least)).clamp(0, 1) for view, m in maps.items()}
