"""Whole runs through the launcher, small: what they reach, what they leave, and that resuming changes nothing."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.report import results
from dreamcatalyst.scene.fitted import Fitted
from dreamcatalyst.scene.ply import read_ply, write_ply
from dreamcatalyst.train.edit_config import PromptConfig
from dreamcatalyst.train.fit import FitMethod
from dreamcatalyst.train.optim import LearningRates

EVERY_PARAMETER = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


def rows(trial):
    with (trial / "report" / "error.csv").open() as file:
        return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]


def assert_same_splats(a, b):
    one, other = read_ply(a / "save" / "last.ply"), read_ply(b / "save" / "last.ply")
    for name in EVERY_PARAMETER:
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_a_fit_approaches_its_photographs_and_leaves_everything(launch):
    begins = ["system.initial_opacity=0.1", "system.densify.start=20", "system.densify.every=20"]
    trial = launch("fit.yaml", "trainer.max_steps=60", *begins)
    curve = rows(trial)
    assert curve[0]["step"] == 0 and curve[-1]["step"] == 60
    assert curve[-1]["psnr_photo"] > curve[0]["psnr_photo"] + 3
    assert all(b["seconds"] >= a["seconds"] for a, b in zip(curve, curve[1:], strict=False))
    for name in (
        "save/last.ply",
        "save/it60-comparison.png",
        "report/error.svg",
        "ckpts/last.ckpt",
        "configs/parsed.yaml",
    ):
        assert (trial / name).stat().st_size > 0, name
    summary = json.loads((trial / "report" / "summary.json").read_text())
    assert summary["step"] == 60 and summary["splats"] == len(read_ply(trial / "save" / "last.ply"))


def test_photographs_of_several_sizes_are_fitted_and_scored(launch, tmp_path):
    """Also how consistent neighbouring views are, which have no common size; and there is a report at the end."""
    frames = []
    for i, (width, height) in enumerate([(24, 18), (18, 24), (24, 18), (20, 20)]):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((height, width, 3), 40 * i, np.uint8))
        pose = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append(dict(file_path=f"{i}.png", transform_matrix=pose, fl_x=20.0))
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    ply = write_ply(tmp_path / "a.ply", make_world("statue").scene[::50])
    options = [f"data.source={tmp_path}", f"system.gs_source={ply}", "data.width=null", "data.height=null"]
    trial = launch("fit.yaml", *options, "data.test_every=2", "trainer.max_steps=2", "system.report.video_frames=2")
    assert (trial / "report" / "index.html").is_file() and (trial / "save" / "it2-test.mp4").is_file()
    assert "consistency_short" in json.loads((trial / "report" / "summary.json").read_text())["mean"]


def test_an_edit_approaches_the_edit_that_the_prior_knows(launch):
    trial = launch("closed-form.yaml", "trainer.max_steps=60", "data.batch_size=2", "system.report.every=30")
    curve = rows(trial)
    assert curve[-1]["psnr_edit"] > curve[0]["psnr_edit"] + 3
    assert curve[-1]["psnr_source"] < 40
    assert (trial / "save" / "source.ply").is_file()
    assert [row["t"] for row in curve[1:]][-1] == 201  # the schedule ends where it should for any number of steps


def test_cameras_of_another_scene_are_warned_of(launch, tmp_path, capsys):
    statue = make_world("statue").scene
    other = write_ply(tmp_path / "other.ply", statue[::100])
    same = write_ply(tmp_path / "same.ply", statue)
    launch("closed-form.yaml", "trainer.max_steps=1", f"system.gs_source={same}")
    assert "belong together" not in capsys.readouterr().err
    launch("closed-form.yaml", "trainer.max_steps=1", f"system.gs_source={other}")
    assert "belong together" in capsys.readouterr().err
    launch("closed-form.yaml", "trainer.max_steps=1", f"system.gs_source={other}", "data.source=")
    assert "belong together" not in capsys.readouterr().err


def test_the_null_edit_leaves_the_scene_alone(launch):
    trial = launch(
        "closed-form.yaml",
        "trainer.max_steps=4",
        "system.guidance.guidance_scale=0",
        "system.guidance.noise=independent",
    )
    source, last = read_ply(trial / "save" / "source.ply"), read_ply(trial / "save" / "last.ply")
    for name in EVERY_PARAMETER:
        assert torch.equal(getattr(source, name), getattr(last, name)), name


@pytest.mark.parametrize(
    ("config", "options"),
    [
        ("closed-form.yaml", ["data.batch_size=2"]),
        ("fit.yaml", ["system.densify.start=2", "system.densify.every=2", "system.densify.grad_threshold=1e-6"]),
    ],
)
def test_a_resumed_run_has_the_same_bits_as_an_uninterrupted_one(launch, config, options):
    whole = launch(config, "trainer.max_steps=8", *options, "checkpoint.every_n_train_steps=5", name="whole")
    checkpoint = next((whole / "ckpts").glob("*step=5.ckpt"))
    copy = whole.parents[1] / "resumed" / "trial" / "ckpts" / checkpoint.name
    copy.parent.mkdir(parents=True)
    copy.write_bytes(checkpoint.read_bytes())
    resumed = launch(config, "trainer.max_steps=8", *options, f"resume={copy}", name="resumed")
    assert_same_splats(whole, resumed)
    assert rows(resumed)[-1]["step"] == 8


def test_a_densify_step_keeps_its_update(launch):
    """Density control that finds nothing to do changes nothing, at whatever step it looks."""
    idle = ["system.densify.start=0", "system.densify.grad_threshold=1e9", "system.densify.min_opacity=0"]
    idle += ["system.densify.max_size=0"]
    with_it = launch(
        "fit.yaml", "trainer.max_steps=4", *idle, "system.densify.every=1", "system.densify.stop=9", name="a"
    )
    without = launch("fit.yaml", "trainer.max_steps=4", "system.densify.every=0", name="b")
    assert_same_splats(with_it, without)


def test_validate_and_export_work_from_a_ply_and_from_a_checkpoint(launch, capsys):
    trial = launch("closed-form.yaml", "trainer.max_steps=2")
    launch("closed-form.yaml", f"resume={trial / 'ckpts' / 'last.ckpt'}", mode="--validate")
    assert "psnr_edit" in capsys.readouterr().out
    launch("fit.yaml", f"system.gs_source={trial / 'save' / 'last.ply'}", mode="--validate", name="fit")
    assert "psnr_photo" in capsys.readouterr().out
    video = "system.report.video_frames=3"
    launch("closed-form.yaml", f"resume={trial / 'ckpts' / 'last.ckpt'}", video, mode="--export")
    export = trial / "save" / "it2-export"
    assert (export / "point_cloud.ply").is_file() and (export / "video.mp4").stat().st_size > 0


def test_preview_draws_a_grid_without_a_run(launch):
    trial = launch(
        "closed-form.yaml",
        "system.preview.prompts=[Make it night, Make it autumn]",
        "system.preview.guidance_scales=[1,7.5]",
        mode="--preview",
    )
    assert (trial / "save" / "preview.png").stat().st_size > 0
    assert not (trial / "ckpts").exists()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("system.prompt_processor.prompt=Make it purple polka dots", "Known"),
        ("system.guidance.rule=dreamcatalist", "Did you mean 'dreamcatalyst'"),
        ("system.guidence.rule=pds", "Did you mean 'guidance'"),
        ("system.gs_source=nowhere.ply", "nowhere.ply"),
        ("system.renderer.backend=gpu", "rasterizer"),
        ("data.source=demo:statues", "Did you mean 'statue'"),
        ("system.guidance.guidance_scale=strong", "strong"),
        ("system.report.video_frames=-1", "system.report.video_frames: got -1"),
        ("system.renderer.background=[2,0,0]", "system.renderer.background[0]: got 2.0"),
    ],
)
def test_wrong_input_is_one_clear_error(launch, capsys, override, words):
    launch("closed-form.yaml", "trainer.max_steps=2", override, status=2)
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error


def test_a_gradient_that_is_not_finite_ends_the_run_and_loses_nothing(launch, capsys, monkeypatch):
    monkeypatch.setattr(FitMethod, "step_loss", poisoned(FitMethod.step_loss, at=3))
    trial = launch("fit.yaml", "trainer.max_steps=9", status=2)
    told = capsys.readouterr().err
    assert "step 3" in told and "not finite" in told and str(trial / "ckpts" / "last.ckpt") in told
    assert all(value.isfinite().all() for _, value in read_ply(trial / "save" / "last.ply").parameters())
    monkeypatch.undo()
    whole = launch("fit.yaml", "trainer.max_steps=9", name="whole")
    resumed = launch("fit.yaml", "trainer.max_steps=9", f"resume={trial / 'ckpts' / 'last.ckpt'}")
    assert_same_splats(resumed, whole)


def poisoned(step_loss, at):
    """The same loss, whose gradient at step `at` is NaN."""

    def step(self, batch, number):
        terms, render, numbers = step_loss(self, batch, number)
        if number == at:
            next(iter(terms.values())).register_hook(lambda gradient: gradient * float("nan"))
        return terms, render, numbers

    return step


def test_results_come_in_the_order_of_what_would_be_missed_most(launch, monkeypatch):
    """A video that cannot be written costs neither splats nor scores; a test that is left out no splats."""

    def refuse(*arguments):
        raise OSError("no room")

    monkeypatch.setattr(results, "write_video", refuse)
    with pytest.raises(OSError, match="no room"):
        launch("fit.yaml", "trainer.max_steps=2", "system.report.video_frames=2", name="full")
    trial = launch("fit.yaml", "trainer.max_steps=2", "trainer.limit_test_batches=0", name="untested")
    full = trial.parents[1] / "full" / "trial"
    for path in ("save/last.ply", "report/error.csv", "report/summary.json", "ckpts/last.ckpt"):
        assert (full / path).is_file(), path
    assert (trial / "save" / "last.ply").is_file()


def test_a_run_that_time_ends_leaves_a_checkpoint(launch):
    trial = launch("fit.yaml", "trainer.max_steps=100000", "trainer.max_time=00:00:00:01")
    saved = torch.load(trial / "ckpts" / "last.ckpt", weights_only=True)
    assert 0 < saved["global_step"] < 100000 and (trial / "save" / "last.ply").is_file()


def test_a_checkpoint_of_another_system_is_refused(launch, capsys):
    trial = launch("closed-form.yaml", "trainer.max_steps=1")
    launch("fit.yaml", f"resume={trial / 'ckpts' / 'last.ckpt'}", "trainer.max_steps=2", status=2)
    told = capsys.readouterr().err.splitlines()[-1]
    assert "system_type was 'dreamcatalyst-edit-system' and is now 'dreamcatalyst-fit-system'" in told
    assert f"system.gs_source={trial / 'save' / 'last.ply'}" in told and ";" not in told
    launch("fit.yaml", f"resume={trial / 'ckpts' / 'last.ckpt'}", mode="--test", status=2)
    assert "EditSystem" in capsys.readouterr().err


def test_an_infinite_score_is_null_in_the_summary(launch):
    trial = launch("closed-form.yaml", "trainer.max_steps=1", "trainer.limit_train_batches=1", mode="--test")
    text = (trial / "report" / "summary.json").read_text()
    assert json.loads(text)["mean"]["psnr_source"] is None and "Infinity" not in text


def test_an_empty_prompt_is_refused():
    with pytest.raises(ConfigError, match="prompt"):
        PromptConfig("  ")


def test_learning_rates_run_geometrically_to_their_end():
    rates = LearningRates(means=2e-4, means_decay=0.01, decay=0.25)
    first, last = rates.at(0, 101, 3.0), rates.at(100, 101, 3.0)
    assert first["means"] == pytest.approx(6e-4) and last["means"] == pytest.approx(6e-6)
    assert last["sh0"] == pytest.approx(0.25 * first["sh0"])
    assert rates.at(50, 101, 3.0)["means"] == pytest.approx(6e-5)
    assert LearningRates(warm_up_steps=10).at(0, 100, 1.0)["sh0"] == pytest.approx(2.5e-4)


def test_scheduled_learning_rate():
    assert LearningRates(sh0=(0, 0.0, 1.0, 10)).at(5, 100, 1.0)["sh0"] == pytest.approx(0.5)


def test_an_edit_finer_than_its_fit_is_refused_with_the_remedy(launch, capsys):
    fit = launch("fit.yaml", "trainer.max_steps=2", name="fit")
    ply = f"system.gs_source={fit / 'save' / 'last.ply'}"
    edit = ["trainer.max_steps=1", ply]
    launch("closed-form.yaml", *edit, "data.width=48", "data.height=48", name="finer", status=2)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert "was fitted at 24 x 24 pixels" in line and "draws it at 48 x 48" in line and "data.max_side=48" in line
    same = launch("closed-form.yaml", *edit, name="same")
    for name in ("source.ply", "last.ply"):  # so that an edit of the edit knows it, too
        assert Fitted.of(same / "save" / name) == Fitted.of(fit / "save" / "last.ply")
    finer = ["data.width=48", "data.height=48", "system.allow_coarse_fit=true"]
    launch("closed-form.yaml", *edit, *finer, name="allowed")


def test_an_overlay_is_kept_whole_and_runs_again_from_where_it_is_kept(launch, tmp_path):
    overlay, base = tmp_path / "over.yaml", Path(__file__).resolve().parents[2] / "configs/closed-form.yaml"
    overlay.write_text(f"base: {base}\nsystem: {{guidance: {{chi: 0.1}}}}\n")
    trial = launch(str(overlay), "trainer.max_steps=1")
    kept = trial / "configs" / "raw.yaml"
    assert "base" not in yaml.safe_load(kept.read_text()) and "chi: 0.1" in kept.read_text()
    assert_same_splats(launch(str(kept), "trainer.max_steps=1"), trial)
