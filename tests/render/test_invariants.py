"""What must not change a render: the order of splats, where the world's origin, axes and unit are, what cannot be seen;
and what must add up."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.render.projection import rotations
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.stiff.splats import cloud, decided
from tests.render.conftest import PRECISIONS

few = settings(max_examples=8, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)
# Precision and tolerance, in units of 1 + the largest number. In float32 two ways to the same picture differ by
# rounding, at most by some hundred units in the last place.
TOLERANCES = {torch.float64: 1e-9, torch.float32: 3e-5}
BACKENDS = {name: (dtype, TOLERANCES[dtype]) for name, dtype in PRECISIONS.items()}
backends = pytest.mark.parametrize("backend", BACKENDS)


def views(count: int, seed: int) -> Cameras:
    """Cameras around the cloud, float64."""
    g = torch.Generator().manual_seed(seed)
    target = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    eyes = target + torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1) * 3.5
    K = torch.tensor([[19.0, 0, 7.1], [0, 17.0, 4.8], [0, 0, 1]], dtype=torch.float64)
    return Cameras(look_at(eyes, target, target.new_tensor([0.0, 1.0, 0.0])), K.expand(count, 3, 3).clone(), 15, 10)


def draw(backend: str, scene: Gaussians, cameras: Cameras, cotangents: torch.Tensor | None = None):
    """Images [V,H,W,5] (rgb, alpha, depth) and derivatives by parameter, in float64; a flat background."""
    dtype = BACKENDS[backend][0]
    scene = scene.to(dtype=dtype).detach().clone()
    leaves = {name: value.requires_grad_() for name, value in scene.parameters()}
    render = rasterize(scene, cameras, backend=backend, depth=True, background=torch.tensor([0.2, 0.5, 0.9]))
    if cotangents is not None and len(scene):
        torch.cat([render.rgb, render.alpha], dim=-1).backward(cotangents.to(dtype))
    images = torch.cat([render.rgb, render.alpha, render.depth], dim=-1).detach().double()
    return images, {name: None if leaf.grad is None else leaf.grad.double() for name, leaf in leaves.items()}


def settled(scene: Gaussians, cameras: Cameras) -> torch.Tensor:
    """Random cotangents [V,H,W,4], zero where a decision of the image model is so near that rounding may turn it."""
    masks = torch.stack([decided(scene, cameras[v], False, 1e-2) for v in range(len(cameras))])
    shape = *masks.shape, 4
    return torch.randn(shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64) * masks[..., None]


def assert_equal(backend: str, one: torch.Tensor, other: torch.Tensor, where: torch.Tensor | float = 1.0) -> None:
    one, other = one * where, other * where
    assert (one - other).abs().max() <= BACKENDS[backend][1] * (1 + other.abs().max())


@backends
@given(seeds, st.integers(2, 25))
@few
def test_the_order_of_splats_does_not_matter(backend, seed, n):
    scene, cameras = cloud(n, 2, seed), views(1, seed)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    cotangents = settled(scene, cameras)
    (images, grads), (shuffled, moved) = (draw(backend, s, cameras, cotangents) for s in (scene, scene[order]))
    assert_equal(backend, shuffled, images, cotangents[..., :1] != 0)
    for name in PARAMETERS:
        assert_equal(backend, moved[name], grads[name][order])


@backends
@given(seeds)
@few
def test_the_world_s_origin_and_axes_do_not_matter(backend, seed):
    """Splats and camera moved together. Colour that depends on the direction would have to be turned too: degree 0."""
    scene, cameras, g = cloud(20, 0, seed), views(1, seed), torch.Generator().manual_seed(seed)
    turn = torch.nn.functional.normalize(torch.randn(4, generator=g, dtype=torch.float64), dim=0)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotations(turn), torch.randn(3, generator=g, dtype=torch.float64) * 2
    (w, x, y, z), q = turn, scene.quats
    left = torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).reshape(4, 4)  # q -> turn q
    moved = replace(scene, means=scene.means @ motion[:3, :3].T + motion[:3, 3], quats=q @ left.T)
    seen = replace(cameras, viewmats=cameras.viewmats @ torch.linalg.inv(motion))
    cotangents = settled(scene, cameras)
    (images, grads), (again, turned) = draw(backend, scene, cameras, cotangents), draw(backend, moved, seen, cotangents)
    assert_equal(backend, again, images, cotangents[..., :1] != 0)
    assert_equal(backend, turned["means"], grads["means"] @ motion[:3, :3].T)
    assert_equal(backend, turned["quats"], grads["quats"] @ left.T)
    for name in ("log_scales", "logit_opacities", "sh0"):
        assert_equal(backend, turned[name], grads[name])


@backends
@given(seeds, st.floats(-2, 4))
@few
def test_the_world_s_unit_does_not_matter(backend, seed, exponent):
    """From a fiftieth, below which the near plane would come into play, to 16 times the size."""
    size, scene, cameras = 2.0**exponent, cloud(20, 2, seed), views(1, seed)
    larger = replace(scene, means=scene.means * size, log_scales=scene.log_scales + math.log(size))
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] *= size
    cotangents = settled(scene, cameras)
    images, grads = draw(backend, scene, cameras, cotangents)
    again, grown = draw(backend, larger, replace(cameras, viewmats=viewmats), cotangents)
    inside = cotangents[..., :1] != 0
    assert_equal(backend, again[..., :4], images[..., :4], inside)
    assert_equal(backend, again[..., 4:] / size, images[..., 4:], inside)
    assert_equal(backend, grown["means"] * size, grads["means"])
    for name in PARAMETERS[1:]:
        assert_equal(backend, grown[name], grads[name])


@backends
@given(seeds, st.integers(0, 20))
@few
def test_an_opacity_of_zero_is_as_good_as_removal(backend, seed, hidden):
    """What cannot be seen takes no part and no derivative: of the compiled renderer to the bit (the dense one sums
    over all splats at once, in an order that depends on their number)."""
    scene, cameras = cloud(20, 1, seed), views(2, seed)
    gone = torch.randperm(20, generator=torch.Generator().manual_seed(seed))[:hidden]
    kept = torch.ones(20, dtype=torch.bool)
    kept[gone] = False
    faint = replace(scene, logit_opacities=scene.logit_opacities.masked_fill(~kept, -60.0))
    cotangents = torch.randn(2, 10, 15, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    (images, grads), (without, rest) = (draw(backend, s, cameras, cotangents) for s in (faint, scene[kept]))
    pairs = [(images, without)]
    for name in PARAMETERS if hidden < 20 else ():
        pairs.append((grads[name][kept], rest[name]))
        assert (grads[name][~kept] == 0).all()
    for one, other in pairs:
        assert_equal(backend, one, other)
        assert backend != "cpu" or torch.equal(one, other)


@backends
@given(seeds, st.integers(2, 4))
@few
def test_the_derivative_of_a_sum_over_views_is_the_sum_of_theirs(backend, seed, count):
    scene, cameras = cloud(20, 3, seed), views(count, seed)
    cotangents = torch.randn(count, 10, 15, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    _, together = draw(backend, scene, cameras, cotangents)
    alone = [draw(backend, scene, cameras[v], cotangents[v : v + 1])[1] for v in range(count)]
    for name in PARAMETERS:
        assert_equal(backend, together[name], torch.stack([grads[name] for grads in alone]).sum(0))


@backends
@given(seeds)
@few
def test_the_background_shows_through_what_is_left(backend, seed):
    """Affine in the background: the derivative is the transmittance. And alpha is in [0,1)."""
    dtype, _ = BACKENDS[backend]
    scene, cameras = cloud(20, 1, seed).to(dtype=dtype), views(1, seed)
    black, grey = (rasterize(scene, cameras, backend=backend, background=torch.full((3,), v)) for v in (0.0, 0.75))
    assert_equal(backend, grey.rgb, black.rgb + 0.75 * (1 - black.alpha))
    assert (black.alpha >= 0).all() and (black.alpha < 1).all()
