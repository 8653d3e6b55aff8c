"""The coefficient figures: drawn where matplotlib is, and what is missing is named where it is not."""

from __future__ import annotations

import re
import sys

import pytest

from benchmarks import coefficient_figures


def test_without_matplotlib_the_remedy_is_an_extra_that_brings_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit, match=r'need matplotlib.*pip install "\.\[\w+\]"') as error:
        coefficient_figures.main(["--out", str(tmp_path / "figure.png")])
    name = re.search(r"\.\[(\w+)\]", str(error.value))[1]
    project = (coefficient_figures.ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert "matplotlib" in re.search(rf"^{name} = \[(.*?)\]", project, re.M | re.S)[1]
    assert "matplotlib" not in re.search(r"^dependencies = \[(.*?)^\]", project, re.M | re.S)[1]


def test_the_figure_is_drawn(tmp_path):
    pytest.importorskip("matplotlib", reason="the benchmarks extra is not installed")
    coefficient_figures.main(["--out", str(tmp_path / "figure.png")])
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
