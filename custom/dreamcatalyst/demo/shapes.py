"""Surfaces made of flat splats: ellipsoids, discs and domes, with texture and baked light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import Gaussians
from ..scene.place import frames

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
OVERLAP = 1.15  # a splat's standard deviation over half the spacing of its neighbours: closed, not blurred
Surface = tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Float[Tensor, " N"]]  # points, normals, widths
FLATNESS = 0.12  # thickness of a surface splat over its width


@dataclass(frozen=True)
class Light:
    """One distant lamp and the light from everywhere. direction: towards the lamp (need not be of unit length).

    lamp, ambient: strengths. color: RGB of both, 1 for white.
    """

    direction: tuple[float, float, float] = (0.5, 0.35, 0.8)
    lamp: float = 0.65
    ambient: float = 0.45
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def shade(self, normals: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Brightness of surfaces with unit `normals`; a wrapped cosine, so that no side is black."""
        towards = torch.nn.functional.normalize(torch.tensor(self.direction, dtype=normals.dtype), dim=0)
        return self.ambient + self.lamp * ((normals @ towards) * 0.5 + 0.5) ** 1.5

    def lit(self, normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The light that surfaces with unit `normals` send back where they are white."""
        return self.shade(normals)[:, None] * normals.new_tensor(self.color)


def sphere_points(n: int) -> Float[Tensor, "{n} 3"]:
    """n nearly evenly spread points on the unit sphere (a Fibonacci lattice)."""
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / n
    r = (1 - z * z).clamp(min=0).sqrt()
    return torch.stack([r * torch.cos(GOLDEN_ANGLE * i), r * torch.sin(GOLDEN_ANGLE * i), z], -1).float()


def facing(scene: Gaussians) -> Float[Tensor, "N 3"]:
    """Unit normals of flat splats: where their quaternions turn the z axis."""
    w, x, y, z = torch.nn.functional.normalize(scene.quats, dim=-1).unbind(-1)
    return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)


def turn(axis: str, degrees: float) -> Float[Tensor, "3 3"]:
    """The rotation matrix about the x, y or z axis, counterclockwise as seen from the axis' tip."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    out = torch.eye(3)
    out[i, i], out[i, j], out[j, i], out[j, j] = c, -s, s, c
    return out


def surface(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    widths: Float[Tensor, " N"],
    colors: Float[Tensor, "N 3"],
    opacity: float = 0.95,
) -> Gaussians:
    """Flat splats tangent to a surface. widths: standard deviation, world units."""
    scales = torch.stack([widths, widths, widths * FLATNESS], -1)
    return Gaussians.from_colors(
        points, scales, colors.clamp(0, 1), points.new_full((len(points),), opacity), frames(normals)
    )


def speckle(points: Float[Tensor, "N 3"], seed: int, strength: float, scale: float) -> Float[Tensor, " N"]:
    """A smooth random brightness around 0 (about +-strength): a sum of seeded plane waves of wavelength `scale`."""
    rng = np.random.default_rng(seed)
    waves = torch.from_numpy(rng.normal(size=(12, 3)).astype(np.float32)) * (2 * math.pi / scale)
    phases = torch.from_numpy(rng.uniform(0, 2 * math.pi, 12).astype(np.float32))
    return strength * torch.sin(points @ waves.T + phases).mean(-1) * 2


def ellipsoid(
    center: Sequence[float], radii: Sequence[float], spacing: float, rotation: Float[Tensor, "3 3"] | None = None
) -> Surface:
    """Points, unit normals and splat widths on an ellipsoid, about `spacing` (world units) apart."""
    r = torch.tensor(radii, dtype=torch.float32)
    a, b, c = (float(v) ** 1.6075 for v in radii)
    area = 4 * math.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6075)  # Thomsen's approximation
    unit = sphere_points(max(24, int(area / (spacing * spacing))))
    normals = torch.nn.functional.normalize(unit / r, dim=-1)
    stretch = (r.prod() * (unit / r).norm(dim=-1)).sqrt()  # how much the lattice is drawn apart there
    widths = 0.5 * OVERLAP * math.sqrt(4 * math.pi / len(unit)) * stretch
    points = unit * r
    if rotation is not None:
        points, normals = points @ rotation.T, normals @ rotation.T
    return points + torch.tensor(center, dtype=torch.float32), normals, widths


def disc(center: Sequence[float], radius: float, n: int) -> Surface:
    """Points, normals (up, +z) and widths of a flat round floor of n splats (a Vogel spiral)."""
    i = torch.arange(n, dtype=torch.float32) + 0.5
    r, angle = radius * (i / n).sqrt(), GOLDEN_ANGLE * i
    points = torch.stack([r * torch.cos(angle), r * torch.sin(angle), torch.zeros(n)], -1)
    normals = points.new_tensor([0.0, 0, 1]).expand(n, 3)
    widths = points.new_full((n,), 0.5 * OVERLAP * radius * math.sqrt(math.pi / n))
    return points + torch.tensor(center, dtype=torch.float32), normals, widths


def plane(center: Sequence[float], right: Sequence[float], up: Sequence[float], spacing: float) -> Surface:
    """Points, normals and widths of a rectangle: `right` and `up` lead from its centre to the middles of two sides;
    its normal is right x up."""
    middle, x, y = (torch.tensor(v, dtype=torch.float32) for v in (center, right, up))
    n, m = (max(2, round(2 * float(v.norm()) / spacing)) for v in (x, y))
    a, b = torch.meshgrid((torch.arange(n) + 0.5) / n * 2 - 1, (torch.arange(m) + 0.5) / m * 2 - 1, indexing="ij")
    points = middle + a.reshape(-1, 1) * x + b.reshape(-1, 1) * y
    normal = torch.nn.functional.normalize(torch.linalg.cross(x, y), dim=0)
    return points, normal.repeat(n * m, 1), points.new_full((n * m,), 0.65 * OVERLAP * spacing)


def dome(radius: float, n: int, lowest: float = -0.15) -> Surface:
    """Points, inward normals and widths of a sky: the part of a sphere above height `lowest` * radius."""
    unit = sphere_points(n)
    unit = unit[unit[:, 2] > lowest]
    widths = unit.new_full((len(unit),), 0.8 * OVERLAP * radius * math.sqrt(4 * math.pi / n))  # soft, as a sky is
    return unit * radius, -unit, widths
