"""Where the prior itself would act: where its prediction with the instruction differs from the one without.

After Mirzaei et al. 2023, "Watch Your Steps", whose relevance map is |eps(x_t, image, text) - eps(x_t, image, no text)|
of InstructPix2Pix, averaged over noise and robustly normalised. No further model is needed, and any prior will do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .. import plugin
from ..config import AtLeastOne, Between, Fraction, NonNegative, PositiveFraction, Seed
from ..data.camera import Cameras
from ..diffusion.api import Row
from ..diffusion.noise import abar_at, add_noise, keyed_noise
from ..errors import ConfigError, PriorError, choose
from ..guidance.guidance import Guidance
from ..kept import stamp
from .api import MaskRequest, Segmenter

NOTHING = 3.7  # times what two noise draws differ by, below which a difference of predictions is none of the edit's
DECIDING = 6  # views that are asked first, and twice, whether the edit is one of everything
FENCE = 1.5  # interquartile ranges beyond the quartiles, from where on values are outliers (Tukey 1977)


@dataclass(frozen=True)
class Answer:
    """Of one view's latents, in units of the prior's predicted noise. relevance: mean over channels, draws
    and levels of the difference |eps(text, image) - eps(no text, image)|. signal: root mean square over channels and
    levels of what is the same in all draws. noise: of what differs from draw to draw, NaN where there was one draw."""

    relevance: Float[Tensor, "h w"]
    signal: Float[Tensor, "h w"]
    noise: Float[Tensor, "h w"]

    @classmethod
    def of(cls, apart: Float[Tensor, "T D C h w"]) -> Answer:
        """From differences of predictions at T levels with D draws."""
        one = apart.shape[1] == 1
        variance = torch.full_like(apart[:, 0], torch.nan) if one else apart.var(dim=1)  # of a single draw
        signal = apart.mean(dim=1).square() - variance / apart.shape[1]  # without what the mean of noise adds
        rms = (each.mean(dim=(0, 1)).clamp(min=0).sqrt() for each in (signal, variance))
        return cls(apart.abs().mean(dim=(0, 1, 2)), *rms)


@dataclass(frozen=True)
class Relevance(Segmenter):
    """Views differ in how much of the edit they show, so all are normalised together: a view in which the instruction
    changes nothing stays empty, where its own maximum would have been made 1."""

    lowest: Between = 0.4  # noise levels that are looked at, as fractions of T: the lowest
    highest: Between = 0.8  # and the highest
    timesteps: AtLeastOne = 2  # levels, evenly spread from lowest to highest
    draws: AtLeastOne = 1  # noise draws per level
    noise: str = "paired"  # each draw with both signs, where what is linear in it cancels; independent: as published
    threshold: Between = 0.5  # of the normalised relevance, in (0,1)
    softness: NonNegative = 0.2  # width of the ramp of the mask around the threshold; 0: a step
    blur: Fraction = 0.01  # standard deviation of a Gaussian blur before it, fraction of the view's longer side
    everywhere: PositiveFraction = 0.08  # an edit of all where the least tenth changes by this share of the 99th
    # percentile, and by far more than nothing does (NOTHING); 1: never
    seed: Seed = 0  # of the noise

    def __post_init__(self) -> None:
        choose("kind of noise", self.noise, ("paired", "independent"), "noise")
        if self.lowest > self.highest:
            raise ConfigError(f"lowest, highest: got {self.lowest} and {self.highest}, expected lowest <= highest.")

    def __call__(self, request: MaskRequest, views: Sequence[int]) -> dict[int, Float[Tensor, "H W"]]:
        guidance = _guidance(request)
        first = views[:: math.ceil(len(views) / DECIDING)]
        asked = {view: self.ask(guidance, request.render(view), view, max(self.draws, 2)) for view in first}
        if self.concerns_all(asked):
            return {view: torch.ones(request.cameras[view].height, request.cameras[view].width) for view in views}
        rest = (view for view in views if view not in asked)
        asked |= {view: self.ask(guidance, request.render(view), view, self.draws) for view in rest}
        maps = normalised({view: asked[view].relevance for view in views})
        return {view: self.mask(values, request.cameras[view]) for view, values in maps.items()}

    def concerns_all(self, asked: Mapping[int, Answer]) -> bool:
        """Whether the instruction changes everything, so that a mask would only leave out what changes least: night
        falls on what is dark already, too. asked: of `ask`, with two draws or more.

        Where an edit changes nothing, predictions still differ between noise draws, and the least tenth of the pixels
        must stand out from that, whatever the model's predictions measure. On the small model it is 1.6 to 2.5 times
        that noise for edits of a thing, and 5 to 16 times for those of everything.
        Unpaired noise is everywhere, and says nothing.
        """
        if self.noise != "paired":
            return False
        signal, noise = pooled(a.signal for a in asked.values()), pooled(a.noise for a in asked.values())
        least, high = np.quantile(signal, [0.1, 0.99])
        above = float(np.quantile(signal / np.maximum(noise, max(1e-6 * high, 1e-30)), 0.1))
        if not (least > self.everywhere * high and above > NOTHING):
            return False
        plugin.info(
            f"mask: the instruction changes everything (the least tenth by {least / high:.2f} of the 99th percentile, "
            f"{above:.1f} times the noise of no change); system.mask.options.everywhere=1 masks nevertheless"
        )
        return True

    def identity(self, request: MaskRequest) -> Any:
        prior = _guidance(request).prior
        return request.prompt, type(prior).__qualname__, prior.config, stamp(getattr(prior.config, "path", None))

    @torch.no_grad()
    def ask(self, guidance: Guidance, source: Float[Tensor, "H W 3"], view: int, draws: int) -> Answer:
        """How the prediction for a source render differs with the instruction from without, over `draws` noise
        draws per level."""
        prior, (latents, condition) = guidance.prior, guidance.encode_source(source, view)
        shape, kind = latents.shape[1:], (latents.dtype, latents.device)
        size, last = max(self.draws, 2), len(prior.alphas_cumprod) - 1
        apart = []
        for t in np.linspace(self.lowest, self.highest, self.timesteps):
            t = round(float(t) * last)
            keys = range(t * size, t * size + draws)
            noise = torch.stack([keyed_noise(self.seed, key, view, shape, *kind) for key in keys])
            noise = torch.cat([noise, -noise]) if self.noise == "paired" else noise
            noisy = add_noise(latents.expand_as(noise), noise, abar_at(prior.alphas_cumprod, t))
            image = prior.stack([condition] * len(noise))
            with_text, without = prior.predict_noise([Row(noisy, guidance.text, image), Row(noisy, None, image)], t)
            apart.append((with_text - without).float().unflatten(0, (-1, draws)).mean(dim=0))  # over both signs
        return Answer.of(torch.stack(apart))

    def mask(self, relevance: Float[Tensor, "h w"], camera: Cameras) -> Float[Tensor, "H W"]:
        """Normalised relevance of latents as a mask in [0,1] of the size of the view."""
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


def pooled(maps: Iterable[Float[Tensor, "h w"]]) -> Float[np.ndarray, " values"]:
    """The values of all views. For numpy's quantiles, which take any number of values; torch.quantile only 2^24."""
    return np.concatenate([m.cpu().numpy().ravel() for m in maps])


def normalised(maps: dict[int, Float[Tensor, "h w"]]) -> dict[int, Float[Tensor, "h w"]]:
    """Relevance of all views together to [0,1]: what lies more than 1.5 interquartile ranges beyond the quartiles is
    clipped, and the rest stretched from its least to its greatest.

    Nothing is clipped below half of the 99th percentile. Where the prior leaves most pixels exactly alone, the
    quartiles lie in rounding errors, and clipping at them would make a mask of those.
    Raises PriorError where the prior does not tell the instruction from none.
    """
    values = pooled(maps.values())
    first, third, high = np.quantile(values, [0.25, 0.75, 0.99])
    least = max(float(values.min()), float(first - FENCE * (third - first)))
    most = min(float(values.max()), max(float(third + FENCE * (third - first)), float(high) / 2))
    if not most - least > 1e-6 * max(most, 1e-6):
        raise PriorError(
            f"mask: the prior's prediction is everywhere the same with the instruction as without (differences from "
            f"{least:.3g} to {most:.3g}). Is the prompt empty? Another instruction, or another kind of mask, is needed"
        )
    return {view: ((m - least) / (most - least)).clamp(0, 1) for view, m in maps.items()}
