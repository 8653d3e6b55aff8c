"""The surface under a pixel of a view, and how high it is under a thing that is to stand there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..data.camera import Cameras, look_at
from ..errors import SceneError
from ..scene.gaussians import Gaussians
from .api import Render

Draw = Callable[..., Render]  # (scene, cameras, **options of `rasterize`) -> Render
SOLID = 0.5  # alpha from which on a pixel shows a surface
NEAR = 0.015  # of the longer side: the surface's slope is that of so wide a window around the pixel
STEP = 0.15  # of its depth by which a surface may differ within that window
STEEPEST = 60.0  # degrees from level on which a thing can stand
FROM_ABOVE = 48  # pixels across the look down on the ground
LEAP = 0.25  # of the thing's height: what lies higher or lower than this is another surface


@dataclass(frozen=True)
class Ground:
    """Where a pixel's ray meets a surface. point, eye [3]: there, and where the ray begins, world units; normal [3]:
    unit, towards the camera."""

    point: Float[Tensor, " 3"]
    eye: Float[Tensor, " 3"]
    normal: Float[Tensor, " 3"]

    def at_level(self, up: Float[Tensor, " 3"], above: float) -> Float[Tensor, " 3"]:
        """The point of the ray that lies `above` the point along `up`; straight above it, where the ray is level."""
        ray = self.point - self.eye
        rise = float(ray @ up)
        return self.point + (above / rise * ray if abs(rise) > 0.05 * float(ray.norm()) else above * up)


@torch.no_grad()
def ground_at(scene: Gaussians, camera: Cameras, x: float, y: float, draw: Draw) -> Ground | None:
    """The surface that the pixel at (x, y), from the upper left corner, shows; None where it shows none.

    Its slope is that of a small window around the pixel, where the depth does not leap (least squares).
    """
    depth, alpha = drawn_depth(draw, scene, camera)
    column, row = min(int(x), camera.width - 1), min(int(y), camera.height - 1)
    if not float(alpha[row, column]) >= SOLID:
        return None
    here, eye = depth[row, column], camera.centers[0].double()
    point = points_of(camera, depth.new_tensor([[x, y]]), here[None])[0]
    reach = max(1, round(NEAR * max(camera.width, camera.height)))
    rows, columns = torch.meshgrid(*(torch.arange(n).double() for n in depth.shape), indexing="ij")
    near = ((rows - row).abs() <= reach) & ((columns - column).abs() <= reach) & (alpha >= SOLID).to(depth.device)
    near &= (depth - here).abs() <= STEP * here
    pixels = torch.stack([columns[near] + 0.5, rows[near] + 0.5], dim=-1).to(depth)
    return Ground(point, eye, plane_normal(points_of(camera, pixels, depth[near]), eye))


def drawn_depth(draw: Draw, scene: Gaussians, camera: Cameras) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Depth (float64, world units) and alpha of one view."""
    drawn = draw(scene, camera, depth=True)
    if drawn.depth is None:
        raise SceneError("rasterize: the backend draws no depth, which says where a surface is")
    return drawn.depth[0, ..., 0].double(), drawn.alpha[0, ..., 0]


def points_of(camera: Cameras, pixels: Float[Tensor, "P 2"], depths: Float[Tensor, " P"]) -> Float[Tensor, "P 3"]:
    """World points [P,3] at camera depths [P] (z, world units) under places [P,2] of one camera's picture."""
    K, viewmat = camera.Ks[0].to(pixels), camera.viewmats[0].to(pixels)
    rays = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1) @ torch.linalg.inv(K).T
    return (rays * depths[:, None] - viewmat[:3, 3]) @ viewmat[:3, :3]


def plane_normal(cloud: Float[Tensor, "P 3"], eye: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The unit normal of the plane through points, towards `eye`; straight towards it where they span no plane."""
    middle = cloud.mean(dim=0)
    towards = torch.nn.functional.normalize(eye - middle, dim=0)
    if len(cloud) < 3:
        return towards
    values, vectors = torch.linalg.eigh((cloud - middle).T @ (cloud - middle))
    if not float(values[1]) > 1e-4 * float(values[2]):  # on a line
        return towards
    normal = vectors[:, 0]
    return normal if float(normal @ towards) >= 0 else -normal


def require_level(ground: Ground, up: Float[Tensor, " 3"], where: str) -> None:
    """Raise SceneError where nothing can stand: on a wall, a ceiling, the sky."""
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(ground.normal @ up.to(ground.normal))))))
    if tilt > STEEPEST:
        raise SceneError(
            f"{where}: shows a surface that is tilted by {tilt:.0f} degrees, such as a wall or the sky, expected one "
            f"to stand on, tilted by {STEEPEST:.0f} at most. Choose a pixel of the ground, or give system.add.position"
        )


@torch.no_grad()
def level_under(
    scene: Gaussians, foot: Float[Tensor, " 3"], up: Float[Tensor, " 3"], radius: float, height: float, draw: Draw
) -> float:
    """How far above `foot`, along `up`, the ground lies under a thing that stands there (negative: below), as it is
    seen from above within `radius` of it. A slanting view's depth is less exact: of the splats that a pixel shows, the
    nearer ones hide the others, so that it lies before the surface by about a splat's width.

    height: the thing's. What lies higher or lower than a part of it is another surface; where nothing else is seen, 0.
    """
    radius, above = max(radius, 0.02 * height), max(height, 2 * radius)
    up, half = up.to(foot), FROM_ABOVE / 2
    eye = foot + above * up
    K = torch.tensor([[half * above / radius, 0, half], [0, half * above / radius, half], [0, 0, 1]])
    viewmat = look_at(eye[None], foot, torch.eye(3).to(foot)[int(up.abs().argmin())])
    camera = Cameras(viewmat.to(scene.means), K[None].to(scene.means), FROM_ABOVE, FROM_ABOVE)
    depth, alpha = drawn_depth(draw, scene, camera)
    levels = above - depth
    ground = (alpha >= SOLID) & (levels.abs() <= LEAP * height)
    return float(levels[ground].median()) if bool(ground.any()) else 0.0
