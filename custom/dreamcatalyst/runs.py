"""The folder of a run: made for one run alone, and what a run that did not finish has left there."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from . import kept
from .config import ExperimentConfig
from .errors import ConfigError
from .files import clear_parts

FOLDERS = ("save", "ckpts", "configs", "report")  # inside a run's folder
LAST = ("save/last.ply", "ckpts/last.ckpt")


@contextmanager
def claimed(config: ExperimentConfig, *, numbered: bool, writes: bool) -> Iterator[ExperimentConfig]:
    """Make the run's folder and keep it for this process inside the block; gives the config with the folder's name.

    numbered: where the folder is there already, take the next free of name-2, name-3, ... (for names that are the time
    of the start). writes: the run trains or tests, and so would replace results: it shares its folder with no other
    process, and refuses one that holds results, unless it resumes from a checkpoint in it. A folder in which nothing
    was written goes with the block. Raises ConfigError.
    """
    folder, made = Path(config.trial_dir), True
    resumed = bool(config.resume) and folder.resolve() in Path(config.resume).resolve().parents
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if numbered and not resumed:
            folder = _make_next(folder)
        else:
            made = not folder.is_dir()
            folder.mkdir(exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise _unusable(config, folder, error) from error
    try:
        if writes:
            kept.lock(folder, handle)
        _check(folder, replaces=writes and not resumed)
        if writes:
            clear_parts(folder)
        added = folder.name[len(config.trial_name) :]
        yield dataclasses.replace(
            config,
            timestamp=f"{config.timestamp}{added}",
            trial_name=folder.name,
            trial_dir=str(folder),
        )
    finally:
        os.close(handle)  # and with it the lock, as the process's end does
        if made:
            with suppress(OSError):  # it is not empty, or is gone
                folder.rmdir()


def _make_next(folder: Path) -> Path:
    for number in itertools.count(1):
        path = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        with suppress(FileExistsError):
            path.mkdir()
            return path
    raise RuntimeError("unreachable")


def _check(folder: Path, replaces: bool) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"exp_root_dir: '{folder}' cannot be written to. Choose another folder: exp_root_dir=...")
    for path in (folder / name for name in FOLDERS):
        if path.exists() and not path.is_dir():
            raise ConfigError(f"{path}: is a file where a folder of the run has to be. Remove it, or set another tag=.")
    there = left_in(folder)
    if there and replaces:
        checkpoint = next((path for path in there if path.suffix == ".ckpt"), None)
        goes_on = f", or go on with it: resume={checkpoint}" if checkpoint else ""
        raise ConfigError(
            f"{folder}: holds the results of another run, which this one would replace. Choose another folder: "
            f"tag=... or use_timestamp=true{goes_on}."
        )


def left_in(folder: Path) -> list[Path]:
    """Splats and the newest checkpoint of a run's folder, as far as they are there."""
    ply, last = (folder / name for name in LAST)
    others = sorted(folder.glob("ckpts/*.ckpt"), key=lambda path: path.stat().st_mtime)
    checkpoint = [last] if last.is_file() else others[-1:]
    return [*([ply] if ply.is_file() else []), *checkpoint]


def told(folder: Path) -> str:
    """What is on disk of a run that ended early, for the end of a message."""
    there = left_in(folder)
    if not there:
        return "nothing was saved yet"
    checkpoint = next((path for path in there if path.suffix == ".ckpt"), None)
    goes_on = f" (go on: resume={checkpoint})" if checkpoint else ""
    return f"on disk: {', '.join(map(str, there))}{goes_on}"


def _unusable(config: ExperimentConfig, folder: Path, error: OSError) -> ConfigError:
    reason = error.strerror or str(error)
    return ConfigError(
        f"exp_root_dir: '{config.exp_root_dir}' cannot hold the run's folder {folder}: {reason}. "
        "Choose another: exp_root_dir=..."
    )
