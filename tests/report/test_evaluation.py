"""The list of edits, the table, and a small evaluation that is begun, interrupted and gone on with."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from dreamcatalyst.config import load_config
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.report.evaluation import METHODS, Pair, read_pairs, table, views_note
from dreamcatalyst.scene.ply import read_ply

import launch
from benchmarks import evaluate
from tests.diffusion.small_model import make_model
from tests.report.small_clip import make_clip, make_predictor
from tests.segment.small_models import make_clipseg

GIVEN = Path(__file__).resolve().parents[3] / "shared" / "data" / "prompt_pairs.yaml"
LIST = """
"demo:statue":
  source: a photo of a bear statue
  region: everything
  edits:
    a photo of a statue at sunset: Make it sunset
    a photo of a statue at night: Make it night
"""


def test_the_paper_evaluates_forty_pairs_of_eight_scenes():
    count = Counter(pair.scene for pair in read_pairs())
    assert count == dict(face=7, bear=6, person=9, plant=3, bamboo=1, campsite=2, farm=1, yuseung=11)
    assert len({pair.name for pair in read_pairs()}) == 40


@pytest.mark.skipif(not GIVEN.is_file(), reason="the table of prompts is not at hand")
def test_the_pairs_are_word_for_word_those_of_the_paper():
    assert [replace(pair, region="") for pair in read_pairs()] == [
        Pair(**row, region="") for row in yaml.safe_load(GIVEN.read_text())
    ]


def test_all_edits_of_a_scene_have_one_region_in_words():
    regions = {}
    for pair in read_pairs():
        assert regions.setdefault(pair.scene, pair.region) == pair.region
    assert {scene for scene, region in regions.items() if region == "everything"} == {"campsite", "farm"}


def test_the_methods_are_the_rows_of_the_paper_s_table_on_3dgs_but_dge():
    rows = [method.row for method in METHODS if method.row]
    assert rows == [
        "PDS",
        "DreamCatalyst",
        "GaussianEditor, DDS",
        "GaussianEditor, IN2N",
        "GaussianEditor, DreamCatalyst",
        "GaussianEditor, DreamCatalyst fast",
    ]
    assert len({method.name for method in METHODS}) == len(METHODS)
    assert {"ge-in2n", "ge-dds", "ge-pds"} <= {method.name for method in METHODS}


def test_the_table_says_how_it_is_to_be_read_and_holds_no_paper_s_figures():
    one, other = read_pairs()[:2]
    found = {one: {"clip_direction": 0.1, "minutes": 2.0}, other: {"clip_direction": -0.3}}
    told = table({"ours": found, "dc-splat": found}, ["dc-splat"])
    assert "| ours | - | 2 | the list's | -0.100 | - | - | 2.0 |" in told  # the mean keeps its sign
    assert "| dc-splat | DreamCatalyst | 2 | none | -0.100" in told
    assert "Compare rows of this table with each other alone" in told and "different pairs" not in told
    rows = [line for line in told.splitlines() if line.startswith("| ")]
    assert len(rows) == 3  # the header and the two: nobody else's
    assert "different pairs" in table({"ours": found, "theirs": {one: found[one]}})
    assert "codes train on the views that they score" in views_note(8) and "trained on" in views_note(0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- a\n- b", "expected scenes by name"),
        ("face: {edits: {a: b}}", "face: expected source"),
        ("face: {source: a, edits: [b]}", "face: expected source"),
        ("face: {source: a, region: a, edits: {b: 3}}", "expected text: text"),
        ("face: [", "not valid YAML"),
        ("face: {source: a, edits: {b: c}}", "face.region: got None"),
    ],
)
def test_a_list_that_is_none_is_refused(tmp_path, text, words):
    (tmp_path / "list.yaml").write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_pairs(tmp_path / "list.yaml")


def test_an_evaluation_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    (tmp_path / "pairs.yaml").write_text(LIST)
    clip, predictor = make_clip(tmp_path / "clip"), make_predictor(tmp_path / "linear.pth")
    arguments = ["--pairs", str(tmp_path / "pairs.yaml"), "--output", str(tmp_path / "out")]
    arguments += ["--config", str(evaluate.ROOT / "configs" / "closed-form.yaml"), f"system.report.clip={clip}"]
    arguments += [f"system.report.aesthetic={predictor}", "trainer.max_steps=1", "data.width=24", "data.height=24"]
    arguments += ["system.report.video_frames=0", "trainer.accelerator=cpu"]
    runs, whole, real = [], False, evaluate.subprocess.run

    def in_process(command, *others, **options):
        if "launch.py" not in command[1]:
            return real(command, *others, **options)
        runs.append(command)
        if whole or len(runs) == 1:
            launch.main(command[2:])
        return None

    monkeypatch.setattr(evaluate.subprocess, "run", in_process)
    assert evaluate.main(arguments) == 1  # the second pair is missing
    told = capsys.readouterr()
    assert (
        "| closed-form | - | 1 | none |" in told.out and "failed: closed-form, demo:statue: Make it night" in told.err
    )
    whole = True
    assert evaluate.main(arguments) == 0
    assert len(runs) == 3  # what was done is not done again
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| closed-form")]
    assert row.startswith("| closed-form | - | 2 | none |") and row.count(" - ") == 1
    assert row in (tmp_path / "out" / "table.md").read_text().splitlines()


@pytest.mark.usefixtures("one_thread")
def test_one_command_runs_all_rows_on_one_mask(tmp_path, capsys, monkeypatch):
    """Every method, on models that learned nothing: the mask is found once, and is the same for all that know one."""
    sunset = LIST.replace("everything", "statue").split("    a photo of a statue at night")[0]
    (tmp_path / "pairs.yaml").write_text(sunset)
    models = {"ip2p": make_model(tmp_path / "ip2p"), "sd": make_model(tmp_path / "sd", channels=4)}
    monkeypatch.setattr(evaluate, "FINDER", {"path": str(make_clipseg(tmp_path / "clipseg"))})
    out, real = tmp_path / "out", evaluate.subprocess.run

    def in_process(command, *others, **options):
        if "launch.py" not in command[1]:
            return real(command, *others, **options)
        config = yaml.safe_load(Path(command[command.index("--config") + 1]).read_text())
        path = models[config["system"]["guidance"]["prior_type"]]
        return launch.main([*command[2:], f"system.guidance.prior.path={path}"])

    monkeypatch.setattr(evaluate.subprocess, "run", in_process)
    # A network that learned nothing finds all of the picture or nothing.
    mask = ["system.mask.options.threshold=0.001", "system.mask.threshold=0.1", "system.mask.views=1"]
    small = ["trainer.max_steps=1", "data.width=24", "data.height=24", "trainer.accelerator=cpu"]
    small += ["system.report.video_frames=0", "system.report.views=1", "system.guidance.prior.dtype=fp32"]
    assert evaluate.main(["--pairs", str(tmp_path / "pairs.yaml"), "--output", str(out), *mask, *small]) == 0
    told = capsys.readouterr().out
    for method in METHODS:
        (row,) = [line for line in told.splitlines() if line.startswith(f"| {method.name} |")]
        assert f"| {method.row or '-'} | 1 |" in row
    assert "held out, every 8th" in told and "Compare rows of this table" in told
    assert len(list((out / "masks").glob("*.pt"))) == 1
    weights = []
    for method in METHODS:
        (ply,) = (out / method.name).glob("*/save/last.ply")
        weights += [read_ply(ply).extra.get("mask")]
    known = [each for each in weights if each is not None]
    assert len(known) == 7 and all(torch.equal(known[0], other) for other in known)


def test_scenes_that_are_not_there_are_said(tmp_path, capsys):
    assert evaluate.main(["--scenes", str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "left out" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["ge-in2n", "dc-ge-ip2p", "dc-ge-published", "dc-splat"])
def test_an_edit_of_everything_has_no_mask_whatever_the_config_says(tmp_path, name):
    config = evaluate.ROOT / f"configs/{name}.yaml"
    made = evaluate.on_one_mask(config, "everything", tmp_path)
    words = ["data.source=x", "system.gs_source=x", "system.prompt_processor.prompt=x"]
    assert load_config(made, cli_args=words).system["mask"]["kind"] == "none"
    more = ["system.mask.options.path=x", "trainer.max_steps=3"]
    pair = Pair("farm", "a", "b", "c")
    assert evaluate.options_of(pair, config, more) == more[1:]
    there = evaluate.options_of(replace(pair, region="barn"), config, more)
    assert there == (more[1:] if name == "dc-splat" else more)


def test_scenes_are_fitted_as_finely_as_an_edit_at_512_needs(tmp_path, monkeypatch):
    (tmp_path / "bear").mkdir()
    given = {}
    monkeypatch.setattr(evaluate, "launch", lambda trial, config, options: given.update({config.name: options}))
    evaluate.main(["--scenes", str(tmp_path), "--output", str(tmp_path / "out"), "--fit", "trainer.max_steps=7000"])
    config = load_config(evaluate.ROOT / "configs/fit.yaml", cli_args=given["fit.yaml"])
    assert config.data["max_side"] == 1600 and config.data["test_every"] == 8
    assert config.trainer["max_steps"] == 7000 and config.system["densify"]["max_splats"] == 3_000_000
