"""The page of a run: one file, whole by itself, with everything that it should say."""

import base64
import math
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.report.chart import line_chart, picture_file, ticks
from dreamcatalyst.report.page import Page, Table, data_uri

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
    heights = [float(v) for v in re.findall(r'cy="([\d.]+)" r="2.6"', chart)]
    assert heights[0] > heights[1]  # larger is higher


def test_a_plot_is_a_file_of_its_own():
    chart = line_chart("PSNR", {"a": [(0, 1.0), (2, 0.5)], "b <": [(0, 1.0), (2, 3.5)]})
    text = picture_file([chart, "", chart])
    root = ElementTree.fromstring(text)  # well-formed
    assert root.tag == "{http://www.w3.org/2000/svg}svg" and len(root.findall("{*}svg")) == 2
    assert "url(" not in text and "href" not in text


def test_a_band_lies_behind_its_line_and_within_the_plot():
    low, up = [(0, 1.0), (2, 0.5)], [(0, 1.0), (2, 9.5)]
    chart = line_chart("PSNR", {"a": [(0, 1.0), (2, 3.5)], "b": [(0, 1.0), (2, 3.0)]}, bands={"b": (low, up)})
    assert chart.index("<polygon") < chart.index("<polyline") and chart.count('<g class="c1"><polygon') == 1
    corners = [tuple(map(float, pair.split(","))) for pair in re.search(r'polygon points="([^"]*)"', chart)[1].split()]
    assert corners[0] == corners[3] and corners[2][1] < corners[1][1] and min(v for _, v in corners) > 0
