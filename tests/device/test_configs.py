"""One step of every config that needs a GPU, and a whole edit with densification, with the splats and the networks on a
device that is not the CPU's; and that a mistake in the product itself would be seen there."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
import torch
from diffusers import UNet2DConditionModel
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.render import gsplat
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.ply import read_ply, write_ply
from dreamcatalyst.train import densify
from dreamcatalyst.train.edit import EditSystem
from dreamcatalyst.train.editing import EditMethod
from dreamcatalyst.train.source import SourceViews

import launch as launcher
from tests.device.far import DeviceError, Far, install
from tests.test_configs import CONFIGS, ROOT, models, overrides  # noqa: F401  (models is a fixture)
from tests.train.test_confined import ANCHORED, GROWING, MASK

pytestmark = pytest.mark.usefixtures("one_thread")
ON_GPU = sorted(path for path, needs in CONFIGS.items() if "gpu" in needs)
MOST_WAITS = 40  # in one step, besides the clock's: what is finite, losses, norms; never per view or per splat


@pytest.fixture
def device(monkeypatch):
    found = install(monkeypatch)
    with found:
        yield found


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """Some of the synthetic scene's splats, as a PLY."""
    return write_ply(tmp_path_factory.mktemp("splats") / "few.ply", make_world("statue").scene[::40])


@pytest.fixture
def seen(device, monkeypatch):
    """Of each training step: how often it waited, how often the clock did, and whether splats, their state and their
    moments were all on the device."""
    steps, step = [], EditSystem._step

    def spy(self, batch, number):
        device.waits = Counter()
        out = step(self, batch, number)
        held = [*self.method.splats.parameters.values(), *self.method.splats.state.values()]
        held += [v for s in self.method.splats.optimizer.state.values() for v in s.values()]
        clock = device.waits.pop("clock", 0)
        steps.append((Counter(device.waits), clock, all(isinstance(value, Far) for value in held)))
        return out

    monkeypatch.setattr(EditSystem, "_step", spy)
    return steps


@pytest.fixture
def run(models, few, tmp_path):  # noqa: F811
    """One step of a config; its folder."""

    def go(path):
        options = [f"system.gs_source={few}", f"exp_root_dir={tmp_path}", "trainer.fast_dev_run=true"]
        options += ["data.width=32", "data.height=32", "data.max_view_num=2"]
        given = [*overrides(path, models, tmp_path), *options, "trainer.accelerator=cpu"]
        assert launcher.main(["--config", str(ROOT / path), *given]) == 0
        return tmp_path

    return go


@pytest.mark.parametrize("path", ON_GPU)
def test_a_step_on_a_device(seen, run, path):
    assert list(run(path).rglob("*.ply"))
    ((waits, clock, far),) = seen
    assert far and clock > 0
    assert sum(waits.values()) <= MOST_WAITS, waits


def test_a_masked_edit_that_grows_on_a_device(seen, launch, few):  # noqa: F811
    """Densification, anchors and a feathered mask; what is outside of it stays to the bit."""
    feathered = MASK.replace("kind: box", "kind: box, feather: 0.1")
    options = [f"system.gs_source={few}", feathered, *GROWING, *ANCHORED, "trainer.enable_checkpointing=false"]
    trial = launch(
        "closed-form.yaml", "trainer.max_steps=5", "system.report.every=0", "system.report.views=1", *options
    )
    assert len(seen) == 5 and all(far for *_, far in seen)
    assert all(sum(waits.values()) <= MOST_WAITS for waits, *_ in seen), seen
    last, source = read_ply(trial / "save" / "last.ply"), read_ply(few)
    outside = last[last.extra["mask"] < 0.5]
    rows = {tuple(row) for row in source.means.tolist()}
    assert len(last) > len(source) and len(outside) > 0
    assert all(tuple(row) in rows for row in outside.means.tolist())
    assert all(getattr(last, name).isfinite().all() for name in PARAMETERS)


def cameras_left_on_the_cpu(monkeypatch):
    monkeypatch.setattr(Cameras, "to", lambda self, *_, **__: self)


def a_network_left_on_the_cpu(monkeypatch):
    monkeypatch.setattr(UNet2DConditionModel, "to", lambda self, *_, **__: self)


def a_background_on_the_cpu(monkeypatch):
    arguments = gsplat.arguments
    black = torch.zeros(3)
    monkeypatch.setattr(gsplat, "arguments", lambda s, c, options: arguments(s, c, replace(options, background=black)))


def a_source_on_the_cpu(monkeypatch):
    view = SourceViews.view
    monkeypatch.setattr(SourceViews, "view", lambda self, index: (view(self, index)[0].cpu(), None))


PLANTS = [cameras_left_on_the_cpu, a_network_left_on_the_cpu, a_background_on_the_cpu, a_source_on_the_cpu]


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
def test_a_mistake_in_the_product_is_seen(device, run, monkeypatch, plant):
    plant(monkeypatch)
    with pytest.raises((DeviceError, AssertionError, RuntimeError), match="device"):
        run("configs/dc-splat.yaml")


def test_statistics_on_the_cpu_are_seen(device, launch, few, monkeypatch):
    monkeypatch.setattr(
        "dreamcatalyst.train.densify.screen_statistics",
        lambda splats: {name: torch.zeros(len(splats)) for name in densify.STATISTICS},
    )
    with pytest.raises(DeviceError):
        launch("closed-form.yaml", f"system.gs_source={few}", "trainer.max_steps=1")


def test_a_look_at_each_splat_is_seen(seen, run, monkeypatch):
    """What no device refuses, and what makes a step slow: counted."""
    step_loss = EditMethod.step_loss

    def looking(self, batch, step):
        for opacity in self.splats.parameters["logit_opacities"][:100]:
            opacity.item()
        return step_loss(self, batch, step)

    monkeypatch.setattr(EditMethod, "step_loss", looking)
    run("configs/dc-splat.yaml")
    ((waits, *_),) = seen
    assert sum(waits.values()) > 100 > MOST_WAITS
