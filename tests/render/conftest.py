"""Random scenes and cameras that the renderers' tests share."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.render.api import BACKENDS
from dreamcatalyst.scene.gaussians import Gaussians

CPU = torch.device("cpu")
# The best precision in which each backend draws on this machine, for those that do.
PRECISIONS = {
    backend.name: dtype
    for backend in BACKENDS.parts()
    for dtype in (torch.float32, torch.float64)
    if backend.takes(CPU, dtype)
}


@pytest.fixture
def random_scene():
    """A function (n, sh_degree=3, seed=0) -> Gaussians in a box around z = 4, float32."""

    def make(n: int, sh_degree: int = 3, seed: int = 0) -> Gaussians:
        g = torch.Generator().manual_seed(seed)
        means = torch.rand(n, 3, generator=g) * 2 - 1
        means[:, 2] += 4
        return Gaussians(
            means=means,
            quats=torch.randn(n, 4, generator=g),
            log_scales=torch.randn(n, 3, generator=g) * 0.4 - 2.5,
            logit_opacities=torch.randn(n, generator=g) + 1,
            sh0=torch.randn(n, 1, 3, generator=g),
            shN=torch.randn(n, (sh_degree + 1) ** 2 - 1, 3, generator=g) * 0.3,
        )

    return make


@pytest.fixture
def pinhole():
    """A function (width, height, views=1) -> Cameras, off-centre, with fx != fy, each view a little further round."""

    def make(width: int, height: int, views: int = 1) -> Cameras:
        angles = torch.arange(views) * 0.1
        viewmats = torch.eye(4).repeat(views, 1, 1)
        viewmats[:, 0, 0] = viewmats[:, 2, 2] = angles.cos()
        viewmats[:, 0, 2], viewmats[:, 2, 0] = angles.sin(), -angles.sin()
        viewmats[:, 0, 3] = -4 * angles.sin()
        viewmats[:, 1, 3] = 0.05
        K = torch.tensor([[1.4 * width, 0, 0.55 * width], [0, 1.2 * width, 0.45 * height], [0, 0, 1]])
        return Cameras(viewmats, K.repeat(views, 1, 1), width, height)

    return make
