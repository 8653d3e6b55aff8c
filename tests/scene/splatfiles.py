"""Splats to be written, and how far two scenes are apart, for the tests of formats."""

from __future__ import annotations

import numpy as np
import torch
from dreamcatalyst.scene.gaussians import Gaussians


def splats(n: int = 700, degree: int = 3, seed: int = 0) -> Gaussians:
    """Splats of a lopsided world, unnormalised quaternions among them."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=draw)

    return Gaussians(
        means=normal(n, 3) * torch.tensor([1.0, 2.0, 3.0]) + torch.tensor([5.0, -3.0, 1.0]),
        quats=normal(n, 4) * 2,
        log_scales=normal(n, 3) * 0.5 - 4,
        logit_opacities=normal(n) * 2,
        sh0=normal(n, 1, 3) * 0.6,
        shN=normal(n, (degree + 1) ** 2 - 1, 3) * 0.15,
    )


def shapes(scene: Gaussians) -> torch.Tensor:
    """R S [N,3,3], whose columns are the splats' axes, each turned so that its largest number is positive: what is
    left of a quaternion when an ellipsoid is all that counts."""
    w, x, y, z = torch.nn.functional.normalize(scene.quats.double(), dim=1).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    axes = torch.stack(rows, 1) * scene.scales.double()[:, None]
    return axes @ axes.transpose(1, 2)


def apart(one: Gaussians, other: Gaussians) -> dict[str, float]:
    """The largest differences: of positions, of covariances relative to their size, of log scales' sum, opacities,
    colours and SH."""
    first, second = shapes(one), shapes(other)
    size = torch.linalg.matrix_norm(first)
    return {
        "means": float((one.means - other.means).abs().max()),
        "shape": float((torch.linalg.matrix_norm(first - second) / size).max()),
        "opacity": float((one.opacities - other.opacities).abs().max()),
        "sh0": float((one.sh0 - other.sh0).abs().max()),
        "shN": float((one.shN - other.shN).abs().max()) if one.shN.shape == other.shN.shape and one.sh_degree else 0.0,
    }


def matched(one: Gaussians, other: Gaussians) -> Gaussians:
    """The rows of `one` in the order of `other`, by their positions."""
    from scipy.spatial import KDTree

    _, rows = KDTree(one.means.numpy()).query(other.means.numpy())
    if len(one) != len(other) or len(np.unique(rows)) != len(one):
        raise AssertionError(f"{len(one)} and {len(other)} splats do not match one to one")
    return one[torch.from_numpy(rows)]
