"""Small scenes that the project makes itself: a scene, the cameras around it and what each splat belongs to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.camera import Cameras, look_at
from ..errors import ConfigError, choose
from ..registry import Registry
from ..scene.gaussians import Gaussians
from .shapes import Light, disc, dome, ellipsoid, speckle, surface

# The statue, in units of about its own height: name, centre, radii (x forward, y left, z up).
BEAR = (
    ("body", (0.0, 0.0, 0.46), (0.27, 0.25, 0.33)),
    ("belly", (0.11, 0.0, 0.42), (0.19, 0.19, 0.24)),
    ("head", (0.08, 0.0, 0.88), (0.19, 0.20, 0.18)),
    ("muzzle", (0.25, 0.0, 0.83), (0.10, 0.09, 0.075)),
    ("nose", (0.335, 0.0, 0.855), (0.032, 0.04, 0.028)),
    ("ear", (0.05, 0.15, 1.04), (0.045, 0.065, 0.065)),
    ("ear", (0.05, -0.15, 1.04), (0.045, 0.065, 0.065)),
    ("eye", (0.235, 0.075, 0.925), (0.024, 0.026, 0.028)),
    ("eye", (0.235, -0.075, 0.925), (0.024, 0.026, 0.028)),
    ("arm", (0.14, 0.25, 0.50), (0.10, 0.09, 0.20)),
    ("arm", (0.14, -0.25, 0.50), (0.10, 0.09, 0.20)),
    ("leg", (0.20, 0.18, 0.14), (0.20, 0.11, 0.12)),
    ("leg", (0.20, -0.18, 0.14), (0.20, 0.11, 0.12)),
    ("pedestal", (0.06, 0.0, -0.04), (0.46, 0.42, 0.10)),
)
STONE = {"nose": 0.55, "eye": 0.35, "muzzle": 1.08, "pedestal": 0.8}  # brightness by part, of the stone's colour
# What a splat can belong to; the splats' extra "part" is an index into this.
PARTS = ("floor", "sky", *dict.fromkeys(name for name, _, _ in BEAR), "wall", "tree", "ball", "box", "pot", "plant")
PARTS += ("hat", "rabbit ear", "scarf")  # what edits add
UPRIGHT = torch.eye(3)


@dataclass(frozen=True)
class Solid:
    """An ellipsoid of the scene. center: world units; radii: along its own axes, world units;
    rotation: from its own axes to the world's; rows: first and one past the last of its splats."""

    name: str
    center: Float[Tensor, " 3"]
    radii: Float[Tensor, " 3"]
    rotation: Float[Tensor, "3 3"] = field(default_factory=lambda: UPRIGHT)
    rows: tuple[int, int] = (0, 0)

    def local(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Points in the solid's own axes and radii: of length 1 on its surface."""
        return (points - self.center) @ self.rotation / self.radii


@dataclass(frozen=True)
class Thing:
    """What an instruction can name. name: as in the instruction ("bear statue"); rows: first and one past the last of
    its splats; solids: what it is made of, where that matters to an edit."""

    name: str
    rows: tuple[int, int]
    solids: tuple[Solid, ...] = ()


@dataclass(frozen=True)
class World:
    """A made scene. scene: splats with the extra "part" [N] (an index into PARTS); cameras: V views of it;
    light: what it is lit by; things: what instructions can name; seed: it was made from."""

    scene: Gaussians
    cameras: Cameras
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    light: Light = field(default_factory=Light)
    things: tuple[Thing, ...] = ()
    seed: int = 0

    @property
    def outdoors(self) -> bool:
        """Whether there is a sky."""
        return bool(part_mask(self.scene, "sky").any())

    def thing(self, name: str) -> Thing:
        """The thing called `name`. Raises ConfigError naming the nearest one of this world."""
        known = {thing.name: thing for thing in self.things}
        return known[choose("thing in this world", name, known)]


def label(name: str, scene: Gaussians) -> Gaussians:
    """The same splats as part `name`."""
    return scene.with_extra(part=torch.full((len(scene),), float(PARTS.index(name))))


def solids(rows: Sequence[tuple]) -> list[Solid]:
    """Solids from rows of (name, centre, radii), as BEAR has them."""
    return [Solid(name, torch.tensor(center), torch.tensor(radii)) for name, center, radii in rows]


def carve(
    parts: Sequence[Solid], stone: Float[Tensor, " 3"], seed: int, light: Light, spacing: float = 0.028
) -> tuple[Gaussians, list[Solid]]:
    """Ellipsoids of one speckled stone of that colour; the same solids with their rows, counted from 0."""
    made, placed, first = [], [], 0
    for part in parts:
        fine = spacing * (0.55 if part.name in ("eye", "nose") else 0.8 if part.name in ("ear", "muzzle") else 1.0)
        points, normals, widths = ellipsoid(part.center.tolist(), part.radii.tolist(), fine, part.rotation)
        grain = 1 + speckle(points, seed, 0.18, 0.25) + speckle(points, seed + 1, 0.12, 0.07)
        shade = light.lit(normals) * grain[:, None] * STONE.get(part.name, 1.0)
        made.append(label(part.name, surface(points, normals, widths, stone * shade)))
        placed.append(replace(part, rows=(first, first + len(points))))
        first += len(points)
    return Gaussians.cat(made), placed


def statue(parts: Sequence[Solid], first: int) -> Thing:
    """What "the bear statue" names among carved `parts` (all but the pedestal), where their splats begin at `first`."""
    shifted = [
        replace(part, rows=(part.rows[0] + first, part.rows[1] + first)) for part in parts if part.name != "pedestal"
    ]
    return Thing("bear statue", (shifted[0].rows[0], shifted[-1].rows[1]), tuple(shifted))


def bear_statue(seed: int, spacing: float = 0.028, light: Light | None = None) -> Gaussians:
    """A bear of stone that sits on a pedestal: one ellipsoid per part, every splat labelled with its part."""
    return carve(solids(BEAR), torch.tensor([0.60, 0.56, 0.52]), seed, light or Light(), spacing)[0]


def surroundings(seed: int, light: Light | None = None) -> Gaussians:
    """A round lawn with a path around the statue, and a sky over it."""
    light = light or Light()
    points, normals, widths = disc((0.0, 0.0, -0.12), 3.6, 3600)
    r = points[:, :2].norm(dim=-1, keepdim=True)
    wave = 0.04 * torch.sin(5 * torch.atan2(points[:, 1:2], points[:, :1]))
    path = torch.sigmoid((r - 0.62) / 0.02) * torch.sigmoid((0.98 + wave - r) / 0.02)
    grass, gravel = torch.tensor([0.30, 0.44, 0.20]), torch.tensor([0.66, 0.60, 0.50])
    color = grass * (1 - path) + gravel * path
    mottle = 1 + speckle(points, seed + 2, 0.25, 0.9) + speckle(points, seed + 3, 0.22, 0.17)
    lawn = surface(points, normals, widths, color * (light.shade(normals) * mottle)[:, None])
    points, normals, widths = dome(5.0, 1800)
    height = (points[:, 2:] / 5.0).clamp(0, 1).sqrt()
    zenith, horizon = torch.tensor([0.33, 0.52, 0.82]), torch.tensor([0.85, 0.87, 0.88])
    cloud = torch.sigmoid(speckle(points, seed + 4, 4.0, 3.5) - 0.5)[:, None] * 0.45
    sky = surface(points, normals, widths, (zenith * height + horizon * (1 - height)) * (1 - cloud) + 0.97 * cloud)
    return Gaussians.cat([label("floor", lawn), label("sky", sky)])


def orbit(n: int, size: int, radius: float = 2.35, fov: float = 42.0, target: float = 0.46) -> Cameras:
    """n cameras around the z axis at heights that wave between two rings; fov in degrees, size in pixels."""
    angle = torch.arange(n, dtype=torch.float32) * (2 * math.pi / n)
    tilt = torch.deg2rad(18 + 12 * torch.sin(3 * angle + 0.4))
    eye = radius * torch.stack([tilt.cos() * angle.cos(), tilt.cos() * angle.sin(), tilt.sin()], -1)
    eye[:, 2] += target
    focal = 0.5 * size / math.tan(math.radians(fov) / 2)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]).repeat(n, 1, 1)
    return Cameras(look_at(eye, torch.tensor([0.0, 0.0, target]), torch.tensor([0.0, 0.0, 1.0])), K, size, size)


def statue_world(seed: int = 0, views: int = 32, size: int = 128) -> World:
    """The bear statue on its lawn, with `views` cameras of `size` x `size` pixels around it."""
    light = Light()
    around = surroundings(seed, light)
    bear, parts = carve(solids(BEAR), torch.tensor([0.60, 0.56, 0.52]), seed, light)
    things = (statue(parts, len(around)),)
    return World(Gaussians.cat([around, bear]), orbit(views, size), light=light, things=things, seed=seed)


WORLDS = Registry("demo scene", __package__)
WORLDS.add("statue", statue_world)
WORLDS.add("random", ".random_world:random_world")


def make_world(name: str, where: str = "data.source", **options) -> World:
    """The world called `name` (registered in WORLDS), or that of another seed: random:7. Raises ConfigError naming the
    nearest known one."""
    kind, colon, seed = name.partition(":")
    if colon and not seed.isdecimal():
        raise ConfigError(f"{where}: got the world '{name}', expected a whole number after the colon: {kind}:7")
    return WORLDS.get(kind, where)(**options, **({"seed": int(seed)} if colon else {}))


def part_mask(scene: Gaussians, *names: str) -> Bool[Tensor, " N"]:
    """Which splats belong to one of the named parts."""
    wanted = torch.tensor([PARTS.index(choose("part", name, PARTS)) for name in names])
    return torch.isin(scene.extra["part"].long(), wanted)
