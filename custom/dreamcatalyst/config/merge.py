"""YAML files and `key=value` arguments, merged; nothing is resolved.

A file may be an overlay: its key `base` names the YAML that it is laid over, relative to it.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import GrammarParseError, OmegaConfBaseException

from ..errors import ConfigError, nearest, unknown
from .experiment import ExperimentConfig
from .schedules import largest, shown

GONE = {  # configs that restated another one: file to what says the same
    f"dreamcatalyst-{psi}.yaml": f"configs/rules/dreamcatalyst.yaml system.guidance.rule=dreamcatalyst-{psi}"
    for psi in ("psi2", "psi3")
}


def merge_config(*yamls: str | Path, cli_args: Sequence[str] = (), **overrides: Any) -> DictConfig:
    """YAML files merged from left to right, then `key.sub=value` arguments, then `overrides`; nothing is resolved, so
    that what follows from another key still does. Raises ConfigError, also for a value that is left to the user."""
    merged = merge_open(*yamls, cli_args=cli_args, **overrides)
    for key in missing_keys(OmegaConf.to_container(merged)):
        raise ConfigError(f"{key}: a value is needed, and none is given. Add {key}=... to the command.")
    return merged


def merge_open(*yamls: str | Path, cli_args: Sequence[str] = (), **overrides: Any) -> DictConfig:
    """`merge_config`, in which values may still be left to the user."""
    _register_resolvers()
    parts = [*(read_yaml(Path(path)) for path in yamls), _dotlist(cli_args), OmegaConf.create(overrides)]
    return functools.reduce(_merged, parts)


def _merged(below: DictConfig, above: DictConfig) -> DictConfig:
    first, second = OmegaConf.to_container(below), OmegaConf.to_container(above)
    _require_keys(first, second)
    for key in _left_behind(first, second):
        below = copy.deepcopy(below)
        OmegaConf.update(below, key, {}, merge=False)
    return cast(DictConfig, OmegaConf.merge(below, above))


def _left_behind(below: Any, above: Any, where: str = "") -> Iterator[str]:
    """The dotted keys of `options` that belong to another `kind` than the one that is laid over it."""
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return
    if {"kind", "options"} <= below.keys() and above.get("kind", below["kind"]) != below["kind"]:
        yield f"{where}options"
    for key in below.keys() & above.keys():
        yield from _left_behind(below[key], above[key], f"{where}{key}.")


def _require_keys(below: Any, above: Any, where: str = "") -> None:
    """Raise ConfigError where a section, or a list, is to be replaced by the other: OmegaConf merges neither."""
    if isinstance(below, dict) and isinstance(above, dict):
        for key in below.keys() & above.keys():
            _require_keys(below[key], above[key], f"{where}.{key}" if where else str(key))
    elif isinstance(below, dict) and isinstance(above, list):
        raise ConfigError(f"{where}: got {shown(above)}, expected keys of their own: {', '.join(map(str, below))}.")
    elif isinstance(below, list) and isinstance(above, dict):
        raise ConfigError(f"{where}: got {shown(above)}, expected a list such as {shown(below)}.")


def leaves(node: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """The dotted key and the value of all that is no dict in nested dicts."""
    if not isinstance(node, dict):
        yield where, node
        return
    for key, below in node.items():
        yield from leaves(below, f"{where}.{key}" if where else str(key))


def missing_keys(node: Any) -> list[str]:
    """The dotted keys of those values that a YAML leaves to its user (`???`); node: nested dicts, unresolved."""
    return [key for key, value in leaves(node) if isinstance(value, str) and value == "???"]


def read_yaml(path: Path, overlays: tuple[Path, ...] = ()) -> DictConfig:
    """A YAML file, laid over the one that its key `base` names, relative to it, and so on. overlays: the files that led
    here. Raises ConfigError for a file that is not there or no YAML, an unknown key, and a base that leads back."""
    above = _read(path, f"{overlays[-1]}: base" if overlays else "--config")
    base = above.pop("base", None)
    if base is None:
        return above
    file, chain = path.parent / str(base), (*overlays, path)
    if file.resolve() in [each.resolve() for each in chain]:
        raise ConfigError(f"{path}: base: leads back to a file that is laid over it: {' over '.join(map(str, chain))}.")
    below = read_yaml(file, chain)
    merged = _merged(below, above)
    for key in missing_keys(OmegaConf.to_container(above)):
        OmegaConf.update(merged, key, "???")  # what is left to the user is a value of the overlay, too
    return merged


def _read(path: Path, where: str) -> DictConfig:
    if not path.is_file() and path.name in GONE:
        raise ConfigError(f"{where}: '{path}' is gone: use {GONE[path.name]}.")
    if not path.is_file():
        folder = path.parent if path.parent.is_dir() else Path("configs")
        there = [str(p) for p in sorted(folder.glob("*.yaml"))]
        known = f" Known: {', '.join(there)}." if there else ""
        raise ConfigError(f"{where}: there is no file '{path}'.{nearest(str(path), there)}{known}")
    try:
        content = yaml.compose(path.read_text(encoding="utf-8"))
        loaded = cast(DictConfig, OmegaConf.load(path)) if isinstance(content, yaml.MappingNode) else None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise ConfigError(f"{place}: not valid YAML: {error.problem}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {error}.") from error
    if loaded is None:
        faults = {type(None): "is empty", yaml.SequenceNode: "got a list", yaml.ScalarNode: "got a single value"}
        raise ConfigError(
            f"{path}: {faults[type(content)]}, expected keys such as data_type, data, system_type, system."
        )
    known = ["base", *(spec.name for spec in dataclasses.fields(ExperimentConfig))]
    for key in loaded:
        if key not in known:
            raise ConfigError(unknown("key", key, known, str(path)))
    return loaded


def _is_words(text: str) -> bool:
    """Whether there are blanks outside of all ${...}."""
    before = None
    while before != text:
        before, text = text, re.sub(r"\$\{[^{}]*\}", "", text)
    return bool(re.search(r"\s", text.strip()))


def escaped(node: Any) -> Any:
    """Nested dicts, lists and texts such that OmegaConf reads every text in them as it stands, ${...} included."""
    if isinstance(node, dict):
        return {key: escaped(below) for key, below in node.items()}
    if isinstance(node, list):
        return [escaped(below) for below in node]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", node) if isinstance(node, str) else node


def _dotlist(arguments: Sequence[str]) -> DictConfig:
    """`a.b=value` arguments as a config. A value is YAML where it reads as a number, list, mapping ({..}) or word such
    as true or null, and otherwise the text as it was typed: spaces, commas, colons and apostrophes survive, and in
    prose what begins with ${ too, which elsewhere is an interpolation."""
    config = OmegaConf.create({})
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or not key or key.startswith("-"):
            raise ConfigError(
                f"'{argument}' on the command line is neither a flag nor key=value. "
                'A value with spaces needs quotes: system.prompt_processor.prompt="Make it sunset".'
            )
        if not all(key.split(".")):
            raise ConfigError(f"'{argument}' on the command line: '{key}' is no key: a part of it is empty.")
        try:
            parsed = OmegaConf.create(f"value: {text}").value
        except (yaml.YAMLError, OmegaConfBaseException) as error:
            if text[:1] in "[{" and text:
                raise ConfigError(f"{key}: '{text}' is not a valid list or mapping.") from error
            parsed = text
        is_text = isinstance(parsed, str) and text[:1] not in ("'", '"')
        is_word = isinstance(parsed, bool) and text.lower() not in ("true", "false")
        if not all(key.split(".")):
            raise ConfigError(f"'{argument}' on the command line: '{key}' is no key: a part of it is empty.")
        is_prose = OmegaConf.is_config(parsed) and text[:1] not in ("[", "{")
        value = text if is_text or is_word or is_prose else parsed
        if isinstance(value, str) and (key.endswith("prompt") or _is_words(value)):
            value = escaped(value)
        try:
            OmegaConf.update(config, key, value, force_add=True)
        except GrammarParseError as error:
            raise ConfigError(f"{key}: '{text}' is no reference to another key, ${{key}}.") from error
        except OmegaConfBaseException as error:
            raise ConfigError(f"'{argument}' on the command line: '{key}' is no key: {error}") from error
    return config


def _register_resolvers() -> None:
    """threestudio's resolvers, so that its YAML files read the same here. The ones already there are left alone."""
    resolvers = {
        "calc_exp_lr_decay_rate": lambda factor, n: factor ** (1.0 / n),
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "idiv": lambda a, b: a // b,
        "basename": lambda path: Path(path or "").name,
        "rmspace": lambda text, sub: str(text).replace(" ", sub),
        "tuple2": lambda x: [float(x), float(x)],
        "gt0": lambda x: x > 0,
        "cmaxgt0": lambda x: largest(x) > 0,
        "not": lambda x: not x,
        "cmaxgt0orcmaxgt0": lambda a, b: largest(a) > 0 or largest(b) > 0,
    }
    register = getattr(OmegaConf, "register_resolver", None) or OmegaConf.register_new_resolver  # its name before 2.4
    for name, function in resolvers.items():
        if not OmegaConf.has_resolver(name):
            register(name, function)
