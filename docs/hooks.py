"""What mkdocs.yml cannot say: pages of the API, formulas as MathML, and that no page loads what is elsewhere."""

from __future__ import annotations

import ast
import html
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).resolve().parents[1] / "custom" / "dreamcatalyst"
ORDER = ["data", "scene", "render", "demo", "diffusion", "inpaint", "guidance", "segment", "loss", "report"]
ORDER += ["train", "host"]
RUNS = "Configs, registries, files, errors."
INTRODUCTION = "From the docstrings. A file imports only from its own folder and those above it in the list."
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
ELSEWHERE = re.compile(r'<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)="(?:https?:)?//[^"]*"')


def folders() -> dict[str, str]:
    """The package's folders, in the order in which data goes, and what each says of itself."""
    found = {path.parent.name: ast.get_docstring(ast.parse(path.read_text())) for path in PACKAGE.glob("*/__init__.py")}
    return {name: found[name] or "" for name in sorted(found, key=lambda name: (*ORDER, name).index(name))}


def page(title: str, text: str, files: Iterable[Path]) -> str:
    """A page of the API: the docstrings of some of the package's files."""
    modules = [path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".") for path in sorted(files)]
    parts = [f"::: {name}" for name in modules if not name.endswith("__init__")]
    return "\n\n".join([f"# {title}", text, *parts]) + "\n"


def on_config(config: Any) -> Any:
    """List the pages of the API in the navigation."""
    config.nav.append({"API": [f"api/{name}.md" for name in ("index", *folders(), "runs")]})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add a page for each folder of the package, and one for the files beside them: they follow the code."""
    listed = folders()
    pages = {name: page(name, text, (PACKAGE / name).rglob("*.py")) for name, text in listed.items()}
    pages["runs"] = page("runs", RUNS, PACKAGE.glob("*.py"))
    rows = [f"| [{name}]({name}.md) | {text} |" for name, text in (*listed.items(), ("runs", RUNS))]
    head = ["# API reference", "", INTRODUCTION, "", "| folder | what it holds |", "|---|---|"]
    pages["index"] = "\n".join(head + rows)
    for name, content in pages.items():
        files.append(File.generated(config, f"api/{name}.md", content=content))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Write formulas in MathML."""

    def mathml(match: re.Match) -> str:
        return convert(html.unescape(match[2]).strip(), display="block" if match[1] == "div" else "inline")

    return FORMULA.sub(mathml, content)


def on_post_page(output: str, **given: Any) -> str:
    """Raise PluginError where a page would load something from elsewhere."""
    if found := ELSEWHERE.search(output):
        raise PluginError(f"{given['page'].file.src_path}: loads something from elsewhere: {found[0]}")
    return output
