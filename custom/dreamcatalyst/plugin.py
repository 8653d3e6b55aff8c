"""The seam to threestudio: the one file that knows whether the host is there.

The host imports itself before it loads extensions, and this project's own launcher never imports it, so the host is
there exactly when `threestudio` has been imported. Whatever a part of ours needs from the host (registry, base classes,
the Lightning flavour) it takes from here by the host's name, and so is written once:

    @plugin.register("dreamcatalyst-edit-system")
    class EditSystem(plugin.BaseSystem):
        @dataclass
        class Config(plugin.BaseSystem.Config): ...

Names: register, find, BaseObject, BaseSystem, parse_structured, C, info, warn, and `pl`, the module of Lightning
(`pytorch_lightning` in the host, whose Trainer refuses the classes of `lightning.pytorch`, which serves alone).
Torch and Lightning take seconds to import, so all but the registry is bound when it is first asked for.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

HOSTED: bool = "threestudio" in sys.modules
OLDEST_HOST = (0, 2, 1)

_home: ModuleType | None = None  # in the host: the package whose offers were taken
_offers: dict[str, str] = {}  # alone: name -> the module that registers it
_parts: dict[str, type] = {}  # alone: name -> class

# Where each lazily bound name lives, in the host and alone; "" is the module itself.
_SOURCES = {
    "pl": ("pytorch_lightning:", "lightning.pytorch:"),
    "BaseObject": ("threestudio.utils.base:BaseObject", ".standalone:BaseObject"),
    "BaseSystem": ("threestudio.systems.base:BaseSystem", ".standalone:BaseSystem"),
    "parse_structured": ("threestudio.utils.config:parse_structured", ".standalone:parse_structured"),
    "C": ("threestudio.utils.misc:C", ".config:value"),
    "info": ("threestudio:info", ".standalone:info"),
    "warn": ("threestudio:warn", ".standalone:warn"),
}


def __getattr__(name: str) -> Any:
    if name not in _SOURCES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module, _, attribute = _SOURCES[name][0 if HOSTED else 1].partition(":")
    loaded = importlib.import_module(module, __package__)
    globals()[name] = getattr(loaded, attribute) if attribute else loaded
    return globals()[name]


def register(name: str) -> Callable[[type], type]:
    """Class decorator that enters a class into the host's registry, or alone into ours.

    Raises ValueError where another class has the name.
    """
    if HOSTED:
        return sys.modules["threestudio"].register(name)

    def bind(cls: type) -> type:
        if name in _parts:
            raise ValueError(f"'{name}' is registered twice: by {_parts[name].__name__} and {cls.__name__}")
        _parts[name] = cls
        return cls

    return bind


def find(name: str) -> type:
    """The class registered under `name`. Raises KeyError where there is none."""
    if HOSTED:
        return sys.modules["threestudio"].find(name)
    if name not in _parts and name in _offers:
        importlib.import_module(_offers[name])
    return _parts[name]


def names() -> list[str]:
    """All names that `find` knows, sorted."""
    return sorted(sys.modules["threestudio"].__modules__ if HOSTED else {*_offers, *_parts})


def offer(modules: Mapping[str, str], package: str) -> None:
    """Announce which modules register which names (name -> ".train.fit", relative to `package`).

    The host looks into its registry and nowhere else, so there the modules are imported at once (torch and Lightning
    already are); alone each waits until `find` is asked for its name. Raises ImportError for a host that is too old,
    and where custom/ holds this extension twice, as a link and as a clone for instance: the first one stays.
    """
    global _home
    if not HOSTED:
        _offers.update({name: f"{package}{module}" for name, module in modules.items()})
        return
    version = getattr(sys.modules["threestudio"], "__version__", "0")
    if tuple(int(n) for n in re.findall(r"\d+", version)[:3]) < OLDEST_HOST:
        oldest = ".".join(map(str, OLDEST_HOST))
        raise ImportError(f"{package} needs threestudio >= {oldest}, this is {version}. Update the host: git pull.")
    if _home is not None:
        first, second = (Path(str(home.__file__)).parent for home in (_home, sys.modules[package]))
        sys.modules[package] = _home  # the host has put the second in its place; what is imported later is the first's
        raise ImportError(
            f"{package} is in custom/ twice: {first}, which is used, and {second}. Remove one of them from custom/."
        )
    _home = sys.modules[package]
    for module in dict.fromkeys(modules.values()):
        importlib.import_module(module, package)
