"""Worlds drawn at random: a bear statue or other things on some ground, under a sky or in a room."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor

from ..data.camera import Cameras, look_at
from ..scene.gaussians import Gaussians
from .bears import bear_solids, turned
from .places import INDOORS, OUTDOORS, floor, garden_wall, mottled, near, one_of, room, sky, trees
from .shapes import Light, ellipsoid, plane, surface, turn
from .worlds import Solid, Thing, World, carve, label, statue

HELD_OUT = 1000  # seeds below are for judging; training pairs are made of worlds with this seed or above
LEVEL = -0.12  # height of the ground
STONES = (
    (0.60, 0.56, 0.52),
    (0.52, 0.52, 0.53),
    (0.68, 0.64, 0.58),
    (0.62, 0.52, 0.42),
    (0.44, 0.43, 0.42),
    (0.56, 0.47, 0.42),
    (0.50, 0.53, 0.48),
)
PAINTS = (
    (0.72, 0.22, 0.18),
    (0.20, 0.36, 0.66),
    (0.30, 0.52, 0.26),
    (0.80, 0.66, 0.22),
    (0.82, 0.80, 0.76),
    (0.48, 0.30, 0.56),
    (0.78, 0.46, 0.20),
    (0.55, 0.55, 0.55),
    (0.45, 0.32, 0.22),
)
CLAY = ((0.66, 0.38, 0.26), (0.58, 0.56, 0.54), (0.36, 0.42, 0.50), (0.80, 0.76, 0.70))


def random_light(rng: Generator) -> Light:
    """A lamp from anywhere above, of daylight's colours."""
    azimuth, height = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(25, 75))
    direction = (math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height))
    warm = rng.normal() * 0.035
    color = (1 + warm, 1.0, 1 - warm)
    return Light(direction, rng.uniform(0.5, 0.8), rng.uniform(0.4, 0.55), color)


def pedestal(rng: Generator) -> tuple[Solid, float]:
    """A flat round stone, and the height of what stands on it."""
    height = rng.uniform(0.07, 0.13)
    radius = rng.uniform(0.40, 0.52)
    solid = Solid("pedestal", torch.tensor([0.05, 0.0, LEVEL + 0.8 * height]), torch.tensor([radius, radius, height]))
    return solid, LEVEL + 1.5 * height


def bear(rng: Generator, light: Light, first: int) -> tuple[Gaussians, Thing]:
    """A bear statue in the middle, most often on a pedestal, turned any way."""
    base, level = pedestal(rng) if rng.random() < 0.7 else (None, LEVEL)
    spin, size = turn("z", rng.uniform(0, 360)), rng.uniform(0.92, 1.06)
    parts = [turned(part, torch.zeros(3), spin, size) for part in bear_solids(rng)]
    lift = torch.tensor([*rng.uniform(-0.06, 0.06, 2), level], dtype=torch.float32)
    parts = [Solid(p.name, p.center + lift, p.radii, p.rotation) for p in parts]
    parts += [base] if base else []
    scene, placed = carve(parts, one_of(STONES, rng), int(rng.integers(2**31)), light)
    return scene, statue(placed, first)


def ball(rng: Generator, light: Light, at: Float[Tensor, " 2"], size: float) -> list[Gaussians]:
    """A ball, plain or with a band around it."""
    points, normals, widths = ellipsoid((*at.tolist(), LEVEL + size), (size,) * 3, max(0.03, 0.1 * size))
    color = one_of(PAINTS, rng).expand(len(points), 3)
    if rng.random() < 0.4:
        axis = torch.nn.functional.normalize(torch.tensor(rng.normal(size=3), dtype=torch.float32), dim=0)
        color = torch.where((normals @ axis).abs()[:, None] < 0.25, one_of(PAINTS, rng), color)
    color = color * light.lit(normals) * mottled(points, rng, 0.03, 0.05)
    return [label("ball", surface(points, normals, widths, color))]


def box(rng: Generator, light: Light, at: Float[Tensor, " 2"], size: float) -> list[Gaussians]:
    """A box of painted boards, five sides of it."""
    half = torch.tensor([size * rng.uniform(0.8, 1.2), size * rng.uniform(0.8, 1.2), size * rng.uniform(0.7, 1.3)])
    spin, (a, b, c) = turn("z", rng.uniform(0, 360)), half.float().tolist()
    center = torch.tensor([*at.tolist(), LEVEL + c])
    paint = one_of(PAINTS, rng)
    sides = [((0, 0, c), (a, 0, 0), (0, b, 0))]
    sides += [((s * a, 0, 0), (0, s * b, 0), (0, 0, c)) for s in (1, -1)]
    sides += [((0, s * b, 0), (-s * a, 0, 0), (0, 0, c)) for s in (1, -1)]
    made = []
    for side in sides:
        middle, right, up = (spin @ torch.tensor(vector, dtype=torch.float32) for vector in side)
        spacing = max(0.035, 0.12 * size)
        points, normals, widths = plane((center + middle).tolist(), right.tolist(), up.tolist(), spacing)
        board = 1 + 0.12 * torch.sign(torch.sin((points[:, 2] - LEVEL) * 2 * math.pi / 0.22))[:, None]
        color = paint * light.lit(normals) * board * mottled(points, rng, 0.05, 0.06)
        made.append(label("box", surface(points, normals, widths, color)))
    return [Gaussians.cat(made)]


def plant(rng: Generator, light: Light, at: Float[Tensor, " 2"], size: float) -> list[Gaussians]:
    """A pot, and the leaves in it."""
    x, y = at.tolist()
    points, normals, widths = ellipsoid(
        (x, y, LEVEL + 0.55 * size), (0.55 * size, 0.55 * size, 0.6 * size), max(0.03, 0.1 * size)
    )
    pot = surface(points, normals, widths, one_of(CLAY, rng) * light.lit(normals) * mottled(points, rng, 0.04, 0.08))
    green = one_of(((0.24, 0.42, 0.16), (0.34, 0.48, 0.20), (0.20, 0.36, 0.22)), rng)
    leaves = []
    for _ in range(int(rng.integers(7, 13))):
        tilt, spin = rng.uniform(5, 60), rng.uniform(0, 360)
        rotation = turn("z", spin) @ turn("y", tilt)
        reach = size * rng.uniform(0.45, 0.8)
        center = torch.tensor([x, y, LEVEL + size]) + rotation @ torch.tensor([0.0, 0.0, 0.8 * reach])
        points, normals, widths = ellipsoid(
            center.tolist(), (0.10 * size, 0.22 * size, reach), max(0.035, 0.1 * size), rotation
        )
        color = near(green.tolist(), rng) * light.lit(normals) * mottled(points, rng, 0.1, 0.15)
        leaves.append(surface(points, normals, widths, color))
    return [label("pot", pot), label("plant", Gaussians.cat(leaves))]


# The first of what each makes is what an instruction names.
MAKERS = {"ball": ball, "box": box, "flower pot": plant}


def cameras_around(rng: Generator, n: int, size: int) -> Cameras:
    """n cameras of any side, distance, height and field of view that keep what stands in the middle in the picture."""
    angle = torch.tensor(rng.uniform(0, 2 * math.pi, n))
    tilt = torch.tensor(np.clip(rng.normal(17, 10, n), 1, 40)).deg2rad()
    fov = rng.uniform(38, 52, n)
    seen = rng.uniform(1.6, 2.2, n)  # height of what the picture shows at the target, world units
    radius = torch.tensor(np.clip(seen / 2 / np.tan(np.radians(fov) / 2), 1.9, 3.0))
    target = torch.tensor([0.0, 0.0, 0.44]) + torch.tensor(rng.normal(size=(n, 3)) * 0.05)
    eye = target + radius[:, None] * torch.stack([tilt.cos() * angle.cos(), tilt.cos() * angle.sin(), tilt.sin()], -1)
    K = torch.zeros(n, 3, 3)
    K[:, 0, 0] = K[:, 1, 1] = torch.tensor(0.5 * size / np.tan(np.radians(fov) / 2))
    K[:, 0, 2] = K[:, 1, 2] = size / 2
    K[:, 2, 2] = 1
    return Cameras(look_at(eye.float(), target.float(), torch.tensor([0.0, 0.0, 1.0])), K, size, size)


def arranged(rng: Generator, with_bear: bool) -> list[tuple[str, Float[Tensor, " 2"], float]]:
    """What stands around the bear, or in its place and around that: kind, place on the ground, size."""
    kinds = [str(kind) for kind in rng.permutation(["ball", "box", "flower pot"])]
    kinds = kinds[: rng.choice(3, p=[0.5, 0.35, 0.15])] if with_bear else kinds[: rng.integers(1, 3)]
    start, out = rng.uniform(0, 2 * math.pi), []
    for k, kind in enumerate(kinds):
        if k == 0 and not with_bear:
            out.append((kind, torch.zeros(2), rng.uniform(0.32, 0.5)))
        else:
            angle = start + 2.4 * k + rng.uniform(-0.5, 0.5)
            at = rng.uniform(0.75, 0.95) * torch.tensor([math.cos(angle), math.sin(angle)])
            out.append((kind, at, rng.uniform(0.14, 0.26)))
    return out


def surroundings(rng: Generator, light: Light, shadows: Float[Tensor, "K 3"]) -> list[Gaussians]:
    """Ground with sky, trees and walls as they come, or a room. shadows: as `floor` takes them."""
    if rng.random() < 0.18:
        return [floor(rng, light, LEVEL, INDOORS, True, shadows), *room(rng, light, LEVEL)]
    made = [floor(rng, light, LEVEL, OUTDOORS, False, shadows), sky(rng)]
    made += trees(rng, light, LEVEL) if rng.random() < 0.4 else []
    made += [garden_wall(rng, light, LEVEL)] if rng.random() < 0.25 else []
    return made


def random_world(seed: int = 0, views: int = 32, size: int = 128) -> World:
    """The world of `seed`, with `views` cameras of `size` x `size` pixels around its middle.

    Three in four have a bear statue in the middle, the others a ball, a box or a plant in its place. Seeds below
    HELD_OUT are for judging; a seed gives the same splats again, whatever `views` and `size`.
    """
    rng = np.random.default_rng([seed, 1])
    light, with_bear = random_light(rng), rng.random() < 0.75
    placed = arranged(rng, with_bear)
    shadows = [[0.0, 0.0, 0.42]] * with_bear + [[*at.tolist(), 1.1 * extent] for _, at, extent in placed]
    made, things = surroundings(rng, light, torch.tensor(shadows)), []
    if with_bear:
        scene, thing = bear(rng, light, sum(len(part) for part in made))
        made.append(scene)
        things.append(thing)
    for kind, at, extent in placed:
        first = sum(len(part) for part in made)
        scenes = MAKERS[kind](rng, light, at, extent)
        things.append(Thing(kind, (first, first + len(scenes[0]))))
        made += scenes
    cameras = cameras_around(np.random.default_rng([seed, 2]), views, size)
    return World(Gaussians.cat(made), cameras, light=light, things=tuple(things), seed=seed)
