"""The image model in closed form, and the reference's derivatives against finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render import sh
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.render.projection import project, rotations
from dreamcatalyst.scene.gaussians import Gaussians
from scipy.special import sph_harm_y

from tests.render.conftest import PRECISIONS

BACKENDS = list(PRECISIONS)
FOCAL, SIDE = 50.0, 21  # the principal point is the centre of pixel (10, 10)


def camera() -> Cameras:
    K = torch.tensor([[FOCAL, 0, 10.5], [0, FOCAL, 10.5], [0, 0, 1]])
    return Cameras(torch.eye(4)[None], K[None], SIDE, SIDE)


def on_axis(depths: list[float], opacities: list[float], colors: list[list[float]], scale: float = 0.1) -> Gaussians:
    """Isotropic splats on the optical axis."""
    means = torch.tensor([[0.0, 0.0, z] for z in depths])
    return Gaussians.from_colors(means, torch.full_like(means, scale), torch.tensor(colors), torch.tensor(opacities))


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_isotropic_splat(backend):
    """alpha = o exp(-r^2 / 2 (s^2 f^2 / z^2 + 0.3)) along each axis, cut below 1/255; colour over the background."""
    render = rasterize(
        on_axis([2.0], [0.8], [[1.0, 0.5, 0.0]]), camera(), background=torch.ones(3), depth=True, backend=backend
    )
    variance = (0.1 * FOCAL / 2) ** 2 + 0.3
    for step in range(11):
        alpha = 0.8 * math.exp(-0.5 * step**2 / variance)
        alpha = alpha if alpha >= 1 / 255 else 0.0
        for y, x in ((10, 10 + step), (10 - step, 10)):
            assert render.alpha[0, y, x, 0].item() == pytest.approx(alpha, abs=2e-6)
            color = [alpha * c + 1 - alpha for c in (1.0, 0.5, 0.0)]
            assert render.rgb[0, y, x].tolist() == pytest.approx(color, abs=3e-6)
            assert render.depth[0, y, x, 0].item() == pytest.approx(2.0 if alpha else 0.0, abs=1e-5)
    assert render.means2d[0, 0].tolist() == pytest.approx([10.5, 10.5])
    assert render.radii[0, 0].item() == math.ceil(math.sqrt(2 * math.log(0.8 * 255) * variance))


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_splats_are_ordered_by_depth(backend):
    render = rasterize(
        on_axis([3.0, 2.0], [0.5, 0.6], [[1.0, 0, 0], [0, 1.0, 0]]), camera(), depth=True, backend=backend
    )
    assert render.rgb[0, 10, 10].tolist() == pytest.approx([0.4 * 0.5, 0.6, 0.0], abs=1e-6)
    assert render.depth[0, 10, 10, 0].item() == pytest.approx((0.6 * 2 + 0.2 * 3) / 0.8, abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_depths_are_ordered_by_index(backend):
    render = rasterize(on_axis([2.0, 2.0], [0.5, 0.5], [[1.0, 0, 0], [0, 1.0, 0]]), camera(), backend=backend)
    assert render.rgb[0, 10, 10].tolist() == pytest.approx([0.5, 0.25, 0.0], abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_cap_and_stop(backend):
    """The first splat is capped at 0.999; the second would leave 1e-6 < 1e-4, so neither it nor the third is drawn."""
    colors = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]
    render = rasterize(on_axis([1.0, 2.0, 3.0], [0.9999, 0.9999, 0.5], colors), camera(), backend=backend)
    assert render.rgb[0, 10, 10].tolist() == pytest.approx([0.999, 0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_antialiased_opacity(backend):
    """A splat far smaller than the blur keeps its energy: opacity times sqrt(det / det blurred) = s^2 / (s^2 + 0.3)."""
    scene = on_axis([2.0], [0.9], [[1.0, 1.0, 1.0]], scale=0.01)
    render = rasterize(scene, camera(), antialiased=True, backend=backend)
    variance = (0.01 * FOCAL / 2) ** 2
    assert render.alpha[0, 10, 10, 0].item() == pytest.approx(0.9 * variance / (variance + 0.3), abs=1e-6)


def test_gradcheck(random_scene, pinhole):
    """Every derivative in float64, away from the image model's jumps: nothing here is cut, capped or stopped."""
    scene = random_scene(4, sh_degree=2, seed=5).to(dtype=torch.float64)
    scene.log_scales[:] += 2.5  # large: alpha stays above the cut in the whole image
    scene.logit_opacities[:] -= 1.5
    scene.sh0[:] = scene.sh0.abs() + 0.5  # away from the clamp at black
    cameras = pinhole(4, 3, views=2)
    features, background = torch.rand(4, 1, dtype=torch.float64), torch.rand(3, dtype=torch.float64)
    leaves = [p.clone().requires_grad_() for _, p in scene.parameters()] + [background, features]

    def images(*values):
        render = rasterize(
            Gaussians(*values[:6]), cameras, background=values[6], features=values[7], depth=True, antialiased=True
        )
        return render.rgb, render.alpha, render.depth, render.features

    assert torch.autograd.gradcheck(images, [leaf.requires_grad_() for leaf in leaves], fast_mode=False)


def test_image_depends_on_means2d(random_scene, pinhole):
    """Moving all splats by one image-plane vector is moving the principal point the other way."""
    scene, cameras = random_scene(20).to(dtype=torch.float64), pinhole(12, 10)
    scene.means.requires_grad_()
    render = rasterize(scene, cameras)
    render.means2d.retain_grad()
    g = torch.randn(render.rgb.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (render.rgb * g).sum().backward()
    values = []
    for sign in (1, -1):
        Ks = cameras.Ks.double().clone()
        Ks[:, 0, 2] += sign * 1e-6
        moved = Cameras(cameras.viewmats.double(), Ks, 12, 10)
        values.append((rasterize(scene, moved).rgb * g).sum().item())
    assert render.means2d.grad[..., 0].sum().item() == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-4)


def test_projection_is_the_perspective_map(random_scene, pinhole):
    """In the limit of small splats: cov2d - 0.3 I is that of sampled points sent through the camera."""
    cameras = pinhole(100, 80).to(dtype=torch.float64)
    g = torch.Generator().manual_seed(1)
    scale, quat = torch.tensor([[0.01, 0.004, 0.002]], dtype=torch.float64), torch.randn(1, 4, generator=g).double()
    mean = torch.tensor([[0.3, -0.2, 3.0]], dtype=torch.float64)
    noise = torch.randn(200_000, 3, generator=g, dtype=torch.float64)
    points = mean + (noise * scale) @ rotations(quat)[0].T
    sent = project(points, quat.expand(len(points), -1), scale.expand(len(points), -1), cameras).means2d[0]
    splat = project(mean, quat, scale, cameras)
    xx, xy, yy = splat.covs2d[0, 0].tolist()
    assert torch.cov(sent.T).flatten().tolist() == pytest.approx([xx - 0.3, xy, xy, yy - 0.3], rel=0.02, abs=2e-4)
    assert splat.dets[0, 0].item() == pytest.approx(xx * yy - xy * xy)


def test_harmonics_are_those_of_the_textbook():
    """Real combinations of scipy's complex harmonics, which carry the Condon-Shortley sign: order l, m = -l..l."""
    dirs = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    theta, phi = torch.acos(dirs[:, 2]).numpy(), torch.atan2(dirs[:, 1], dirs[:, 0]).numpy()
    ours, k = sh.basis(dirs, 3).numpy(), 0
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(m), theta, phi)
            true = y.real if m == 0 else math.sqrt(2) * (y.real if m > 0 else y.imag)
            assert ours[:, k] == pytest.approx(true, abs=1e-12), (degree, m)
            k += 1


def test_mismatches_are_refused(random_scene, pinhole):
    scene, cameras = random_scene(3, 1), pinhole(4, 4)
    for options in (dict(background=torch.zeros(4)), dict(features=torch.zeros(2, 1)), dict(sh_degree=2)):
        with pytest.raises(SceneError, match="expected|asked"):
            rasterize(scene, cameras, **options)
