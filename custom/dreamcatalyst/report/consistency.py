"""Whether views show the same thing: colours of one view, looked up in another one by depth."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.camera import Cameras
from ..render.api import Render

DEPTH_TOLERANCE = 0.02  # a fraction of the depth: what lies deeper in the other view is hidden there
SOLID = 0.5  # least alpha of a pixel that shows a surface
LEAST = 0.01  # a pair of views that shares a smaller part of the picture says nothing


def lifted(depth: Float[Tensor, "H W 1"], camera: Cameras) -> Float[Tensor, "H W 3"]:
    """The points in the world that the pixels of one view show. depth: z in the camera, world units."""
    y, x = torch.meshgrid(
        torch.arange(camera.height, dtype=depth.dtype, device=depth.device) + 0.5,
        torch.arange(camera.width, dtype=depth.dtype, device=depth.device) + 0.5,
        indexing="ij",
    )
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(camera.Ks[0].to(depth)).T
    viewmat = camera.viewmats[0].to(depth)
    return (rays * depth - viewmat[:3, 3]) @ viewmat[:3, :3]


def looked_up(
    points: Float[Tensor, "H W 3"], other: Render, camera: Cameras
) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """The colours that another view shows at `points`, and which of these it sees: in front
    of it, inside of its picture, solid there, and not behind what it shows."""
    viewmat = camera.viewmats[0].to(points)
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[..., 2:]
    pixels = (local @ camera.Ks[0].to(points).T)[..., :2] / z.clamp(min=1e-6)
    place = 2 * pixels / pixels.new_tensor([camera.width, camera.height]) - 1
    maps = torch.cat([other.rgb[0], other.depth[0], other.alpha[0]], dim=-1).permute(2, 0, 1)[None]
    found = F.grid_sample(maps, place[None], mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
    inside = (place.abs() <= 1).all(-1) & (z[..., 0] > 0) & (found[..., 4] > SOLID)
    return found[..., :3], inside & ((found[..., 3] - z[..., 0]).abs() <= DEPTH_TOLERANCE * z[..., 0])


def disagreement(one: Render, camera: Cameras, other: Render, other_camera: Cameras) -> float | None:
    """Root mean square difference of the colours of what both views see, 0 where they agree; None where they share
    less than a hundredth of the picture. Both renders are of a single view, with depth.

    It is the warping error of video and scene stylisation (Lai et al. 2018; Huang et al. 2021), with the renders' own
    depth in place of optical flow. Splats of degree 0 still have some: of resampling, and of surfaces that are not
    opaque. So it says something beside the same number of the unedited scene.
    """
    colours, seen = looked_up(lifted(one.depth[0], camera), other, other_camera)
    seen &= one.alpha[0, ..., 0] > SOLID
    if float(seen.float().mean()) < LEAST:
        return None
    return float((one.rgb[0] - colours)[seen].square().mean().sqrt())


def nearest_views(cameras: Cameras, index: int, ranks: tuple[int, ...]) -> list[int]:
    """The views that are 1st, 7th ... nearest to view `index` (ranks from 1; the last one where there are fewer): by
    the distance of centres, in units of their mean distance, plus the angle between viewing directions in radians."""
    distance = (cameras.centers - cameras.centers[index]).norm(dim=-1)
    cosine = F.cosine_similarity(cameras.forward, cameras.forward[index][None], dim=-1).clamp(-1, 1)
    apart = distance / distance.mean().clamp(min=1e-12) + cosine.arccos()
    apart[index] = -1.0
    order = apart.argsort(stable=True).tolist()[1:]
    return [order[min(rank, len(order)) - 1] for rank in ranks] if order else []
