"""Annotations, shapes of tensors included, are checked whenever a test calls the package; runs check nothing."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from beartype import BeartypeConf, FrozenDict, beartype
from jaxtyping import install_import_hook
from omegaconf import DictConfig

ROOT = Path(__file__).resolve().parent.parent / "custom"
COMPILED = re.compile(r"^from numba import|^@njit|^@kernel", re.MULTILINE)  # numba cannot compile a checked function

# Those whose annotations hold.
FOLDERS = ("data", "scene", "render", "demo", "diffusion", "guidance", "segment", "inpaint", "loss", "report")
# An int may stand for a float, and a section of OmegaConf for a dict, as in its own structured configs.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict({dict: dict | DictConfig})))


def checked(function: Callable) -> Callable:
    """With its annotations checked; a function inside another, which is made anew at each call, as it is."""
    return function if "<locals>" in function.__qualname__ else _beartype(function)


def checked_modules() -> list[str]:
    """The modules of FOLDERS, but those with kernels and the `__init__` files, whose names would stand for all."""
    folders = [ROOT / "dreamcatalyst" / name for name in FOLDERS]
    files = sorted(path for folder in folders for path in folder.rglob("*.py") if path.name != "__init__.py")
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in files
        if not COMPILED.search(path.read_text(encoding="utf-8"))
    ]


def install() -> None:
    """From now on imported modules check each call. Must come before the package's first import."""
    install_import_hook(checked_modules(), f"{__name__}.checked")
