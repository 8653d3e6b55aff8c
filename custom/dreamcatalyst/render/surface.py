"""Depth pictures as surfaces in the world: their points, their normals, splats that cover them, and who sees them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.camera import Cameras
from ..scene.gaussians import Gaussians

SPREAD = 0.6  # a splat's standard deviation over the distance of its neighbours: closed, and hardly blurred
FLATNESS = 0.1  # its thickness over its smaller width
OPACITY = 0.95
GRAZING = 0.05  # cosine of the angle to the normal below which a view says nothing of a surface


def surface_points(camera: Cameras, depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """Where the pixels of one view lie in the world. depth: z, world units."""
    K, pose = camera.Ks[0].to(depth), camera.viewmats[0].to(depth)
    v, u = torch.meshgrid(
        torch.arange(camera.height).to(depth) + 0.5, torch.arange(camera.width).to(depth) + 0.5, indexing="ij"
    )
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=-1)
    return (rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]


def _steps(points: Float[Tensor, "H W 3"]) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
    """From each pixel's point to that of the next one, to the right and down: half of the way between neighbours."""
    wide = F.pad(points.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    return (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2


def surface_normals(camera: Cameras, points: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Unit normals of the surface through `points` of one view, on the side that the view sees."""
    right, down = _steps(points)
    normals = F.normalize(torch.linalg.cross(right, down), dim=-1)
    towards = ((camera.centers[0].to(points) - points) * normals).sum(dim=-1, keepdim=True)
    return torch.where(towards < 0, -normals, normals)


def surface_splats(
    camera: Cameras,
    depth: Float[Tensor, "H W"],
    rgb: Float[Tensor, "H W 3"],
    where: Bool[Tensor, "H W"],
    sh_degree: int,
) -> Gaussians:
    """One flat splat for each pixel of `where`: it lies in the surface, and is as long there as the pixel is, so that
    the surface is closed for other views, too. rgb in [0,1], the same from all sides."""
    points = surface_points(camera, depth)
    right, down = (step[where] for step in _steps(points))
    axes, lengths, _ = torch.linalg.svd(torch.stack([right, down], dim=-1).double(), full_matrices=False)
    turned = torch.cat([axes, torch.linalg.cross(axes[..., 0], axes[..., 1])[..., None]], dim=-1)
    lengths = SPREAD * lengths.to(points).clamp_min(1e-6)
    return Gaussians.from_colors(
        means=points[where],
        scales=torch.cat([lengths, FLATNESS * lengths[:, 1:]], dim=-1),
        colors=rgb[where].to(points),
        opacities=torch.full_like(points[where][:, 0], OPACITY),
        quats=_quaternions(turned).to(points),
        sh_degree=sh_degree,
    )


def _quaternions(rotations: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    """wxyz."""
    from scipy.spatial.transform import Rotation

    if not len(rotations):
        return rotations.new_zeros(0, 4)
    return torch.from_numpy(Rotation.from_matrix(rotations.cpu().numpy()).as_quat()[:, [3, 0, 1, 2]])


def seen(
    points: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    views: Sequence[tuple[Cameras, Float[Tensor, "H W"]]],
    slack: Float[Tensor, " P"],
) -> Bool[Tensor, " P"]:
    """Whether some view sees a surface's points from the side of their normals: nothing that it shows lies before them.

    views: single cameras and their depths [H,W] (z; 0: nothing is there). slack [P]: world units by which a point may
    lie behind what a view shows, and still counts as seen.
    """
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for camera, depth in views:
        pose, K = camera.viewmats[0].to(points), camera.Ks[0].to(points)
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = local[:, 2].clamp_min(1e-6)
        u, v = (local[:, axis] / z * K[axis, axis] + K[axis, 2] for axis in (0, 1))
        inside = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        shown = depth.to(points)[v.clamp(0, camera.height - 1).long(), u.clamp(0, camera.width - 1).long()]
        free = (shown <= 0) | (z <= shown + slack)
        facing = (F.normalize(camera.centers[0].to(points) - points, dim=-1) * normals).sum(dim=-1) > GRAZING
        found |= inside & free & facing
    return found
