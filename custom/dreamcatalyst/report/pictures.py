"""Renders as files to look at: labelled rows of pictures, and videos that browsers play."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..files import replacing, write_bytes

BAR = 18  # pixels above a picture, for its label


def to_uint8(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """A picture in [0,1] (clamped) in 8 bits, RGB."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def labelled(image: Float[Tensor, "H W 3"], label: str) -> UInt8[np.ndarray, "barred W 3"]:
    """The picture under a bar with its label, BAR + H pixels high."""
    pixels = to_uint8(image)
    bar = np.full((BAR, pixels.shape[1], 3), 255, np.uint8)
    size = min(0.42, 0.42 * pixels.shape[1] / (8 * max(len(label), 1)))
    cv2.putText(bar, label, (2, BAR - 5), cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([bar, pixels])


def picture_row(panels: Sequence[tuple[str, Float[Tensor, "H W 3"]]]) -> UInt8[np.ndarray, "barred row 3"]:
    """Pictures of one height side by side, each with its label."""
    return np.hstack([labelled(image, label) for label, image in panels])


def write_png(path: Path, pixels: UInt8[np.ndarray, "H W 3"]) -> Path:
    """Write RGB. Raises FileError."""
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))
    return write_bytes(path, encoded.tobytes())


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], fps: int = 24) -> Path:
    """Write RGB frames of one size as H.264 in yuv420p; odd sides lose their last row or column, and a side of
    one pixel is doubled.

    Raises FileError.
    """
    import imageio.v2 as imageio

    with replacing(path, path.suffix) as part:
        with imageio.get_writer(
            part, fps=fps, codec="libx264", quality=8, macro_block_size=2, pixelformat="yuv420p"
        ) as out:
            for frame in frames:
                cast(Any, out).append_data(_even(frame))
        with imageio.get_reader(part) as made:  # where the disk is full, the writer says nothing
            cast(Any, made).get_data(0)
    return path


def _even(frame: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "even_H even_W 3"]:
    """The frame with even sides."""
    frame = frame.repeat(1 + (frame.shape[0] == 1), axis=0).repeat(1 + (frame.shape[1] == 1), axis=1)
    return np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
