"""The truth for all tests: every splat against every pixel, in plain torch, differentiable by autograd in any
precision.

Memory and time grow with pixels times splats: for small images only.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..data.camera import Cameras
from ..scene.gaussians import Gaussians
from . import sh
from .api import Backend, Render, RenderOptions
from .projection import project, radii
from .thresholds import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN


def rasterize(scene: Gaussians, cameras: Cameras, options: RenderOptions) -> Render:
    """Draw `scene`; arguments and result as in `api.rasterize`. Source: Kerbl et al. 2023, sections 4-6."""
    splats = project(scene.means, scene.quats, scene.scales, cameras)
    rgb = sh.colors(scene.means, cameras.centers, scene.sh0, scene.shN, options.sh_degree)
    opacities = scene.opacities.expand(len(cameras), -1)
    if options.antialiased:
        opacities = opacities * splats.compensation
    views, n = opacities.shape
    channels = [rgb, splats.depths[..., None]]
    channels += [] if options.features is None else [options.features.expand(views, -1, -1)]
    channels = torch.cat(channels, dim=-1)
    radius = radii(splats, opacities, cameras)

    images, alphas = [], []
    for v in range(views):
        order = splats.depths[v].argsort(stable=True)
        order = order[radius[v, order] > 0]  # front to back
        weights = blend(
            splats.means2d[v, order], splats.covs2d[v, order], splats.dets[v, order], opacities[v, order], cameras
        )
        images.append(weights @ channels[v, order])
        alphas.append(weights.sum(-1, keepdim=True))
    size = (views, cameras.height, cameras.width, -1)
    image, alpha = torch.stack(images).view(size), torch.stack(alphas).view(size)
    covered = torch.where(alpha > 0, alpha, 1.0)
    return Render(
        rgb=image[..., :3] + (1 - alpha) * options.background,
        alpha=alpha,
        depth=image[..., 3:4] / covered if options.depth else None,
        features=None if options.features is None else image[..., 4:],
        means2d=splats.means2d,
        radii=radius,
    )


def blend(
    means2d: Float[Tensor, "M 2"],
    covs2d: Float[Tensor, "M 3"],
    dets: Float[Tensor, " M"],
    opacities: Float[Tensor, " M"],
    cameras: Cameras,
) -> Float[Tensor, "pixels M"]:
    """Weights alpha_i T_i [H*W,M] of M splats ordered front to back, T_i = prod_{j<i} (1 - alpha_j)."""
    x = torch.arange(cameras.width).to(means2d) + 0.5
    y = torch.arange(cameras.height).to(means2d) + 0.5
    dx, dy = x[None, :, None] - means2d[:, 0], y[:, None, None] - means2d[:, 1]  # [1,W,M], [H,1,M]
    xy, yy = covs2d[:, 1], covs2d[:, 2]
    # sigma = d^T cov^-1 d / 2 as a sum of two squares, which cannot cancel for needles
    sigma = 0.5 * ((dx - dy * (xy / yy)) ** 2 * (yy / dets) + dy * dy / yy)
    alpha = (opacities * torch.exp(-sigma)).clamp_max(ALPHA_MAX).flatten(0, 1)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    # Transmittance never rises: the splats that leave enough of it are those before the stop.
    alpha = torch.where(torch.cumprod(1 - alpha, dim=-1) > TRANSMITTANCE_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=-1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=-1)[:, : after.shape[1]]
    return alpha * before


BACKEND = Backend("reference", rasterize)
