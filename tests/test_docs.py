"""The documentation: its commands run as printed, its links lead somewhere, and the README stays a front door."""

from __future__ import annotations

import csv
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from dreamcatalyst import plugin
from dreamcatalyst.config import check, load_config

import launch
from benchmarks.tutorial import NEEDED, PICTURE, Block, blocks, run, script

ROOT = Path(__file__).resolve().parent.parent
FRONT = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = FRONT + sorted((ROOT / "docs").glob("*.md"))
HOSTS = {"configs/dreamfusion-sd.yaml", "configs/instructnerf2nerf.yaml"}  # threestudio's own
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
SHORT = 4  # steps of a run


def text(path: str | Path) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text(page), flags=re.M | re.S), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_readme_has_at_most_900_words():
    """Everything counts: tables, commands and the bibliography too."""
    assert len(text("README.md").split()) <= 900


def test_the_readme_marks_the_two_commands_that_others_run():
    marked = {block.note: block.text for block in blocks(text("README.md")) if block.note}
    assert "launch.py --config configs/dc-ge.yaml" in marked["run"] and "-m pytest" in marked["test"]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page):
    """Pages of the API are made with the site (docs/hooks.py), and are checked there."""
    for link in LINK.findall(text(page)):
        if link.startswith("http") or link.startswith("api/"):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_in_the_navigation():
    def pages(entry) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        return [page for part in (entry.values() if isinstance(entry, dict) else entry) for page in pages(part)]

    listed = pages(yaml.safe_load(text("mkdocs.yml"))["nav"])
    assert len(set(listed)) == len(listed)
    written = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert {page for page in listed if not page.startswith("api/")} == written


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_configs_and_files_that_pages_name_exist(page):
    named = set(re.findall(r"\b((?:configs|benchmarks)/[\w/-]+\.(?:yaml|py))", text(page))) - HOSTS
    assert not [name for name in named if not (ROOT / name).is_file()]


def test_commands_that_need_something_say_so():
    """A block that names a config which needs a GPU or a download is marked, and so never run by the tests."""
    needs = {entry["path"]: set(entry["needs"]) for entry in yaml.safe_load(text("extension.yaml"))["configs"]}
    for page in PAGES:
        for block in blocks(text(page)):
            heavy = {name for name, need in needs.items() if need & {"download", "gpu", "host"} and name in block.text}
            assert not heavy or block.note.startswith("needs:"), (page.name, heavy)


def test_a_page_becomes_a_script():
    heavy, light = "false\n", "python launch.py --config a.yaml \\\n    b=1  # why\nls\n"
    page = f"<!-- needs: gpu -->\n```bash\n{heavy}```\n\n```bash\n{light}```\n"
    assert blocks(page) == [Block("needs: gpu", heavy), Block("", light)]
    assert script(page).split() == ["set", "-euo", "pipefail", *light.replace("\\\n", "").split()]
    short = " ".join(script(page, 3).splitlines()[1].split())
    assert (
        short
        == "python launch.py --config a.yaml b=1 trainer.max_steps=3 system.report.video_frames=0 data.max_side=64"
    )


def launches() -> list[tuple[str, list[str]]]:
    """(page, arguments) of each call of the launcher on one of our configs, those that no test can run too. The page on
    extending names parts of its own; it is run as a whole."""
    found = []
    for page in [page for page in PAGES if page.name != "extend.md"]:
        for block in blocks(text(page)):
            for line in block.text.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if "--config" in words and (ROOT / words[words.index("--config") + 1]).is_file():
                    found.append((page.name, words[words.index("--config") + 1 :]))
    return found


@pytest.mark.parametrize(("page", "words"), launches(), ids=lambda value: value if isinstance(value, str) else value[0])
def test_commands_name_registered_parts_and_valid_keys(page, words):
    """All but the checkpoint, which an earlier command makes."""
    given = [word for word in words[1:] if not word.startswith(("--", "resume="))]
    config = load_config(ROOT / words[0], cli_args=given)
    for key in ("data", "system"):
        check(plugin.find(getattr(config, f"{key}_type")), getattr(config, key), key)


@pytest.fixture
def newcomer(tmp_path, monkeypatch):
    """A folder with what the launcher needs and nothing else, and a function that runs a page's commands there, each
    run shortened to eight steps. (A fresh clone of what is committed is .ci/run's.)"""
    for name in NEEDED:
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)

    def run(page: str) -> Path:
        for line in script(page, SHORT).splitlines()[1:]:
            python, launcher, *words = shlex.split(line)
            assert (python, launcher) == ("python", "launch.py") and launch.main(words) == 0, line
        return tmp_path / "outputs"

    return run


@pytest.mark.slow
def test_the_readmes_commands_run(newcomer):
    """All that need no GPU, download or capture. Installing, and the tests themselves, are left to .ci/run, which does
    both as printed."""
    page = re.sub(r"python3 -m venv .*? && \.venv/bin/(?=python launch.py)", "", text("README.md"))
    page = re.sub(r"<!-- test -->\n```bash.*?```\n", "", page, flags=re.DOTALL)
    assert page.count("\npython launch.py") >= 5
    outputs = newcomer(page)
    assert (outputs / "fit/statue/save/last.ply").is_file()
    assert len(list(outputs.glob("closed-form/*/save/last.ply"))) == 1
    assert len(list(outputs.glob("dc-ge/*/report/index.html"))) == 1


@pytest.mark.slow
def test_the_tutorials_commands_run_and_lead_to_its_pictures(newcomer):
    page = text("docs/tutorial.md")
    outputs, pictures = newcomer(page), list(PICTURE.finditer(page))
    assert len(pictures) == page.count("](tutorial/") >= 6
    for match in pictures:
        assert list(outputs.parent.glob(re.sub(r"it\d+", "it*", match["source"]))), match["source"]
        assert (ROOT / "docs" / match["target"]).is_file()


@pytest.mark.slow
def test_the_newcomers_of_the_page_on_extending_do_what_it_says(newcomer, tmp_path):
    """A column of the metric, splats that the mask let the density control remove, and the rule in the plan. In a
    process of its own, since what is registered stays."""
    page = text("docs/extend.md")
    for name, code in re.findall(r"^```python\n(?=# (\w+\.py):)(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        (tmp_path / name).write_text(code, encoding="utf-8")
    done = run(page, tmp_path, SHORT + 1)  # its density control is due at the fourth
    assert done.returncode == 0, done.stdout
    assert "rule dds-pull" in done.stdout and "mask (above)" in done.stdout
    with (tmp_path / "outputs/closed-form/newcomers/report/error.csv").open(encoding="utf-8") as file:
        first, *_, last = list(csv.DictReader(file))
    assert float(last["mse_source"]) > 0 and int(last["splats"]) < int(first["splats"])


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("material")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    api = (tmp_path / "site/api/render.html").read_text(encoding="utf-8")
    assert "rasterize" in api and "means2d" in api
