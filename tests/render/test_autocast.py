"""Mixed precision stops at the renderer's door: under autocast the same bits as without, in images and derivatives."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.render.api import Frozen, rasterize


def images_and_gradients(scene, cameras, backend, half: bool, **options):
    scene = scene.detach().clone()
    for _, value in scene.parameters():
        value.requires_grad_()
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        render = rasterize(scene, cameras, backend=backend, **options)
    images = [i for i in (render.rgb, render.alpha, render.depth, render.features) if i is not None]
    sum((image * torch.linspace(0, 1, image.numel()).view(image.shape)).sum() for image in images).backward()
    return [*images, render.means2d, render.radii, *(value.grad for _, value in scene.parameters())]


@pytest.mark.parametrize("backend", ["cpu", "reference", "gsplat"])
@pytest.mark.parametrize("case", ["plain", "frozen", "features"])
def test_the_same_bits_under_autocast(gsplat_here, random_scene, pinhole, backend, case):
    scene, cameras = random_scene(80), pinhole(24, 20, views=2)
    options = {
        "plain": dict(antialiased=True),
        "frozen": dict(frozen=Frozen(random_scene(40, seed=1))),
        "features": dict(depth=True, features=torch.ones(80, 2, dtype=torch.bfloat16)),  # of a network in half
    }[case]
    half, whole = (images_and_gradients(scene, cameras, backend, half, **options) for half in (True, False))
    for got, want in zip(half, whole, strict=True):
        assert got.dtype == want.dtype and torch.equal(got, want)


def test_autocast_goes_on_behind_it(random_scene, pinhole):
    with torch.autocast("cpu", torch.bfloat16):
        rasterize(random_scene(3), pinhole(4, 4))
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.bfloat16
