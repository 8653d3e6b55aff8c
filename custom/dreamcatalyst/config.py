"""YAML onto typed dataclasses, the experiment that a YAML describes, and scalars that follow a schedule.

Parsing is pure: it makes no folder and builds nothing. All that a user can get wrong is a ConfigError that names the
place, what was got, what was expected and the nearest valid key.
"""

from __future__ import annotations

import dataclasses
import math
import re
import sys
import time
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Union

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import GrammarParseError, OmegaConfBaseException

from .errors import ConfigError, choose, nearest, unknown
from .files import folder_name, write_text

TIMESTAMP = "@%Y%m%d-%H%M%S"  # of a run's start, in its folder's name
LARGEST = sys.float_info.max
_SCHEDULE = "[v0, v1, end], [start, v0, v1, end] or [start, v0, v1, s1, v2, s2, ...]"


# --- what a number may be: annotations of config fields; OmegaConf, and so the host, sees int and float ---------------


class Range:
    """Which numbers a field takes, as an interval: "[0, 1)" holds 0 and not 1. Infinity is never inside.

    Stands in an annotation, `rate: Annotated[float, Range("[0, inf)")]`, and goes for every number of the field: each
    element of a tuple, and each value of a schedule.
    """

    def __init__(self, interval: str):
        self.interval = interval
        low, high = interval[1:-1].split(",")
        self.low, self.high = float(low), float(high)
        self._open = interval[0] == "(", interval[-1] == ")"

    def __contains__(self, number: float) -> bool:
        above = number > self.low if self._open[0] else number >= self.low
        below = number < self.high if self._open[1] else number <= self.high
        return above and below and -math.inf < number < math.inf

    def __str__(self) -> str:
        if math.isinf(self.low) and math.isinf(self.high):
            return "a finite number"
        if math.isinf(self.high):
            return f"more than {self.low:g}" if self._open[0] else f"{self.low:g} or more"
        return f"a number in {self.interval}"


Number = Annotated[float, Range("(-inf, inf)")]
Positive = Annotated[float, Range("(0, inf)")]
NonNegative = Annotated[float, Range("[0, inf)")]
Fraction = Annotated[float, Range("[0, 1]")]
PositiveFraction = Annotated[float, Range("(0, 1]")]
BelowOne = Annotated[float, Range("[0, 1)")]
Between = Annotated[float, Range("(0, 1)")]
Colour = tuple[Fraction, Fraction, Fraction]  # RGB
Integer = Annotated[int, Range("(-inf, inf)")]
Count = Annotated[int, Range("[0, inf)")]
AtLeastOne = Annotated[int, Range("[1, inf)")]
Seed = Annotated[int, Range("[0, 4294967295]")]  # what all generators of random numbers take
DdimSteps = Annotated[int, Range("[1, 1000]")]  # a prior has no more noise levels
Side = Annotated[int, Range("[1, 32766]")]  # pixels; OpenCV resamples no longer sides

Scalar = Annotated[float, "schedule"]
"""A number or a schedule of it, [v0, v1, end], [start, v0, v1, end] or [start, v0, v1, s1, v2, s2, ...]; `value`."""
Rate = Annotated[Scalar, Range("[0, inf)")]


# --- one dataclass ---------------------------------------------------------------------------------------------------


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
        raise ConfigError(f"{where or 'config'}: got {_show(node)}, expected keys of their own: {known}.")
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
    if dataclasses.is_dataclass(hint):
        return parse(hint, raw, place, default if isinstance(default, hint) else None)
    if hint is Any or (hint is dict and isinstance(raw, DictConfig)) or (hint is str and isinstance(raw, str)):
        return raw
    if typing.get_origin(hint) in (tuple, list) and _several(raw):
        return _sequence(hint, raw, place)
    leaf = OmegaConf.structured(dataclasses.make_dataclass("Leaf", [("value", hint)]))
    try:
        if isinstance(raw, bool) and hint in (int, float):
            raise ValueError
        result = OmegaConf.merge(leaf, {"value": raw}).value
    except (OmegaConfBaseException, ValueError, OverflowError) as error:
        raise ConfigError(f"{place}: got {_show(raw)}, expected {_expected(hint)}.") from error
    if isinstance(result, float) and not math.isfinite(result):
        raise ConfigError(f"{place}: got {_show(raw)}, expected a finite number.")
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
    result = _scalar(raw, place) if schedule else _convert(hint, raw, place, None)
    for number in values_of(result) if schedule else [result]:
        for limits in notes:
            if isinstance(limits, Range) and number not in limits:
                within = f" in {_show(raw)}" if isinstance(result, tuple) else f" ({type(number).__name__})"
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
        name = f"a number or a schedule {_SCHEDULE}"
    elif typing.get_origin(inner) in (tuple, list):
        items = ["..." if a is Ellipsis else _expected(a) for a in typing.get_args(inner)]
        name = f"{typing.get_origin(inner).__name__}[{', '.join(items)}]"
    else:
        name = inner.__name__ if isinstance(inner, type) and not typing.get_args(inner) else str(inner)
    return f"{name.replace('typing.', '')}{' or null' if optional else ''}"


def _show(raw: Any) -> str:
    plain = OmegaConf.to_container(raw) if OmegaConf.is_config(raw) else raw
    text = repr(plain)
    return f"{text if len(text) <= 80 else text[:77] + '...'} ({type(plain).__name__})"


# --- schedules -------------------------------------------------------------------------------------------------------


def _several(raw: Any) -> bool:
    """Whether this is a list or a tuple, or what OmegaConf makes of one."""
    return isinstance(raw, Sequence) and not isinstance(raw, (str, bytes))


def _number(raw: Any) -> bool:
    return isinstance(raw, (int, float)) and not isinstance(raw, bool)


def _scalar(raw: Any, place: str) -> float | tuple[int | float, ...]:
    """A number as it is, a schedule as a tuple that keeps its ints and floats apart (they choose the clock). All are
    finite."""
    if _number(raw):
        return _finite(raw, raw, place)
    wrong = ConfigError(f"{place}: got {_show(raw)}, expected {_expected(Scalar)}.")
    if isinstance(raw, str):
        try:
            return _finite(float(raw), raw, place)
        except ValueError as error:
            raise wrong from error
    if not _several(raw):
        raise wrong
    for item in raw:
        if not _number(item):
            raise ConfigError(f"{place}: a schedule holds numbers only, and {_show(item)} is none: {list(raw)}.")
        _finite(item, raw, place)
    if len(raw) not in (3, 4) and (len(raw) < 6 or len(raw) % 2):
        raise ConfigError(f"{place}: a schedule of {len(raw)} numbers, expected {_SCHEDULE}.")
    times = [time for time, _ in _knots(raw)]
    if any(a >= b for a, b in zip(times, times[1:], strict=False)):
        raise ConfigError(f"{place}: the times of a schedule must increase, got {times} in {list(raw)} ({_SCHEDULE}).")
    return tuple(raw)


def _finite(number: int | float, raw: Any, place: str) -> int | float:
    """The number. Raises ConfigError where a float cannot hold it, or it is none."""
    if not -LARGEST <= number <= LARGEST:
        raise ConfigError(f"{place}: got {_show(raw)}, expected finite numbers.")
    return number


def _knots(schedule: Sequence[int | float]) -> list[tuple[int | float, int | float]]:
    """The (time, value) corners of a schedule: start and v0 first, then the others as they stand, (v, time)."""
    start, first, *rest = [0, *schedule] if len(schedule) == 3 else schedule
    return [(start, first)] + [(rest[i + 1], rest[i]) for i in range(0, len(rest), 2)]


def value(scalar: Scalar | Sequence, epoch: int, step: int, interpolation: str = "linear") -> float:
    """The value of a number or schedule at `epoch` and global `step`; threestudio's `C`, clock rule included.

    Between the corners of a schedule the value goes linearly ("linear") or geometrically ("exp"); outside it stays.
    The piece is chosen by the step. The type of the number that ends the piece chooses the clock inside it: an int
    counts global steps, a float counts epochs.
    """
    if _number(scalar):
        return scalar
    knots = _knots(_scalar(scalar, "schedule"))
    piece = sum(step >= time for time, _ in knots[1:-1])
    (start, first), (end, last) = knots[piece : piece + 2]
    now = step if isinstance(end, int) else epoch
    t = min(max((now - start) / (end - start), 0.0), 1.0)
    if choose("interpolation", interpolation, ["linear", "exp"]) == "linear":
        return first + (last - first) * t
    if first <= 0 or last <= 0:
        raise ConfigError(f"schedule: 'exp' interpolation needs positive values, got {first} and {last}.")
    return math.exp(math.log(first) * (1 - t) + math.log(last) * t)


def values_of(scalar: Scalar | Sequence) -> list[float]:
    """The values at the corners of a schedule, between which it stays; of a number, that."""
    return [scalar] if _number(scalar) else [v for _, v in _knots(_scalar(scalar, "schedule"))]


def largest(scalar: Scalar | Sequence) -> float:
    """The largest value that a number or schedule takes."""
    return max(values_of(scalar))


def corners(scalar: Scalar | Sequence) -> list[int | float]:
    """The times at which the pieces of a schedule begin and end, in steps or epochs; [0] for a number."""
    return [0] if _number(scalar) else [time for time, _ in _knots(_scalar(scalar, "schedule"))]


# --- the experiment --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExperimentConfig:
    """One run. `exp_dir`, `trial_name` and `trial_dir` are computed, and only the launcher makes the folders."""

    name: str = "default"  # the experiment's folder under exp_root_dir
    description: str = ""
    tag: str = ""  # the trial's folder is tag + timestamp
    seed: Seed = 0
    use_timestamp: bool = True
    timestamp: str | None = None  # null: the time of the start, as TIMESTAMP
    exp_root_dir: str = "outputs"
    exp_dir: str = ""
    trial_name: str = ""
    trial_dir: str = ""
    n_gpus: Count = 1
    imports: tuple[str, ...] = ()  # Python files or modules that register parts of one's own, before anything is built
    resume: str | None = None  # a checkpoint to go on from, in the trial where it lies
    data_type: str = ""
    data: dict = field(default_factory=dict)
    system_type: str = ""
    system: dict = field(default_factory=dict)
    trainer: dict = field(default_factory=dict)  # any option of lightning's Trainer
    checkpoint: dict = field(default_factory=dict)  # any option of lightning's ModelCheckpoint


def merge_config(*yamls: str | Path, cli_args: Sequence[str] = (), **overrides: Any) -> DictConfig:
    """YAML files merged from left to right, then `key.sub=value` arguments, then `overrides`; nothing is resolved, so
    that what follows from another key still does. Raises ConfigError."""
    _register_resolvers()
    parts = [*(_read(Path(path)) for path in yamls), _dotlist(cli_args), OmegaConf.create(overrides)]
    merged = parts[0]
    for part in parts[1:]:
        _require_keys(OmegaConf.to_container(merged), OmegaConf.to_container(part))
        merged = OmegaConf.merge(merged, part)
    for key in missing_keys(OmegaConf.to_container(merged)):
        raise ConfigError(f"{key}: a value is needed, and none is given. Add {key}=... to the command.")
    return merged


def _require_keys(below: Any, above: Any, where: str = "") -> None:
    """Raise ConfigError where a section, or a list, is to be replaced by the other: OmegaConf merges neither."""
    if isinstance(below, dict) and isinstance(above, dict):
        for key in below.keys() & above.keys():
            _require_keys(below[key], above[key], f"{where}.{key}" if where else str(key))
    elif isinstance(below, dict) and isinstance(above, list):
        raise ConfigError(f"{where}: got {_show(above)}, expected keys of their own: {', '.join(map(str, below))}.")
    elif isinstance(below, list) and isinstance(above, dict):
        raise ConfigError(f"{where}: got {_show(above)}, expected a list such as {_show(below)}.")


def read_config(merged: DictConfig, below: Callable[[], Iterable[str]] = tuple) -> ExperimentConfig:
    """The run that `merge_config` describes: resolved, parsed, with the names of its folders. Raises ConfigError.

    A run that resumes from `<trial>/ckpts/x.ckpt` gets that trial's folder. below: the dotted keys that sections take,
    asked for where a key is unknown: it may be one of them without its section.
    """
    plain = OmegaConf.to_container(merged)
    known = [f.name for f in dataclasses.fields(ExperimentConfig)]
    for key in plain:
        if key not in known:
            raise ConfigError(unknown("key", key, known, "config", _misplaced(key, plain, list(below()))))
    _check_first(merged)
    try:
        resolved = OmegaConf.create(_escaped(OmegaConf.to_container(merged, resolve=True)))
    except OmegaConfBaseException as error:
        place, text = getattr(error, "full_key", None) or "config", str(error.child_node)
        reason = str(error).splitlines()[0]
        # What follows from a text is not to blame for what the text refers to.
        missing = re.search("Interpolation key '(.*)' not found", reason)
        origin = [(k, t) for k, t in leaves(plain) if missing and f"${{{missing[1]}}}" in str(t)]
        place, text = origin[0] if origin else (place, text)
        raise ConfigError(f"{place}: {reason}, in {text}") from error
    return _with_folders(parse(ExperimentConfig, resolved))


def load_config(*yamls: str | Path, cli_args: Sequence[str] = (), **overrides: Any) -> ExperimentConfig:
    """`read_config` of `merge_config`."""
    return read_config(merge_config(*yamls, cli_args=cli_args, **overrides))


def _check_first(merged: DictConfig) -> None:
    """Raise ConfigError for what other keys are worked out from, so that none of these is blamed."""
    for key in ("data", "system", "trainer", "checkpoint"):
        section = OmegaConf.select(merged, key)
        if key in merged and section is not None and not isinstance(section, DictConfig):
            raise ConfigError(f"{key}: got {_show(section)}, expected dict ({key}.<key>=<value>).")
    try:
        steps = OmegaConf.select(merged, "trainer.max_steps")
    except OmegaConfBaseException:
        return  # worked out itself from what cannot be: the resolver names that place
    if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 1):
        raise ConfigError(
            f"trainer.max_steps: got {_show(steps)}, expected a whole number, 1 or more: schedules go over the run's "
            "length."
        )


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


def _misplaced(key: str, plain: dict, below: Sequence[str]) -> list[str]:
    """The dotted keys among `below` that end as the first value under the unknown `key` does, or as `key`."""
    whole = next((name for name, _ in leaves(plain[key], key)), key)
    found = ([name for name in below if name.endswith(f".{end}")] for end in (whole, key))
    return next((names for names in found if names), [])


def save_config(config: ExperimentConfig, path: Path, merged: DictConfig | None = None) -> None:
    """Write a config as YAML that `load_config` takes to the same trial. merged: what `config` was read from: what
    follows from other keys there is written so, and follows them again where the file is loaded with another length."""
    told = {f.name: _escaped(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if merged is not None:
        told |= {key: value for key, value in OmegaConf.to_container(merged).items() if key not in _FOUND}
    write_text(path, OmegaConf.to_yaml(OmegaConf.create(told)))


_FOUND = ("timestamp", "exp_dir", "trial_name", "trial_dir")  # what is no one's to give, but is kept in the YAML


def _with_folders(config: ExperimentConfig) -> ExperimentConfig:
    if config.resume and not Path(config.resume).is_file():
        near = nearest(Path(config.resume).name, [p.name for p in Path(config.resume).parent.glob("*.ckpt")])
        raise ConfigError(f"resume: there is no checkpoint '{config.resume}'.{near}")
    checkpoint = Path(config.resume or "")
    trial = (checkpoint if len(checkpoint.parts) > 2 else checkpoint.absolute()).parent.parent
    if config.resume and (trial / "configs" / "parsed.yaml").is_file():
        tag = folder_name(config.tag)
        return _in_folder(config, trial, trial.name[len(tag) :] if trial.name.startswith(tag) else "")
    timestamp = config.timestamp
    if timestamp is None:
        timestamp = time.strftime(TIMESTAMP) if config.use_timestamp and config.n_gpus == 1 else ""
    # Texts of the user's, which may hold anything: none of them leads out of the folder before it.
    trial_name = folder_name(config.tag) + folder_name(timestamp)
    if not trial_name:
        raise ConfigError("tag: empty, and use_timestamp is false: the trial's folder has no name. Set one of them.")
    return _in_folder(config, Path(config.exp_root_dir) / folder_name(config.name) / trial_name, timestamp)


def _in_folder(config: ExperimentConfig, trial: Path, timestamp: str) -> ExperimentConfig:
    names = dict(exp_dir=str(trial.parent), trial_name=trial.name, trial_dir=str(trial))
    return dataclasses.replace(config, timestamp=timestamp, **names)


def _read(path: Path) -> DictConfig:
    if not path.is_file():
        folder = path.parent if path.parent.is_dir() else Path("configs")
        there = [str(p) for p in sorted(folder.glob("*.yaml"))]
        known = f" Known: {', '.join(there)}." if there else ""
        raise ConfigError(f"--config: there is no file '{path}'.{nearest(str(path), there)}{known}")
    try:
        content = yaml.compose(path.read_text(encoding="utf-8"))
        loaded = OmegaConf.load(path) if isinstance(content, yaml.MappingNode) else None
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
    known = [f.name for f in dataclasses.fields(ExperimentConfig)]
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


def _escaped(node: Any) -> Any:
    """Nested dicts, lists and texts such that OmegaConf reads every text in them as it stands, ${...} included."""
    if isinstance(node, dict):
        return {key: _escaped(below) for key, below in node.items()}
    if isinstance(node, list):
        return [_escaped(below) for below in node]
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
            value = _escaped(value)
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
