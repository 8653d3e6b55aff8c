"""Masks: pictures that are missing or damaged, boxes that are none, and a cache that was disturbed."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from .cases import Case, Outcome, Place, arguments, case, launched
from .things import HEIGHT, SCENE, WIDTH

mask = partial(case, "mask")
KIND = ["system.mask.kind=files", "system.mask.options.folder=masks"]
BOX = ["system.mask.kind=box"]
TWO = {"cache": "masks-kept"}


def files(change: Callable[[Path], object], *more: str) -> Callable[[Place], Sequence[str]]:
    """An edit with a folder of masks that `change` has changed."""

    def given(place: Place) -> Sequence[str]:
        place.copy("scene.ply")
        place.copy("capture")
        change(place.copy("masks"))
        return [*SCENE, *KIND, *more]

    return given


def box(**options: object) -> Sequence[str]:
    """An edit inside of a box."""
    text = ", ".join(f"{key}: {value}" for key, value in options.items())
    return [*BOX, f"system.mask.options={{{text}}}"]


def picture(path: Path, width: int, height: int, dtype: type = np.uint8) -> None:
    path.write_bytes(cv2.imencode(".png", np.zeros((height, width), dtype))[1].tobytes())


def cached(name: str, spoil: Callable[[Path], object], *says: str, status: int = 0) -> Case:
    """An edit whose masks are kept in a folder, which `spoil` changes before a second edit."""

    def run(place: Place) -> Outcome:
        given = [*files(lambda folder: None)(place), "system.mask.cache=kept"]
        first = launched(place, arguments("closed-form", [*given, "name=first"]))
        if first.status != 0:
            return first
        (kept,) = (place.work / "kept").glob("*.pt")
        spoil(kept)
        place.root.with_suffix(".out").unlink()
        second = launched(place, arguments("closed-form", [*given, "name=second"]))
        second.lost = [name for name in second.lost if not name.startswith("work/kept/")]  # made again
        return second

    return Case("mask", f"cache: {name}", run, says, status, 60.0)


def flip(path: Path) -> None:
    """One bit in the middle of the file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def resaved(change: Callable[[dict], object]) -> Callable[[Path], None]:
    """Other content, saved as any program may."""

    def spoil(path: Path) -> None:
        state = torch.load(path, weights_only=True)
        change(state)
        torch.save(state, path)

    return spoil


def occupied(place: Place) -> Sequence[str]:
    place.write("kept", "a file")
    return [*files(lambda folder: None)(place), "system.mask.cache=kept"]


CASES: list[Case] = [
    mask("files: no folder given", ["system.mask.kind=files"], "folder"),
    mask("files: a folder that is not there", [*KIND], "masks", "no such folder"),
    mask("files: a file for the folder", lambda p: p.write("masks", "x") and KIND, "masks"),
    mask("files: an empty folder", files(lambda f: shutil.rmtree(f) or f.mkdir()), "no mask for"),
    mask(
        "files: three of them missing",
        files(lambda f: [(f / f"00{i}.png").unlink() for i in (1, 2, 3)]),
        "no mask for 3",
        "missing=true",
    ),
    mask(
        "files: JPEGs in place of PNGs",
        files(lambda f: [p.rename(p.with_suffix(".jpg")) for p in f.iterdir()]),
        "no mask for",
        ".jpg",
    ),
    mask("files: an empty PNG", files(lambda f: (f / "003.png").write_bytes(b"")), "003.png"),
    mask(
        "files: a PNG cut off",
        files(lambda f: (f / "003.png").write_bytes((f / "003.png").read_bytes()[:40])),
        "003.png",
    ),
    mask("files: text in a PNG", files(lambda f: (f / "003.png").write_text("no picture")), "003.png"),
    mask("files: of another shape", files(lambda f: picture(f / "003.png", 40, 10)), "003.png", "shape"),
    mask(
        "files: a folder named as a PNG",
        files(lambda f: (f / "003.png").unlink() or (f / "003.png").mkdir()),
        "003.png",
    ),
    mask("files: all black", files(lambda f: [picture(p, WIDTH, HEIGHT) for p in list(f.iterdir())]), "mask"),
    mask(
        "files: an option with a typo",
        files(lambda f: None, "system.mask.options.fodler=masks"),
        "'fodler'",
        "'folder'",
    ),
    mask("box: no options", BOX, "low"),
    mask("box: a corner too few", box(low=[0, 0, 0]), "low"),
    mask("box: two numbers", box(low=[0, 0], high=[1, 1]), "low"),
    mask("box: low above high", box(low=[1, 1, 1], high=[0, 0, 0]), "low"),
    mask("box: NaN", box(low=[".nan", 0, 0], high=[1, 1, 1]), "low"),
    mask("box: infinite", box(low=[0, 0, 0], high=[1, 1, ".inf"]), "high"),
    mask("box: outside of the scene", box(low=[900, 900, 900], high=[901, 901, 901]), "mask"),
    mask("box: box and sphere", box(low=[0, 0, 0], high=[1, 1, 1], center=[0, 0, 0], radius=1), "center"),
    mask("sphere: radius 0", box(center=[0, 0, 0], radius=0), "radius"),
    mask("sphere: radius NaN", box(center=[0, 0, 0], radius=".nan"), "radius"),
    mask("sphere: centre NaN", box(center=[".nan", 0, 0], radius=1), "center"),
    mask("rectangle: a view that is not there", box(view="'999'", window=[0, 0, 1, 1]), "view", "999"),
    mask("rectangle: right before left", box(view="'1'", window=[0.9, 0, 0.1, 1]), "window"),
    mask("rectangle: NaN", box(view="'1'", window=[0, 0, ".nan", 1]), "window"),
    mask("rectangle: outside of the view", box(view="'1'", window=[9000, 0, 9100, 10]), "window"),
    mask("kept: splats without a mask", ["system.mask.kind=kept"], "kept"),
    mask("text: no words", ["system.mask.kind=text"], "text"),
    mask(
        "text: a model that is not there",
        ["system.mask.kind=text", "system.mask.options={text: bear, model: no/no}"],
        "mask",
    ),
    mask("cache: a file where its folder should be", occupied, "kept"),
    cached("a flipped bit is found and the mask made again", flip, "made again"),
    cached("an empty file is made again", lambda p: p.write_bytes(b""), "made again"),
    cached(
        "weights of whole numbers are made again", resaved(lambda s: s.update(weights=s["weights"].int())), "made again"
    ),
    cached(
        "weights of NaN are made again", resaved(lambda s: s.update(weights=s["weights"] * float("nan"))), "made again"
    ),
    cached("weights of text are made again", resaved(lambda s: s.update(weights="all")), "made again"),
    cached(
        "weights of too few splats are made again", resaved(lambda s: s.update(weights=s["weights"][:-5])), "made again"
    ),
    cached("a list in place of all is made again", lambda p: torch.save([1, 2], p), "made again"),
]
