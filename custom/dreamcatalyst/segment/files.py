"""Masks drawn elsewhere: one picture per view, found by the view's name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from ..errors import ConfigError, DataError, nearest
from .api import MaskRequest, Segmenter

SHOWN = 5  # names in a message


@dataclass(frozen=True)
class Files(Segmenter):
    """A folder of PNGs, white where the edit may act. The view images/0001.jpg takes images/0001.png or 0001.png.

    Grey or colour (its brightness); where a picture has transparency, that is the mask. Pictures that hold only 0 and 1
    are labels. Other sizes of the same shape are resized. All views of training are used, whatever mask.views says.
    """

    folder: str = ""  # the pictures; absolute, or from where the run is started
    missing: bool = False  # views without a picture are left aside instead of refused: what others say decides

    def __post_init__(self) -> None:
        if not self.folder:
            raise ConfigError("folder: is empty. Name the folder that holds one PNG per view.")

    def __call__(self, request: MaskRequest, views: Sequence[int]) -> dict[int, Float[Tensor, "H W"]]:
        masks = {}
        for view, path in self.paths(request).items():
            camera = request.cameras[view]
            masks[view] = torch.from_numpy(read_mask(path, camera.width, camera.height))
        return masks

    def identity(self, request: MaskRequest) -> list[tuple[int, bytes]]:
        return [(view, path.read_bytes()) for view, path in self.paths(request).items()]

    def paths(self, request: MaskRequest) -> dict[int, Path]:
        """The file of each view of training. Raises DataError that lists the views without one."""
        folder = Path(self.folder).expanduser()
        if not folder.is_dir():
            raise DataError(f"system.mask.options.folder: {folder}: no such folder")
        found, lacking = {}, []
        for view in request.views:
            name = Path(request.names[view])
            places = (folder / name.with_suffix(".png"), folder / f"{name.stem}.png")
            path = next((place for place in places if place.is_file()), None)
            if path is None:
                lacking.append(places[-1].name)
            else:
                found[view] = path
        if not found or (lacking and not self.missing):
            raise DataError(_lacking(folder, lacking, set(found.values()), len(request.views)))
        return found


def _lacking(folder: Path, lacking: list[str], taken: set[Path], wanted: int) -> str:
    there = sorted(path.name for path in folder.iterdir() if path.is_file() and path not in taken)
    names = ", ".join(f"'{name}'" for name in lacking[:SHOWN]) + (" ..." if len(lacking) > SHOWN else "")
    shown = ", ".join(there[:SHOWN]) + (" ..." if len(there) > SHOWN else "") or "nothing"
    return (
        f"{folder}: no mask for {len(lacking)} of {wanted} views: {names}.{nearest(lacking[0], there)} "
        f"Other files: {shown}. Name them after their views, or set mask.options.missing=true to leave them "
        "aside"
    )


def read_mask(path: Path, width: int, height: int) -> Float32[np.ndarray, "{height} {width}"]:
    """A picture in [0,1]. Raises DataError: not a picture, or of another shape."""
    try:
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):  # such as an empty file
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path}: is damaged, or no picture of 8 or 16 bits")
    h, w = image.shape[:2]
    if abs(w * height - h * width) > 1.5 * max(w, h, width, height):  # 1.5 px: sizes are rounded
        raise DataError(f"{path}: is {w}x{h}, which is not the shape of its view, {width}x{height}. Crop it likewise")
    top = 1 if image.max(initial=0) == 1 else np.iinfo(image.dtype).max
    grey = image[..., None] if image.ndim == 2 else image
    transparent = grey.shape[2] in (2, 4) and bool((grey[..., -1] < grey[..., -1].max()).any())
    grey = grey[..., -1:] if transparent else grey[..., :3]
    mask = np.ascontiguousarray(grey.mean(axis=2, dtype=np.float32) / np.float32(top))
    if (w, h) == (width, height):
        return mask
    method = cv2.INTER_AREA if width <= w and height <= h else cv2.INTER_LINEAR
    return cv2.resize(mask, (width, height), interpolation=method)
