"""Masks kept on disk under a digest of everything that made them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from .. import files, plugin
from ..errors import FileError
from ..kept import digest

PLACES = ("data", "scene", "render", "diffusion", "guidance", "segment")  # whose code has a part in a mask


def code() -> str:
    """A hash of this project's code as far as it has a part in a mask."""
    root = Path(__file__).parent.parent
    return digest([(p.name, p.read_bytes()) for place in PLACES for p in sorted((root / place).glob("*.py"))])


def save(folder: Path, key: str, weights: Float[Tensor, " N"], images: Mapping[int, UInt8[Tensor, "H W"]]) -> None:
    """Keep weights and pictures (by number of a view). Raises FileError."""
    files.save(folder / f"{key}.pt", {"key": key, "weights": weights.cpu(), "images": dict(images)})


def load(
    folder: Path, key: str, count: int
) -> tuple[Float[Tensor, " {count}"], dict[int, UInt8[Tensor, "H W"]]] | None:
    """What `save` kept under `key` of `count` splats; None where there is nothing. A file that is not to the bit what
    was written, or not what its name says, is reported and left aside, to be written anew."""
    path = folder / f"{key}.pt"
    if not path.is_file():
        return None
    try:
        kept, _ = files.load(path)
        if not _is_mask(kept, count) or kept["key"] != key:
            raise FileError(f"{path}: holds something else")
    except FileError as error:
        plugin.warn(f"{error}. The mask is made again")
        return None
    return kept["weights"], kept["images"]


def _is_mask(kept: Any, count: int) -> bool:
    """Whether a file holds what `save` puts there, of `count` splats."""
    if not isinstance(kept, dict) or not {"key", "weights", "images"} <= set(kept):
        return False
    weights, images = kept["weights"], kept["images"]
    pictures = isinstance(images, dict) and all(_is_of(image, torch.uint8, 2) for image in images.values())
    return pictures and _is_of(weights, torch.float32, 1) and len(weights) == count and bool(weights.isfinite().all())


def _is_of(value: Any, dtype: torch.dtype, ndim: int) -> bool:
    return isinstance(value, Tensor) and value.dtype == dtype and value.ndim == ndim
