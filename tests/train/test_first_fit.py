"""An edit of photographs without splats fits them first, once, as finely as it draws them."""

from __future__ import annotations

import json
import os
import signal

import cv2
import numpy as np
import pytest
from dreamcatalyst import kept
from dreamcatalyst.scene.fitted import Fitted
from dreamcatalyst.train.fit import FitMethod

from benchmarks.faulty.things import colmap

BRIEF = ["trainer.max_steps=2", "system.first_fit.steps=6", "data.width=null", "data.height=null"]


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """Photographs with cameras and points; what is kept begins empty."""
    monkeypatch.setenv("DREAMCATALYST_CACHE", str(tmp_path / "kept folder"))
    colmap(tmp_path / "père noël")
    return tmp_path / "père noël"


def fits():
    return sorted(path for path in (kept.home() / "fits").glob("*") if path.is_dir())


def words(capture, *more):
    return f"data.source={capture}", *BRIEF, *more


def test_photographs_are_fitted_once_and_their_splats_are_those_of_the_edit(capture, launch, capsys):
    first = launch("closed-form.yaml", *words(capture))
    (fit,) = fits()
    assert "fitted to the photographs" in capsys.readouterr().err
    scene = (first / "save/source.ply").read_bytes()
    assert (fit / "save/last.ply").read_bytes() == scene and not (fit / "ckpts").exists()
    told = json.loads((first / "report/summary.json").read_text())["fit"]
    assert told["steps"] == 6 and told == json.loads((fit / "fit.json").read_text())
    again = launch("closed-form.yaml", *words(capture), mode="--preview")
    assert (again / "save/preview.png").is_file() and fits() == [fit]
    assert " train" not in capsys.readouterr().err
    given = launch("closed-form.yaml", *words(capture), f"system.gs_source={fit}/save/last.ply")
    assert (given / "save/last.ply").read_bytes() == (first / "save/last.ply").read_bytes()


def test_a_kept_fit_that_was_damaged_is_fitted_again(capture, launch, capsys):
    launch("closed-form.yaml", *words(capture), mode="--test")
    splats = fits()[0] / "save/last.ply"
    whole = splats.read_bytes()
    splats.write_bytes(whole[:-1])
    launch("closed-form.yaml", *words(capture), mode="--test")
    assert "is damaged, so it is fitted again" in capsys.readouterr().err and splats.read_bytes() == whole


def test_other_photographs_or_another_recipe_are_another_fit(capture, launch):
    launch("closed-form.yaml", *words(capture), mode="--test")
    launch("closed-form.yaml", *words(capture, "system.first_fit.system.sh_degree=1"), mode="--test")
    photograph = capture / "images/002.png"
    pixels = cv2.imread(str(photograph))
    photograph.write_bytes(cv2.imencode(".png", np.roll(pixels, 1, axis=0))[1].tobytes())
    launch("closed-form.yaml", *words(capture), mode="--test")
    assert len(fits()) == 3


def test_a_fit_is_as_fine_as_the_window_that_the_edit_draws(capture, launch):
    launch("closed-form.yaml", *words(capture), "data.width=12", "data.height=12")  # of 24 x 18: by 1.5
    (fit,) = fits()
    assert Fitted.of(fit / "save/last.ply") == Fitted(16, 12, 20.0)


def test_what_the_prior_does_not_know_is_said_before_the_fit(capture, launch, capsys):
    launch("closed-form.yaml", *words(capture), "system.prompt_processor.prompt=Fly to the moon", status=2)
    assert "does not know the instruction 'Fly to the moon'" in capsys.readouterr().err and not fits()
    launch("closed-form.yaml", *words(capture), "system.first_fit.steps=0", status=2)
    assert "system.gs_source: no splats are given" in capsys.readouterr().err and not fits()


def test_an_interrupted_fit_goes_on_to_the_same_bits(capture, launch, monkeypatch, tmp_path, capsys):
    launch("closed-form.yaml", *words(capture), mode="--test")
    whole = (fits()[0] / "save/last.ply").read_bytes()
    monkeypatch.setenv("DREAMCATALYST_CACHE", str(tmp_path / "another"))
    step_loss = FitMethod.step_loss

    def interrupted(self, batch, step):
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return step_loss(self, batch, step)

    monkeypatch.setattr(FitMethod, "step_loss", interrupted)
    launch("closed-form.yaml", *words(capture), mode="--test", status=130)
    monkeypatch.setattr(FitMethod, "step_loss", step_loss)
    assert "the same command goes on with it" in capsys.readouterr().err
    launch("closed-form.yaml", *words(capture), mode="--test")
    assert "goes on from step 4 of 6" in capsys.readouterr().err
    assert (fits()[0] / "save/last.ply").read_bytes() == whole
