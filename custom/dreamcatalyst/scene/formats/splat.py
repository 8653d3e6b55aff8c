"""The .splat of antimatter15's viewer: 32 bytes for each splat, without a header.

Position and scale as three floats each, colour and opacity as four bytes, and the quaternion (wxyz) as four bytes of
128 (1 + q). Axes are those of the PLY. Viewers draw the first rows while the rest still comes, so the most visible
splats stand first.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...data.origin import Origin
from ...errors import SceneError
from ...files import replacing
from ..gaussians import Gaussians
from .api import Found, NoOptions, SplatFormat, with_suffix
from .quantized import (
    assembled,
    byte_colors,
    color_bytes,
    opacity_bytes,
    opacity_logits,
    to_bytes,
    unit,
    world_positions,
)

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("opacity", "u1"), ("quats", "u1", 4)])
SMALLEST = 1e-30  # of a scale, whose logarithm is to be finite; float32 holds it


def read(path: Path, origin: Origin) -> Found:
    size = path.stat().st_size
    if size == 0 or size % ROW.itemsize:
        raise SceneError(
            f"{path}: {'is empty' if size == 0 else f'is truncated, or no .splat: {size} bytes'}, expected "
            f"{ROW.itemsize} for each splat"
        )
    rows = np.fromfile(path, ROW)
    quats = unit((rows["quats"].astype(np.float32) - 128) / 128)
    if not (rows["scales"] >= 0).all():
        raise SceneError(f"{path}: is no .splat: some of its scales are negative or no numbers")
    logs = np.log(np.maximum(rows["scales"], SMALLEST))
    shN = np.zeros((len(rows), 0, 3))
    scene = assembled(
        rows["means"], quats, logs, opacity_logits(rows["opacity"]), byte_colors(rows["rgb"]), shN, origin
    )
    return Found(scene, ["a .splat holds one colour for each splat, whatever side it is seen from"])


def write(stem: Path, scene: Gaussians, origin: Origin, comments: Sequence[str], options: NoOptions) -> Path:
    rows = np.empty(len(scene), ROW)
    rows["means"] = world_positions(scene, origin)
    rows["scales"] = scene.log_scales.float().exp().numpy()
    rows["rgb"] = color_bytes(scene.sh0[:, 0].float().numpy())
    rows["opacity"] = opacity_bytes(scene.logit_opacities.float().numpy())
    rows["quats"] = to_bytes(unit(scene.quats.float().numpy()) * 128 + 128)
    path = with_suffix(stem, ".splat")
    with replacing(path) as part, part.open("wb") as file:
        file.write(rows.view(np.uint8).data)
    return path


def order(scene: Gaussians) -> Tensor:
    """The largest and most opaque first."""
    visible = scene.log_scales.sum(dim=1) + torch.nn.functional.logsigmoid(scene.logit_opacities)
    return torch.argsort(visible, descending=True, stable=True)


FORMAT = SplatFormat(
    ".splat (antimatter15)",
    (".splat",),
    lambda path, head: False,
    read,
    write,
    loses="colour, opacity and rotation have 8 bits",
    sh_degree=0,
    order=order,
)
