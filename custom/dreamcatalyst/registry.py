"""One small registry for every kind of part that is chosen by name: renderers, priors, dataset formats, metrics."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from typing import Any

from .errors import choose


class Registry:
    """Names to objects of one kind. A target given as ".module:attribute" is imported when it is first asked for,
    so that listing names never imports a heavy package.

    kind: what the parts are, in words, for the error message. package: what relative targets are relative to.
    """

    def __init__(self, kind: str, package: str | None):
        self.kind, self.package = kind, package
        self._targets: dict[str, Any] = {}

    def add(self, name: str, target: Any = None) -> Callable | None:
        """Register `target` under `name`; without a target, decorate. Raises ValueError where the name is taken."""
        if target is None:
            return lambda obj: (self.add(name, obj), obj)[1]
        if name in self._targets:
            raise ValueError(f"{self.kind} '{name}' is registered twice")
        self._targets[name] = target
        return None

    def get(self, name: str, where: str = "") -> Any:
        """Return the part called `name`. Raises ConfigError naming the nearest known one."""
        target = self._targets[choose(self.kind, name, self._targets, where)]
        if isinstance(target, str):
            module, _, attribute = target.partition(":")
            target = getattr(importlib.import_module(module, self.package), attribute)
            self._targets[name] = target
        return target

    def parts(self) -> list[Any]:
        """All registered parts, in the order of their registration."""
        return [self.get(name) for name in list(self._targets)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def names(self) -> list[str]:
        """All registered names, sorted."""
        return sorted(self._targets)
