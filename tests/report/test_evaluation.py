"""The list of edits, the table, and a small evaluation that is begun, interrupted and gone on with."""

from collections import Counter
from pathlib import Path

import pytest
import yaml
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.report.evaluation import PAPER, Pair, read_pairs, table

import launch
from benchmarks import evaluate
from tests.report.small_clip import make_clip, make_predictor

GIVEN = Path(__file__).resolve().parents[3] / "shared" / "data" / "prompt_pairs.yaml"
LIST = """
"demo:statue":
  source: a photo of a bear statue
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
    assert read_pairs() == [Pair(**row) for row in yaml.safe_load(GIVEN.read_text())]


def test_dreamcatalyst_leads_the_paper_s_tables():
    nerf, splats = PAPER["NeRF"], PAPER["3DGS"]
    assert max(nerf, key=lambda name: nerf[name][0]) == "DreamCatalyst"
    assert nerf["PDS"][3] / nerf["DreamCatalyst, fast"][3] == pytest.approx(23, abs=0.3)  # as the abstract says
    assert max(splats, key=lambda name: splats[name][2]) == "GaussianEditor, DreamCatalyst"


def test_figures_of_the_paper_stand_beside_its_own_pairs_alone():
    one, other = read_pairs()[:2]
    found = {one: {"clip_direction": 0.1, "minutes": 2.0}, other: {"clip_direction": -0.3}}
    told = table({"ours": found})
    assert "| ours | 2 | -0.100 | - | - | 2.0 |" in told  # the mean keeps its sign
    assert "DreamCatalyst (NeRF, as the paper reports it) | 40 | 0.180 | 0.746 | 5.688 | 70.0" in told
    stranger = Pair("kitchen", "a photo of a kitchen", "a photo of a kitchen at night", "Make it night")
    assert "paper" not in table({"ours": {**found, stranger: {"clip_direction": 0.1}}})
    assert "paper" not in table({})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- a\n- b", "expected scenes by name"),
        ("face: {edits: {a: b}}", "face: expected source"),
        ("face: {source: a, edits: [b]}", "face: expected source"),
        ("face: {source: a, edits: {b: 3}}", "expected text: text"),
        ("face: [", "not valid YAML"),
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
    assert "| closed-form | 1 |" in told.out and "failed: closed-form, demo:statue: Make it night" in told.err
    whole = True
    assert evaluate.main(arguments) == 0
    assert len(runs) == 3  # what was done is not done again
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| closed-form")]
    assert row.startswith("| closed-form | 2 |") and " - " not in row
    assert (tmp_path / "out" / "table.md").read_text().splitlines()[-1] == row


def test_scenes_that_are_not_there_are_said(tmp_path, capsys):
    assert evaluate.main(["--scenes", str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "left out" in capsys.readouterr().err
