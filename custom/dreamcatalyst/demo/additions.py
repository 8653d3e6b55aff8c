"""Things that an edit puts on a synthetic bear: a party hat, rabbit ears, a scarf. The world's own splats stay."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import Gaussians
from .shapes import GOLDEN_ANGLE, OVERLAP, Light, ellipsoid, surface
from .worlds import Solid, World, label

SPACING = 0.022  # world units between neighbouring splats, somewhat finer than the statue's
RED, WHITE, YELLOW = (0.82, 0.10, 0.12), (0.95, 0.94, 0.90), (0.96, 0.80, 0.16)
GREY, PINK = (0.80, 0.78, 0.76), (0.93, 0.62, 0.64)
Maker = Callable[[Solid, Solid, Light], Gaussians]  # head, body -> the thing


def with_addition(world: World, make: Maker, part: str) -> Gaussians:
    """The world's splats, to the bit, followed by those of the thing that `make` puts on its bear, labelled `part`."""
    solids = {solid.name: solid for solid in world.thing("bear statue").solids}
    return Gaussians.cat([world.scene, label(part, make(solids["head"], solids["body"], world.light))])


def painted(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    widths: Float[Tensor, " N"],
    albedo: Float[Tensor, "N 3"],
    light: Light,
) -> Gaussians:
    """A lit surface of colours albedo."""
    return surface(points, normals, widths, albedo * light.lit(normals))


def striped(
    share: Float[Tensor, " N"], first: tuple[float, ...], second: tuple[float, ...], count: float
) -> Float[Tensor, "N 3"]:
    """Colours in `count` pairs of stripes along share in [0,1]."""
    where = torch.sigmoid(torch.sin(2 * math.pi * count * share) / 0.15)[:, None]
    return where * share.new_tensor(first) + (1 - where) * share.new_tensor(second)


def party_hat(head: Solid, body: Solid, light: Light) -> Gaussians:
    """A cone with red and white stripes around it and a yellow ball on its tip, upright on top of the head."""
    top = head.center + torch.tensor([0.0, 0.0, 0.86 * float(head.radii[2])])
    radius, height = 0.62 * float(head.radii[1]), 1.3 * float(head.radii[2])
    slant = math.hypot(radius, height)
    n = int(math.pi * radius * slant / SPACING**2)
    share = 1 - ((torch.arange(n) + 0.5) / n).sqrt()  # of the height: as many splats on each area
    angle = torch.arange(n) * GOLDEN_ANGLE
    ring = torch.stack([angle.cos(), angle.sin()], -1)
    points = torch.cat([radius * (1 - share)[:, None] * ring, height * share[:, None]], -1)
    normals = torch.cat([ring * height, torch.full((n, 1), radius)], -1) / slant
    cone = painted(
        points + top, normals, torch.full((n,), 0.62 * OVERLAP * SPACING), striped(share, RED, WHITE, 3), light
    )
    ball = ellipsoid((top + torch.tensor([0.0, 0.0, height])).tolist(), (0.2 * radius,) * 3, 0.7 * SPACING)
    return Gaussians.cat([cone, painted(*ball, torch.tensor(YELLOW).expand(len(ball[0]), 3), light)])


def rabbit_ears(head: Solid, body: Solid, light: Light) -> Gaussians:
    """Two long ears, grey behind and pink within, upright between the bear's own."""
    made = []
    for side in (-1.0, 1.0):
        along = 0.34 * side * float(head.radii[1])
        center = head.center + head.rotation @ torch.tensor([0.0, along, 0.0])
        center = center + torch.tensor([0.0, 0.0, 1.45 * float(head.radii[2])])
        points, normals, widths = ellipsoid(center.tolist(), (0.032, 0.052, 0.16), SPACING)
        within = torch.sigmoid((normals @ head.rotation[:, 0] - 0.55) / 0.1)[:, None]
        albedo = within * torch.tensor(PINK) + (1 - within) * torch.tensor(GREY)
        made.append(painted(points, normals, widths, albedo, light))
    return Gaussians.cat(made)


def scarf(head: Solid, body: Solid, light: Light) -> Gaussians:
    """A striped ring around the neck, and one end that hangs down in front."""
    down = torch.nn.functional.normalize(body.center - head.center, dim=0)
    neck = head.center + 0.86 * float(head.radii[2]) * down
    forward = head.rotation[:, 0] - (head.rotation[:, 0] @ down) * down
    forward = torch.nn.functional.normalize(forward, dim=0)
    aside = torch.linalg.cross(forward, down)
    wide, thick = 0.94 * float(head.radii[1]), 0.055
    n, m = max(8, round(2 * math.pi * wide / SPACING)), max(8, round(2 * math.pi * thick / SPACING))
    u, v = torch.meshgrid(torch.arange(n) / n, torch.arange(m) / m, indexing="ij")
    u, v = u.reshape(-1), v.reshape(-1)
    out = (2 * math.pi * u).cos()[:, None] * forward + (2 * math.pi * u).sin()[:, None] * aside
    normals = (2 * math.pi * v).cos()[:, None] * out - (2 * math.pi * v).sin()[:, None] * down
    points = neck + wide * out + thick * normals
    ring = painted(points, normals, torch.full((n * m,), 0.62 * OVERLAP * SPACING), striped(u, RED, WHITE, 9), light)
    turned = torch.stack([forward, aside, -down], -1)
    end = neck + (wide + 1.3 * thick) * forward + 0.09 * aside + 0.14 * down
    points, normals, widths = ellipsoid(end.tolist(), (0.03, 0.05, 0.16), SPACING, turned)
    share = ((points - end) @ down / 0.32 + 0.5).clamp(0, 1)
    return Gaussians.cat([ring, painted(points, normals, widths, striped(share, RED, WHITE, 3), light)])
