"""Every error that a user can cause. They share one shape: where, what was got, what was expected, the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


class DreamCatalystError(Exception):
    """Base of all errors of this project. The launcher prints its message without a traceback."""


class ConfigError(DreamCatalystError):
    """A configuration key, value or name that cannot be used."""


class DataError(DreamCatalystError):
    """Photographs, cameras or a capture's folder that cannot be used."""


class SceneError(DreamCatalystError):
    """Splats or a splat file that cannot be used."""


class PriorError(DreamCatalystError):
    """A diffusion prior that cannot be loaded or asked what was asked of it."""


class FileError(DreamCatalystError):
    """A file or folder that cannot be read or written. full: the file system has no room for it."""

    def __init__(self, message: str, full: bool = False):
        super().__init__(message)
        self.full = full


class NumericalError(DreamCatalystError):
    """A number that stopped being finite, with the place where it was first seen."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" with the closest of `known`, or "" where none is close."""
    close = difflib.get_close_matches(str(name), [str(k) for k in known], n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""


def unknown(kind: str, name: object, known: Iterable[str], where: str = "", elsewhere: Sequence[str] = ()) -> str:
    """The message for a name that is not among `known`: place, name, nearest, all known ones. elsewhere: where else the
    name is known, in full; it is then meant rather than one that looks alike."""
    known = sorted(known)
    place = f"{where}: " if where else ""
    meant = f" Did you mean {' or '.join(map(repr, elsewhere))}?" if elsewhere else nearest(str(name), known)
    return f"{place}unknown {kind} '{name}'.{meant} Known: {', '.join(known) or 'none'}."


def choose(kind: str, name: str, known: Iterable[str], where: str = "") -> str:
    """Return `name` if it is one of `known`, else raise ConfigError that names the nearest one.

    kind: what is being chosen, in words ("guidance rule"). where: the config key ("system.guidance.rule").
    """
    known = list(known)
    if name in known:
        return name
    raise ConfigError(unknown(kind, name, known, where))
