"""Measures of images against images. Each is registered by name with its unit and its direction."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..loss.image import ssim_map
from ..registry import Registry

METRICS = Registry("metric", __package__)


@dataclass(frozen=True)
class Metric:
    """A measure that is a mean over pixels: of what, its unit, whether more of it is better.

    pixels: (image, reference) [B,H,W,3] to a value for each pixel, [B,H,W,C]; finish: from their mean to the measure.
    """

    name: str
    unit: str
    higher_is_better: bool
    pixels: Callable[[Tensor, Tensor], Tensor]
    finish: Callable[[Tensor], Tensor] | None = None

    def __call__(self, image: Tensor, reference: Tensor, weight: Tensor | None = None) -> Tensor:
        """image, reference [B,H,W,3] in [0,1]; weight [B,H,W,1] in [0,1] or None for all pixels. Returns [B]."""
        return self.over(image, reference, [weight])[0]

    def over(self, image: Tensor, reference: Tensor, weights: Sequence[Tensor | None]) -> list[Tensor]:
        """The measure under each of several weights, at the price of one."""
        values = self.pixels(image, reference)
        means = [_mean(values, weight) for weight in weights]
        return means if self.finish is None else [self.finish(mean) for mean in means]


def metric(name: str, unit: str, *, better: str, finish: Callable[[Tensor], Tensor] | None = None) -> Callable:
    """Register a function of pixels under `name` (see Metric); better: "higher" or "lower"."""

    def add(pixels: Callable) -> Metric:
        made = Metric(name, unit, better == "higher", pixels, finish)
        METRICS.add(name, made)
        return made

    return add


def _mean(value: Tensor, weight: Tensor | None) -> Tensor:
    """Mean over pixels and channels of [B,H,W,C], weighted if a weight is given (NaN where it is zero throughout)."""
    if weight is None:
        return value.flatten(1).mean(1)
    weight = weight.expand_as(value).flatten(1)
    return (value.flatten(1) * weight).sum(1) / weight.sum(1)


@metric("psnr", "dB", better="higher", finish=lambda mean: -10 * torch.log10(mean))
def psnr(image: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio for a peak of 1; infinite where the images are equal."""
    return (image - reference) ** 2


@metric("ssim", "", better="higher")
def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004), 1 for equal images."""
    return ssim_map(image, reference)


@metric("l1", "", better="lower")
def l1(image: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (image - reference).abs()


def compare(
    image: Tensor, references: Mapping[str, Tensor], region: Tensor | None = None, brief: bool = False
) -> dict[str, float]:
    """Every metric of a picture [H,W,3] in [0,1] against each reference, as "<metric>_<reference>".

    region [H,W,1] of 0 and 1: where the picture is meant to change. With it also "<metric>_source_outside", against the
    source where nothing should have changed (the drift), and "<metric>_<reference>_inside" against all others. A
    region without a pixel in this view has no score. brief: SSIM, which takes most of the time, against the first
    reference only.
    """
    scores = {}
    for name, reference in references.items():
        weights: dict[str, Tensor | None] = {name: None}
        if region is not None:
            where, weight = ("outside", 1 - region) if name == "source" else ("inside", region)
            if bool(weight.any()):
                weights[f"{name}_{where}"] = weight[None]
        pair = image[None], reference.to(image)[None].clamp(0, 1)
        for kind in ("psnr", "ssim", "l1"):
            if brief and kind == "ssim" and name != next(iter(references)):
                continue
            values = METRICS.get(kind).over(*pair, list(weights.values()))
            scores |= {f"{kind}_{key}": float(value) for key, value in zip(weights, values, strict=True)}
    return scores
