"""Linking this extension into a threestudio folder."""

from __future__ import annotations

import filecmp
import shutil
from pathlib import Path

from .errors import ConfigError


def link(source: Path, target: Path, host: Path) -> None:
    """Make `target`, a path in the threestudio folder `host`, a symlink to the folder `source`; a copy, with a notice,
    where the file system has no symlinks. Linking twice changes nothing. Raises ConfigError where `host` is no
    threestudio, or `target` is there and is something else, or a clone of this repository is in the host's custom/.
    """
    try:
        _link(source, target, host)
    except (OSError, RuntimeError, shutil.Error) as error:  # a loop of links is a RuntimeError before Python 3.13
        reason = getattr(error, "strerror", None) or (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"--link: '{target}' cannot be made: {reason}.") from error


def _link(source: Path, target: Path, host: Path) -> None:
    lacking = [name for name in ("launch.py", "threestudio", "custom") if not (host / name).exists()]
    if lacking:
        raise ConfigError(f"--link: '{host}' is no threestudio folder: it has no {' and no '.join(lacking)}.")
    clone = next(host.glob(f"custom/*/custom/{target.name}/__init__.py"), None)
    if clone is not None:
        raise ConfigError(
            f"--link: '{clone.parents[2]}' is a clone of this extension, which threestudio loads as it is; its configs "
            f"are in '{clone.parents[2] / 'configs'}'. Remove it to link another one."
        )
    if target.is_symlink() and target.resolve() == source.resolve():
        print(f"{target} is linked already")
    elif target.is_dir() and not target.is_symlink() and _same(source, target):
        print(f"{target} is a copy of {source} already")
    elif target.is_symlink() or target.exists():
        raise ConfigError(f"--link: '{target}' is there already and is something else. Remove it and link again.")
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            target.symlink_to(source.resolve(), target_is_directory=True)
            print(f"{target} -> {source}")
        except (OSError, NotImplementedError) as error:
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
            print(f"{target} is a copy, since no link can be made there ({error}): after an update, link anew")


def _same(source: Path, target: Path) -> bool:
    pending = [filecmp.dircmp(source, target, ignore=["__pycache__"])]
    while pending:
        folder = pending.pop()
        if folder.left_only or folder.diff_files or folder.funny_files:
            return False
        pending.extend(folder.subdirs.values())
    return True
