"""Folders that cannot be written, are files, or hold another run; and --link."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from .cases import Case, Outcome, Place, arguments, case, command, launched
from .things import NAMED, SCENE

G, L = "folders", "--link"


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder in which nothing can be made, whoever tries: for root, who may all, a file system that is read-only."""
    folder.mkdir(parents=True, exist_ok=True)
    if os.geteuid() == 0:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", str(folder)], check=True)
        try:
            yield
        finally:
            subprocess.run(["umount", str(folder)], check=True)
    else:
        folder.chmod(0o500)
        try:
            yield
        finally:
            folder.chmod(0o700)


def locked(name: str, place_of: str, given: Callable[[Place], Sequence[str]], *says: str, **options: object) -> Case:
    """A launch while a folder is read-only."""

    def run(place: Place) -> Outcome:
        words = given(place)
        with read_only(place.work / place_of):
            return launched(place, words)

    return Case(options.pop("group", G), name, run, says, **options)


def in_the_way(name: str) -> Callable[[Place], Sequence[str]]:
    """A file where the run would make a folder."""
    return lambda place: place.write(name, "a file") and NAMED


def finished(place: Place) -> Sequence[str]:
    place.take("edit")
    return [*SCENE, *NAMED]


def kept_all(place: Place, outcome: Outcome) -> list[str]:
    """A file that a run replaces was lost, also where the run goes on."""
    return [f"replaced: {name}" for name in outcome.lost]


def host(change: Callable[[Path], object]) -> Callable[[Place], Sequence[str]]:
    """--link into a threestudio that `change` has changed."""

    def given(place: Place) -> Sequence[str]:
        change(place.copy("host"))
        return ["--link", "host"]

    return given


def linked(change: Callable[[Path], object], name: str, *says: str, status: int = 2) -> Case:
    return command(L, name, host(change), *says, status=status)


def looped(path: Path) -> None:
    """A link that leads to itself."""
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(path.name)


def two_systems(place: Place) -> Outcome:
    """Inputs on a file system that cannot be written."""
    with read_only(place.work / "elsewhere"):
        return launched(place, arguments("closed-form", []))


CASES: list[Case] = [
    locked("exp_root_dir cannot be written", "outputs", lambda p: arguments("closed-form", []), "outputs"),
    case(G, "exp_root_dir is a file", in_the_way("outputs"), "outputs"),
    case(G, "the experiment's folder is a file", in_the_way("outputs/closed-form"), "outputs/closed-form"),
    case(G, "the trial's folder is a file", in_the_way("outputs/closed-form/trial"), "outputs/closed-form/trial"),
    *(
        case(G, f"{name} is a file", in_the_way(f"outputs/closed-form/trial/{name}"), "outputs/closed-form/trial")
        for name in ("save", "ckpts", "configs", "report", "csv_logs")
    ),
    case(G, "exp_root_dir in a folder that takes none", ["exp_root_dir=/proc/outputs"], "/proc/outputs"),
    case(G, "exp_root_dir of 5000 characters", ["exp_root_dir=" + "long/" * 1000], "long/"),
    case(G, "exp_root_dir is a link to itself", lambda p: looped(p / "outputs") or [], "outputs"),
    case(G, "a finished run of the same name, without a time", finished, "trial"),
    locked(
        "the photographs cannot be written to",
        "none",
        lambda p: arguments(
            "closed-form", [f"system.gs_source={p.copy('scene.ply').name}", f"data.source={p.copy('capture').name}"]
        ),
        "wrote",
        status=0,
        seconds=30,
    ),
    command(L, "a folder that is not there", ["--link", "nowhere"], "--link", "nowhere"),
    command(L, "a file", lambda p: ["--link", p.write("a", "x").name], "--link"),
    command(L, "no threestudio", lambda p: (p / "a").mkdir() or ["--link", "a"], "no threestudio"),
    linked(lambda h: (h / "custom/dreamcatalyst").mkdir(), "a folder of that name there", "is something else"),
    linked(lambda h: looped(h / "custom/dreamcatalyst"), "a link to itself there", "--link"),
    linked(lambda h: looped(h / "configs"), "its configs are a link to itself", "--link", "configs"),
    linked(lambda h: (h / "configs").write_text("x"), "its configs are a file", "--link", "configs"),
    linked(
        lambda h: (h / "custom").rmdir() or (h / "custom").write_text("x"), "its custom is a file", "--link", "custom"
    ),
    linked(lambda h: (h / "custom/dreamcatalyst").symlink_to("/nowhere/at/all"), "a link to nowhere there", "--link"),
    locked("its custom cannot be written", "host/custom", host(lambda h: None), "--link", group=L),
]
