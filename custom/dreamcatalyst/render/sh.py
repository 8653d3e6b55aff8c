"""Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS files."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import SH_C0

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
