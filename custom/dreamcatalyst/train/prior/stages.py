"""The two stages of training: what trains in each, how far each is, and what the second one draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...diffusion.noise import keyed_generator
from .data import Pairs
from .models import TIMESTEPS, Stage, UnetConfig

STAGES = {"autoencoder": ("vae",), "unet": ("unet", "text_encoder")}  # what trains in each, in order


@dataclass
class Progress:
    """How far a stage is. first: the run's step at which it began, None before; seconds: spent in its steps."""

    first: int | None = None
    seconds: float = 0.0

    def at(self, step: int, stage: Stage) -> float:
        """From 0 to 1 over the stage, by its steps, or by its minutes where these are over sooner."""
        if self.first is None:
            return 0.0
        by_time = self.seconds / 60 / stage.minutes if stage.minutes else 0.0
        return min(max((step - self.first) / stage.steps, by_time), 1.0)

    def steps(self, step: int, end: int | None = None) -> int:
        """How many steps were done by the run's `step`, where the stage was over at `end` (None: it is not)."""
        return 0 if self.first is None else (step if end is None else end) - self.first


def unet_inputs(
    pairs: Pairs,
    index: np.ndarray,
    latents: Mapping[str, Tensor],
    latent_std: Tensor,
    tokens: Callable[[str], Tensor],
    config: UnetConfig,
    seed: int,
    number: int,
) -> tuple[Tensor, ...]:
    """Clean scaled latents, image latents, token numbers [B,L], noise and timesteps of step `number`.

    index [B]: which pairs. latents: "source" and "edited" [2n,C,h,w] of all pairs and then of all mirrored ones.
    tokens: a text to its token numbers [L].
    Conditions are dropped as in Brooks et al. 2023, but for one thing: without an instruction and with the image, the
    aim is the image itself. The null instruction then changes nothing, and guidance points from there.
    Timesteps are drawn in proportion to themselves: the noisier, the more of an edit is still to be found.
    """
    rng = np.random.default_rng((seed, number, 1))
    draw, noisiness = rng.random(len(index)), rng.random(len(index)) ** 0.5
    t = torch.from_numpy((TIMESTEPS * noisiness).astype(np.int64))
    text_end, image_end = config.drop_text, config.drop_text + config.drop_image
    no_text = draw < text_end
    no_image = (text_end <= draw) & (draw < image_end)
    neither = (image_end <= draw) & (draw < image_end + config.drop_both)
    place = index + len(pairs) * rng.integers(0, 2, len(index))  # mirrored or not
    source, edited = (latents[kind][place].float() for kind in ("source", "edited"))
    clean = torch.where(_column(no_text), source, edited)
    image = source * _column(~(no_image | neither))
    texts = zip(pairs.instruction[index], no_text | neither, strict=True)
    ids = torch.stack([tokens("" if dropped else str(text)) for text, dropped in texts])
    noise = torch.randn(clean.shape, generator=keyed_generator(seed, "noise", number))
    return clean / latent_std.to(clean), image, ids, noise, t


def cosine(done: float) -> float:
    """The learning rate's share after `done` of a stage, from 1 to 0."""
    return 0.5 * (1 + math.cos(math.pi * done))


def _column(values: np.ndarray) -> Tensor:
    """[B] as [B,1,1,1]."""
    return torch.from_numpy(values)[:, None, None, None]
