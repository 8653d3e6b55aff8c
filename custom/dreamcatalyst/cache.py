"""Things that are kept as long as there is room for them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import torch

T = TypeVar("T")


def tensor_bytes(value: Any) -> int:
    """Bytes of all tensors in nested tuples, lists and dicts."""
    if isinstance(value, torch.Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, dict):
        value = value.values()
    return sum(map(tensor_bytes, value)) if isinstance(value, (tuple, list, type({}.values()))) else 0


class ByteCache:
    """Values by key, at most `limit` bytes of them: the least recently used go first. A value larger than the limit is
    handed out and not kept; limit 0 keeps nothing."""

    def __init__(self, limit: int, size: Callable[[Any], int] = tensor_bytes):
        self.limit, self.bytes, self._size = limit, 0, size
        self._held: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._held)

    def find(self, key: Hashable) -> Any:
        """The value of `key`, None where it is not held."""
        if key not in self._held:
            return None
        self._held.move_to_end(key)
        return self._held[key][0]

    def put(self, key: Hashable, value: Any) -> None:
        """Hold `value` under `key`, in place of what was there, as far as the limit allows."""
        if key in self._held:
            self.bytes -= self._held.pop(key)[1]
        size = self._size(value)
        if size > self.limit:
            return
        self._held[key] = value, size
        self.bytes += size
        while self.bytes > self.limit:
            self.bytes -= self._held.popitem(last=False)[1][1]

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of `key`, made where it is not held."""
        value = self.find(key)
        if value is None:
            value = make()
            self.put(key, value)
        return value

    def clear(self) -> None:
        """Let go of everything."""
        self._held.clear()
        self.bytes = 0
