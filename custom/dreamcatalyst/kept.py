"""What is kept between runs: under what name, where, and by one process at a time."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from .errors import ConfigError


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


@contextmanager
def alone(folder: Path, waits: Callable[[], None]) -> Iterator[None]:
    """Inside the block no other process is inside one for the same folder, which is kept between runs and need not be
    there: where one is, `waits` is called, and it is waited for. Raises ConfigError."""
    path = folder.with_name(f"{folder.name}.lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise ConfigError(
            f"{path.parent}: what is kept between runs cannot be written there: {error.strerror or error}. Choose "
            "another folder: DREAMCATALYST_CACHE=<folder> before the command."
        ) from error
    try:
        lock(folder, handle, waits)
        yield
    finally:
        os.close(handle)


def lock(folder: Path, handle: int, waits: Callable[[], None] | None = None) -> None:
    """Lock what is open as `handle`, for `folder`, until it is closed or the process ends, however that ends. waits:
    called before another process is waited for; None: that is a ConfigError."""
    try:
        import fcntl
    except ImportError:  # Windows has none, and two runs into one folder have to be the user's care there
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            if waits is not None:
                waits()
                fcntl.flock(handle, fcntl.LOCK_EX)
                return
            raise ConfigError(
                f"{folder}: another process is running in this folder. Wait for it, or choose another: tag=..."
            ) from error
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.EBADF):  # network drives without locks
            raise
