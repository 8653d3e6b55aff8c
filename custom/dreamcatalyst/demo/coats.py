"""Edits of one thing in a synthetic scene: coats and shapes of other bears, metals, paints. All else keeps its bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import SH_C0, Gaussians
from .shapes import facing, frames, speckle
from .worlds import Solid, Thing, World

FUR_SHADE = 0.8  # fur scatters light: softer shade than a stone's
Coat = Callable[
    [Thing, Solid, Float[Tensor, "N 3"]], Float[Tensor, "N 3"]
]  # thing, its solid, points in the world -> albedo


def colors_of(scene: Gaussians) -> Float[Tensor, "N 3"]:
    """Plain colours of splats without view dependence."""
    return 0.5 + SH_C0 * scene.sh0[:, 0]


def with_rows(scene: Gaussians, first: int, **fields: Float[Tensor, "n ..."]) -> Gaussians:
    """`scene` with the rows from `first` on replaced in the named parameters; `colors` [n,3] stands for sh0."""
    if "colors" in fields:
        fields["sh0"] = ((fields.pop("colors").clamp(0, 1) - 0.5) / SH_C0)[:, None]
    out = {}
    for name, rows in fields.items():
        out[name] = getattr(scene, name).clone()
        out[name][first : first + len(rows)] = rows
    return replace(scene, **out)


def soft(x: Float[Tensor, " N"], edge: float, width: float) -> Float[Tensor, "N 1"]:
    """1 where x is well below `edge`, 0 well above, over about `width`."""
    return torch.sigmoid((edge - x) / width)[:, None]


def _part(thing: Thing, name: str) -> Solid:
    return next(solid for solid in thing.solids if solid.name == name)


def _patch(points: Float[Tensor, "N 3"], eye: Solid, head: Solid) -> Float[Tensor, "N 1"]:
    """How dark the panda's patch around `eye` is at `points` of the head: an oval that hangs outwards."""
    middle, away = (eye.center - head.center) @ head.rotation, (points - eye.center) @ head.rotation
    size = eye.radii[2] / 0.028  # the statue's eye
    out, up = torch.sign(middle[1]) * away[:, 1] / size - 0.008, away[:, 2] / size + 0.010
    long, short = (out - up) * 0.7071, (out + up) * 0.7071
    return soft((long / 0.076).square() + (short / 0.054).square() + (away[:, 0] / size / 0.12).square(), 1.0, 0.12)


def panda(thing: Thing, solid: Solid, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """White; black are ears, the patches around the eyes, nose, limbs and the band over the shoulders."""
    white, black = points.new_tensor([0.93, 0.92, 0.88]), points.new_tensor([0.07, 0.07, 0.08])
    dark = points.new_zeros(len(points), 1)
    if solid.name in ("ear", "nose", "arm", "leg"):
        dark = dark + 1
    elif solid.name == "eye":  # brown, so that it is seen in its patch
        return points.new_tensor([0.24, 0.18, 0.15]).expand(len(points), 3)
    elif solid.name in ("body", "belly"):
        height = _part(thing, "body").local(points)[:, 2]
        dark = soft((height - 0.58).abs(), 0.22, 0.025)
    elif solid.name == "head":
        for eye in (part for part in thing.solids if part.name == "eye"):
            dark = torch.maximum(dark, _patch(points, eye, _part(thing, "head")))
    return white * (1 - dark) + black * dark


def polar_bear(thing: Thing, solid: Solid, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Creamy white; nose and eyes black, the muzzle and inside of the ears a little greyer."""
    color = {
        "nose": (0.06, 0.06, 0.07),
        "eye": (0.06, 0.05, 0.05),
        "muzzle": (0.90, 0.87, 0.80),
        "ear": (0.84, 0.80, 0.73),
    }
    return points.new_tensor(color.get(solid.name, (0.96, 0.94, 0.87))).expand(len(points), 3)


def grizzly(thing: Thing, solid: Solid, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Brown, darker towards the paws, with a tan muzzle and lighter, grizzled shoulders."""
    color = {
        "nose": (0.06, 0.05, 0.05),
        "eye": (0.05, 0.03, 0.02),
        "muzzle": (0.66, 0.50, 0.33),
        "ear": (0.30, 0.18, 0.09),
    }
    base = points.new_tensor(color.get(solid.name, (0.46, 0.28, 0.14))).expand(len(points), 3)
    if solid.name in ("arm", "leg"):
        paw = soft(solid.local(points)[:, 2], -0.1, 0.3)
        base = base * (1 - paw) + points.new_tensor([0.25, 0.14, 0.07]) * paw
    elif solid.name == "body":
        hump = 1 - soft(solid.local(points)[:, 2], 0.55, 0.12)
        base = base * (1 - hump) + points.new_tensor([0.60, 0.42, 0.24]) * hump
    return base


# Radii of the parts that differ, as factors (x forward, y sideways, z up in the part's own axes).
PANDA_SHAPE = {
    "ear": (1.15, 1.2, 1.2),
    "muzzle": (0.85, 1.0, 1.0),
    "belly": (1.06, 1.08, 1.0),
    "head": (1.0, 1.06, 1.03),
}
POLAR_SHAPE = {"ear": (0.9, 0.75, 0.75), "muzzle": (1.3, 0.9, 0.95), "head": (1.04, 0.92, 0.95)}
GRIZZLY_SHAPE = {
    "ear": (1.0, 0.85, 0.85),
    "muzzle": (1.15, 1.0, 1.0),
    "body": (1.06, 1.06, 1.04),
    "arm": (1.08, 1.1, 1.0),
}


def reshaped(solid: Solid, shape: dict[str, tuple[float, ...]]) -> Solid:
    """`solid` with its radii scaled as `shape` says; the nose goes with the muzzle's tip."""
    out = replace(solid, radii=solid.radii * solid.radii.new_tensor(shape.get(solid.name, (1.0, 1.0, 1.0))))
    if solid.name in ("muzzle", "nose") and "muzzle" in shape:
        reach = 0.06 * (shape["muzzle"][0] - 1) * (1.0 if solid.name == "muzzle" else 2.4)
        out = replace(out, center=out.center + out.rotation @ out.center.new_tensor([reach, 0.0, 0.0]))
    return out


def dress(world: World, coat: Coat, shape: dict[str, tuple[float, ...]], thing: str = "bear statue") -> Gaussians:
    """The world with `thing` in another coat and shape: each of its splats moves with its ellipsoid, in the world's
    light, with the short fur's own speckle. As many splats, in the same order."""
    bear, scene = world.thing(thing), world.scene
    new = replace(bear, solids=tuple(reshaped(solid, shape) for solid in bear.solids))
    for old, solid in zip(bear.solids, new.solids, strict=True):
        first, last = old.rows
        unit = old.local(scene.means[first:last])
        normals = torch.nn.functional.normalize(unit / solid.radii, dim=-1) @ solid.rotation.T
        points = (unit * solid.radii) @ solid.rotation.T + solid.center
        fur = 1 + speckle(points, world.seed + 7, 0.07, 0.06)
        colors = coat(new, solid, points) * world.light.lit(normals) ** FUR_SHADE * fur[:, None]
        fields = dict(colors=colors)
        if solid.name in shape or not torch.equal(old.center, solid.center):
            grown = float((solid.radii / old.radii).log().mean())
            fields |= dict(means=points, quats=frames(normals), log_scales=scene.log_scales[first:last] + grown)
        scene = with_rows(scene, first, **fields)
    return scene


def ramp(x: Float[Tensor, " N"], stops: tuple[tuple[float, float, float], ...]) -> Float[Tensor, "N 3"]:
    """Colours along `stops`, evenly spaced over x in 0..1."""
    table = x.new_tensor(stops)
    at = x.clamp(0, 1) * (len(stops) - 1)
    i = at.floor().long().clamp(max=len(stops) - 2)
    part = (at - i)[:, None]
    return table[i] * (1 - part) + table[i + 1] * part


BRONZE = ((0.05, 0.05, 0.04), (0.20, 0.15, 0.09), (0.42, 0.29, 0.15), (0.66, 0.48, 0.26), (0.98, 0.88, 0.66))
GOLD = ((0.16, 0.08, 0.01), (0.50, 0.29, 0.02), (0.86, 0.60, 0.08), (1.0, 0.85, 0.32), (1.0, 0.98, 0.82))


def _grain(rows: Gaussians, lit: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Brightness of splats without their light `lit`: about 1 on the plain surface, less on eyes and joints."""
    bare = colors_of(rows).mean(-1) / lit
    return (bare / bare.median()).clamp(0.2, 1.3)


def metal(world: World, thing: str, stops: tuple[tuple[float, float, float], ...]) -> Gaussians:
    """The world with `thing` cast in metal: what faces up mirrors the sky, what faces down the dark ground, and the
    lamp gleams; dark parts stay dark."""
    first, last = world.thing(thing).rows
    rows = world.scene[first:last]
    normals = facing(rows)
    towards = torch.nn.functional.normalize(normals.new_tensor(world.light.direction), dim=0)
    lamp, above = (normals @ towards) * 0.5 + 0.5, torch.sigmoid((normals[:, 2] - 0.15) / 0.12)
    bright = 0.08 + 0.30 * lamp**1.5 + 0.22 * above + 0.55 * lamp**16
    tarnish = 0.3 + 0.7 * _grain(rows, world.light.shade(normals))
    return with_rows(world.scene, first, colors=ramp(bright * tarnish, stops))


def paint(world: World, thing: str, color: tuple[float, float, float]) -> Gaussians:
    """The world with `thing` painted: its own light and grain stay."""
    first, last = world.thing(thing).rows
    rows = world.scene[first:last]
    normals = facing(rows)
    white = world.light.lit(normals) * (0.4 + 0.6 * _grain(rows, world.light.shade(normals)))[:, None]
    return with_rows(world.scene, first, colors=white * white.new_tensor(color))
