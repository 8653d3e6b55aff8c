"""Splats that can be drawn: of finite numbers, whose squares float32 holds."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from ..data.origin import Origin
from ..errors import SceneError
from .gaussians import Gaussians

FARTHEST, LARGEST_LOG = 1e15, 40.0  # world units; beyond, float32 does not hold the squares


def drawable(path: Path, scene: Gaussians, drop: bool, origin: Origin) -> Gaussians:
    """The scene of a file, which must be finite and have positions and scales whose squares float32 holds. drop: leave
    out and count splats that are not so, instead of raising SceneError. origin: what the positions count from."""
    scene = finite(path, scene, drop)
    far = (scene.means.double() + torch.tensor(origin, dtype=torch.float64)).abs() > FARTHEST
    scene = without(path, scene, far.any(dim=1), f"positions beyond {FARTHEST:g}", drop)
    large = (scene.log_scales > LARGEST_LOG).any(dim=1)
    fault = f"scales beyond exp({LARGEST_LOG:g}), though scale_* are logarithms,"
    return without(path, scene, large, fault, drop)


def finite(path: Path, scene: Gaussians, drop: bool) -> Gaussians:
    """The scene of a file, whose parameters must be finite numbers; drop: leave out and count splats whose are not."""
    bad = torch.zeros(len(scene), dtype=torch.bool)
    for _, value in scene.parameters():
        bad |= ~value.flatten(1).isfinite().all(dim=1) if value.ndim > 1 else ~value.isfinite()
    return without(path, scene, bad, "NaN or infinite parameters", drop)


def without(path: Path, scene: Gaussians, bad: Bool[Tensor, " N"], fault: str, drop: bool) -> Gaussians:
    """The scene without the splats `bad`; raises SceneError where they are not to be dropped."""
    count = int(bad.sum())
    if count == 0:
        return scene
    if not drop:
        first = int(bad.nonzero()[0, 0])
        raise SceneError(
            f"{path}: {count} of {len(scene)} splats have {fault} (first: row {first}). "
            "system.drop_nonfinite=true leaves them out"
        )
    if count == len(scene):
        raise SceneError(f"{path}: all {count} splats have {fault}; nothing is left")
    print(f"{path}: {count} of {len(scene)} splats with {fault} left out")
    return scene[~bad]
