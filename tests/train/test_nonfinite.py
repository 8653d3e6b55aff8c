"""A number that is not finite, put in at each stage of a step: the run says where, and what it leaves is finite."""

import csv
import json
import math
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm
from dreamcatalyst.errors import NumericalError
from dreamcatalyst.scene.ply import read_ply
from dreamcatalyst.train.editing import EditMethod
from dreamcatalyst.train.finite import gradient_norms, require_finite, restore, snapshot

from tests.train.test_runs import assert_same_splats

AT = 3  # the step that is spoilt
NAN, INF = math.nan, math.inf


def spoil_render(monkeypatch, value, now):
    draw = EditMethod.draw_now

    def spoilt(self, cameras):
        render = draw(self, cameras)
        bad = now(self) and torch.is_grad_enabled()
        return replace(render, rgb=render.rgb * value) if bad else render

    monkeypatch.setattr(EditMethod, "draw_now", spoilt)


def spoil_guidance(monkeypatch, value, now):
    predict, step_loss, at = ClosedForm.predict_noise, EditMethod.step_loss, []

    def noted(self, batch, step):
        at[:] = [now(self)]
        return step_loss(self, batch, step)

    def spoilt(self, rows, timestep):
        out = predict(self, rows, timestep)
        if at[0]:
            out[0] = out[0].clone()
            out[0][0, 0, 0, 0] = value
        return out

    monkeypatch.setattr(EditMethod, "step_loss", noted)
    monkeypatch.setattr(ClosedForm, "predict_noise", spoilt)


def spoil_backward(monkeypatch, value, now):
    step_loss = EditMethod.step_loss

    def spoilt(self, batch, step):
        terms, render, numbers = step_loss(self, batch, step)
        if now(self):
            terms["guidance"].register_hook(lambda gradient: gradient * value)
        return terms, render, numbers

    monkeypatch.setattr(EditMethod, "step_loss", spoilt)


def spoil_update(monkeypatch, value, now):
    def spoilt(self):
        if self.context.step() == AT + 1:  # the optimizer's step counts
            with torch.no_grad():
                self.splats.parameters["quats"][5, 1] = value

    monkeypatch.setattr(EditMethod, "after_update", spoilt)


PLACES = {  # what is put in: (how, value, the words that name it)
    "render NaN": (spoil_render, NAN, ("stage render", "colours")),
    "render Inf": (spoil_render, INF, ("stage render", "colours")),
    "guidance NaN": (spoil_guidance, NAN, ("guidance 'dreamcatalyst'", "gradient")),
    "guidance Inf": (spoil_guidance, INF, ("guidance 'dreamcatalyst'", "gradient")),
    "gradient NaN": (spoil_backward, NAN, ("stage backward", "the gradient of means")),
    "gradient Inf": (spoil_backward, INF, ("stage backward", "the gradient of means")),
    "gradient 1e35": (spoil_backward, 1e35, ("stage backward", "so large")),
    "update NaN": (spoil_update, NAN, ("stage optimizer", "1 of", "quats")),
    "update Inf": (spoil_update, -INF, ("stage optimizer", "1 of", "quats")),
}


def assert_finite(trial):
    saved = torch.load(trial / "ckpts" / "last.ckpt", weights_only=True)
    moments = [v for s in saved["optimizer_states"][0]["state"].values() for v in s.values()]
    tensors = [*saved["splats"]["parameters"].values(), *saved["splats"]["state"].values(), *moments]
    tensors += [value for _, value in read_ply(trial / "save" / "last.ply").parameters()]
    assert all(bool(torch.isfinite(torch.as_tensor(value)).all()) for value in tensors)
    return saved


@pytest.mark.parametrize("name", PLACES)
def test_a_run_stops_with_the_place_and_leaves_the_last_good_state(launch, capsys, monkeypatch, name):
    spoil, value, words = PLACES[name]
    spoil(monkeypatch, value, lambda method: method.context.step() == AT)
    trial = launch("closed-form.yaml", "trainer.max_steps=6", "system.report.every=0", status=2)
    told = capsys.readouterr().err
    for word in (f"step {AT}", "timestep ", "view 00", *words, "last.ckpt"):
        assert word in told, told
    saved = assert_finite(trial)
    summary = json.loads((trial / "report" / "summary.json").read_text())
    assert summary["step"] == saved["global_step"] and (trial / "report" / "index.html").is_file()
    if name.endswith("NaN") and spoil is not spoil_update:  # there the step counts, without its update
        monkeypatch.undo()
        whole = launch("closed-form.yaml", "trainer.max_steps=6", "system.report.every=0", name="whole")
        again = f"resume={trial / 'ckpts' / 'last.ckpt'}"
        assert_same_splats(launch("closed-form.yaml", "trainer.max_steps=6", "system.report.every=0", again), whole)


@pytest.mark.parametrize("name", [name for name in PLACES if "Inf" not in name])
def test_a_step_can_be_left_out_and_is_counted(launch, capsys, monkeypatch, name):
    spoil, value, words = PLACES[name]
    spoil(monkeypatch, value, lambda method: method.context.step() == AT)
    options = ["trainer.max_steps=6", "system.report.every=1", "system.nonfinite=skip"]
    trial = launch("closed-form.yaml", *options)
    told = capsys.readouterr().err
    assert f"step {AT}" in told and words[0] in told and "1 so far" in told
    assert assert_finite(trial)["global_step"] == 6
    summary = json.loads((trial / "report" / "summary.json").read_text())
    assert summary["skipped"] == 1 and summary["step"] == 6
    with (trial / "report" / "error.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["skipped"] for row in rows] == [""] * 4 + ["1"] * 3 and not rows[AT + 1]["loss"]


def test_a_run_of_nothing_but_bad_steps_changes_nothing(launch, monkeypatch):
    spoil_backward(monkeypatch, NAN, lambda system: True)
    trial = launch("closed-form.yaml", "trainer.max_steps=4", "system.nonfinite=skip", "system.report.every=0")
    source, last = read_ply(trial / "save" / "source.ply"), read_ply(trial / "save" / "last.ply")
    for (_, one), (_, other) in zip(source.parameters(), last.parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_choice_is_checked(launch, capsys):
    launch("closed-form.yaml", "system.nonfinite=skipp", status=2)
    assert "Did you mean 'skip'" in capsys.readouterr().err


def test_what_is_named_and_counted():
    value = torch.tensor([1.0, NAN, -INF])
    with pytest.raises(NumericalError, match="stage render: 2 of 3 elements of colours"):
        require_finite("render", good=torch.ones(2), colours=value)
    require_finite("render", large=torch.full((9,), 3e38))  # their sum overflows, they do not


def test_norms_are_those_of_the_gradients():
    parameters = {"a": torch.nn.Parameter(torch.ones(2)), "b": torch.nn.Parameter(torch.ones(3, 0))}
    assert gradient_norms(parameters) == {"a": 0.0}
    parameters["a"].grad = torch.tensor([3.0, 4.0])
    assert gradient_norms(parameters) == {"a": 5.0}


def test_a_parameter_gets_back_what_it_was():
    parameters = {"a": torch.nn.Parameter(torch.ones(2))}
    kept = snapshot(parameters)
    with torch.no_grad():
        parameters["a"].fill_(NAN)
    restore(parameters, kept)
    assert torch.equal(parameters["a"], torch.ones(2))
