"""Things of synthetic scenes to be put into others, and how they look in another world's light."""

from __future__ import annotations

from ..scene.gaussians import Gaussians
from .coats import colors_of, with_rows
from .shapes import Light, facing
from .worlds import World


def first_thing(world: World) -> Gaussians:
    """The splats of the first thing that instructions can name in `world`, such as its bear, in its world's light."""
    first, last = world.things[0].rows
    return world.scene[first:last]


def relit(thing: Gaussians, own: Light, moved: Gaussians, other: Light) -> Gaussians:
    """`moved`, which is `thing` elsewhere, in the light of where it is: colours are albedo times light. own, other:
    what lights the one and the other."""
    albedo = colors_of(thing) / own.lit(facing(thing))
    return with_rows(moved, 0, colors=albedo * other.lit(facing(moved)))
