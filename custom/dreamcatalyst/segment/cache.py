"""Masks kept on disk under a digest of everything that made them."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import plugin

PLACES = ("data", "scene", "render", "diffusion", "guidance", "segment")  # whose code has a part in a mask
BROKEN = (RuntimeError, ValueError, KeyError, TypeError, AttributeError, EOFError, OSError, pickle.UnpicklingError)


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
        state.update(memoryview(np.ascontiguousarray(part)).cast("B") if part.size else b"")
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


def code() -> str:
    """A hash of this project's code as far as it has a part in a mask."""
    root = Path(__file__).parent.parent
    return digest([(p.name, p.read_bytes()) for place in PLACES for p in sorted((root / place).glob("*.py"))])


def stamp(path: str | Path | None) -> Any:
    """Names, sizes and times of the files of a local folder, such as a model's; the name alone of anything else."""
    folder = Path(path).expanduser() if path else None
    if folder is None or not folder.is_dir():
        return path
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return [(p.relative_to(folder).as_posix(), p.stat().st_size, p.stat().st_mtime_ns) for p in files]


def save(folder: Path, key: str, weights: Tensor, images: Mapping[int, Tensor]) -> None:
    """Keep weights [N] and pictures (number of a view to uint8 [H,W]). The file appears when it is complete."""
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f".{key}.{os.getpid()}.part"
    try:
        torch.save({"key": key, "weights": weights.cpu(), "images": dict(images)}, part)
        part.replace(folder / f"{key}.pt")
    finally:
        part.unlink(missing_ok=True)


def load(folder: Path, key: str) -> tuple[Tensor, dict[int, Tensor]] | None:
    """What `save` kept under `key`; None where there is nothing. A file that is damaged or is not what its name says
    is reported and left aside, to be written anew."""
    path = folder / f"{key}.pt"
    if not path.is_file():
        return None
    try:
        kept = torch.load(path, map_location="cpu", weights_only=True)
        if kept["key"] != key:
            raise ValueError(f"it holds the mask {kept['key']}")
        return kept["weights"], kept["images"]
    except BROKEN as error:
        fault = f"{type(error).__name__}: {str(error).split('. ')[0]}"
        plugin.warn(f"{path}: is no mask that can be used and is made again ({fault})")
        return None
