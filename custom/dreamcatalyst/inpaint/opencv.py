"""Inpainting without a model, by OpenCV (cv2.inpaint) and its contributed modules (cv2.xphoto)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..config import Fraction
from ..errors import ConfigError, choose
from .api import Inpainter


def _by(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    image: Float[Tensor, "H W 3"],
    hole: Bool[Tensor, "H W"],
) -> Float[Tensor, "H W 3"]:
    """`function` takes BGR uint8 [H,W,3] and the hole as uint8 [H,W] of 0 and 255."""
    pixels = (image.cpu().numpy() * 255).round().astype(np.uint8)[..., ::-1]
    filled = function(np.ascontiguousarray(pixels), hole.cpu().numpy().astype(np.uint8) * 255)
    return torch.from_numpy(np.ascontiguousarray(filled[..., ::-1])).to(image) / 255


@dataclass(frozen=True)
class Telea(Inpainter):
    """Inward from the border by fast marching: smooth, and the surest where nothing is known of the texture
    (Telea 2004)."""

    radius: Fraction = 0.025  # of the neighbourhood that a pixel is made of, a fraction of the longer side
    method = cv2.INPAINT_TELEA

    def fill(self, image: Tensor, hole: Tensor, loaded: Any = None) -> Tensor:
        radius = max(1.0, self.radius * max(hole.shape))
        return _by(lambda pixels, mask: cv2.inpaint(pixels, mask, radius, self.method), image, hole)


@dataclass(frozen=True)
class NavierStokes(Telea):
    """Isophotes go on into the hole as a fluid's streamlines would (Bertalmio et al. 2001)."""

    method = cv2.INPAINT_NS


def _xphoto() -> Any:
    """cv2.xphoto. Raises ConfigError where this OpenCV has none."""
    if not hasattr(cv2, "xphoto"):
        raise ConfigError(
            "system.inpaint.kind: this OpenCV has no contributed modules (cv2.xphoto): pip install "
            "opencv-contrib-python-headless in place of opencv-python; or choose telea or navier-stokes."
        )
    return cv2.xphoto


@dataclass(frozen=True)
class ShiftMap(Inpainter):
    """Patches of the surroundings, copied to where they fit best: it keeps textures (He & Sun 2012)."""

    def load(self, device: torch.device) -> None:
        _xphoto()

    def fill(self, image: Tensor, hole: Tensor, loaded: Any = None) -> Tensor:
        xphoto = _xphoto()

        def shifted(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
            lab = cv2.cvtColor(pixels, cv2.COLOR_BGR2Lab)
            filled = np.zeros_like(lab)
            xphoto.inpaint(lab, 255 - mask, filled, xphoto.INPAINT_SHIFTMAP)
            return cv2.cvtColor(filled, cv2.COLOR_Lab2BGR)

        return _by(shifted, image, hole)


@dataclass(frozen=True)
class Fsr(Inpainter):
    """Waves that go on into the hole: frequency selective reconstruction (Genser et al. 2018)."""

    quality: str = "fast"  # fast | best

    def __post_init__(self) -> None:
        choose("quality", self.quality, ("fast", "best"), "quality")

    def load(self, device: torch.device) -> None:
        _xphoto()

    def fill(self, image: Tensor, hole: Tensor, loaded: Any = None) -> Tensor:
        xphoto = _xphoto()
        method = xphoto.INPAINT_FSR_FAST if self.quality == "fast" else xphoto.INPAINT_FSR_BEST

        def extrapolated(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
            filled = np.zeros_like(pixels)
            xphoto.inpaint(pixels, 255 - mask, filled, method)
            return filled

        return _by(extrapolated, image, hole)
