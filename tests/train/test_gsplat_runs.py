"""Whole edits drawn by the package gsplat, its compiled part replaced by torch, against the same edits drawn by numba;
and mixed precision, which is there for networks."""

import json
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render import gsplat
from dreamcatalyst.render.api import BACKENDS
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.ply import read_ply, write_ply
from dreamcatalyst.train import editing
from dreamcatalyst.train.editing import EditMethod
from dreamcatalyst.train.fit import FitMethod

from tests.train.test_confined import GROWING, MASK, inside

pytestmark = pytest.mark.usefixtures("one_thread")
PLAIN = ["system.guidance.noise=independent", "system.report.every=0", "system.report.views=1"]


@pytest.fixture(scope="module")
def statue(tmp_path_factory):
    """A tenth of the synthetic scene's splats, twice as large, and their PLY."""
    scene = make_world("statue").scene[::10]
    path = write_ply(tmp_path_factory.mktemp("statue") / "few.ply", replace(scene, log_scales=scene.log_scales + 0.7))
    return read_ply(path), f"system.gs_source={path}"


def test_a_masked_edit_that_grows(launch, gsplat_here, statue):
    statue, source = statue
    options = [*PLAIN, source, MASK, *GROWING, "trainer.max_steps=10", "system.anchor.kind=last-densify"]
    drawn = {b: launch("closed-form.yaml", *options, f"system.renderer.backend={b}") for b in ("gsplat", "cpu")}
    last = {backend: read_ply(trial / "save" / "last.ply") for backend, trial in drawn.items()}
    outside = statue[~inside(statue)]
    for name in PARAMETERS:
        assert torch.equal(getattr(last["gsplat"][: len(outside)], name), getattr(outside, name)), name
    grown = {backend: len(scene) - len(outside) for backend, scene in last.items()}
    assert grown["gsplat"] > 1.5 * int(inside(statue).sum())
    assert abs(grown["gsplat"] - grown["cpu"]) <= 0.02 * grown["cpu"]  # a gradient at a threshold falls to either side

    plans = {b: json.loads((trial / "report" / "plan.json").read_text()) for b, trial in drawn.items()}
    promised = {b: {part["name"] for part in plan["builds"]} for b, plan in plans.items()}
    assert "renders of frozen splats" in promised["cpu"] and "renders of frozen splats" not in promised["gsplat"]
    assert "renders of frozen splats" in {part["name"] for part in plans["gsplat"]["leaves_out"]}


def test_the_same_edit_as_by_the_cpu(launch, gsplat_here, statue):
    """Without densification, row by row: three steps of Adam, which turn rounding of a gradient near zero into a step
    of either sign, but only of few splats."""
    statue, source = statue
    options = [*PLAIN, source, MASK, "trainer.max_steps=3"]
    ours, theirs = (
        read_ply(launch("closed-form.yaml", *options, f"system.renderer.backend={b}") / "save" / "last.ply")
        for b in ("gsplat", "cpu")
    )
    before = statue[torch.argsort(inside(statue).int(), stable=True)]
    for name in PARAMETERS[:5]:
        moved = (getattr(theirs, name) - getattr(before, name)).norm()
        assert (getattr(ours, name) - getattr(theirs, name)).norm() <= 0.05 * moved, name


@pytest.mark.parametrize("config, loads", [("closed-form.yaml", (EditMethod, "make_splats")),
                                           ("fit.yaml", (FitMethod, "first_scene"))])  # fmt: skip
def test_a_machine_that_cannot_draw_is_told_before_anything_is_loaded(launch, monkeypatch, capsys, config, loads):
    def refuse():
        raise SceneError("rasterize: backend 'gsplat' lacks nvcc")

    def none(*_):
        pytest.fail("loaded all the same")

    monkeypatch.setitem(BACKENDS._targets, "gsplat", replace(gsplat.BACKEND, devices=(), prepare=refuse))
    monkeypatch.setattr(*loads, none)
    monkeypatch.setattr(editing, "Guidance", none)
    launch(config, "trainer.max_steps=1", "system.renderer.backend=gsplat", status=2)
    assert "lacks nvcc" in capsys.readouterr().err


def test_gsplat_on_a_cpu_is_refused_before_anything_is_loaded(launch, monkeypatch, capsys):
    monkeypatch.setattr(editing, "Guidance", lambda *_, **__: pytest.fail("loaded all the same"))
    launch("closed-form.yaml", "trainer.max_steps=1", "system.renderer.backend=gsplat", status=2)
    assert "expected torch.float32 on cuda" in capsys.readouterr().err


def test_mixed_precision_does_not_reach_the_backward_pass(launch, monkeypatch):
    """Lightning calls all of a step under autocast; products of the backward pass would lose their digits there."""
    seen, step_loss = {"forward": set(), "backward": set()}, EditMethod.step_loss

    def spy(self, batch, step):
        loss, render, numbers = step_loss(self, batch, step)
        seen["forward"].add(torch.is_autocast_enabled("cpu"))
        render.rgb.register_hook(lambda _: seen["backward"].add(torch.is_autocast_enabled("cpu")))
        return loss, render, numbers

    monkeypatch.setattr(EditMethod, "step_loss", spy)
    launch("closed-form.yaml", *PLAIN, "trainer.max_steps=1", "trainer.precision=bf16-mixed")
    assert seen == {"forward": {True}, "backward": {False}}
