"""What a splat format is, and the one entrance for reading and writing: content decides which format a file is of."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from ...config import parse
from ...data.origin import ZERO, Origin, far_origin
from ...errors import ConfigError, SceneError
from ...memory import free_memory
from ...registry import Registry
from ..finite import drawable, finite
from ..gaussians import Gaussians

SPLATS = Registry("splat format", __package__)
SPLATS.add("ply", ".ply:FORMAT")
SPLATS.add("compressed-ply", ".compressed_ply:FORMAT")
SPLATS.add("spz", ".spz:FORMAT")
SPLATS.add("sog", ".sog:FORMAT")
SPLATS.add("gltf", ".gltf:FORMAT")
SPLATS.add("splat", ".splat:FORMAT")
SPLATS.add("ksplat", ".ksplat:FORMAT")

HEAD = 4096  # bytes from the beginning that a format is recognised by
RENDERED = 240  # bytes of a splat with SH degree 3 as it is held, float32


@dataclass(frozen=True)
class NoOptions:
    """Of a format whose files are all written alike."""


@dataclass(frozen=True)
class Found:
    """What a format reads. notices: sentences for the user about what was left aside or understood in a way of its
    own."""

    scene: Gaussians
    notices: Sequence[str] = ()


@dataclass(frozen=True)
class SplatFormat:
    """A splat format: one file that defines one and registers it in SPLATS is enough.

    title: in words. suffixes: ends of its files' names, the usual one first. detect(path, head): whether a file is of
    it, by its first HEAD bytes; a format without a mark of its own returns False, and is known by its name.
    read(path, origin): splats with raw parameters, positions from `origin`; raises SceneError.
    write(stem, scene, origin, comments, options): writes the file `stem` + suffix whole or not at all, and returns its
    path; None for a format that is read alone. options: a dataclass of what may be asked for when writing.
    loses: what the file does not hold exactly, in words; empty: everything is exact. sh_degree: the highest it holds.
    extras: whether further columns are kept. order(scene): the rows in the order in which they are best written.
    comments(path): what was written as comments, from where the format keeps such. implied: options that go with a
    suffix, where it is asked for by a file's name.
    """

    title: str
    suffixes: tuple[str, ...]
    detect: Callable[[Path, bytes], bool]
    read: Callable[[Path, Origin], Found]
    write: Callable[..., Path] | None = None
    options: type = NoOptions
    loses: str = ""
    sh_degree: int = 3
    extras: bool = False
    order: Callable[[Gaussians], Tensor] | None = None
    comments: Callable[[Path], list[str]] | None = None
    implied: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Written:
    """A file, and the splats that went into it, in its order. left_out: what it has no place for, in words."""

    path: Path
    scene: Gaussians
    left_out: Sequence[str] = ()


# --- reading


def read_splats(
    path: str | Path, *, drop_nonfinite: bool = False, origin: Origin = ZERO, quiet: bool = False
) -> Gaussians:
    """Splats of a file of any format, to be drawn: without NaN and Inf, and without positions and scales whose squares
    float32 does not hold, as they come of files whose scales are no logarithms.

    Content decides the format, whatever the name says. drop_nonfinite: leave such splats out and print how many,
    instead of raising. origin: the point of the file's world that becomes (0,0,0). quiet: without what there is to say
    of the file. Raises SceneError.
    """
    path, format, notices = find_format(path)
    found = format.read(path, origin)
    for notice in [] if quiet else [*notices, *found.notices]:
        print(f"{path}: {notice}")
    return drawable(path, found.scene, drop_nonfinite, origin)


def splat_origin(path: str | Path) -> Origin:
    """Where the splats (or points) of a file lie, for `read_splats`, by up to ten thousand of them; zero unless they
    are far away. Raises SceneError as `read_splats` does where there is no such file."""
    path, format, _ = find_format(path)
    if format is SPLATS.get("ply"):  # which may hold plain points, and positions as doubles
        from ..ply import ply_origin

        return ply_origin(path)
    means = format.read(path, ZERO).scene.means
    some = means[:: max(1, len(means) // 10_000)].double().numpy()
    return far_origin(some[torch.from_numpy(some).isfinite().all(dim=1).numpy()])


def read_comments(path: str | Path) -> list[str]:
    """The comments that a splat file carries; none in formats without a place for them. Raises SceneError."""
    path, format, _ = find_format(path)
    return [] if format.comments is None else format.comments(path)


def find_format(path: str | Path) -> tuple[Path, SplatFormat, list[str]]:
    """The file to read, its format, and what there is to say of its name. path: a file, or a folder that is one splat
    file of several parts. Raises SceneError where there is no file, or where it is of no known format."""
    path = Path(path)
    if path.is_dir() and (path / "meta.json").is_file():
        path = path / "meta.json"
    if path.is_dir():
        raise SceneError(f"{path}: is a folder, expected a splat file (or the folder of a SOG, with its meta.json)")
    if not path.is_file():
        beside = [other.name for other in path.parent.glob("*")] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, beside, n=1, cutoff=0.8)
        raise SceneError(f"{path}: no such file." + (f" Did you mean '{path.with_name(near[0])}'?" if near else ""))
    with path.open("rb") as file:
        head = file.read(HEAD)
    formats, by_name = [SPLATS.get(name) for name in SPLATS.names()], named(path)
    for format in formats:
        if format.detect(path, head):
            other = by_name is not None and not path.name.lower().endswith(format.suffixes)
            return path, format, [f"is a {format.title}, whatever its name says"] if other else []
    if by_name is None:
        known = "; ".join(f"{format.title} ({', '.join(format.suffixes)})" for format in formats)
        raise SceneError(f"{path}: is no splat file that is known by its content or its name. Known: {known}")
    return path, by_name[0], []


def named(path: str | Path) -> tuple[SplatFormat, str] | None:
    """The format that a file's name speaks of, and its suffix: the longest that fits; None for other names."""
    lower = Path(path).name.lower()
    fits = [
        (len(suffix), -place, name, suffix)
        for name in SPLATS.names()
        for place, suffix in enumerate(SPLATS.get(name).suffixes)
        if lower.endswith(suffix)
    ]
    if not fits:
        return None
    _, _, name, suffix = max(fits)
    return SPLATS.get(name), suffix


def require_room(path: Path, count: int, bytes_each: float = RENDERED) -> None:
    """Raise SceneError where memory does not hold `count` splats, as a damaged or malicious file may promise them."""
    needed, free = count * bytes_each, free_memory()
    if needed > free:
        raise SceneError(
            f"{path}: promises {count} splats, which take {needed / 2**30:.1f} GiB; {free / 2**30:.1f} GiB are free"
        )


# --- writing


def write_splats(
    stem: str | Path,
    scene: Gaussians,
    format: str = "ply",
    *,
    options: Mapping[str, Any] | None = None,
    origin: Origin = ZERO,
    comments: Sequence[str] = (),
) -> Written:
    """Write splats as the file `stem` with the suffix of `format`, whole or not at all; folders are made as needed.

    options: what the format may be asked for. origin: the point of the file's world that is (0,0,0) in `scene`.
    comments: lines of ASCII. Raises ConfigError for a format that is not known or only read, and for its options,
    SceneError for splats that it cannot hold, FileError where the file cannot be written.
    """
    kind, parsed = writer(format, options or {})
    stem, scene = Path(stem), scene.detach().to("cpu")
    left_out = []
    if scene.extra and not kind.extras:
        left_out.append(f"the extra columns {', '.join(sorted(scene.extra))}")
    if scene.sh_degree > kind.sh_degree:
        left_out.append(f"colours that depend on the view (SH above degree {kind.sh_degree})")
    if comments and kind.comments is None:
        left_out.append(f"the comments ({'; '.join(comments)})")
    if kind.loses:
        scene = finite(stem, scene, drop=False)
    if kind.order is not None:
        scene = scene[kind.order(scene)]
    write = cast(Callable[..., Path], kind.write)
    return Written(write(stem, scene, origin, comments, parsed), scene, left_out)


def writer(format: str, options: Mapping[str, Any]) -> tuple[SplatFormat, Any]:
    """A format that can be written, and its options. Raises ConfigError."""
    kind: SplatFormat = SPLATS.get(format, "export.format")
    if kind.write is None:
        known = ", ".join(name for name in SPLATS.names() if SPLATS.get(name).write is not None)
        raise ConfigError(f"export.format: '{format}' is only read, not written. Written are: {known}.")
    return kind, parse(kind.options, options, "export.options")


def with_suffix(stem: Path, suffix: str) -> Path:
    """The file's path; a stem may have dots in its name."""
    return stem.with_name(stem.name + suffix)
