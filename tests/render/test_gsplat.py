"""The backend gsplat: the real package's `rasterization` with its compiled part replaced (gsplat_on_cpu.py), and what a
machine that lacks something is told."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render import gsplat
from dreamcatalyst.render.api import find_backend, rasterize
from dreamcatalyst.render.lift import lift
from dreamcatalyst.scene.gaussians import PARAMETERS

from tests.render.test_backends_agree import draw

FAR = torch.device("cuda")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("options", [dict(), dict(depth=True), dict(features=2), dict(depth=True, features=40)])
def test_same_as_the_reference_in_float64(gsplat_here, random_scene, pinhole, antialiased, options):
    """The same formulas: what is left are the last digits, in images and in all derivatives, those of means2d too."""
    options = dict(options, antialiased=antialiased, sh_degree=2)
    if "features" in options:  # 40 are more than gsplat composites at once
        options["features"] = torch.rand(60, options["features"], generator=torch.Generator().manual_seed(2))
    scene, cameras = random_scene(60, 2), pinhole(37, 29, views=2)
    images, grads, radii = draw(scene, cameras, torch.float64, "gsplat", **options)
    true_images, true_grads, true_radii = draw(scene, cameras, torch.float64, "reference", **options)
    assert images.keys() == true_images.keys() and grads.keys() == true_grads.keys()
    for name, true in true_images.items():
        assert images[name].shape == true.shape, name
        assert (images[name] - true).abs().max() <= 1e-9, name
    for name, true in true_grads.items():
        assert (grads[name] - true).norm() <= 1e-9 * true.norm(), name
    assert torch.equal(radii, true_radii)


def test_float32_loses_no_more_than_its_digits(gsplat_here, random_scene, pinhole):
    scene, cameras = random_scene(40, 1, seed=3), pinhole(24, 20)
    images, grads, _ = draw(scene, cameras, torch.float32, "gsplat")
    true_images, true_grads, _ = draw(scene, cameras, torch.float32, "reference")
    assert (images["rgb"] - true_images["rgb"]).abs().max() <= 2e-6
    for name in PARAMETERS:
        assert (grads[name] - true_grads[name]).norm() <= 2e-6 * true_grads[name].norm(), name


def test_a_zero_quaternion_is_the_identity(gsplat_here, random_scene, pinhole):
    """Its kernel would divide by the norm. The gradient is zero, as elsewhere."""
    scene, upright = random_scene(10, 0), random_scene(10, 0)
    scene.quats[:5], upright.quats[:5] = 0, torch.tensor([1.0, 0, 0, 0])
    images, grads, _ = draw(scene, pinhole(20, 20), torch.float64, "gsplat")
    assert torch.equal(images["rgb"], draw(upright, pinhole(20, 20), torch.float64, "gsplat")[0]["rgb"])
    assert (grads["quats"][:5] == 0).all() and grads["quats"][5:].isfinite().all()


def test_no_splats_are_the_background(gsplat_here, random_scene, pinhole):
    render = rasterize(random_scene(0), pinhole(5, 4, views=2), background=torch.tensor([0.2, 0.4, 0.6]),
                       depth=True, features=torch.zeros(0, 2), backend="gsplat")  # fmt: skip
    assert torch.allclose(render.rgb, torch.tensor([0.2, 0.4, 0.6]).expand(2, 4, 5, 3))
    assert (render.alpha == 0).all() and (render.depth == 0).all() and render.features.shape == (2, 4, 5, 2)
    assert render.means2d.shape == (2, 0, 2) and render.radii.shape == (2, 0)


def test_masks_are_lifted(gsplat_here, random_scene, pinhole):
    scene, cameras = random_scene(40, 1).to(dtype=torch.float64), pinhole(29, 21, views=2)
    masks = torch.rand(2, 21, 29, generator=torch.Generator().manual_seed(5))
    got, true = (lift(scene, cameras, masks, backend=backend) for backend in ("gsplat", "reference"))
    torch.testing.assert_close(got.inside, true.inside, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(got.total, true.total, rtol=1e-9, atol=1e-9)


# --- what a machine that lacks something is told


def test_splats_off_the_gpu_are_refused(random_scene, pinhole):
    with pytest.raises(SceneError, match="expected torch.float32 on cuda.*'auto' chooses"):
        rasterize(random_scene(2), pinhole(4, 4), backend="gsplat")


def test_auto_takes_gsplat_for_a_gpu():
    assert find_backend("auto", FAR).name == "gsplat"
    with pytest.raises(SceneError, match="backend 'gsplat' got torch.float64 splats on cuda"):
        find_backend("auto", FAR, torch.float64)


def test_absent_package_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(SceneError, match="pip install 'gsplat>=1.5.3,<1.6'"):
        find_backend("gsplat", FAR).prepare()


RIGHT, WRONG = ("1.5.3", "1.5.3+pt24cu124", "1.5.9rc1"), ("1.4.0", "1.5.2", "1.6.0", "1.10.0")


@pytest.mark.parametrize("version, right", [*((v, True) for v in RIGHT), *((v, False) for v in WRONG)])
def test_versions_that_draw_otherwise_are_refused(monkeypatch, version, right):
    package = ModuleType("gsplat")
    package.__version__ = version
    monkeypatch.setitem(sys.modules, "gsplat", package)
    if right:
        assert gsplat.package() is package
    else:
        with pytest.raises(SceneError, match=f"found gsplat {version}, expected 1.5.3 or later and before 1.6"):
            gsplat.package()


@pytest.fixture
def kernels(monkeypatch):
    """A function (compiled, compilers, result): what the machine has, and what loading gsplat's kernels gives (an error
    is raised)."""
    pytest.importorskip("gsplat")
    loads = []

    def put(compiled: bool, compilers: dict[str, bool], result) -> list:
        monkeypatch.setattr(gsplat, "compiled", lambda: compiled)
        monkeypatch.setattr(gsplat, "compilers", lambda: compilers)

        def load(name):
            loads.append(name)
            if isinstance(result, Exception):
                raise result
            return SimpleNamespace(_C=result)

        monkeypatch.setattr(gsplat, "importlib", SimpleNamespace(import_module=load))
        return loads

    return put


def test_without_a_compiler_nothing_is_tried(kernels):
    loads = kernels(False, {"nvcc": False, "a C++ compiler": True, "ninja": False}, object())
    with pytest.raises(SceneError, match="lacks nvcc, ninja. Install the CUDA toolkit"):
        find_backend("gsplat", FAR).prepare()
    assert loads == []


def test_compiling_is_announced_before_it_begins(kernels, monkeypatch):
    loads, said = kernels(False, {"nvcc": True}, object()), []
    monkeypatch.setattr(gsplat.plugin, "info", lambda text: said.append((text, list(loads))))
    find_backend("gsplat", FAR).prepare()
    assert [(text.split(":")[0], before) for text, before in said] == [("gsplat compiles its kernels", [])]
    assert loads == ["gsplat.cuda._backend"]


def test_compiled_kernels_need_no_compiler_and_no_word(kernels, monkeypatch):
    kernels(True, {"nvcc": False}, object())
    monkeypatch.setattr(gsplat.plugin, "info", pytest.fail)
    find_backend("gsplat", FAR).prepare()


@pytest.mark.parametrize("result", [RuntimeError("ninja: build\nstopped: 3 errors"), OSError("libcudart.so.12"), None])
def test_kernels_that_do_not_load_are_one_line(kernels, result):
    kernels(True, {}, result)
    with pytest.raises(SceneError) as caught:
        find_backend("gsplat", FAR).prepare()
    assert "\n" not in str(caught.value) and "trainer.accelerator=cpu" in str(caught.value)
    if result is not None:
        assert str(result).splitlines()[-1] in str(caught.value)


def test_this_machine_is_asked_in_earnest():
    """Without stand-ins: where gsplat was never compiled, what is missing is found, whatever it is."""
    pytest.importorskip("gsplat")
    assert isinstance(gsplat.compiled(), bool)
    assert gsplat.compilers().keys() == {"nvcc", "a C++ compiler", "ninja"}
    assert all(isinstance(there, bool) for there in gsplat.compilers().values())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_against_the_reference_on_the_gpu(random_scene, pinhole):
    pytest.importorskip("gsplat")
    find_backend("gsplat", FAR).prepare()
    scene, cameras = random_scene(200), pinhole(40, 30, views=2)
    got = rasterize(scene.to("cuda"), cameras, depth=True, backend="gsplat")
    true = rasterize(scene, cameras, depth=True, backend="reference")
    assert ((got.rgb.cpu() - true.rgb).abs() > 1e-3).double().mean() < 0.01
    assert ((got.depth.cpu() - true.depth).abs() > 1e-2).double().mean() < 0.01
