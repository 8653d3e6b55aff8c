"""Rules of the house that no single file shows: who may import whom, and that the manifest tells the truth."""

from __future__ import annotations

import ast
import dataclasses
import re
import typing
from pathlib import Path

import pytest
import yaml
from dreamcatalyst import OFFERS, plugin
from dreamcatalyst.config import ExperimentConfig, Range, check, load_config, missing_keys, read_yaml
from dreamcatalyst.diffusion.api import PRIORS
from dreamcatalyst.inpaint.api import INPAINTERS
from dreamcatalyst.segment.api import SEGMENTERS
from omegaconf import OmegaConf

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "custom" / "dreamcatalyst"
TREES = {
    path.relative_to(PACKAGE).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(PACKAGE.rglob("*.py"))
}
CONFIGS = sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "configs").rglob("*.yaml"))
HOSTED = [path for path in CONFIGS if path.startswith("configs/swap/")]  # for the host's systems: checked by running

# The way the data goes: a file imports only from its own place and from what stands to the left of it.
ORDER = ["config", "data", "scene", "render", "demo", "diffusion", "inpaint"]
ORDER += ["guidance", "segment", "loss", "report", "train"]
FOR_ALL = {"cache", "errors", "kept", "memory", "meter", "files", "registry", "plugin"}
RUNS = {"resume", "signals"}  # what is about whole runs, and so for the folder that assembles them
OUTSIDE = {  # files of the top level that stand outside the order, and what each may import
    "__init__": {"plugin"},
    "cache": set(),
    "kept": {"errors"},
    "memory": set(),
    "meter": set(),
    "errors": set(),
    "files": {"errors"},
    "registry": {"errors"},
    "plugin": set(),
    "standalone": {"config", "errors", "files"},
    "runs": {"config", "errors", "files", "kept"},
    "resume": {"config", "errors", "files", "plugin"},
    "signals": set(),
    "trainer": {"config", "errors", "plugin"},
    "link": {"errors"},
    "imports": {"errors"},
    "host": {"config", "diffusion", "errors", "guidance", "plugin"},
}
HOST = {"threestudio", "lightning", "pytorch_lightning"}
HEAVY = {"pycolmap", "diffusers", "transformers", "gsplat", "trimesh", "imageio", "matplotlib"}


def imported(nodes) -> tuple[set[str], list[tuple[int, str]]]:
    """Top-level packages that are imported absolutely, and (dots, module) of the relative imports."""
    absolute, relative = set(), []
    for node in nodes:
        if isinstance(node, ast.Import):
            absolute |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            absolute.add(node.module.split(".")[0])
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module] if node.module else [alias.name for alias in node.names]
            relative += [(node.level, module) for module in modules]
    return absolute, relative


def test_imports_inside_the_package_are_relative():
    assert not [file for file, tree in TREES.items() if imported(ast.walk(tree))[0] & {"dreamcatalyst", "custom"}]


def test_imports_go_the_way_of_the_data():
    wrong = {}
    for file, tree in TREES.items():
        place, depth = file.split("/")[0].removesuffix(".py"), file.count("/") + 1
        # `depth` dots lead out of the file's own folder up to the package; what follows is a name of the top level.
        used = {module.split(".")[0] for dots, module in imported(ast.walk(tree))[1] if dots == depth} - {place}
        allowed = OUTSIDE[place] if place in OUTSIDE else FOR_ALL.union(ORDER[: ORDER.index(place)])
        allowed = allowed | RUNS if place == "train" else allowed
        if used - allowed:
            wrong[file] = used - allowed
    assert not wrong


def modules_used(file: str) -> set[str]:
    """The files of the package that a file imports, wherever in it."""
    used = set()
    for node in ast.walk(TREES[file]):
        if isinstance(node, ast.ImportFrom) and node.level:
            folder = (PACKAGE / file).parents[node.level - 1] / (node.module or "").replace(".", "/")
            paths = [folder.with_suffix(".py"), *(folder / f"{alias.name}.py" for alias in node.names)]
            used |= {path.relative_to(PACKAGE).as_posix() for path in paths if path.is_file()}
    return used - {file}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """A way from a node back to itself; empty where there is none."""
    done: set[str] = set()

    def walk(node: str, way: list[str]) -> list[str]:
        if node in way:
            return way[way.index(node) :]
        if node in done:
            return []
        found = next((c for c in (walk(other, [*way, node]) for other in sorted(graph[node])) if c), [])
        done.add(node)
        return found

    return next((c for c in (walk(node, []) for node in graph) if c), [])


def test_no_file_imports_itself_by_a_detour():
    """Nor do files of one folder, and imports inside functions count: they would only hide it."""
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
    graph = {file: modules_used(file) for file in TREES}
    assert "train/method.py" in graph["train/sourced.py"] and "files.py" in graph["scene/ply.py"]
    assert circle(graph) == []


def test_only_the_seam_knows_host_and_lightning():
    assert [file for file, tree in TREES.items() if imported(ast.walk(tree))[0] & HOST] == ["standalone.py"]


def test_heavy_packages_are_imported_where_they_are_used():
    for file, tree in TREES.items():
        at_once, _ = imported(node for node in ast.walk(tree) if getattr(node, "col_offset", 0) == 0)
        assert not at_once & HEAVY, file
        assert "numba" not in at_once or file.startswith("render/cpu"), file


def test_devices_are_named_in_one_place():
    assert {f for f in TREES if "cuda" in (PACKAGE / f).read_text(encoding="utf-8")} <= {"render/gsplat.py"}


def test_errors_are_neither_swallowed_nor_asserted():
    for file, tree in TREES.items():
        for node in ast.walk(tree):
            assert not isinstance(node, ast.Assert), f"{file}:{node.lineno}: assert"
            if isinstance(node, ast.ExceptHandler):
                assert node.type is not None, f"{file}:{node.lineno}: bare except"
                assert not all(isinstance(line, ast.Pass) for line in node.body), f"{file}:{node.lineno}: swallowed"


# --- extension.yaml


@pytest.fixture(scope="module")
def manifest():
    return yaml.safe_load((ROOT / "extension.yaml").read_text())


def test_the_manifest_lists_what_is_registered(manifest):
    listed = {name: kind for kind, names in manifest["registers"].items() for name in names}
    assert set(listed) == set(OFFERS)
    bases = {"data": plugin.pl.LightningDataModule, "system": plugin.BaseSystem, "guidance": plugin.BaseObject}
    for name, kind in listed.items():
        assert issubclass(plugin.find(name), bases[kind]), name


def test_the_manifest_agrees_with_the_package(manifest):
    assert (ROOT / manifest["entry"]).samefile(PACKAGE)
    project = (ROOT / "pyproject.toml").read_text()
    assert re.search(r'^version = "(.*)"$', project, re.MULTILINE)[1] == manifest["version"]
    assert manifest["host"]["threestudio"] == ">=" + ".".join(map(str, plugin.OLDEST_HOST))


def test_the_manifest_lists_the_configs(manifest):
    assert sorted(entry["path"] for entry in manifest["configs"]) == CONFIGS
    assert all(set(entry["needs"]) <= {"capture", "download", "gpu", "host"} for entry in manifest["configs"])


@pytest.mark.parametrize("path", [path for path in CONFIGS if path not in HOSTED])
def test_every_config_names_registered_parts_and_valid_keys(path):
    left_open = missing_keys(OmegaConf.to_container(read_yaml(ROOT / path)))
    config = load_config(ROOT / path, cli_args=[f"{key}=given" for key in left_open])
    for key in ("data", "system"):
        name = getattr(config, f"{key}_type")
        assert name in OFFERS
        check(plugin.find(name), getattr(config, key), key)


# --- ranges


def parsed_classes() -> dict[str, type]:
    """Every dataclass that is filled from a YAML, by the name of the part whose options it holds."""
    found: dict[str, type] = {"experiment": ExperimentConfig}

    def add(name: str, cls: type) -> None:
        if not dataclasses.is_dataclass(cls):
            for part, below in getattr(cls, "parts", {}).items():
                add(f"{name}.{part}", below)
            cls = getattr(cls, "Config", None)
        if cls is not None:
            found[name] = cls
            for key, hint in typing.get_type_hints(cls).items():
                if dataclasses.is_dataclass(hint):
                    add(f"{name}.{key}", hint)

    for registry in (PRIORS, SEGMENTERS, INPAINTERS):
        for name in registry.names():
            add(name, registry.get(name))
    for name in OFFERS:
        add(name, plugin.find(name))
    return found


def loose_numbers(hint) -> bool:
    """Whether a type holds an int or a float that has no range."""
    if hasattr(hint, "__metadata__"):
        return not any(isinstance(note, Range) for note in hint.__metadata__)
    return hint in (int, float) or any(loose_numbers(inner) for inner in typing.get_args(hint))


def test_a_type_without_a_range_is_found_wherever_it_stands():
    whole = typing.Annotated[int, Range("[0, 9]")]
    assert loose_numbers(int) and loose_numbers(float | None) and loose_numbers(tuple[whole, float])
    assert loose_numbers(typing.Annotated[float, "schedule"])
    assert not (loose_numbers(bool) or loose_numbers(str | None) or loose_numbers(dict[str, whole] | None))


def test_every_number_of_every_config_has_a_range():
    classes, host = parsed_classes(), {f.name for f in dataclasses.fields(plugin.BaseSystem.Config)}
    assert {"dreamcatalyst-edit-system.densify", "dreamcatalyst-prior-system.unet", "ip2p.freeu", "box"} <= set(classes)
    loose = [
        f"{name}.{key}"
        for name, cls in classes.items()
        for key, hint in typing.get_type_hints(cls, include_extras=True).items()
        if key not in host and loose_numbers(hint)
    ]
    assert not loose
