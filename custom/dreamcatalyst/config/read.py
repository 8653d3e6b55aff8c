"""The run that a YAML describes. Parsing is pure: it makes no folder and builds nothing."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..errors import ConfigError, nearest, unknown
from ..files import folder_name, write_text
from .experiment import ExperimentConfig
from .merge import escaped, leaves, merge_config
from .parse import parse
from .schedules import shown

TIMESTAMP = "@%Y%m%d-%H%M%S"  # of a run's start, in its folder's name


def read_config(merged: DictConfig, below: Callable[[], Iterable[str]] = tuple) -> ExperimentConfig:
    """The run that `merge_config` describes: resolved, parsed, with the names of its folders. Raises ConfigError.

    A run that resumes from `<trial>/ckpts/x.ckpt` gets that trial's folder. below: the dotted keys that sections take,
    asked for where a key is unknown: it may be one of them without its section.
    """
    plain = cast(dict[str, Any], OmegaConf.to_container(merged))
    known = [f.name for f in dataclasses.fields(ExperimentConfig)]
    for key in plain:
        if key not in known:
            raise ConfigError(unknown("key", key, known, "config", _misplaced(key, plain, list(below()))))
    _check_first(merged)
    try:
        resolved = OmegaConf.create(escaped(OmegaConf.to_container(merged, resolve=True)))
    except OmegaConfBaseException as error:
        place, text = getattr(error, "full_key", None) or "config", str(error.child_node)
        reason = str(error).splitlines()[0]
        # What follows from a text is not to blame for what the text refers to.
        missing = re.search("Interpolation key '(.*)' not found", reason)
        if missing:
            _check_choices(missing[1], plain, merged)
        origin = [(k, t) for k, t in leaves(plain) if missing and f"${{{missing[1]}}}" in str(t)]
        place, text = origin[0] if origin else (place, text)
        raise ConfigError(f"{place}: {reason}, in {text}") from error
    return _with_folders(parse(ExperimentConfig, resolved))


def load_config(*yamls: str | Path, cli_args: Sequence[str] = (), **overrides: Any) -> ExperimentConfig:
    """`read_config` of `merge_config`."""
    return read_config(merge_config(*yamls, cli_args=cli_args, **overrides))


def _check_first(merged: DictConfig) -> None:
    """Raise ConfigError for what other keys are worked out from, so that none of these is blamed."""
    for key in ("data", "system", "trainer", "checkpoint", "export"):
        section = OmegaConf.select(merged, key)
        if key in merged and section is not None and not isinstance(section, DictConfig):
            raise ConfigError(f"{key}: got {shown(section)}, expected dict ({key}.<key>=<value>).")
    try:
        steps = OmegaConf.select(merged, "trainer.max_steps")
    except OmegaConfBaseException:
        return  # worked out itself from what cannot be: the resolver names that place
    if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 1):
        raise ConfigError(
            f"trainer.max_steps: got {shown(steps)}, expected a whole number, 1 or more: schedules go over the run's "
            "length."
        )


def _check_choices(missing: str, plain: dict, merged: DictConfig) -> None:
    """Raise ConfigError where `missing` is what another key chooses from a list (system.steps.${system.mode}): then
    that key's value is to blame."""
    chosen = re.compile(r"\$\{([\w.-]+)\.\$\{([\w.-]+)\}\}")  # ${<list>.${<key>}}
    for _, text in leaves(plain):
        for among, key in chosen.findall(str(text)):
            value, known = OmegaConf.select(merged, key), OmegaConf.select(merged, among)
            if f"{among}.{value}" == missing and isinstance(known, DictConfig):
                raise ConfigError(unknown("value", value, map(str, known), key))


def _misplaced(key: str, plain: dict, below: Sequence[str]) -> list[str]:
    """The dotted keys among `below` that end as the first value under the unknown `key` does, or as `key`."""
    whole = next((name for name, _ in leaves(plain[key], key)), key)
    found = ([name for name in below if name.endswith(f".{end}")] for end in (whole, key))
    return next((names for names in found if names), [])


def save_config(config: ExperimentConfig, path: Path, merged: DictConfig | None = None) -> None:
    """Write a config as YAML that `load_config` takes to the same trial. merged: what `config` was read from: what
    follows from other keys there is written so, and follows them again where the file is loaded with another length."""
    told = {f.name: escaped(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if merged is not None:
        plain = cast(dict[str, Any], OmegaConf.to_container(merged))
        told |= {key: value for key, value in plain.items() if key not in _FOUND}
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
