"""What is kept between runs: under what name, and where."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor


def home() -> Path:
    """The folder of what is kept, which may not be there yet: $DREAMCATALYST_CACHE, else dreamcatalyst in
    $XDG_CACHE_HOME or ~/.cache."""
    own, shared = os.environ.get("DREAMCATALYST_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if own:
        return Path(own).expanduser()
    return (Path(shared) if shared else Path.home() / ".cache") / "dreamcatalyst"


def digest(*parts: Any) -> str:
    """A hash of nested numbers, text, bytes, tensors, mappings, sequences and dataclasses, by value."""
    state = hashlib.blake2b(digest_size=16)
    for part in parts:
        _update(state, part)
    return state.hexdigest()


def _update(state: Any, part: Any) -> None:
    if isinstance(part, Tensor):
        part = part.detach().cpu().contiguous().numpy()
    if isinstance(part, np.ndarray):
        state.update(f"array {part.dtype} {part.shape} ".encode())
        state.update(np.ascontiguousarray(part).data.cast("B") if part.size else b"")
    elif dataclasses.is_dataclass(part):
        _update(state, (type(part).__qualname__, {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}))
    elif isinstance(part, Mapping):
        _update(state, [(key, part[key]) for key in sorted(part)])
    elif isinstance(part, Sequence) and not isinstance(part, (str, bytes)):
        state.update(f"list {len(part)} ".encode())
        for each in part:
            _update(state, each)
    else:
        text = repr(part).encode()
        state.update(f"{type(part).__name__} {len(text)} ".encode() + text)


def stamp(path: str | Path | None) -> Any:
    """Names, sizes and times of the files of a local folder, such as a model's; the name alone of anything else."""
    folder = Path(path).expanduser() if path else None
    if folder is None or not folder.is_dir():
        return path
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return [(p.relative_to(folder).as_posix(), p.stat().st_size, p.stat().st_mtime_ns) for p in files]
