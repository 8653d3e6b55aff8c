"""A new part is one file outside of the package, which registers it; the run that imports it can name it at once.

Each toy of tests/newcomers/ goes through the launcher, and changes something that the launcher writes.
"""

import csv
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from dreamcatalyst.data.formats import FORMATS
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.diffusion.api import PRIORS
from dreamcatalyst.guidance.rules import RULES
from dreamcatalyst.inpaint.api import INPAINTERS
from dreamcatalyst.render.api import BACKENDS
from dreamcatalyst.report.metrics import METRICS
from dreamcatalyst.scene.formats.api import SPLATS
from dreamcatalyst.scene.gaussians import SH_C0
from dreamcatalyst.scene.ply import read_ply, write_ply
from dreamcatalyst.segment.api import SEGMENTERS
from dreamcatalyst.train.density import DENSITY

TOYS = Path(__file__).parent / "newcomers"
REGISTRIES = [METRICS, DENSITY, SEGMENTERS, INPAINTERS, PRIORS, BACKENDS, RULES, FORMATS, SPLATS]


@pytest.fixture(autouse=True)
def forget(monkeypatch):
    """Toys are known in these tests alone."""
    for registry in REGISTRIES:
        monkeypatch.setattr(registry, "_targets", dict(registry._targets))
    yield
    for name in [name for name in sys.modules if name.startswith("dreamcatalyst_parts.")]:
        del sys.modules[name]


@pytest.fixture
def edit(launch):
    """One step of an edit with a toy; the trial's folder."""

    def run(toy: str, *overrides: str, config: str = "closed-form.yaml", **options):
        steps = ["trainer.max_steps=2", "system.report.every=1", f"imports=[{TOYS / toy}.py]"]
        return launch(config, *steps, *overrides, **options)

    return run


def header(trial: Path) -> list[str]:
    with (trial / "report" / "error.csv").open() as file:
        return next(csv.reader(file))


def last_row(trial: Path) -> dict[str, str]:
    with (trial / "report" / "error.csv").open() as file:
        return list(csv.DictReader(file))[-1]


def test_a_metric_is_a_column_of_every_table(edit, capsys):
    trial = edit("metric")
    assert {"rms_edit", "rms_source"} <= set(header(trial))
    row = last_row(trial)
    assert float(row["rms_edit"]) >= float(row["l1_edit"]) > 0  # of any image; and of none that is computed otherwise
    assert "rms_edit" in json.loads((trial / "report" / "summary.json").read_text())["mean"]
    assert "RMS error at held-out views" in (trial / "report" / "index.html").read_text()
    assert "rms_edit" in capsys.readouterr().out


def test_a_density_strategy_decides_how_many_splats_there_are(edit):
    thin = ["system.densify={strategy: thin-out, options: {share: 0.25}, every: 1, start: 0}"]
    trial = edit("density", *thin)
    before, after = (len(read_ply(trial / "save" / name)) for name in ("source.ply", "last.ply"))
    assert after == round(0.25 * before)
    assert "by strategy thin-out" in (trial / "report" / "index.html").read_text()


def test_the_options_of_a_strategy_are_checked(edit, capsys):
    edit("density", "system.densify={strategy: thin-out, options: {share: 2}}", status=2)
    assert "system.densify.options.share: got 2" in capsys.readouterr().err
    edit("density", "system.densify.strategy=thin", status=2)
    assert "Did you mean 'thin-out'?" in capsys.readouterr().err


def test_a_segmenter_says_which_splats_may_change(edit):
    trial = edit("segmenter", "system.mask={kind: above, options: {height: 0.6}}")
    mask = read_ply(trial / "save" / "last.ply").extra["mask"]
    means = read_ply(trial / "save" / "source.ply").means
    assert int((mask >= 0.5).sum()) == int((means[:, 2] > 0.6).sum()) > 0


def test_an_inpainter_fills_the_hole(edit):
    plain = "system.inpaint={kind: plain, options: {colour: [0, 0, 1]}}"
    trial = edit("inpainter", plain, "system.heal.views=4", "system.learning_rates.sh0=0", config="delete.yaml")
    last = read_ply(trial / "save" / "last.ply")
    added = json.loads((trial / "report" / "summary.json").read_text())["counts"]["splats put in"]
    colours = last.sh0[len(last) - added :, 0] * SH_C0 + 0.5
    assert added > 0 and np.allclose(colours.numpy(), (0, 0, 1), atol=1e-5)


def test_a_prior_says_what_becomes_of_the_scene(edit):
    def redness(trial):
        sh0 = read_ply(trial / "save" / "last.ply").sh0[:, 0]
        return float((sh0[:, 0] - sh0[:, 2]).mean())

    many = ["trainer.max_steps=12", "system.guidance.prior_type=plain"]
    red, blue = (edit("prior", *many, f"system.guidance.prior={{colour: {c}}}") for c in ("[1,0,0]", "[0,0,1]"))
    assert redness(red) > redness(blue) + 0.1


def test_a_backend_draws(edit):
    def picture(*overrides):
        trial = edit("backend", *overrides)
        return cv2.imread(str(next(trial.glob("save/it2-test/*.png"))))[:24, :24]  # the source

    drawn, swapped = picture("system.renderer.backend=reference"), picture("system.renderer.backend=swapped")
    assert np.abs(drawn[..., ::-1].astype(int) - swapped).max() <= 1 < np.abs(drawn.astype(int) - swapped).max()


def test_a_format_is_found_by_its_files(edit, tmp_path):
    (tmp_path / "eyes").mkdir()
    (tmp_path / "eyes" / "eyes.txt").write_text("4 0 1\n0 4 1\n-4 0 1\n0 -4 1\n")
    splats = write_ply(tmp_path / "statue.ply", make_world("statue").scene)
    trial = edit("format", f"data.source={tmp_path / 'eyes'}", f"system.gs_source={splats}", "data.test_every=3")
    assert json.loads((trial / "report" / "summary.json").read_text())["held_out"] == ["eye-0", "eye-3"]


def test_a_splat_format_is_written_and_read(launch, tmp_path, capsys):
    toy, orbit = f"imports=[{TOYS / 'splats.py'}]", ["data.source=", "data.orbit_views=4"]
    splats, text = write_ply(tmp_path / "statue.ply", make_world("statue").scene), tmp_path / "statue.round"
    launch("convert.yaml", toy, *orbit, f"system.gs_source={splats}", f"export.path={text}", mode="--export")
    assert len(text.read_text().splitlines()) == 1 + len(read_ply(splats))
    said = capsys.readouterr()
    assert "list of round splats: shapes. PSNR of renders" in said.out + said.err
    launch(
        "convert.yaml", toy, *orbit, f"system.gs_source={text}", f"export.path={tmp_path / 'b.spz'}", mode="--export"
    )
    assert "all splats are round" in capsys.readouterr().out
    launch(
        "convert.yaml", *orbit, f"system.gs_source={splats}", "export.format=rounder", toy, mode="--export", status=2
    )
    assert "Did you mean 'round'?" in capsys.readouterr().err


def test_a_rule_moves_the_splats_otherwise(edit):
    trials = [edit("rule", f"system.guidance.rule={name}") for name in ("dds", "dds-held")]
    moved = [read_ply(trial / "save" / "last.ply").means for trial in trials]
    assert not bool((moved[0] == moved[1]).all())
    assert "rule dds-held" in (trials[1] / "report" / "plan.json").read_text()


@pytest.mark.parametrize("file, words", [
    ("nowhere.py", "is no file"),
    ("fails.py", "ZeroDivisionError: division by zero"),
    ("no.such.module", "No module named 'no'"),
])  # fmt: skip
def test_what_cannot_be_imported_is_one_error_before_the_run(launch, tmp_path, capsys, file, words):
    (tmp_path / "fails.py").write_text("1 / 0\n")
    name = tmp_path / file if file.endswith(".py") else file
    launch("closed-form.yaml", f"imports=[{name}]", status=2)
    error = capsys.readouterr().err
    assert "error: imports[0]: " in error and words in error and "Traceback" not in error
    assert ("fails.py:1" in error) == (file == "fails.py")
