"""A resumed run is the run that it goes on from, or an error: what made a checkpoint is kept in it and compared."""

from __future__ import annotations

import dataclasses
import fnmatch
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from . import files, plugin
from .config import ExperimentConfig, check, load_config, parse
from .errors import ConfigError, DreamCatalystError, FileError

MADE_BY = "made_by"  # the entry of a checkpoint that holds `recipe` and `contents`
NEEDED = {"epoch", "global_step", "pytorch-lightning_version", "state_dict"}
TO_TRAIN = {"optimizer_states", "lr_schedulers", "loops"}

# What a resumed run may have otherwise than the run that it goes on from. All else is the run.
MAY_CHANGE = (
    # its length: schedules go over the new one from there on, and the run says so
    *("trainer.max_steps", "trainer.max_epochs", "trainer.max_time", "trainer.min_steps", "trainer.min_epochs"),
    *("system.mode", "system.steps*"),
    # what is reported, shown and kept of it
    *("system.report.*", "system.preview.*", "system.samples.*", "system.loggers*", "system.nonfinite"),
    *("trainer.logger", "trainer.log_every_n_steps", "trainer.enable_*", "trainer.profiler"),
    *("trainer.val_check_interval", "trainer.check_val_every_n_epoch", "trainer.num_sanity_val_steps"),
    *("trainer.limit_val_batches", "trainer.limit_test_batches", "trainer.limit_predict_batches"),
    # where it runs
    *("trainer.accelerator", "trainer.devices", "trainer.num_nodes", "trainer.strategy", "trainer.benchmark"),
    *("trainer.detect_anomaly", "trainer.inference_mode", "trainer.plugins", "trainer.default_root_dir"),
    "system.renderer.backend",
    # what it keeps in memory
    *("system.renderer.cache_mib", "system.source_cache_mib", "system.mask.cache", "system.cleanup_*", "data.cache*"),
)
# Keys that name files. They may change where the content is the same, and must not where it is another.
NAMES_FILES = (
    *("system.gs_source", "system.original", "system.mesh", "system.add.path", "data.source"),
    *("system.guidance.prior.path", "system.mask.options.folder"),
)
FREE = ("trainer.", "system.guidance.prior.", "system.mask.options.")  # below them, what is not given is not listed
CAMERAS = ("transforms*.json", "cameras.json", "sparse/**/*", "colmap/sparse/**/*")  # of a capture's folder
READ_WHOLE = 1 << 22  # bytes up to which a file in a folder is compared by content, not by size alone
NOT_GIVEN = "not given"
SHOWN = 4  # differences in a message


# --- what made a run


def recipe(config: ExperimentConfig, classes: Mapping[str, type]) -> dict[str, Any]:
    """All settings of a run by dotted key, with the defaults of those that are not given. classes: of data and system.

    Raises ConfigError where the config does not fit the classes.
    """
    told = {"seed": config.seed, "data_type": config.data_type, "system_type": config.system_type}
    for key, cls in classes.items():
        section = getattr(config, key)
        parsed, parts = parse(cls.Config, section, key), check(cls, section, key)
        told |= dict(_flat(_plain(parsed) | _plain(parts), key))
    return told | dict(_flat(_plain(config.trainer), "trainer"))


def _plain(node: Any) -> Any:
    """Nested dataclasses, containers of OmegaConf and tuples as what a checkpoint may hold."""
    if OmegaConf.is_config(node):
        node = OmegaConf.to_container(node)
    if dataclasses.is_dataclass(node):
        node = {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
    if isinstance(node, Mapping):
        return {str(key): _plain(value) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [_plain(value) for value in node]
    return node if node is None or isinstance(node, (bool, int, float, str)) else str(node)


def _flat(node: Mapping[str, Any], where: str) -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{where}.{key}")
        else:
            yield f"{where}.{key}", value


def contents(told: Mapping[str, Any]) -> dict[str, str]:
    """A digest of what the keys that name files lead to, as far as they lead to files here."""
    found = {}
    for key in NAMES_FILES:
        path = Path(str(told.get(key) or "")).expanduser()
        if told.get(key) and path.exists():
            found[key] = files.file_digest(path) if path.is_file() else _folder_digest(path, key == "data.source")
    return found


def _folder_digest(folder: Path, capture: bool) -> str:
    """Of names, sizes and, up to a size, contents: of a capture's cameras, where it has some; else of all files."""
    inside = {path for pattern in CAMERAS for path in folder.glob(pattern)} if capture else set()
    inside = inside or set(folder.glob("**/*"))
    digest = hashlib.blake2b(digest_size=files.DIGEST)
    for path in sorted(path for path in inside if path.is_file()):
        size = path.stat().st_size
        content = files.file_digest(path) if size <= READ_WHOLE else ""
        digest.update(f"{path.relative_to(folder).as_posix()} {size} {content}\n".encode())
    return digest.hexdigest()


# --- checkpoints


def read_checkpoint(path: str | Path, *, to_train: bool) -> dict[str, Any]:
    """A run's checkpoint, verified. to_train: one that training can go on from, not only be looked at.

    Raises ConfigError that names the file and what else there is beside it.
    """
    try:
        saved, sealed = files.load(path)
    except FileError as error:
        raise ConfigError(f"resume: no checkpoint of a run: {error}.{_beside(Path(path))}") from error
    lacking = (NEEDED | (TO_TRAIN if to_train else set())) - (set(saved) if isinstance(saved, dict) else set())
    if lacking:
        which = "can be looked at, but not trained on" if lacking <= TO_TRAIN else "is no checkpoint of a run"
        raise ConfigError(f"resume: {path} {which}: it has no {', '.join(sorted(lacking))}.{_beside(Path(path))}")
    for key in ("epoch", "global_step"):
        if not isinstance(saved[key], int):
            raise ConfigError(f"resume: {path} is no checkpoint of a run: its {key} is {saved[key]!r}.")
    if not sealed:
        plugin.info(f"resume: {path} carries no digest: it was written by an earlier version, and is taken as it is")
    return saved


def _beside(path: Path) -> str:
    others = sorted(p for p in path.parent.glob("*.ckpt") if p != path)
    ply = path.parent.parent / "save" / "last.ply"
    there = [f"resume={p}" for p in others] + ([f"system.gs_source={ply}"] if ply.is_file() else [])
    return f" There are: {', '.join(there)}." if there else ""


def compare(saved: Mapping[str, Any], told: Mapping[str, Any], path: str | Path) -> None:
    """Raise ConfigError where the run `told` is not the run of the checkpoint `saved`, read from `path`, or where that
    run is over. Says aloud where the run's length is another one."""
    steps, done = told.get("trainer.max_steps"), saved["global_step"]
    if isinstance(steps, int) and done >= steps:
        raise ConfigError(
            f"resume: {path} is of step {done}, and trainer.max_steps is {steps}: there is nothing left to train. "
            f"Train for longer: trainer.max_steps={2 * done}; or look at it: --test, --validate, --export."
        )
    before = saved.get(MADE_BY) or _from_yaml_beside(Path(path), told)
    if before is None:
        plugin.warn(f"resume: {path} does not say what made it, so that it cannot be compared with this run")
        return
    was, had, has = before["recipe"], before["contents"], contents(told)
    changed = []
    # A key that one version knows and the other does not says nothing, but where keys are free.
    for key in sorted(key for key in {*was, *told} if (key in was and key in told) or key.startswith(FREE)):
        old, new = was.get(key, NOT_GIVEN), told.get(key, NOT_GIVEN)
        same_files = key in had and had[key] == has.get(key)
        free = any(fnmatch.fnmatchcase(key, pattern) for pattern in MAY_CHANGE)
        if old != new and not (same_files or free or _follows(old, new, was, told)):
            changed.append(f"{key} was {_show(old)} and is now {_show(new)}")
        elif key in had and key in has and not same_files:
            changed.append(f"the content of {key} ({told[key]}) is another one")
    if was.get("system_type") != told["system_type"]:  # then all else differs, too
        changed = [c for c in changed if c.startswith("system_type ")]
    if changed:
        more = f" and {len(changed) - SHOWN} more" if len(changed) > SHOWN else ""
        ply = Path(path).parent.parent / "save" / "last.ply"
        raise ConfigError(
            f"resume: this is not the run of {path}: {'; '.join(changed[:SHOWN])}{more}. Leave it as it was, or "
            f"begin a new run from its splats: system.gs_source={ply} without resume="
        )
    if was.get("trainer.max_steps") != steps:
        plugin.info(
            f"resume: the run was of {was.get('trainer.max_steps')} steps and is now of {steps}: from step {done} on, "
            "its schedules go over the new length"
        )


def _follows(was: Any, now: Any, old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    """Whether a schedule is the same but for its end, which is that of the run in both."""
    key = "trainer.max_steps"
    if not (isinstance(was, list) and isinstance(now, list)):
        return False
    return [new.get(key) if v == old.get(key) else v for v in was] == now


def _from_yaml_beside(path: Path, told: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the trial's own parsed.yaml says of a checkpoint that an earlier version wrote; None where it is silent."""
    written = path.parent.parent / "configs" / "parsed.yaml"
    if not written.is_file():
        return None
    try:
        config = load_config(written)
        classes = {key: plugin.find(told[f"{key}_type"]) for key in ("data", "system")}
        if (config.data_type, config.system_type) != (told["data_type"], told["system_type"]):
            return {"recipe": {"data_type": config.data_type, "system_type": config.system_type}, "contents": {}}
        return {"recipe": recipe(config, classes), "contents": {}}
    except DreamCatalystError as error:
        plugin.info(f"{written}: is of another version ({error})")
        return None


def _show(value: Any) -> str:
    text = value if value is NOT_GIVEN else repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
