"""The page of a run: one file, whole by itself, with everything that it should say."""

import base64
import csv
import json
import math
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.report.chart import line_chart, ticks
from dreamcatalyst.report.clock import STAGES
from dreamcatalyst.report.page import Page, Table, data_uri

pytest_plugins = ["tests.train.conftest"]
VOID = {"meta", "img", "input"}


class Balanced(HTMLParser):
    """Raises where tags do not close in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links = [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.links += [value for key, value in attributes if key in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_a_page_is_whole_by_itself_and_says_what_it_is_given():
    picture = torch.rand(8, 12, 3, generator=torch.Generator().manual_seed(0))
    page = Page(
        "Make it <b>bold</b>",
        "a & b",
        tiles={"PSNR": "31.2"},
        pictures=[[("before", picture), ("after", picture)]],
        charts=[line_chart("loss", {"loss": [(0, 1.0), (2, 0.5)]}), ""],
        stages={"render": 3.0, "unet": 1.0, "idle": 0.0},
        tables={"Scores": Table(["view", "psnr"], [["0001", "30"], ["mean", "30"]])},
        texts={"Config": "a: <1>"},
    )
    text = page.html()
    links = Balanced(text).links
    assert links and all(link.startswith("data:image/jpeg;base64,") for link in links)
    assert "http" not in text and "<b>bold" not in text and "&lt;1&gt;" in text and "a &amp; b" in text
    assert "render 3.0 s, 75.0 %" in text and "idle" not in text and "class=mean" in text


def test_pictures_travel_inside_of_the_page():
    picture = torch.zeros(16, 16, 3)
    picture[..., 0] = 1.0
    encoded = base64.b64decode(data_uri(picture).split(",")[1])
    read = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(read.astype(int) - [255, 0, 0]).max() < 8


@pytest.mark.parametrize(("low", "high"), [(0, 1), (13.2, 47.9), (-3e-7, 2e-6), (5, 5), (0, 1234.5)])
def test_ticks_are_round_and_cover(low, high):
    found = ticks(low, high)
    assert found[0] <= low + 1e-12 and found[-1] >= high - 1e-9 * max(abs(high), 1) and 2 <= len(found) <= 9
    step = found[1] - found[0]
    assert round(step / 10 ** math.floor(math.log10(step) + 1e-9), 6) in (1, 2, 5, 10)


def test_a_chart_leaves_out_what_it_cannot_draw():
    assert line_chart("x", {"one": [(0, 1.0)]}) == "" == line_chart("x", {"none": [(0, math.inf), (1, math.nan)]})
    chart = line_chart("x", {"a": [(0, math.inf), (1, 1.0), (2, 10.0)], "b": [(0, 0.0), (1, 0.0)]}, log=True)
    assert chart.count("<circle") == 2 and "1e0" in chart and "1e1" in chart and ">b<" not in chart
    heights = [float(v) for v in re.findall(r'cy="([\d.]+)"', chart)]
    assert heights[0] > heights[1]  # larger is higher


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
    from tests.report.small_clip import make_clip, make_predictor

    words = ["system.report.clip_source=a photo of a bear", "system.report.clip_target=a photo of a bear at sunset"]
    given = [f"system.report.clip={make_clip(tmp_path / 'clip')}", *words]
    given.append(f"system.report.aesthetic={make_predictor(tmp_path / 'linear.pth')}")
    trial = launch("closed-form.yaml", "trainer.max_steps=2", *given)
    mean = json.loads((trial / "report" / "summary.json").read_text())["mean"]
    assert {"clip_direction", "clip_similarity", "aesthetic", "aesthetic_source"} <= set(mean)
    assert -1 <= mean["clip_direction"] <= 1 and mean["clip_similarity"] > 0.5


def test_options_that_need_each_other(launch, capsys):
    launch("closed-form.yaml", "system.report.aesthetic=somewhere.pth", status=2)
    assert "aesthetic: is for a CLIP" in capsys.readouterr().err
    launch("closed-form.yaml", "system.report.clip=./nowhere", "trainer.max_steps=1", status=2)
    assert "no such folder" in capsys.readouterr().err
