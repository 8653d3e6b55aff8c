"""Losses and similarity between images."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

SSIM_SIGMA, SSIM_RADIUS = 1.5, 5  # an 11 x 11 Gaussian window (Wang et al. 2004)
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # for a data range of 1


@lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " taps"]:
    x = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64)
    w = torch.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    return (w / w.sum()).to(device, dtype)


def _blur(maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
    """Separable Gaussian of [B,C,H,W] with zeros outside, as 3DGS does."""
    c, w = maps.shape[1], _window(maps.dtype, maps.device)
    rows = F.conv2d(maps, w.view(1, 1, 1, -1).expand(c, 1, 1, -1), padding=(0, SSIM_RADIUS), groups=c)
    return F.conv2d(rows, w.view(1, 1, -1, 1).expand(c, 1, -1, 1), padding=(SSIM_RADIUS, 0), groups=c)


def ssim_map(a: Float[Tensor, "B H W C"], b: Float[Tensor, "B H W C"]) -> Float[Tensor, "B H W C"]:
    """Structural similarity at every pixel. a, b [B,H,W,3] in [0,1]; returns [B,H,W,3], at most 1.

    Source: Wang et al. 2004; window 11 x 11, sigma 1.5, zeros outside the image.
    """
    x, y = a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2)
    mx, my, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y], dim=1)).chunk(5, dim=1)
    vx, vy, cov = xx - mx * mx, yy - my * my, xy - mx * my
    top = (2 * mx * my + SSIM_C1) * (2 * cov + SSIM_C2)
    return (top / ((mx * mx + my * my + SSIM_C1) * (vx + vy + SSIM_C2))).permute(0, 2, 3, 1)


class _SsimToTarget(torch.autograd.Function):
    """`ssim_map` on the CPU against a target that has no gradient: OpenCV's filter and the derivative in closed form,
    which take a sixth of the time of convolutions that torch differentiates."""

    @staticmethod
    def forward(ctx, render: Tensor, target: Tensor) -> Tensor:
        x, y = render.detach(), target
        mx, my, xx, yy, xy = map(_filter, (x, y, x * x, y * y, x * y))
        product = mx * my
        means, spreads = mx * mx + my * my + SSIM_C1, xx + yy + (SSIM_C1 + SSIM_C2)
        spreads -= means  # of the two variances
        near, along = 2 * product + SSIM_C1, 2 * (xy - product) + SSIM_C2
        below = 1 / (means * spreads)
        ssim = near * along * below
        ctx.save_for_backward(x, y, mx, my, ssim, near * below, along * below, means, spreads)
        return ssim

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        x, y, mx, my, ssim, near, along, means, spreads = ctx.saved_tensors
        by_xx, by_xy = grad * ssim / spreads, grad * near  # of xx with its sign turned, and half of xy
        by_mean = grad * (my * along - mx * ssim / means) + mx * by_xx - my * by_xy  # half of it
        return 2 * (_filter(by_mean) - x * _filter(by_xx) + y * _filter(by_xy)), None


def _filter(maps: Tensor) -> Tensor:
    """`_blur` of [B,H,W,C] on the CPU."""
    window = _window(maps.dtype, maps.device).numpy()
    done = [cv2.sepFilter2D(m, -1, window, window, borderType=cv2.BORDER_CONSTANT) for m in maps.contiguous().numpy()]
    return torch.from_numpy(np.stack(done)).reshape(maps.shape)


def photometric_loss(
    render: Float[Tensor, "B H W C"],
    target: Float[Tensor, "B H W C"],
    ssim_weight: float = 0.2,
    kept: Float[Tensor, "B H W 1"] | None = None,
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), a scalar. render, target [B,H,W,3]. Source: Kerbl et al. 2023, equation 7, w = 0.2.

    kept [B,H,W,1] of 0 and 1: the pixels over which it is the mean; the others are black in both pictures.
    """
    share: Tensor | float = 1.0
    if kept is not None:
        render, target = render * kept, target * kept
        share = kept.mean().clamp_min(1 / kept.numel())
    l1 = (render - target).abs().mean()
    if ssim_weight == 0:
        return l1 / share
    embedded = render.device.type == "cpu" and not target.requires_grad
    similarity = _SsimToTarget.apply(render, target) if embedded else ssim_map(render, target)
    return ((1 - ssim_weight) * l1 + ssim_weight * (1 - similarity.mean())) / share
