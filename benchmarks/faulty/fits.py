"""Fits: what is asked of them, the masks of photographs, and what is kept of fits on the way to an edit."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from .cases import Case, Outcome, Place, arguments, case, launched
from .things import HEIGHT, WIDTH

fit = partial(case, "fit", config="fit")
first = partial(case, "fit on the way")
BRIEF = ["data.source=capture", "system.first_fit.steps=2"]


def photographs(*more: str, change: Callable[[Path], object] = bool) -> Callable[[Place], Sequence[str]]:
    """A COLMAP capture with masks; `change` has changed its folder."""

    def given(place: Place) -> Sequence[str]:
        folder = place.copy("colmap", "capture")
        place.copy("masks", "capture/masks")
        change(folder)
        return [*BRIEF[: 1 if more and more[0] == "fit" else 2], *(m for m in more if m != "fit")]

    return given


def of_fit(*more: str, change: Callable[[Path], object] = bool) -> Callable[[Place], Sequence[str]]:
    """The same for a run of configs/fit.yaml."""
    return photographs("fit", *more, change=change)


def picture(name: str, width: int = WIDTH, height: int = HEIGHT) -> Callable[[Path], object]:
    """A mask of another size."""
    png = cv2.imencode(".png", np.full((height, width), 255, np.uint8))[1].tobytes()
    return lambda folder: (folder / name).write_bytes(png)


def kept(name: str, spoil: Callable[[Path], object], *says: str, status: int = 0) -> Case:
    """An edit that finds a kept fit which `spoil` has changed."""

    def run(place: Place) -> Outcome:
        before = os.environ.get("DREAMCATALYST_CACHE")
        os.environ["DREAMCATALYST_CACHE"] = str(place.root / "kept")
        try:
            given = arguments("closed-form", ["--test", *photographs()(place), "data.max_side=null"])
            made = launched(place, [*given, "name=first"])
            if made.status != 0:
                return made
            (folder,) = (path for path in (place.root / "kept/fits").iterdir() if path.is_dir())
            spoil(folder)
            place.root.with_suffix(".out").unlink()
            second = launched(place, [*given, "name=second"])
            second.lost = [lost for lost in second.lost if not lost.startswith("kept/")]  # made again
            return second
        finally:
            os.environ.pop("DREAMCATALYST_CACHE") if before is None else os.environ.update(DREAMCATALYST_CACHE=before)

    return Case("fit on the way", f"kept: {name}", run, says, status, 60.0)


CASES = [
    first("an unknown key", photographs("system.first_fit.stps=3"), "system.first_fit", "'steps'"),
    first("steps below zero", photographs("system.first_fit.steps=-1"), "system.first_fit.steps", "0 or more"),
    first("a part of a step", photographs("system.first_fit.steps=1.5"), "system.first_fit.steps", "1.5"),
    first("a key that a fit has not", photographs("system.first_fit.system.sh_dgree=1"), "first_fit", "'sh_degree'"),
    first("a value that a fit refuses", photographs("system.first_fit.system.sh_degree=4"), "sh_degree", "[0, 3]"),
    first("a section that is a number", photographs("system.first_fit.system=1"), "system.first_fit.system", "1"),
    first("none, where it is needed", photographs("system.first_fit.steps=0"), "system.gs_source: no splats are given"),
    first(
        "words that the prior does not know",
        photographs("system.prompt_processor.prompt=Fly to the moon"),
        "does not know the instruction 'Fly to the moon'",
    ),
    first(
        "a photograph that is cut short",
        photographs(change=lambda f: (f / "images/003.png").write_bytes((f / "images/003.png").read_bytes()[:200])),
        "003.png",
        "cut off",
    ),
    kept("the splats are cut short", lambda f: (f / "save/last.ply").write_bytes(b"ply"), "is fitted again"),
    kept("what is written of it is no JSON", lambda f: (f / "fit.json").write_text("{"), "is fitted again"),
    fit("density control of another name", of_fit("system.densify.strategy=mcm"), "system.densify.strategy", "'mcmc'"),
    fit(
        "an option that sampling has not",
        of_fit("system.densify.strategy=mcmc", "system.densify.options={nose: 1}"),
        "system.densify.options",
        "'noise'",
    ),
    fit("a growth above all", of_fit("system.densify={strategy: mcmc, options: {growth: 2}}"), "growth", "[0, 1]"),
    fit("an exposure below zero", of_fit("system.exposure=-0.1"), "system.exposure", "0 or more"),
    fit("more coarse steps than there are", of_fit("system.coarse=1.5"), "system.coarse", "[0, 1]"),
    fit("a background that is a colour", of_fit("system.random_background=white"), "system.random_background", "white"),
    fit("masks in a folder that is not there", of_fit("data.masks=mask"), "data.masks", "no folder 'mask'"),
    fit("masks of other photographs", of_fit("data.masks=sparse"), "data.masks", "none of the 8 photographs"),
    fit(
        "a mask of another size",
        of_fit("data.masks=masks", change=picture("masks/002.png", WIDTH + 1)),
        "002.png",
        f"{WIDTH + 1}x{HEIGHT}",
    ),
    fit(
        "a mask that is no picture",
        of_fit("data.masks=masks", change=lambda folder: (folder / "masks/002.png").write_bytes(b"no picture")),
        "002.png",
    ),
    fit("words without a model", of_fit("system.leave_out={text: sky, path: models/none}"), "models/none"),
]
