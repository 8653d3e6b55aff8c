"""What every run says of itself: its page, its rows, its summary, and what they cost."""

import csv
import json

import pytest
from dreamcatalyst.report.clock import STAGES

from tests.report.small_clip import make_clip, make_predictor
from tests.report.test_page import Balanced


@pytest.fixture
def trial(launch):
    return launch("closed-form.yaml", "trainer.max_steps=6", "system.report.every=3", "system.report.overhead=100")


def test_every_run_leaves_one(trial):
    text = (trial / "report" / "index.html").read_text()
    Balanced(text)
    for word in ("Make it sunset", "Before and after", "Against run time", "PSNR to the known edit", "python", "torch"):
        assert word in text, word
    assert "guidance_scale: 7.5" in text and "identity distance" in text and "convergence" in text  # config, errors
    summary = json.loads((trial / "report" / "summary.json").read_text())
    assert {"machine", "versions", "stages", "overhead", "mean"} <= set(summary)
    assert {"consistency_short", "consistency_short_source"} <= set(summary["mean"])


def test_rows_say_where_the_time_went(trial):
    with (trial / "report" / "error.csv").open() as file:
        rows = [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]
    assert [row["step"] for row in rows] == [0, 3, 6]
    last = rows[-1]
    stages = {name: last[f"seconds_{name}"] for name in STAGES}
    assert sum(stages.values()) - stages["logging"] == pytest.approx(last["seconds"], abs=0.01)
    for name in ("render", "encode", "unet", "backward", "optimizer", "logging"):
        assert stages[name] > 0, name
    assert {"t", "loss", "residual", "norm_means", "norm_sh0", "memory_mib", "change_per_second"} <= set(last)
    assert last["change_per_second"] > 0 and "norm_shN" not in last  # of degree 0


def test_reports_stay_within_their_share(launch):
    trial = launch("closed-form.yaml", "trainer.max_steps=40", "system.report.every=1", "system.report.overhead=0")
    with (trial / "report" / "error.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 41  # all steps are there; errors where they must be
    assert [row["step"] for row in rows if row["psnr_edit"]] == ["0", "40"]
    assert all(row["loss"] for row in rows[1:])


def test_a_clip_scores_an_edit(launch, tmp_path):
    words = ["system.report.clip_source=a photo of a bear", "system.report.clip_target=a photo of a bear at sunset"]
    given = [f"system.report.clip={make_clip(tmp_path / 'clip')}", *words]
    given.append(f"system.report.aesthetic={make_predictor(tmp_path / 'linear.pth')}")
    trial = launch("closed-form.yaml", "trainer.max_steps=2", *given)
    mean = json.loads((trial / "report" / "summary.json").read_text())["mean"]
    assert {"clip_direction", "clip_similarity", "aesthetic", "aesthetic_source"} <= set(mean)
    assert -1 <= mean["clip_direction"] <= 1 and mean["clip_similarity"] > 0.5


def test_the_page_says_where_nothing_measures_the_edit(launch, tmp_path, capsys):
    """A learned prior on splats of one's own has no truth: distances from the source only. An exact one knows."""
    from tests.diffusion.small_model import make_model

    told = "No figure here measures the edit"
    learned = ["system.guidance.prior_type=ip2p", f"system.guidance.prior={{path: {make_model(tmp_path / 'ip2p')}}}"]
    learned += ["trainer.max_steps=1", "system.prompt_processor.prompt=make it snow at the weekend"]
    trial = launch("closed-form.yaml", *learned, name="learned")
    assert told in (trial / "report" / "index.html").read_text() and told in capsys.readouterr().out
    words = ["system.report.clip_source=a photo of a bear", "system.report.clip_target=a photo of a bear in snow"]
    judged = launch(
        "closed-form.yaml", *learned, *words, f"system.report.clip={make_clip(tmp_path / 'clip')}", name="judged"
    )
    exact = launch("closed-form.yaml", "trainer.max_steps=1", name="exact")
    assert not any(told in (t / "report" / "index.html").read_text() for t in (judged, exact))
    assert told not in capsys.readouterr().out


def test_options_that_need_each_other(launch, capsys):
    launch("closed-form.yaml", "system.report.aesthetic=somewhere.pth", status=2)
    assert "aesthetic: is for a CLIP" in capsys.readouterr().err
    launch("closed-form.yaml", "system.report.clip=./nowhere", "trainer.max_steps=1", status=2)
    assert "no such folder" in capsys.readouterr().err
