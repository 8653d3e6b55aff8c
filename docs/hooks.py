"""What mkdocs.yml cannot say: pages of the API, formulas as MathML, and that no page loads what is elsewhere."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).resolve().parents[1] / "custom" / "dreamcatalyst"
FOLDERS = {
    "data": "Captures: cameras, photographs, formats.",
    "scene": "Splats: their parameters, PLY files, surgery.",
    "render": "`rasterize`, and what draws it.",
    "demo": "Made worlds, and edits of them.",
    "diffusion": "Priors: diffusion models, and the closed form.",
    "guidance": "Rules, timesteps, distillation.",
    "segment": "Masks.",
    "host": "Rules inside threestudio's own systems.",
    "loss": "Image losses and anchors.",
    "report": "Metrics, tables, pictures, the page of a run.",
    "train": "Methods and systems: what a run does.",
}
RUNS = "Configs, registries, files, errors."
INTRODUCTION = "From the docstrings. A file imports only from its own folder and those above it in the list."
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
ELSEWHERE = re.compile(r'<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)="(?:https?:)?//[^"]*"')


def on_files(files: Files, config: Any) -> Files:
    """Add one page for each folder of the package, and one for the files beside them: they follow the code."""
    top = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")
    pages = {name: f"# {name}\n\n{text}\n\n::: dreamcatalyst.{name}\n" for name, text in FOLDERS.items()}
    pages["runs"] = f"# runs\n\n{RUNS}\n\n" + "\n".join(f"::: dreamcatalyst.{name}\n" for name in top)
    listed = {**FOLDERS, "runs": RUNS}
    pages["index"] = "\n".join(
        ["# API reference", "", INTRODUCTION, "", "| folder | what it holds |", "|---|---|"]
        + [f"| [{name}]({name}.md) | {text} |" for name, text in listed.items()]
    )
    for name, content in pages.items():
        files.append(File.generated(config, f"api/{name}.md", content=content))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Write formulas in MathML."""

    def mathml(match: re.Match) -> str:
        return convert(html.unescape(match[2]).strip(), display="block" if match[1] == "div" else "inline")

    return FORMULA.sub(mathml, content)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Raise PluginError where a page would load something from elsewhere."""
    if found := ELSEWHERE.search(output):
        raise PluginError(f"{page.file.src_path}: loads something from elsewhere: {found[0]}")
    return output
