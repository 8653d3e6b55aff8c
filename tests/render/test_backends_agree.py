"""Every backend against the float64 reference: images and all derivatives, with the same cotangents. gsplat is the real
package with its compiled part replaced (gsplat_on_cpu.py)."""

from __future__ import annotations

import numba
import pytest
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians

IMAGES = ("rgb", "alpha", "depth", "features")


def draw(scene: Gaussians, cameras: Cameras, dtype: torch.dtype, backend: str, features=None, **options):
    """Images and derivatives by name, in float64, of a fixed random linear function of the images."""
    scene = scene.to(dtype=dtype).detach().clone()
    leaves = dict(scene.parameters())
    leaves["background"] = torch.tensor([0.2, 0.5, 0.9], dtype=dtype)
    if features is not None:
        leaves["features"] = options["features"] = features.to(dtype).clone()
    for leaf in leaves.values():
        leaf.requires_grad_()
    render = rasterize(scene, cameras, background=leaves["background"], backend=backend, **options)
    render.means2d.retain_grad()
    images = {name: getattr(render, name) for name in IMAGES if getattr(render, name) is not None}
    g = torch.Generator().manual_seed(7)
    cotangents = [torch.randn(image.shape, generator=g, dtype=torch.float64).to(dtype) for image in images.values()]
    torch.autograd.backward(list(images.values()), cotangents)
    leaves["means2d"] = render.means2d
    grads = {k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in leaves.items()}
    return {k: v.detach().double() for k, v in images.items()}, {k: v.double() for k, v in grads.items()}, render.radii


@pytest.fixture(params=["cpu", "gsplat"])
def backend(request) -> str:
    if request.param == "gsplat":
        request.getfixturevalue("gsplat_here")
    return request.param


def assert_agree(
    backend: str, scene: Gaussians, cameras: Cameras, edge: float = 0.0, dtype=torch.float32, **options
) -> None:
    """`backend` in float32 (or `dtype`) against reference in float64.

    Tight everywhere but for the share `edge` of the entries, where a splat may fall on the other side of a threshold
    (alpha 1/255, transmittance 1e-4): there the error is bounded by what such a splat can weigh.
    """
    images, grads, radii = draw(scene, cameras, dtype, backend, **options)
    true_images, true_grads, true_radii = draw(scene, cameras, torch.float64, "reference", **options)
    for name, image in images.items():
        error, scale = (image - true_images[name]).abs(), 1 + true_images[name].abs()
        assert (error > 1e-4 * scale).double().mean() <= edge, name
        assert (error <= 0.02 * scale).all() or name == "depth", name
    for name, grad in grads.items():
        true = true_grads[name]
        assert grad.isfinite().all(), name
        assert (grad - true).norm() <= (2e-4 if edge == 0 else 2e-2) * true.norm() + 1e-6, name
    if radii.numel():
        # gsplat rounds the radius up before it asks whether the box is in the image; ours then draws less than it
        drawn = true_radii > 0 if backend == "gsplat" else torch.ones_like(true_radii, dtype=torch.bool)
        assert ((radii - true_radii).abs() > 1)[drawn].sum() == 0
        assert (radii != true_radii).double().mean() <= 0.015


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("antialiased", [False, True])
def test_random_scenes(backend, random_scene, pinhole, sh_degree, antialiased):
    scene, cameras = random_scene(150, sh_degree, seed=sh_degree), pinhole(37, 29, views=2)
    features = torch.randn(150, 2, generator=torch.Generator().manual_seed(3))
    assert_agree(backend, scene, cameras, edge=0.002, antialiased=antialiased, depth=True, features=features)


def test_lower_degree_than_the_scene_has(backend, random_scene, pinhole):
    assert_agree(backend, random_scene(60), pinhole(20, 20), edge=0.005, sh_degree=1)


@pytest.mark.parametrize("size", [(1, 1), (8, 16), (9, 17), (7, 15), (64, 3), (3, 64)])
def test_image_sizes(backend, random_scene, pinhole, size):
    assert_agree(backend, random_scene(80, 1), pinhole(*size), edge=0.01)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_splats(backend, random_scene, pinhole, n):
    features = torch.ones(n, 3)
    assert_agree(backend, random_scene(n), pinhole(16, 12, views=2), depth=True, features=features, antialiased=True)


def test_off_screen_and_behind(backend, random_scene, pinhole):
    scene = random_scene(200, 1)
    scene.means[:50, 2] -= 8  # behind
    scene.means[50:100, 0] += 30  # outside
    scene.means[100:120, 2] -= 3.2  # about the near plane, some far outside of the frustum
    assert_agree(backend, scene, pinhole(24, 24), edge=0.01)


def test_all_culled(backend, random_scene, pinhole):
    scene = random_scene(20)
    scene.means[:, 2] -= 10
    images, grads, radii = draw(scene, pinhole(10, 10), torch.float32, backend, depth=True)
    assert (images["alpha"] == 0).all() and (images["depth"] == 0).all() and (radii == 0).all()
    assert torch.allclose(images["rgb"], torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64))
    assert all((grads[name] == 0).all() for name in PARAMETERS)


def test_larger_than_the_image(backend, random_scene, pinhole):
    scene = random_scene(6, 1)
    scene.log_scales[:] = 1.5
    scene.logit_opacities[:] = -2
    assert_agree(backend, scene, pinhole(20, 14), edge=0.01)


def test_needles(backend, random_scene, pinhole):
    """Thinner than the blur and longer than the image, at all angles. gsplat's determinant xx yy - xy xy loses the
    digits of float32 there (3 % of the pixels are off by more than 1e-4), so it is held in float64."""
    scene = random_scene(40, 0)
    scene.log_scales[:] = torch.tensor([1.0, -9.0, -9.0])
    scene.logit_opacities[:] = -1
    dtype = torch.float64 if backend == "gsplat" else torch.float32
    assert_agree(backend, scene, pinhole(50, 50), edge=0.02, dtype=dtype)
    assert_agree(backend, scene, pinhole(50, 50), edge=0.02, dtype=dtype, antialiased=True)


def test_thousands_on_one_pixel(backend, random_scene, pinhole):
    """Faint splats, all at the centre: deep lists, and the transmittance stop in every pixel that they cover."""
    scene = random_scene(3000, 0)
    scene.means[:, :2] *= 0.01
    scene.logit_opacities[:] -= 5
    assert_agree(backend, scene, pinhole(16, 16), edge=0.05)


def test_opacities_at_the_cut_and_at_the_cap(backend, random_scene, pinhole):
    scene = random_scene(100, 0)
    scene.logit_opacities[:50] = -6  # below 1/255: never drawn
    scene.logit_opacities[50:] = 9  # above 0.999: capped near the centre
    assert_agree(backend, scene, pinhole(33, 21), edge=0.02)
    assert (draw(scene, pinhole(33, 21), torch.float32, backend)[2][:, :50] == 0).all()


def test_degenerate_splats(backend, random_scene, pinhole):
    """Zero quaternions are the identity; flat and vanishing scales are drawn through the blur."""
    scene = random_scene(30, 0)
    scene.quats[:10] = 0
    scene.log_scales[10:20, 0] = -40
    scene.log_scales[20:] = -40
    assert_agree(backend, scene, pinhole(20, 20), edge=0.01)
    assert_agree(backend, scene, pinhole(20, 20), edge=0.01, antialiased=True)


def test_splats_that_are_not_finite_are_not_drawn_by_cpu(random_scene, pinhole):
    scene = random_scene(5, 0)
    scene.means[0] = float("nan")
    scene.log_scales[1] = 200.0
    images, _, radii = draw(scene, pinhole(20, 20), torch.float32, "cpu")
    assert images["rgb"].isfinite().all() and (radii[:, :2] == 0).all()


def test_views_of_one_call_are_the_views_of_many(backend, random_scene, pinhole):
    scene, cameras = random_scene(100), pinhole(30, 20, views=3)
    together = rasterize(scene, cameras, backend=backend)
    for v in range(3):
        alone = rasterize(scene, cameras[v], backend=backend)
        bound = 0 if backend == "cpu" else 1e-5  # torch's matrix product is not the same in another batch
        assert torch.allclose(together.rgb[v], alone.rgb[0], rtol=0, atol=bound)
        assert torch.equal(together.radii[v], alone.radii[0])


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_same_bits_whatever_the_number_of_threads(random_scene, pinhole):
    scene, cameras = random_scene(4000), pinhole(61, 47, views=2)
    features, threads = torch.ones(4000, 1), numba.get_num_threads()
    runs = []
    for count in (1, 2):
        numba.set_num_threads(count)
        runs.append(draw(scene, cameras, torch.float32, "cpu", depth=True, features=features, antialiased=True))
    numba.set_num_threads(threads)
    for one, two in zip(runs[0][:2], runs[1][:2], strict=True):
        assert all(torch.equal(one[name], two[name]) for name in one)
    assert torch.equal(runs[0][2], runs[1][2])


def test_gradients_of_features_are_blending_weights(backend, random_scene, pinhole):
    """Summed over the image, the derivative in a constant feature is each splat's weight; over splats, alpha."""
    scene = random_scene(50)
    features = torch.zeros(50, 1, requires_grad=True)
    render = rasterize(scene, pinhole(30, 30), features=features, backend=backend)
    render.features.sum().backward()
    assert (features.grad >= 0).all()
    assert torch.allclose(features.grad.sum(), render.alpha.sum(), rtol=1e-5)


def test_other_precision_is_refused(random_scene, pinhole):
    with pytest.raises(SceneError, match="reference"):
        rasterize(random_scene(3).to(dtype=torch.float64), pinhole(4, 4), backend="cpu")
