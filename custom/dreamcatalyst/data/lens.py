"""What a photograph was taken with, and how its distortion is undone: intrinsics of any lens to those of a pinhole."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from ..config import Range
from ..errors import DataError

# Zooms tried for the pinhole view of a distorted photograph, narrowest first. Below 1/2 the middle of a wide fisheye
# would keep less than half of its resolution for the sake of stretched corners.
ZOOMS = np.geomspace(4.0, 0.5, 600)
FINITE, FOCAL = Range("(-1e9, 1e9)"), Range("(1e-3, 1e9)")  # pixels; float32 holds their squares
SIDE = Range("[1, 1048576]")  # pixels; OpenCV reads no longer ones
LIMITS = {"fx": FOCAL, "fy": FOCAL, "cx": FINITE, "cy": FINITE, "width": SIDE, "height": SIDE}


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels, pixel centres at +0.5 as in COLMAP; width, height of the photograph they belong to.

    distortion: OpenCV's coefficients: (k1, k2, p1, p2[, k3[, k4, k5, k6]]), or of a fisheye (k1, k2, k3, k4).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def check(self, where: str) -> None:
        """Raise DataError for a number that no lens has. where: whose lens it is, for the message."""
        for name, limits in LIMITS.items():
            if getattr(self, name) not in limits:
                what = {"f": "focal length ", "c": "principal point "}.get(name[0], "")
                raise DataError(f"{where}: {what}{name} is {getattr(self, name)}, expected {limits}")
        if not all(value in FINITE for value in self.distortion):
            raise DataError(f"{where}: the distortion {self.distortion} is not of finite numbers")

    @property
    def distorted(self) -> bool:
        """Whether straight lines are bent (an ideal fisheye bends them with all coefficients zero)."""
        return self.fisheye or any(self.distortion)

    @property
    def K(self) -> np.ndarray:
        """Intrinsics [3,3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def scaled(self, width: int, height: int) -> Lens:
        """The lens of the same photograph at another size, scaled per axis."""
        x, y = width / self.width, height / self.height
        return replace(self, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y, width=width, height=height)

    def project(self, rays: np.ndarray) -> np.ndarray:
        """Pixels [...,2] where the rays (x/z, y/z) [...,2] meet the photograph, with distortion."""
        flat = rays.reshape(-1, 1, 2).astype(np.float64)
        if self.fisheye:
            pixels = cv2.fisheye.distortPoints(flat, self.K, np.array(self._four))
        else:
            points = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
            pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K, np.array(self.distortion))
        return pixels.reshape(rays.shape)

    def pinhole(self) -> Lens:
        """The pinhole that sees the most of this photograph without an unseen corner.

        Size, principal point and the ratio fx : fy stay; only the focal length is zoomed. Raises DataError where
        the coefficients fold the picture over itself.
        """
        if not self.distorted:
            return replace(self, distortion=())
        side = np.linspace(0, 1, 17)
        border = np.concatenate([[(t, 0), (t, 1), (0, t), (1, t)] for t in side]) * (self.width, self.height)
        rays = (border - (self.cx, self.cy)) / (self.fx, self.fy)
        pixels = self.project(rays / ZOOMS[:, None, None])
        inside = ((pixels >= 0) & (pixels <= (self.width, self.height))).all(axis=(1, 2))
        reach = np.linalg.norm(pixels - (self.cx, self.cy), axis=-1)
        grows = np.append(True, (np.diff(reach, axis=0) > 0).all(axis=1))  # else the polynomial has turned back
        usable = np.logical_and.accumulate(inside & grows)
        if not usable[0]:
            raise DataError(f"camera: the distortion {self.distortion} cannot be undone; calibrate it again")
        zoom = float(ZOOMS[usable.sum() - 1])
        return replace(self, fx=self.fx * zoom, fy=self.fy * zoom, distortion=(), fisheye=False)

    @property
    def _four(self) -> tuple[float, ...]:
        return (*self.distortion, 0.0, 0.0, 0.0, 0.0)[:4]


def undistort(image: np.ndarray, lens: Lens) -> np.ndarray:
    """`image` [H,W,C] uint8, taken with `lens`, as `lens.pinhole()` would have seen it."""
    if not lens.distorted:
        return image
    x, y = _maps(lens)
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=4)
def _maps(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the pinhole view lies in the photograph. OpenCV has pixel centres at 0, we at 0.5."""
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K, new, size = lens.K - shift, lens.pinhole().K - shift, (lens.width, lens.height)
    if lens.fisheye:
        return cv2.fisheye.initUndistortRectifyMap(K, np.array(lens._four), np.eye(3), new, size, cv2.CV_32FC1)
    return cv2.initUndistortRectifyMap(K, np.array(lens.distortion), None, new, size, cv2.CV_32FC1)
