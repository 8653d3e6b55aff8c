"""YAML onto typed dataclasses. All that a user can get wrong is a ConfigError that names the place, what was got, what
was expected and the nearest valid key."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Union

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..errors import ConfigError, choose, unknown
from .schedules import EXPECTED, is_list, read_scalar, shown, values_of
from .types import Range


def parse(cls: type, node: Any, where: str = "", base: Any = None) -> Any:
    """Return `cls` filled from `node`, with the defaults of `cls` (or of the instance `base`) where it is silent.

    cls: a dataclass, frozen or not; its fields may be primitives, Optional, lists, tuples, dicts, Enums, `Scalar`, or
    dataclasses, which are parsed in turn. A field with metadata {"choices": [...]} takes only those, one annotated with
    a `Range` only numbers inside. A bare `dict` or `Any` is handed through as it is. `where`: the key under which node
    stands, for messages ("system.densify"). Raises ConfigError for a key that cls does not have, a value of another
    type or outside of its range, a number that is not finite, and `???`; a ConfigError of the class's own
    __post_init__ gets the place in front.
    """
    node = OmegaConf.create({}) if node is None else node
    if not isinstance(node, (Mapping, DictConfig)):
        known = ", ".join(f.name for f in dataclasses.fields(cls))
        raise ConfigError(f"{where or 'config'}: got {shown(node)}, expected keys of their own: {known}.")
    node = node if isinstance(node, DictConfig) else OmegaConf.create(dict(node))
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    for key in node:
        if key not in fields:
            raise ConfigError(unknown("key", key, fields, where or "config"))
    hints = typing.get_type_hints(cls, include_extras=True)
    values = {}
    for name, spec in fields.items():
        place = f"{where}.{name}" if where else name
        default = _default(spec) if base is None else getattr(base, name)
        if OmegaConf.is_missing(node, name) or (name not in node and default in (dataclasses.MISSING, "???")):
            raise ConfigError(f"{place}: a value is needed ({_expected(hints[name])}), and none is given.")
        if name in node:
            values[name] = _convert(hints[name], node[name], place, default)
            if "choices" in spec.metadata and values[name] is not None:
                choose(f"{name} value", values[name], spec.metadata["choices"], place)
    try:
        return cls(**values) if base is None else dataclasses.replace(base, **values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}" if where else str(error)) from error


def check(cls: type, node: Any, where: str) -> dict[str, Any]:
    """Validate the section `node` of a registered class without building it, and return its parsed parts by name.

    cls: has a dataclass `Config` and, optionally, `parts`: the names of those fields of Config that are free dicts in
    the YAML, each with the dataclass that it is to be parsed onto, or with a registered class to be checked in turn.
    """
    config = parse(cls.Config, node, where)
    parsed = {}
    for name, part in getattr(cls, "parts", {}).items():
        section, place = getattr(config, name), f"{where}.{name}"
        parsed[name] = check(part, section, place) if hasattr(part, "Config") else parse(part, section, place)
    return parsed


def known_keys(cls: type, where: str) -> Iterator[str]:
    """The dotted keys below `where` that a registered class takes, or a dataclass, with those of its `parts`."""
    parts = getattr(cls, "parts", {})
    for spec in dataclasses.fields(getattr(cls, "Config", cls)):
        yield f"{where}.{spec.name}"
        if spec.name in parts:
            yield from known_keys(parts[spec.name], f"{where}.{spec.name}")


def _default(spec: dataclasses.Field) -> Any:
    return spec.default_factory() if spec.default_factory is not dataclasses.MISSING else spec.default


def _convert(hint: Any, raw: Any, place: str, default: Any) -> Any:
    """Return `raw` as the type `hint`; `default` is the field's own value, onto which a nested dataclass is merged."""
    hint, optional = _unwrap(hint)
    if raw is None and (optional or hint is Any):
        return None
    hint, *notes = _notes(hint)
    if notes:
        return _ranged(hint, notes, raw, place)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return parse(hint, raw, place, default if isinstance(default, hint) else None)
    if hint is Any or (hint is dict and isinstance(raw, DictConfig)) or (hint is str and isinstance(raw, str)):
        return raw
    if typing.get_origin(hint) in (tuple, list) and is_list(raw):
        return _sequence(hint, raw, place)
    leaf = OmegaConf.structured(dataclasses.make_dataclass("Leaf", [("value", hint)]))
    try:
        if isinstance(raw, bool) and hint in (int, float):
            raise ValueError
        result = OmegaConf.merge(leaf, {"value": raw}).value
    except (OmegaConfBaseException, ValueError, OverflowError) as error:
        raise ConfigError(f"{place}: got {shown(raw)}, expected {_expected(hint)}.") from error
    if isinstance(result, float) and not math.isfinite(result):
        raise ConfigError(f"{place}: got {shown(raw)}, expected a finite number.")
    return OmegaConf.to_object(result) if OmegaConf.is_config(result) else result


def _sequence(hint: Any, raw: Sequence, place: str) -> tuple | list:
    """The elements of a tuple or a list, each converted for itself."""
    kind, hints = typing.get_origin(hint), typing.get_args(hint)
    if kind is list or Ellipsis in hints:
        hints = hints[:1] * len(raw)
    elif len(raw) != len(hints):
        raise ConfigError(f"{place}: got {len(raw)} values, expected {len(hints)} ({_expected(hint)}).")
    return kind(_convert(h, item, f"{place}[{i}]", None) for i, (h, item) in enumerate(zip(hints, raw, strict=True)))


def _ranged(hint: Any, notes: Sequence, raw: Any, place: str) -> Any:
    """`raw` as an annotated number: a schedule where that is among the notes, and inside the range that is."""
    schedule = "schedule" in notes
    result = read_scalar(raw, place) if schedule else _convert(hint, raw, place, None)
    numbers: list[Any] = values_of(result) if schedule else [result]
    for number in numbers:
        for limits in notes:
            if isinstance(limits, Range) and number not in limits:
                within = f" in {shown(raw)}" if isinstance(result, tuple) else f" ({type(number).__name__})"
                raise ConfigError(f"{place}: got {number}{within}, expected {limits}.")
    return result


def _notes(hint: Any) -> tuple[Any, ...]:
    """An annotated type and what it is annotated with."""
    return (hint.__origin__, *hint.__metadata__) if hasattr(hint, "__metadata__") else (hint,)


def _unwrap(hint: Any) -> tuple[Any, bool]:
    """Optional[X] as (X, True), anything else as (it, False)."""
    if typing.get_origin(hint) in (Union, types.UnionType):
        inner = [a for a in typing.get_args(hint) if a is not type(None)]
        if len(inner) == 1:
            return inner[0], True
        return hint, len(inner) < len(typing.get_args(hint))
    return hint, False


def _expected(hint: Any) -> str:
    inner, optional = _unwrap(hint)
    inner, *notes = _notes(inner)
    if "schedule" in notes:
        name = EXPECTED
    elif typing.get_origin(inner) in (tuple, list):
        items = ["..." if a is Ellipsis else _expected(a) for a in typing.get_args(inner)]
        name = f"{typing.get_origin(inner).__name__}[{', '.join(items)}]"
    else:
        name = inner.__name__ if isinstance(inner, type) and not typing.get_args(inner) else str(inner)
    return f"{name.replace('typing.', '')}{' or null' if optional else ''}"
