"""Edits of a whole synthetic scene: other light, other seasons. Colour per splat, the same from every side."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import Gaussians
from .coats import colors_of, with_rows
from .shapes import facing, speckle
from .worlds import World, part_mask


def _recolored(world: World, colors: Float[Tensor, "N 3"]) -> Gaussians:
    return with_rows(world.scene, 0, colors=colors)


def _saturated(colors: Float[Tensor, "N 3"], amount: float) -> Float[Tensor, "N 3"]:
    grey = (colors @ colors.new_tensor([0.299, 0.587, 0.114]))[:, None]
    return grey + amount * (colors - grey)


def _ahead(world: World) -> Float[Tensor, " 3"]:
    """The horizontal direction of the lamp, a unit vector: where a low sun or moon stands."""
    x, y, _ = world.light.direction
    return torch.nn.functional.normalize(torch.tensor([x, y, 0.0]) + 1e-6, dim=0)


def _gradient(height: Float[Tensor, " N"], *stops: tuple[float, tuple[float, float, float]]) -> Float[Tensor, "N 3"]:
    """Colours between `stops` of (height, colour), linear in height."""
    out = height.new_tensor(stops[0][1]).expand(len(height), 3)
    for (low, _), (high, color) in zip(stops, stops[1:], strict=False):
        part = ((height - low) / (high - low)).clamp(0, 1)[:, None]
        out = out * (1 - part) + height.new_tensor(color) * part
    return out


def _heavens(world: World) -> tuple[Float[Tensor, "N 1"], Float[Tensor, " N"], Float[Tensor, "N 1"]]:
    """Of every splat: whether it is sky (0 or 1), the sine of its height above the horizon, and how bright a
    cloud it is (0 for clear blue, 1 for white)."""
    sky = part_mask(world.scene, "sky")[:, None].float()
    unit = torch.nn.functional.normalize(world.scene.means, dim=-1)
    colors = colors_of(world.scene)
    cloud = (colors.amin(-1, keepdim=True) / colors.amax(-1, keepdim=True).clamp(min=1e-3)).clamp(0, 1)
    return sky, unit[:, 2], ((cloud - 0.4) / 0.6).clamp(0, 1)


def sunset(world: World) -> Gaussians:
    """A low sun where the lamp stood: orange light from its side, violet shade, a sky from gold over rose to violet."""
    colors, normals = colors_of(world.scene), facing(world.scene)
    sun = _ahead(world) * math.cos(0.2) + torch.tensor([0.0, 0.0, math.sin(0.2)])
    lit = ((normals @ sun) * 0.5 + 0.5)[:, None] ** 1.5
    warm, shade = colors.new_tensor([0.80, 0.46, 0.20]), colors.new_tensor([0.42, 0.36, 0.41])
    ground = colors / world.light.shade(normals)[:, None] * (shade + warm * lit)
    sky, height, cloud = _heavens(world)
    unit = torch.nn.functional.normalize(world.scene.means, dim=-1)
    glow = ((unit @ sun) * 0.5 + 0.5)[:, None]
    gradient = _gradient(
        height,
        (0.0, (0.99, 0.70, 0.36)),
        (0.14, (0.95, 0.55, 0.34)),
        (0.38, (0.72, 0.46, 0.48)),
        (0.9, (0.38, 0.34, 0.56)),
    )
    above = gradient * (0.85 + 0.2 * glow) + colors.new_tensor([0.35, 0.25, 0.05]) * glow**12
    above = above + cloud * colors.new_tensor([0.10, 0.02, -0.03])
    return _recolored(world, sky * above + (1 - sky) * ground)


def night(world: World) -> Gaussians:
    """Moonlight: dim and blue, with a dark sky that is a little lighter at the horizon."""
    colors = colors_of(world.scene)
    dark = _saturated(colors, 0.4) * colors.new_tensor([0.34, 0.43, 0.64]) + colors.new_tensor([0.01, 0.02, 0.05])
    sky, height, cloud = _heavens(world)
    gradient = _gradient(height, (0.0, (0.13, 0.18, 0.33)), (0.3, (0.06, 0.09, 0.22)), (0.9, (0.02, 0.03, 0.11)))
    above = gradient + cloud * colors.new_tensor([0.03, 0.04, 0.06])
    return _recolored(world, sky * above + (1 - sky) * dark)


def autumn(world: World) -> Gaussians:
    """Whatever is green turns orange, red and yellow; fallen leaves on the ground; a paler, warmer day."""
    scene, colors = world.scene, colors_of(world.scene)
    red, green, blue = colors.unbind(-1)
    foliage = torch.sigmoid(((green - torch.maximum(red, blue)) / green.clamp(min=0.05) - 0.06) / 0.03)[:, None]
    tone = (0.5 + speckle(scene.means, world.seed + 11, 0.6, 0.5)).clamp(0, 1)
    leaf = _gradient(tone, (0.0, (0.78, 0.30, 0.09)), (0.5, (0.88, 0.50, 0.14)), (1.0, (0.90, 0.70, 0.26)))
    brightness = colors.amax(-1, keepdim=True)
    leaves = leaf * (0.2 + 1.2 * brightness)
    litter = torch.sigmoid(speckle(scene.means, world.seed + 12, 9.0, 0.22) - 1.2)[:, None] * 0.6
    litter = litter * part_mask(scene, "floor")[:, None]
    rest = colors * colors.new_tensor([1.05, 0.96, 0.84])
    rest = rest * (1 - litter) + litter * leaf * (0.2 + 0.9 * brightness)
    return _recolored(world, foliage * leaves + (1 - foliage) * rest)


def snow(world: World) -> Gaussians:
    """Fresh snow on all that faces up, under a pale sky, in cold light."""
    scene, colors, normals = world.scene, colors_of(world.scene), facing(world.scene)
    sky, height, _ = _heavens(world)
    ragged = speckle(scene.means, world.seed + 13, 0.25, 0.2)
    cover = torch.sigmoid((normals[:, 2] + ragged - 0.45) / 0.07)[:, None]
    cold = _saturated(colors, 0.7) * colors.new_tensor([0.90, 0.96, 1.04])
    light = (world.light.shade(normals) / world.light.shade(normals.new_tensor([[0.0, 0.0, 1.0]])))[:, None]
    drift = 1 + 0.5 * speckle(scene.means, world.seed + 14, 0.06, 0.8)[:, None]
    white = colors.new_tensor([0.93, 0.95, 0.99]) * (0.55 + 0.45 * light).clamp(max=1.05) * drift
    above = _gradient(height, (0.0, (0.88, 0.90, 0.93)), (0.9, (0.66, 0.72, 0.80)))
    return _recolored(world, sky * above + (1 - sky) * (cover * white + (1 - cover) * cold))
