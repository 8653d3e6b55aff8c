"""Frozen splats beside edited ones: every backend that runs here against one joint scene, and what is kept of them."""

from __future__ import annotations

import numba
import pytest
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import BACKENDS, Frozen, rasterize
from dreamcatalyst.render.cpu import frozen as cpu_frozen
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians

from tests.render.conftest import PRECISIONS

TOTAL = 160


@pytest.fixture(params=BACKENDS.names())
def backend(request) -> str:
    """Every backend; gsplat with its compiled part replaced."""
    if request.param == "gsplat":
        request.getfixturevalue("gsplat_here")
    return request.param


def here(backend: str, scene: Gaussians) -> Gaussians:
    """The scene in the precision in which `backend` is compared."""
    return scene.to(dtype=torch.float64) if backend == "reference" else scene


def draw(scene: Gaussians, frozen: Frozen | None, cameras: Cameras, first: int = 0, **options):
    """Images and derivatives by name, on the CPU in float64, of a fixed random linear function of the images; the
    derivatives and radii are those of the splats from `first` on."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in scene.parameters()}
    leaves["background"] = scene.means.new_tensor([0.2, 0.5, 0.9]).requires_grad_()
    if "features" in options:
        leaves["features"] = options["features"] = options["features"].to(scene.means).requires_grad_()
    splats = Gaussians(**{name: leaves[name] for name in PARAMETERS})
    render = rasterize(splats, cameras, background=leaves["background"], frozen=frozen, **options)
    render.means2d.retain_grad()
    images = {name: getattr(render, name) for name in ("rgb", "alpha", "depth", "features")}
    images = {name: image for name, image in images.items() if image is not None}
    g = torch.Generator().manual_seed(7)
    cotangents = [torch.randn(i.shape, generator=g, dtype=torch.float64).to(i) for i in images.values()]
    torch.autograd.backward(list(images.values()), cotangents)
    leaves["means2d"] = render.means2d
    grads = {k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in leaves.items()}
    grads = {k: g[first:] if k in PARAMETERS else g for k, g in grads.items()}
    grads["means2d"] = grads["means2d"][:, first:]
    plain = [{k: v.detach().double().cpu() for k, v in part.items()} for part in (images, grads)]
    return *plain, render.radii[:, first:].cpu()


def joined(frozen: Gaussians, scene: Gaussians) -> Gaussians:
    return Gaussians.cat([frozen, scene])


def assert_close(got, true, tolerance: float, edge: float = 0.0) -> None:
    """All but the share `edge` of the pixels agree within `tolerance`, the derivatives by their norms."""
    for name, image in true[0].items():
        error, scale = (got[0][name] - image).abs(), 1 + image.abs()
        assert (error > tolerance * scale).double().mean() <= edge, name
        assert (error <= 0.02 * scale).all() or name == "depth", name
    for name, grad in true[1].items():
        assert got[1][name].shape == grad.shape, name
        bound = 2 * tolerance if edge == 0 else 0.02
        assert (got[1][name] - grad).norm() <= bound * grad.norm() + 1e-6, name
    assert got[2].shape == true[2].shape and (got[2] != true[2]).double().sum() <= 0.025 * got[2].numel()


def parts(make, case: str, sh_degree: int = 3) -> tuple[Gaussians, Gaussians]:
    """Frozen and edited splats of one random scene."""
    scene = make(TOTAL, sh_degree, seed=len(case))
    chosen = torch.rand(TOTAL, generator=torch.Generator().manual_seed(1)) < 0.3
    if case == "no frozen":
        chosen[:] = True
    elif case == "no edited":
        chosen[:] = False
    elif case == "in a corner":
        chosen = (scene.means[:, 0] < -0.3) & (scene.means[:, 1] < -0.3)
    elif case == "off screen":
        scene.means[chosen, 0] += 30
    elif case == "in front":
        scene.means[chosen, 2] -= 2.5
    elif case == "behind":
        scene.means[chosen, 2] += 3
    elif case == "behind opaque":
        scene.means[chosen, 2] += 3
        scene.log_scales[~chosen] += 1.2
        scene.logit_opacities[~chosen] = 6
    elif case == "at equal depths":
        scene.means[:, 2] = scene.means[:, 2].mul(8).round() / 8
    return scene[~chosen], scene[chosen]


CASES = "among", "in a corner", "no frozen", "no edited", "off screen", "in front", "behind", "behind opaque"


@pytest.mark.parametrize("case", [*CASES, "at equal depths"])
def test_same_as_one_scene(random_scene, pinhole, backend, case):
    """The float64 reference of the joint scene, in image and derivatives, first drawn and drawn again."""
    (frozen, scene), cameras = parts(random_scene, case), pinhole(37, 29, views=2)
    true = draw(joined(frozen, scene).to(dtype=torch.float64), None, cameras, len(frozen), backend="reference")
    rest, edited = Frozen(here(backend, frozen)), here(backend, scene)
    for _ in range(2):
        got = draw(edited, rest, cameras, backend=backend)
        assert_close(got, true, *((1e-10,) if backend == "reference" else (1e-4, 0.004)))


@pytest.mark.parametrize("options", [dict(antialiased=True), dict(sh_degree=1), dict(depth=True), dict(features=2)])
def test_options_are_those_of_one_scene(random_scene, pinhole, backend, options):
    (frozen, scene), cameras = parts(random_scene, "among"), pinhole(24, 31)
    options = dict(options)
    if "features" in options:
        options["features"] = torch.randn(TOTAL, options["features"], generator=torch.Generator().manual_seed(3))
    whole = joined(frozen, scene).to(dtype=torch.float64)
    true = draw(whole, None, cameras, len(frozen), backend="reference", **options)
    got = draw(here(backend, scene), Frozen(here(backend, frozen)), cameras, backend=backend, **options)
    assert_close(got, true, *((1e-10,) if backend == "reference" else (1e-4, 0.004)))


@pytest.fixture(params=["one round", "two rounds"])
def rounds(request, monkeypatch):
    """Two rounds even where few splats are edited: the nearest of them first, then, in tiles left open, all."""
    if request.param == "two rounds":
        monkeypatch.setattr(cpu_frozen, "MANY", cpu_frozen.NEAREST)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("size", [(61, 47), (8, 16), (9, 17), (1, 1), (3, 64)])
def test_cpu_is_the_cpu_on_one_scene(random_scene, pinhole, case, size, rounds):
    """The same kernels in the same order: nothing but the last digits differs, the background's derivative too."""
    (frozen, scene), cameras = parts(random_scene, case, sh_degree=1), pinhole(*size, views=2)
    true = draw(joined(frozen, scene), None, cameras, len(frozen), backend="cpu")
    assert_close(draw(scene, Frozen(frozen), cameras, backend="cpu"), true, 5e-6)


def test_deep_lists(random_scene, pinhole, rounds):
    """Thousands of faint splats on few pixels: the stop at small transmittance, with frozen splats all about."""
    scene = random_scene(3000, 0)
    scene.means[:, :2] *= 0.01
    scene.logit_opacities[:] -= 4
    frozen, edited = scene[500:], scene[:500]
    true = draw(joined(frozen, edited), None, pinhole(16, 16), len(frozen), backend="cpu")
    assert_close(draw(edited, Frozen(frozen), pinhole(16, 16), backend="cpu"), true, 2e-5)


def test_frozen_splats_take_no_derivative(random_scene, pinhole, backend):
    (frozen, scene), cameras = parts(random_scene, "among"), pinhole(16, 16)
    frozen = here(backend, frozen)
    for _, value in frozen.parameters():
        value.requires_grad_()
    draw(here(backend, scene), Frozen(frozen), cameras, backend=backend)
    assert all(value.grad is None for _, value in frozen.parameters())


def test_opaque_on_one_side_and_faint_on_the_other(random_scene, pinhole):
    """So many edited splats that tiles are finished by the nearest of them on the left, by none on the right."""
    scene = random_scene(9000, 0)
    scene.logit_opacities[:] = torch.where(scene.means[:, 0] < 0, 3.0, -5.0)
    frozen, edited, cameras = scene[6000:], scene[:6000], pinhole(64, 48, views=2)
    assert len(edited) >= cpu_frozen.MANY
    true = draw(joined(frozen, edited), None, cameras, len(frozen), backend="cpu")
    alpha = true[0]["alpha"]
    assert (alpha[:, :, 10:24] > 0.9998).double().mean() > 0.5 and (alpha[:, :, -20:] < 0.99).double().mean() > 0.5
    assert_close(draw(edited, Frozen(frozen), cameras, backend="cpu"), true, 2e-5)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_same_bits_whatever_the_number_of_threads(random_scene, pinhole, rounds):
    scene, cameras, threads = random_scene(3000, 1), pinhole(61, 47, views=2), numba.get_num_threads()
    runs = []
    for count in (1, 2):
        numba.set_num_threads(count)
        runs.append(draw(scene[:700], Frozen(scene[700:]), cameras, backend="cpu"))
    numba.set_num_threads(threads)
    for one, two in zip(runs[0][:2], runs[1][:2], strict=True):
        assert all(torch.equal(one[name], two[name]) for name in one)


def test_results_do_not_depend_on_what_is_kept(random_scene, pinhole, rounds):
    """Bit by bit: nothing kept, kept from splats elsewhere (too few tiles, then more than needed), kept in part."""
    (frozen, scene), cameras = parts(random_scene, "in a corner", 1), pinhole(200, 160, views=3)
    moved = scene.clone()
    moved.means[:] += torch.tensor([0.9, 0.9, 0.0])
    true = [draw(s, Frozen(frozen, limit=0), cameras, backend="cpu")[:2] for s in (scene, moved)]
    one_view = Frozen(frozen)
    draw(scene, one_view, cameras[0], backend="cpu")
    for rest in Frozen(frozen), Frozen(frozen, limit=one_view.kept.bytes * 3 // 2):
        for number in (0, 1, 0, 1):
            got = draw((scene, moved)[number], rest, cameras, backend="cpu")[:2]
            for mine, others in zip(got, true[number], strict=True):
                assert all(torch.equal(mine[name], others[name]) for name in mine)
        assert 0 < rest.kept.bytes <= rest.kept.limit


def test_one_view_is_kept_once_and_any_other_anew(random_scene, pinhole):
    (frozen, scene), camera = parts(random_scene, "among"), pinhole(40, 30)
    rest = Frozen(frozen)
    rasterize(scene, camera, frozen=rest)
    once = rest.kept.bytes
    assert once > 0
    rasterize(scene, camera, frozen=rest, background=torch.ones(3))
    assert rest.kept.bytes == once  # the background is put behind afterwards
    viewmats, Ks = camera.viewmats.clone(), camera.Ks.clone()
    viewmats[:, 0, 3] += 1e-3
    Ks[:, 0, 0] += 1e-3
    changes = (
        dict(cameras=Cameras(viewmats, camera.Ks, 40, 30)),
        dict(cameras=Cameras(camera.viewmats, Ks, 40, 30)),
        dict(cameras=Cameras(camera.viewmats, camera.Ks, 41, 30)),
        dict(cameras=Cameras(camera.viewmats, camera.Ks, 40, 31)),
        dict(sh_degree=1),
        dict(antialiased=True),
    )
    for change in changes:
        before = rest.kept.bytes
        options = {"cameras": camera, **change}
        rgb = rasterize(scene, frozen=rest, **options).rgb
        assert rest.kept.bytes > before
        assert torch.allclose(rgb, rasterize(joined(frozen, scene), **options).rgb, atol=1e-6)


def test_no_gradient_is_no_obstacle(random_scene, pinhole):
    frozen, scene = parts(random_scene, "among")
    for backend in PRECISIONS:
        render = rasterize(scene, pinhole(8, 8), frozen=Frozen(frozen), backend=backend)
        assert not render.rgb.requires_grad and render.means2d.shape == (1, len(scene), 2)


def test_extras_do_not_matter(random_scene, pinhole):
    frozen, scene = parts(random_scene, "among")
    marked = frozen.with_extra(mask=torch.ones(len(frozen)))
    for backend in PRECISIONS:
        a, b = (rasterize(scene, pinhole(8, 8), frozen=Frozen(f), backend=backend).rgb for f in (frozen, marked))
        assert torch.equal(a, b)


def test_mismatches_are_refused(random_scene, pinhole):
    scene, cameras = random_scene(3, 1), pinhole(4, 4)
    with pytest.raises(SceneError, match="SH degree 2"):
        rasterize(scene, cameras, frozen=Frozen(random_scene(3, 2)))
    with pytest.raises(SceneError, match="float64"):
        rasterize(scene, cameras, frozen=Frozen(random_scene(3, 1).to(dtype=torch.float64)))
    with pytest.raises(SceneError, match="meta"):
        rasterize(scene, cameras, frozen=Frozen(random_scene(3, 1).to("meta")))
    with pytest.raises(SceneError, match=r"expected \(5, F\)"):
        rasterize(scene, cameras, frozen=Frozen(random_scene(2, 1)), features=torch.zeros(3, 1))
