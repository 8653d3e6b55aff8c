"""Colours of splats from their spherical harmonics."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import SH_C0
from ..scene.harmonics import basis


def colors(
    means: Float[Tensor, "N 3"],
    centers: Float[Tensor, "V 3"],
    sh0: Float[Tensor, "N 1 3"],
    shN: Float[Tensor, "N K 3"],
    degree: int,
) -> Float[Tensor, "V N 3"]:
    """RGB [V,N,3] >= 0 of splats seen from camera centres: max(0, 0.5 + sum of basis * coefficient).

    means [N,3], centers [V,3] world units; sh0 [N,1,3]; shN [N,>=(degree+1)^2-1,3], bases above `degree` are left out.
    A splat at the camera's centre is seen along the zero direction.
    """
    if degree == 0:
        rgb = (SH_C0 * sh0[:, 0]).expand(len(centers), -1, -1)
    else:
        dirs = torch.nn.functional.normalize(means - centers[:, None], dim=-1)
        y = basis(dirs, degree)
        rgb = y[..., :1] * sh0[:, 0] + torch.einsum("vnk,nkc->vnc", y[..., 1:], shN[:, : y.shape[-1] - 1])
    return (rgb + 0.5).clamp_min(0.0)
