"""A folder of photographs and nothing else: their cameras are found, and kept (sfm/)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..meter import Meter
from . import colmap
from .formats import CaptureOptions, Format, Scan
from .sfm import store
from .sfm.choose import CAPTURE, choose, photographs_below
from .sfm.prepare import Picture, prepare


def find(source: Path) -> Path | None:
    """`source`, where it holds photographs, maybe in folders, and no cameras of them."""
    if not source.is_dir() or any((source / name).exists() for name in CAPTURE):
        return None
    return source if photographs_below(source) else None


def read(source: Path, options: CaptureOptions) -> Scan:
    """Photographs and the cameras that are found for them, or were found before. Raises DataError, which says what to
    photograph instead."""
    own = source / options.images
    root = own if photographs_below(own) else source
    chosen, said = choose(root, options.sfm)

    def copies(folder: Path) -> tuple[list[Picture], list[str]]:
        meter = Meter("cameras: photographs", len(chosen), "photograph")
        try:
            return prepare(root, chosen, folder, options.sfm, meter.update)
        finally:
            meter.close()

    contents = [(path.relative_to(root).as_posix(), store.content(path)) for path in chosen]
    return scan(store.cameras(source, contents, False, options.sfm, copies), options, said)


def scan(folder: Path, options: CaptureOptions, said: Sequence[str]) -> Scan:
    """What stands in a folder of sfm/store.py. said: notices that go before its own."""
    found = colmap.read(folder, replace(options, images="images"))
    return replace(found, notices=[*said, *store.notices(folder)], found=folder)


FORMAT = Format("a folder of photographs", find, read)
