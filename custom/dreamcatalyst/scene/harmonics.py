"""Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS files, and how they turn."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .gaussians import SH_C0

C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)  # sqrt(15/4pi), sqrt(5/16pi), sqrt(15/16pi)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
# sqrt(35/32pi), sqrt(105/4pi), sqrt(21/32pi), sqrt(7/16pi), sqrt(105/16pi)


def basis(dirs: Float[Tensor, "*N 3"], degree: int) -> Float[Tensor, "*N K"]:
    """The (degree+1)^2 real SH at unit directions [...,3] -> [...,(degree+1)^2], orthonormal over the sphere.

    Order l = 0..degree, m = -l..l; odd m carry the Condon-Shortley sign, as in Kerbl et al. 2023.
    """
    x, y, z = dirs.unbind(-1)
    out = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        out += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        out += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * z * z - x * x - y * y)]
        out += [-C2[0] * x * z, C2[2] * (x * x - y * y)]
    if degree >= 3:
        out += [-C3[0] * y * (3 * x * x - y * y), C3[1] * x * y * z, -C3[2] * y * (4 * z * z - x * x - y * y)]
        out += [C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), -C3[2] * x * (4 * z * z - x * x - y * y)]
        out += [C3[4] * z * (x * x - y * y), -C3[0] * x * (x * x - 3 * y * y)]
    return torch.stack(out, dim=-1)


def turned(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """Coefficients of the same functions after a rotation of the world: f'(R d) = f(d). sh: all bands from 0 on.

    Each band of degree l turns among itself, by its Wigner matrix. It is solved for here, not expanded: at as many
    directions as there are functions the turned ones are sums of those that were there, exactly.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    n = 4 * (degree + 1) ** 2  # directions, more than needed: the system is then well conditioned
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * i / n, i * math.pi * (3 - math.sqrt(5))
    flat = (1 - z * z).sqrt()
    dirs = torch.stack([flat * angle.cos(), flat * angle.sin(), z], dim=-1)
    wanted = basis(dirs @ rotation.detach().cpu().double(), degree)  # row by row R^T d
    matrix = torch.linalg.lstsq(basis(dirs, degree), wanted).solution  # [K,K], zero between bands up to rounding
    for band in range(degree + 1):
        own = slice(band**2, (band + 1) ** 2)
        matrix[own, : own.start], matrix[own, own.stop :] = 0.0, 0.0
    return torch.einsum("jk,nkc->njc", matrix.to(sh), sh)
