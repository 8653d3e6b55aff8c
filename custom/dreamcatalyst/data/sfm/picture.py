"""A picture of a reconstruction: its points and cameras from above and from the front."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from ...files import replacing

SIDE = 640  # pixels of each of the two panels
EDGE = 40  # pixels left free around
CAMERA, INK = (40, 40, 220), (60, 60, 60)  # BGR
PANELS = {"from above": (0, 2, -1), "from the front": (0, 1, 1)}  # axis to the right, axis down and its sign


def draw(
    path: Path,
    rotations: Float[np.ndarray, "V 3 3"],
    centres: Float[np.ndarray, "V 3"],
    xyz: Float[np.ndarray, "P 3"],
    rgb: Float[np.ndarray, "P 3"],
    title: str,
) -> None:
    """Write a PNG. rotations, centres: of the cameras, world to camera; y points down in the world; rgb in [0,1]."""
    middle, reach = _window(centres, xyz)
    panels = []
    for name, (right, down, sign) in PANELS.items():
        panel = np.full((SIDE, SIDE, 3), 255, np.uint8)

        def place(points: np.ndarray, right: int = right, down: int = down, sign: int = sign) -> np.ndarray:
            flat = np.stack([points[:, right] - middle[right], sign * (points[:, down] - middle[down])], axis=1)
            return flat * ((SIDE / 2 - EDGE) / reach) + SIDE / 2

        _dots(panel, place(xyz), rgb)
        size = 0.06 * reach
        corners = np.array([[0.0, 0, 0], [-1, -0.7, 1.4], [1, -0.7, 1.4], [1, 0.7, 1.4], [-1, 0.7, 1.4]]) * size
        for rotation, centre in zip(rotations, centres, strict=True):
            tip, *ends = (place(corners @ rotation + centre) * 16).round().astype(int)  # 4 bits below the pixel
            cv2.polylines(panel, [np.array(ends)], True, CAMERA, 1, cv2.LINE_AA, 4)
            for end in ends:
                cv2.line(panel, tuple(tip.tolist()), tuple(end.tolist()), CAMERA, 1, cv2.LINE_AA, 4)
        cv2.putText(panel, name, (12, SIDE - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
        panels.append(panel)
    image = np.concatenate(panels, axis=1)
    cv2.putText(image, title, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.55, INK, 1, cv2.LINE_AA)
    with replacing(path, ".png") as part:
        cv2.imwrite(str(part), image)


def _window(centres: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, float]:
    """The middle and half the side of what is shown: all cameras, and the points but for the farthest tenth."""
    shown = centres
    if len(xyz):
        away = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
        shown = np.concatenate([centres, xyz[away <= np.quantile(away, 0.9)]])
    low, high = shown.min(axis=0), shown.max(axis=0)
    return (low + high) / 2, max(float((high - low).max()) / 2, 1e-6) * 1.05


def _dots(panel: np.ndarray, places: np.ndarray, rgb: np.ndarray) -> None:
    """Points in their colours, a pixel and its right and lower neighbours each."""
    x, y = places.round().astype(int).T
    inside = (x >= 0) & (x < SIDE - 1) & (y >= 0) & (y < SIDE - 1)
    bgr = (rgb[inside, ::-1] * 255).astype(np.uint8)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        panel[y[inside] + dy, x[inside] + dx] = bgr
