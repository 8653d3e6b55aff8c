"""Where a synthetic scene's things stand: grounds of several kinds, skies, walls, rooms and trees."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor

from ..scene.gaussians import Gaussians
from .shapes import Light, disc, dome, ellipsoid, plane, speckle, surface
from .worlds import label

FLOOR_RADIUS, SKY_RADIUS = 3.9, 5.4  # world units; cameras stay within the floor's
ROOM = 3.5  # half the side of a room
FLOOR_SPLATS, SKY_SPLATS = 4200, 1700

Palette = tuple[tuple[float, float, float], ...]


def near(color: Sequence[float], rng: Generator, tint: float = 0.03, value: float = 0.15) -> Float[Tensor, " 3"]:
    """A colour near `color`: brighter or darker by up to `value` of itself, each channel moved by about `tint`."""
    jitter = rng.uniform(1 - value, 1 + value) * (1 + tint * rng.normal(size=3))
    return torch.tensor(np.clip(np.array(color) * jitter, 0.02, 0.98), dtype=torch.float32)


def one_of(palette: Palette, rng: Generator) -> Float[Tensor, " 3"]:
    """A colour near one of `palette`."""
    return near(palette[rng.integers(len(palette))], rng)


def cells(ij: Float[Tensor, "N 2"], seed: int) -> Float[Tensor, " N"]:
    """A repeatable number in [0,1) for every integer cell ij."""
    wave = torch.sin(ij.double() @ torch.tensor([12.9898, 78.233], dtype=torch.float64) + seed % 1000) * 43758.5453
    return (wave - wave.floor()).float()


def mottled(points: Float[Tensor, "N 3"], rng: Generator, coarse: float, fine: float) -> Float[Tensor, "N 1"]:
    """Brightness around 1 with spots of about 0.9 and 0.17 units and the given strengths."""
    seed = int(rng.integers(2**31))
    return (1 + speckle(points, seed, coarse, 0.9) + speckle(points, seed + 1, fine, 0.17))[:, None]


def lawn(points: Float[Tensor, "N 3"], rng: Generator) -> Float[Tensor, "N 3"]:
    """Grass, half the time with a round path around the middle, as the statue's own."""
    color = one_of(((0.30, 0.44, 0.20), (0.36, 0.48, 0.18), (0.24, 0.38, 0.20)), rng).expand(len(points), 3)
    if rng.random() < 0.5:
        r = points[:, :2].norm(dim=-1, keepdim=True)
        inner = rng.uniform(0.5, 0.8)
        wave = 0.04 * torch.sin(5 * torch.atan2(points[:, 1:2], points[:, :1]))
        path = torch.sigmoid((r - inner) / 0.02) * torch.sigmoid((inner + rng.uniform(0.25, 0.6) + wave - r) / 0.02)
        color = color * (1 - path) + path * one_of(((0.66, 0.60, 0.50), (0.58, 0.56, 0.53), (0.62, 0.50, 0.40)), rng)
    return color * mottled(points, rng, 0.25, 0.22)


def paving(points: Float[Tensor, "N 3"], rng: Generator) -> Float[Tensor, "N 3"]:
    """Slabs with darker joints."""
    angle, size = rng.uniform(0, math.pi / 2), rng.uniform(0.35, 0.7)
    c, s = math.cos(angle), math.sin(angle)
    ij = points[:, :2] @ torch.tensor([[c, -s], [s, c]], dtype=torch.float32) / size
    cell = ij.floor()
    edge = (ij - cell - 0.5).abs().amax(-1)
    joint = torch.sigmoid((edge - 0.46) / 0.02)
    tone = 0.9 + 0.2 * cells(cell, int(rng.integers(1000))) - 0.3 * joint
    stone = one_of(((0.58, 0.57, 0.55), (0.66, 0.61, 0.53), (0.56, 0.44, 0.38), (0.48, 0.50, 0.53)), rng)
    return stone * tone[:, None] * mottled(points, rng, 0.08, 0.06)


def sand(points: Float[Tensor, "N 3"], rng: Generator) -> Float[Tensor, "N 3"]:
    """Sand with ripples."""
    angle = rng.uniform(0, math.pi)
    along = points[:, :2] @ torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float32)
    bend = speckle(points, int(rng.integers(2**31)), 0.6, 1.6)
    ripple = 1 + 0.05 * torch.sin(2 * math.pi * along / rng.uniform(0.25, 0.4) + 4 * bend)
    color = one_of(((0.78, 0.68, 0.50), (0.82, 0.75, 0.60), (0.72, 0.58, 0.42)), rng)
    return color * ripple[:, None] * mottled(points, rng, 0.06, 0.06)


def wood(points: Float[Tensor, "N 3"], rng: Generator) -> Float[Tensor, "N 3"]:
    """Boards with grain along them."""
    angle, size = rng.uniform(0, math.pi), rng.uniform(0.22, 0.4)
    c, s = math.cos(angle), math.sin(angle)
    u, v = (points[:, :2] @ torch.tensor([[c, -s], [s, c]], dtype=torch.float32)).unbind(-1)
    board = (v / size).floor()
    tone = 0.85 + 0.3 * cells(torch.stack([board, torch.zeros_like(board)], -1), int(rng.integers(1000)))
    gap = torch.sigmoid(((v / size - board - 0.5).abs() - 0.46) / 0.02)
    stretched = torch.stack([u * 0.12, v, board], -1)
    grain = speckle(stretched, int(rng.integers(2**31)), 0.14, 0.15)
    color = one_of(((0.55, 0.38, 0.24), (0.66, 0.50, 0.34), (0.42, 0.29, 0.20), (0.56, 0.50, 0.44)), rng)
    return color * (tone * (1 + grain) - 0.3 * gap)[:, None]


def earth(points: Float[Tensor, "N 3"], rng: Generator) -> Float[Tensor, "N 3"]:
    """Bare earth or gravel."""
    color = one_of(((0.45, 0.36, 0.27), (0.55, 0.52, 0.48), (0.50, 0.42, 0.34), (0.38, 0.33, 0.28)), rng)
    return color * mottled(points, rng, 0.15, 0.25)


def meadow(points: Float[Tensor, "N 3"], rng: Generator) -> Float[Tensor, "N 3"]:
    """Grass with patches of earth."""
    patch = torch.sigmoid(speckle(points, int(rng.integers(2**31)), 6.0, 1.8) - rng.uniform(0, 2))[:, None]
    return lawn(points, rng) * (1 - patch) + earth(points, rng) * patch


OUTDOORS: dict[str, tuple[Callable, float]] = {  # ground and how often it is drawn
    "lawn": (lawn, 0.42),
    "meadow": (meadow, 0.13),
    "paving": (paving, 0.17),
    "sand": (sand, 0.13),
    "earth": (earth, 0.15),
}
INDOORS: dict[str, tuple[Callable, float]] = {"wood": (wood, 0.6), "paving": (paving, 0.4)}


def floor(
    rng: Generator, light: Light, level: float, kinds: dict, square: bool, shadows: Float[Tensor, "K 3"]
) -> Gaussians:
    """A ground at height `level`. shadows: x, y and radius of the soft dark spot below each thing."""
    names, chances = list(kinds), np.array([chance for _, chance in kinds.values()])
    kind = kinds[names[rng.choice(len(names), p=chances / chances.sum())]][0]
    if square:
        points, normals, widths = plane((0.0, 0.0, level), (ROOM, 0.0, 0.0), (0.0, ROOM, 0.0), 0.108)
    else:
        points, normals, widths = disc((0.0, 0.0, level), FLOOR_RADIUS, FLOOR_SPLATS)
        widths = widths * rng.uniform(1.0, 1.35)  # sharp with a little sky shining through, or closed
    color = kind(points, rng) * light.lit(normals)
    strength = rng.uniform(0.0, 0.45)
    for x, y, radius in shadows.tolist():
        distance = ((points[:, :2] - torch.tensor([x, y])) / radius).square().sum(-1)
        color = color * (1 - strength * torch.exp(-0.5 * distance))[:, None]
    return label("floor", surface(points, normals, widths, color))


def sky(rng: Generator) -> Gaussians:
    """A dome from horizon to zenith, clear, cloudy or grey."""
    points, normals, widths = dome(SKY_RADIUS, SKY_SPLATS)
    height = (points[:, 2:] / SKY_RADIUS).clamp(0, 1).sqrt()
    zenith = one_of(((0.33, 0.52, 0.82), (0.28, 0.46, 0.76), (0.45, 0.60, 0.80), (0.62, 0.66, 0.70)), rng)
    horizon = one_of(((0.85, 0.87, 0.88), (0.78, 0.85, 0.92), (0.86, 0.86, 0.84)), rng)
    cloud = torch.sigmoid(speckle(points, int(rng.integers(2**31)), 4.0, 3.5) - rng.uniform(-0.5, 2.0))[:, None]
    cloud = cloud * rng.uniform(0.1, 0.6)
    return label(
        "sky", surface(points, normals, widths, (zenith * height + horizon * (1 - height)) * (1 - cloud) + 0.97 * cloud)
    )


def trees(rng: Generator, light: Light, level: float) -> list[Gaussians]:
    """A few trees or bushes near the rim of the floor, behind where cameras stand."""
    made = []
    for angle in rng.uniform(0, 2 * math.pi, rng.integers(2, 8)):
        distance, size = rng.uniform(3.3, 3.8), rng.uniform(0.35, 0.7)
        bush = rng.random() < 0.4
        x, y, z = distance * math.cos(angle), distance * math.sin(angle), level + (0.5 * size if bush else 1.3 * size)
        leaves = one_of(((0.22, 0.38, 0.16), (0.30, 0.42, 0.18), (0.16, 0.30, 0.18)), rng)
        points, normals, widths = ellipsoid((x, y, z), (size * 0.8, size * 0.8, size), 0.11)
        color = leaves * light.lit(normals) * mottled(points, rng, 0.3, 0.35)
        made.append(label("tree", surface(points, normals, widths, color)))
        if not bush:
            points, normals, widths = ellipsoid((x, y, level + 0.3 * size), (0.08, 0.08, 0.6 * size), 0.07)
            color = near((0.36, 0.27, 0.20), rng) * light.lit(normals) * mottled(points, rng, 0.1, 0.2)
            made.append(label("tree", surface(points, normals, widths, color)))
    return made


def garden_wall(rng: Generator, light: Light, level: float) -> Gaussians:
    """A round wall or hedge at the rim of the floor, of stone, brick or green."""
    radius, height = FLOOR_RADIUS - 0.1, float(rng.uniform(0.5, 1.5))
    spacing = 0.15
    n, rows = int(2 * math.pi * radius / spacing), max(3, int(height / spacing))
    angle, z = torch.meshgrid(torch.arange(n) * (2 * math.pi / n), (torch.arange(rows) + 0.5) * spacing, indexing="ij")
    angle, z = angle.reshape(-1), z.reshape(-1)
    normals = torch.stack([-angle.cos(), -angle.sin(), torch.zeros_like(angle)], -1)
    points = -radius * normals
    points[:, 2] = z + level
    color = one_of(((0.55, 0.50, 0.44), (0.56, 0.34, 0.26), (0.70, 0.66, 0.60), (0.20, 0.34, 0.16)), rng)
    brick = torch.stack([(angle * radius / 0.45 + 0.5 * (z / 0.3).floor()).floor(), (z / 0.3).floor()], -1)
    tone = 0.85 + 0.3 * cells(brick, int(rng.integers(1000)))
    color = color * tone[:, None] * light.lit(normals) * mottled(points, rng, 0.1, 0.12)
    return label("wall", surface(points, normals, torch.full_like(z, 0.75 * spacing), color))


def room(rng: Generator, light: Light, level: float) -> list[Gaussians]:
    """Four walls with a skirting, and a ceiling."""
    paint = one_of(
        ((0.82, 0.79, 0.72), (0.62, 0.70, 0.74), (0.72, 0.76, 0.66), (0.80, 0.70, 0.62), (0.6, 0.6, 0.62)), rng
    )
    skirting = near((0.75, 0.72, 0.68), rng)
    made, top = [], 2.9
    for k in range(4):
        c, s = round(math.cos(k * math.pi / 2)), round(math.sin(k * math.pi / 2))
        points, normals, widths = plane(
            (ROOM * c, ROOM * s, level + top / 2), (ROOM * s, -ROOM * c, 0.0), (0.0, 0.0, top / 2), 0.16
        )
        normals = normals * -torch.sign((normals * points)[:, :2].sum(-1, keepdim=True))  # inward
        low = torch.sigmoid((level + 0.22 - points[:, 2:]) / 0.03)
        color = (paint * (1 - low) + skirting * low) * light.lit(normals) * mottled(points, rng, 0.04, 0.02)
        made.append(label("wall", surface(points, normals, widths, color)))
    points, normals, widths = plane((0.0, 0.0, level + top), (0.0, ROOM, 0.0), (ROOM, 0.0, 0.0), 0.25)
    made.append(
        label(
            "wall", surface(points, normals, widths, near((0.85, 0.84, 0.80), rng) * light.lit(normals).clamp(min=0.7))
        )
    )
    return made
