"""A backend of one's own: the reference in a mirror that swaps red and blue."""

from dataclasses import replace

from dreamcatalyst.render.api import BACKENDS, Backend
from dreamcatalyst.render.reference import rasterize


def draw(scene, cameras, options):
    render = rasterize(scene, cameras, options)
    return replace(render, rgb=render.rgb.flip(-1))


BACKENDS.add("swapped", Backend("swapped", draw))
