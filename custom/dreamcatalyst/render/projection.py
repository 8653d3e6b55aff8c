"""EWA projection of 3D Gaussians to the image plane, in torch and in any precision."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from ..data.camera import Cameras
from .thresholds import ALPHA_MIN, BLUR, FRUSTUM_MARGIN, NEAR


class Projected(NamedTuple):
    """N splats in V images. means2d [V,N,2] pixels; covs2d [V,N,3] the entries xx, xy, yy in px^2, blurred;
    dets [V,N] px^4, their determinant; depths [V,N] camera z; compensation [V,N] = sqrt(det unblurred / det blurred);
    in_front [V,N] bool: not nearer than the near plane. Where it is false the other entries mean nothing."""

    means2d: Float[Tensor, "V N 2"]
    covs2d: Float[Tensor, "V N 3"]
    dets: Float[Tensor, "V N"]
    depths: Float[Tensor, "V N"]
    compensation: Float[Tensor, "V N"]
    in_front: Bool[Tensor, "V N"]


def rotations(quats: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 3 3"]:
    """Rotation matrices [...,3,3] of wxyz quaternions of any norm. They are divided by max(norm, 1e-12), so that a zero
    quaternion is the identity and its gradient is zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=1e-12).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def project(
    means: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"], scales: Float[Tensor, "N 3"], cameras: Cameras
) -> Projected:
    """Project means [N,3], quats [N,4] wxyz and scales [N,3] (world units) through V cameras.

    Source: Zwicker et al. 2001, EWA splatting: cov2d = J W Sigma W^T J^T + BLUR I, J the Jacobian of the perspective
    map, taken at a point no farther than FRUSTUM_MARGIN outside of the image (Kerbl et al. 2023), where it stays
    bounded.
    """
    rotation, translation = cameras.viewmats[:, :3, :3], cameras.viewmats[:, :3, 3]
    in_camera = torch.einsum("vij,nj->vni", rotation, means) + translation[:, None]
    depths = in_camera[..., 2]
    in_front = depths >= NEAR
    z = torch.where(in_front, depths, torch.ones_like(depths))
    tan = in_camera[..., :2] / z[..., None]
    focal, center = cameras.Ks[:, None, [0, 1], [0, 1]], cameras.Ks[:, None, :2, 2]
    means2d = tan * focal + center

    size = tan.new_tensor([cameras.width, cameras.height])
    low, high = (-FRUSTUM_MARGIN * size - center) / focal, ((1 + FRUSTUM_MARGIN) * size - center) / focal
    tan = torch.maximum(torch.minimum(tan, high), low)
    # The rows of A = J W R S, in px; cov2d = A A^T.
    axes = torch.einsum("vij,njk->vnik", rotation, rotations(quats) * scales[:, None, :])
    ax, ay = ((axes[..., :2, :] - tan[..., None] * axes[..., 2:, :]) * (focal / z[..., None])[..., None]).unbind(-2)
    xx, xy, yy = (ax * ax).sum(-1), (ax * ay).sum(-1), (ay * ay).sum(-1)
    # |ax x ay|^2 = det A A^T: needles keep their digits, where xx yy - xy^2 cancels them.
    area = torch.linalg.vector_norm(torch.linalg.cross(ax, ay, dim=-1), dim=-1)
    dets = area * area + BLUR * (xx + yy) + BLUR * BLUR
    covs2d = torch.stack([xx + BLUR, xy, yy + BLUR], dim=-1)
    return Projected(means2d, covs2d, dets, depths, area / dets.sqrt(), in_front)


def radii(splats: Projected, opacities: Float[Tensor, "V N"], cameras: Cameras) -> Int32[Tensor, "V N"]:
    """Half the longer side, in whole pixels, of the box outside of which a splat's alpha is below ALPHA_MIN: [V,N]
    int32, 0 where it is not drawn (behind the near plane, box outside of the image, opacity [V,N] below ALPHA_MIN)."""
    reach = (2 * (opacities / ALPHA_MIN).clamp_min(1.0).log())[..., None] * splats.covs2d[..., [0, 2]]
    half = reach.sqrt()
    size = half.new_tensor([cameras.width, cameras.height])
    inside = ((splats.means2d + half > 0) & (splats.means2d - half < size)).all(-1)
    drawn = splats.in_front & inside & (opacities >= ALPHA_MIN)
    return torch.where(drawn, half.amax(-1).ceil().clamp(1, 2**30), 0).int()
