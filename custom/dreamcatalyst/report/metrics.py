"""Image metrics. A new one is a function with `@metric(...)`: registered, it is a column of every table and a chart."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..loss.image import ssim_map
from ..registry import Registry

METRICS = Registry("metric", __package__)
Images = Float[Tensor, "B H W 3"]
Values = Float[Tensor, "B H W C"]
Weight = Float[Tensor, "B H W 1"]
Means = Float[Tensor, " B"]
Pixels = Callable[[Images, Images], Values]


@dataclass(frozen=True)
class Metric:
    """A measure of an image against a reference that is a mean over pixels.

    name: of its columns, "<name>_<reference>". title, unit: for people. better: "higher" or "lower". identity: its
    value where image and reference are equal. pixels: (image, reference) to a value for each pixel;
    finish: from their mean to the measure. costly: while a run goes, only against the first reference.
    """

    name: str
    title: str
    unit: str
    better: str
    identity: float
    pixels: Pixels
    finish: Callable[[Means], Means] | None = None
    costly: bool = False

    def label(self, what: str) -> str:
        """`what`, and the unit."""
        return f"{what}, {self.unit}" if self.unit else what

    def __call__(self, image: Images, reference: Images, weight: Weight | None = None) -> Means:
        """image, reference in [0,1]; weight in [0,1], or None for all pixels."""
        return self.over(image, reference, [weight])[0]

    def over(self, image: Images, reference: Images, weights: Sequence[Weight | None]) -> list[Means]:
        """The measure under each of several weights, at the price of one."""
        values = self.pixels(image, reference)
        means = [_mean(values, weight) for weight in weights]
        return means if self.finish is None else [self.finish(mean) for mean in means]


def metric(
    name: str,
    *,
    better: str,
    identity: float,
    title: str = "",
    unit: str = "",
    finish: Callable[[Means], Means] | None = None,
    costly: bool = False,
) -> Callable[[Pixels], Metric]:
    """Register a function of pixels under `name`; see Metric. title: the name, if empty. Raises ValueError for a name
    that is taken or cannot begin a column's ("_" ends it), and for another direction than higher and lower."""
    if better not in ("higher", "lower") or "_" in name:
        raise ValueError(f"metric '{name}': better is '{better}', expected higher or lower; the name holds no '_'")

    def add(pixels: Pixels) -> Metric:
        row = Metric(name, title or name, unit, better, identity, pixels, finish, costly)
        METRICS.add(name, row)
        return row

    return add


def _mean(value: Values, weight: Weight | None) -> Means:
    """Mean over pixels and channels, weighted if a weight is given (NaN where it is zero throughout)."""
    if weight is None:
        return value.flatten(1).mean(1)
    weight = weight.expand_as(value).flatten(1)
    return (value.flatten(1) * weight).sum(1) / weight.sum(1)


@metric(
    "psnr", title="PSNR", unit="dB", better="higher", identity=math.inf, finish=lambda mean: -10 * torch.log10(mean)
)
def psnr(image: Images, reference: Images) -> Values:
    """Peak signal-to-noise ratio for a peak of 1; infinite where the images are equal."""
    return (image - reference) ** 2


@metric("ssim", title="SSIM", better="higher", identity=1.0, costly=True)
def ssim(image: Images, reference: Images) -> Values:
    """Structural similarity (Wang et al. 2004), 1 for equal images."""
    return ssim_map(image, reference)


@metric("l1", title="L1", better="lower", identity=0.0)
def l1(image: Images, reference: Images) -> Values:
    """Mean absolute difference."""
    return (image - reference).abs()


def compare(
    image: Float[Tensor, "H W 3"],
    references: Mapping[str, Float[Tensor, "H W 3"]],
    region: Float[Tensor, "H W 1"] | None = None,
    brief: bool = False,
) -> dict[str, float]:
    """Every metric of a picture in [0,1] against each reference, as "<metric>_<reference>".

    region of 0 and 1: where the picture is meant to change. With it also "<metric>_source_outside", against the
    source where nothing should have changed (the drift), and "<metric>_<reference>_inside" against all others. A
    region without a pixel in this view has no score. brief: costly metrics against the first reference only.
    """
    scores = {}
    for name, reference in references.items():
        weights: dict[str, Weight | None] = {name: None}
        if region is not None:
            where, weight = ("outside", 1 - region) if name == "source" else ("inside", region)
            if bool(weight.any()):
                weights[f"{name}_{where}"] = weight[None]
        pair = image[None], reference.to(image)[None].clamp(0, 1)
        for measure in METRICS.parts():
            if brief and measure.costly and name != next(iter(references)):
                continue
            values = measure.over(*pair, list(weights.values()))
            scores |= {f"{measure.name}_{key}": float(value) for key, value in zip(weights, values, strict=True)}
    return scores
