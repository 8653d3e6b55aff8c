"""Image operators: what an instruction does to an image in closed form, on OpenCV.

The pixel-wise ones are smooth colour maps, the same for a surface point in every view, so that one scene can satisfy
all views; the others (sketches, paint) depend on the neighbourhood in the image, and no scene can.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from ..errors import PriorError, nearest

Picture = Float[ndarray, "H W 3"]
LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, as cv2.COLOR_RGB2GRAY


@dataclass(frozen=True)
class Instruction:
    """What a text asks for, by its name."""

    name: str


@dataclass(frozen=True)
class Operator(Instruction):
    """One instruction's effect in the image.

    name: what it makes. phrases: the words that name it, without the filling ones. pixelwise: each output pixel is a
    function of the same input pixel. apply: RGB in [0,1], float32 or float64, to the same.
    """

    phrases: tuple[str, ...]
    pixelwise: bool
    apply: Callable[[Picture], Picture]

    @torch.no_grad()
    def __call__(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """T(images): RGB in [0,1] to the same, without graph; computed in float32, float64 for float64."""
        wide = images.detach().clamp(0.0, 1.0).to("cpu", torch.promote_types(images.dtype, torch.float32))
        out = [np.clip(self.apply(image), 0.0, 1.0) for image in wide.permute(0, 2, 3, 1).contiguous().numpy()]
        return torch.from_numpy(np.stack(out)).permute(0, 3, 1, 2).contiguous().to(images)


def _luma(image: Picture) -> Float[ndarray, "H W 1"]:
    return (image @ LUMA.astype(image.dtype))[..., None]


def _saturate(image: Picture, amount: float) -> Picture:
    """Colours moved from (amount < 1) or to (> 1) grey at constant luma."""
    grey = _luma(image)
    return grey + amount * (image - grey)


def _ramp(image: Picture, *stops: tuple[float, float, float]) -> Picture:
    """A gradient map: luma 0..1 to a smooth curve (Bezier) through the first and last of `stops`."""
    x = _luma(image)
    degree = len(stops) - 1
    weights = [1.0, *np.cumprod([(degree - k) / (k + 1) for k in range(degree)])]
    terms = (
        float(w) * x**k * (1.0 - x) ** (degree - k) * np.asarray(stop, dtype=image.dtype)
        for k, (w, stop) in enumerate(zip(weights, stops, strict=True))
    )
    return cast(Picture, sum(terms))  # not the int of an empty sum: there are stops


def _smooth(x: Float[ndarray, "*shape"], low: float, high: float) -> Float[ndarray, "*shape"]:
    """0 below `low`, 1 above `high`, a cubic between."""
    x = np.clip((x - low) / (high - low), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _sunset(image: Picture) -> Picture:
    ramp = _ramp(image, (0.10, 0.03, 0.16), (0.85, 0.18, 0.22), (1.0, 0.62, 0.22), (1.0, 0.90, 0.62))
    return 0.55 * ramp + 0.45 * _saturate(image, 1.2) * np.asarray((1.05, 0.78, 0.60), image.dtype)


def _night(image: Picture) -> Picture:
    dark = _saturate(image, 0.35) ** 1.5
    return dark * np.asarray((0.30, 0.42, 0.70), image.dtype) + np.asarray((0.01, 0.02, 0.06), image.dtype)


def _autumn(image: Picture) -> Picture:
    red, green, blue = np.moveaxis(image, -1, 0)
    foliage = _smooth(green - 0.5 * (red + blue), -0.02, 0.14)[..., None]
    leaves = _ramp(image, (0.12, 0.03, 0.0), (0.95, 0.32, 0.02), (1.0, 0.85, 0.45))
    warm = image * np.asarray((1.08, 0.94, 0.76), image.dtype)
    return foliage * leaves + (1.0 - foliage) * warm


def _snow(image: Picture) -> Picture:
    cover = 0.85 * _smooth(_luma(image), 0.18, 0.62)
    white = _ramp(image, (0.70, 0.76, 0.86), (0.90, 0.94, 1.0), (1.0, 1.0, 1.0))
    cold = _saturate(image, 0.55) * np.asarray((0.92, 0.98, 1.10), image.dtype)
    return cover * white + (1.0 - cover) * cold


def _stormy(image: Picture) -> Picture:
    grey = _saturate(image, 0.40) * np.asarray((0.66, 0.72, 0.76), image.dtype)
    return grey + 0.10 * np.sin(2.0 * np.pi * (grey - 0.5))


def _grey(image: Picture) -> Picture:
    return np.repeat(_luma(image), 3, axis=-1)


def _sepia(image: Picture) -> Picture:
    return _ramp(image, (0.10, 0.06, 0.03), (0.58, 0.42, 0.27), (1.0, 0.95, 0.82))


def _golden(image: Picture) -> Picture:
    return _ramp(image, (0.10, 0.04, 0.0), (0.85, 0.48, 0.03), (1.0, 0.88, 0.20), (1.0, 0.98, 0.80))


def _bronze(image: Picture) -> Picture:
    return _ramp(image, (0.05, 0.03, 0.02), (0.50, 0.24, 0.10), (0.72, 0.50, 0.26), (1.0, 0.88, 0.66))


def _bytes(image: Picture) -> UInt8[ndarray, "H W 3"]:
    return np.round(image * 255.0).astype(np.uint8)


def _pencil_sketch(image: Picture) -> Picture:
    grey = cv2.cvtColor(_bytes(image), cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    # Colour dodge by the blurred negative: flat areas become paper, edges stay as strokes.
    radius = max(min(image.shape[:2]) / 64.0, 1.0)
    paper = cv2.GaussianBlur(grey, (0, 0), radius)
    strokes = np.clip(grey / np.maximum(paper, 1e-3), 0.0, 1.0) ** 2.5
    return np.repeat((0.92 * strokes + 0.06 * grey)[..., None], 3, axis=-1).astype(image.dtype)


def _oil_painting(image: Picture) -> Picture:
    size = max(round(min(image.shape[:2]) / 80.0), 2)
    return cv2.xphoto.oilPainting(_bytes(image), size, 1).astype(image.dtype) / 255.0


def _cartoon(image: Picture) -> Picture:
    painted = cv2.stylization(_bytes(image), sigma_s=40, sigma_r=0.45).astype(image.dtype) / 255.0
    return _saturate(painted, 1.15) * 0.88 + 0.12


OPERATORS: tuple[Operator, ...] = (
    Operator("sunset", ("sunset", "sundown", "dusk", "golden hour"), True, _sunset),
    Operator("night", ("night", "nighttime", "midnight", "night time", "moonlight"), True, _night),
    Operator("autumn", ("autumn", "fall", "autumnal", "autumn leaves"), True, _autumn),
    Operator("just snowed", ("just snowed", "snowed", "snow", "snowy", "winter", "covered snow"), True, _snow),
    Operator("stormy", ("stormy", "storm", "overcast", "cloudy", "gloomy"), True, _stormy),
    Operator("black and white", ("black and white", "monochrome", "greyscale", "grayscale"), True, _grey),
    Operator("sepia", ("sepia", "old", "vintage", "old photograph"), True, _sepia),
    Operator("golden", ("golden", "gold", "made gold", "golden statue", "gold statue"), True, _golden),
    Operator("bronze", ("bronze", "made bronze", "bronze statue"), True, _bronze),
    Operator("pencil sketch", ("pencil sketch", "sketch", "pencil drawing", "drawing"), False, _pencil_sketch),
    Operator("oil painting", ("oil painting", "oil", "painting", "oil paint"), False, _oil_painting),
    Operator("cartoon", ("cartoon", "cartoonish", "comic", "comic book"), False, _cartoon),
)

# Words that carry no instruction of their own: "Turn the scene into a pencil sketch" asks for "pencil sketch".
_FILLING = frozenset(
    """a an the it its this that them scene image picture photo photograph place view make made turn change convert
    transform render give look looks looking appear like as if into to in at of with be is was were has had have been
    style please would could you""".split()  # noqa: SIM905  (a list of forty strings reads worse)
)


def _core(text: str) -> tuple[str, ...]:
    words = re.findall(r"[^\W_]+", re.sub(r"['’]", "", text.lower()))
    return tuple(word for word in words if word not in _FILLING)


_BY_CORE = {_core(phrase): operator for operator in OPERATORS for phrase in operator.phrases}


def find_operator(instruction: str) -> Operator | None:
    """The operator that `instruction` asks for, whatever its case, punctuation and filling words; None for "".

    "Make it sunset", "turn this scene into a sunset!" and "sunset" are one. What is left after the filling words has
    to be a phrase of one operator: "turn night into sunset" is refused, not guessed.
    Raises PriorError for an unknown instruction, listing the known ones and the nearest.
    """
    if not instruction.strip():
        return None
    core = _core(instruction)
    if core in _BY_CORE:
        return _BY_CORE[core]
    hint = nearest(" ".join(core), [" ".join(known) for known in _BY_CORE])
    raise PriorError(
        f"system.prompt_processor.prompt: the closed-form prior does not know the instruction '{instruction}'.{hint} "
        f"Known: {', '.join(operator.name for operator in OPERATORS)}. Any other needs a neural prior."
    )
