"""Zstandard, which Python has from 3.14 on and the package zstandard before."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from ...errors import SceneError

LEVEL = 5


def compress(data: bytes) -> bytes:
    """Raises SceneError where there is nothing that could."""
    return _package("write").ZstdCompressor(level=LEVEL).compress(data)


def decompress(path: Path, data: bytes, size: int) -> bytes:
    """Exactly `size` bytes; no more are ever made. Raises SceneError for a damaged stream, and as `compress`."""
    zstandard = _package("read", path)
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            out = stream.read(size)
            more = stream.read(1)
    except zstandard.ZstdError as error:
        raise SceneError(f"{path}: is damaged: its zstd stream cannot be read ({error})") from error
    if len(out) != size or more:
        raise SceneError(f"{path}: is damaged: a stream has {'over ' if more else ''}{len(out)} bytes, expected {size}")
    return out


def _package(verb: str, path: Path | None = None) -> Any:
    try:
        return importlib.import_module("zstandard")
    except ModuleNotFoundError as error:
        place = "export.options.version=4" if path is None else path
        raise SceneError(
            f"{place}: .spz of version 4 is packed with zstd, and Python has none to {verb} it with: "
            "pip install zstandard" + (", or write version 3" if path is None else "")
        ) from error
