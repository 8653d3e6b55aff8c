"""Masks of photographs: what of each counts in a fit. People and skies that move are left out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..errors import DataError
from .formats import Shot
from .images import image_size, there


def masked(shots: Sequence[Shot], folder: str, source: Path) -> tuple[list[Shot], list[str]]:
    """The photographs of the capture `source` with their masks, and what the user must know of them.

    folder: of masks, in the capture or elsewhere: `<name>.png` for a photograph called so with its suffix (COLMAP's
    convention), or with .png in place of it. Empty: those that the shots name. Raises DataError for a folder in which
    there are none, and for a mask that is not there or of another size than its photograph.
    """
    if folder:
        beside = (source if source.is_dir() else source.parent) / folder
        place = beside if there(beside) else Path(folder).expanduser()
        if not there(place) or not place.is_dir():
            raise DataError(f"data.masks: there is no folder '{folder}', neither in {source} nor elsewhere")
        shots = [replace(shot, mask=_of(shot, place)) for shot in shots]
        if all(shot.mask is None for shot in shots):
            held = ", ".join(sorted(path.name for path in place.iterdir())[:4]) or "nothing"
            raise DataError(
                f"data.masks: {place}: holds a mask of none of the {len(shots)} photographs. Looked for "
                f"'{shots[0].name}.png', found {held}"
            )
    for shot in shots:
        if shot.mask is not None and shot.path is not None:
            if not there(shot.mask):
                raise DataError(
                    f"{source}: the mask {shot.mask} of '{shot.name}' is missing. Put it there, or set data.masks"
                )
            size, expected = image_size(shot.mask), image_size(shot.path)
            if size != expected:
                got, due = (f"{width}x{height}" for width, height in (size, expected))
                raise DataError(f"{shot.mask}: is {got}, and its photograph {due}: make the mask as large")
    without = sum(shot.mask is None for shot in shots)
    if 0 < without < len(shots):
        return list(shots), [f"{without} of {len(shots)} photographs have no mask, and count whole"]
    return list(shots), []


def _of(shot: Shot, folder: Path) -> Path | None:
    name = Path(shot.name)
    names = (folder / f"{shot.name}.png", folder / name.with_suffix(".png"), folder / f"{name.name}.png")
    return next((path for path in (*names, folder / f"{name.stem}.png") if there(path)), None)
