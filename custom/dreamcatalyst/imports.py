"""Parts of one's own: Python files that a run's config names, and that register rules, metrics and so on."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

from .errors import ConfigError


def import_parts(names: Iterable[str], where: str = "imports") -> None:
    """Import each of `names`, a file (ends in .py, relative to the working directory) or a module, once in a process.

    Raises ConfigError, with the place in the file, where one is missing or its code fails.
    """
    for number, name in enumerate(names):
        place = f"{where}[{number}]"
        try:
            if name.endswith(".py"):
                _import_file(Path(name).expanduser(), place)
            else:
                importlib.import_module(name)
        except ConfigError:
            raise
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            reason = f"{type(error).__name__}: {error}"
            spot = f"{frame.filename}:{frame.lineno}"
            raise ConfigError(f"{place}: '{name}' cannot be imported: {reason} ({spot}).") from error


def _import_file(path: Path, place: str) -> None:
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.py")) if path.parent.is_dir() else []
        known = f" Python files there: {', '.join(beside)}." if beside else ""
        raise ConfigError(f"{place}: '{path}' is no file (from {Path.cwd()}).{known}")
    module_name = f"dreamcatalyst_parts.{path.resolve().as_posix().strip('/').replace('/', '_').removesuffix('.py')}"
    if module_name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(module_name, path.resolve())
    if spec is None or spec.loader is None:
        raise ConfigError(f"{place}: '{path}' is no Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module_name]
        raise
