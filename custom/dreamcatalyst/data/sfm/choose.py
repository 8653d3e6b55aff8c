"""Which photographs of a folder are used: found, in their order, each once, and no more than the budget."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...files import file_digest
from ..images import SUFFIXES
from .options import SfmOptions

CONVERTED = (".heic", ".heif", ".avif")  # read through Pillow, the first two with pillow-heif
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".3gp", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".ogv")
FEWEST = 3  # photographs that cameras are found from
MORE = (
    "Cameras are found from at least 3, better 20 or more, taken from places around the scene, each showing most of "
    "what the one before shows"
)
DEPTH = 3  # folders below the one that is named
CAPTURE = ("sparse", "transforms.json", "cameras.json")  # what makes a folder a capture of another format


def photographs_below(root: Path) -> list[Path]:
    """Photographs in `root` and in folders below it, in the order in which people count (img_2 before img_10).

    What begins with a dot is hidden, and a folder that is a capture of another format is not looked into.
    """
    found: list[Path] = []
    for folder, folders, names in os.walk(root):
        here = Path(folder)
        if here != root and any(name in CAPTURE for name in (*folders, *names)):
            folders.clear()
            continue
        deep = len(here.relative_to(root).parts) >= DEPTH
        folders[:] = [] if deep else [name for name in folders if not name.startswith((".", "__"))]
        suffixes = (*SUFFIXES, *CONVERTED)
        found += [here / n for n in names if not n.startswith(".") and Path(n).suffix.lower() in suffixes]
    return sorted(found, key=lambda path: natural(path.relative_to(root).as_posix()))


def natural(text: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers inside names by their value."""
    parts = re.findall(r"[0-9]+|[^0-9]+", text)
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part.casefold()) for part in parts]


def choose(root: Path, options: SfmOptions) -> tuple[list[Path], list[str]]:
    """The photographs below `root` that are used, and what is said of those that are not.

    Raises DataError where there are fewer than three that differ.
    """
    found = photographs_below(root)
    if not found:
        names = sorted(path.name for path in root.rglob("*") if path.suffix.lower() in RAW)[:1]
        raw = f" '{names[0]}' is a raw file: develop them to JPEG." if names else ""
        raise DataError(f"{root}: holds no photographs (looked for {', '.join((*SUFFIXES, *CONVERTED))}).{raw}")
    chosen, notices = _each_once(root, found)
    if len(chosen) < FEWEST:
        what = "one photograph" if len(chosen) == 1 else "two photographs"
        if len(found) > len(chosen) == 1:
            what = f"{len(found)} files that are all the same photograph"
        raise DataError(f"{root}: holds {what}. {MORE}")
    if len(chosen) > options.photographs:
        notices.append(
            f"{root}: {options.photographs} of {len(chosen)} photographs are used, evenly spread. "
            "data.sfm.photographs sets how many"
        )
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, options.photographs).round().astype(int)]
    return chosen, notices


def _each_once(root: Path, found: list[Path]) -> tuple[list[Path], list[str]]:
    """Without files of the same content, and without a telephone's originals beside the JPEG made of them."""
    stems = {path.with_suffix("") for path in found if path.suffix.lower() not in CONVERTED}
    single = [path for path in found if path.suffix.lower() not in CONVERTED or path.with_suffix("") not in stems]
    notices = []
    if len(single) < len(found):
        notices.append(f"{root}: {len(found) - len(single)} HEIC files are left aside: their JPEGs lie beside them")
    sizes: dict[int, list[Path]] = defaultdict(list)
    for path in single:
        sizes[path.stat().st_size].append(path)
    alike: dict[str, Path] = {}
    twice: list[tuple[Path, Path]] = []
    for paths in sizes.values():
        for path in paths if len(paths) > 1 else ():
            first = alike.setdefault(file_digest(path), path)
            if first is not path:
                twice.append((first, path))
    if twice:
        first, second = (path.relative_to(root).as_posix() for path in twice[0])
        notices.append(f"{root}: {len(twice)} photographs are there twice ('{second}' is '{first}'), and are used once")
    copies = {path for _, path in twice}
    return [path for path in single if path not in copies], notices
