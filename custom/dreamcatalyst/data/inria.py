"""Cameras without photographs: the `cameras.json` that 3DGS training writes beside its splats."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..errors import DataError
from .formats import CaptureOptions, Format, Scan, Shot, read_json
from .lens import Lens

NAME = "cameras.json"
KEYS = ("width", "height", "position", "rotation", "fx", "fy")


def find(source: Path) -> Path | None:
    """The file itself, or the one in the folder `source`."""
    path = source if source.name == NAME else source / NAME
    return path if path.is_file() else None


def beside(splats: Path) -> Path | None:
    """The cameras.json of the 3DGS run that wrote this PLY: in its folder or up to two above
    (<run>/point_cloud/iteration_30000/point_cloud.ply)."""
    if splats.is_symlink() and not splats.exists():  # such as one that leads to itself
        return None
    return next((path for folder in list(splats.resolve().parents)[:3] if (path := find(folder)) is not None), None)


def read(path: Path, options: CaptureOptions) -> Scan:
    """Cameras of a list of {img_name, width, height, position, rotation, fx, fy}: position and rotation are camera to
    world, OpenCV axes; the principal point is the middle. Raises DataError where a key is missing or misshapen."""
    entries = read_json(path)
    if not isinstance(entries, list):
        raise DataError(f"{path}: expected a list of cameras as 3DGS writes it, got {type(entries).__name__}")
    return Scan([_shot(path, i, entry) for i, entry in enumerate(entries)], None, [])


def _shot(path: Path, index: int, entry: object) -> Shot:
    if not isinstance(entry, dict):
        raise DataError(f"{path}: camera {index} is {entry!r}, expected an object with {', '.join(KEYS)}")
    missing = [key for key in KEYS if key not in entry]
    if missing:
        raise DataError(f"{path}: camera {index} has no '{missing[0]}' (found {', '.join(entry)})")
    try:
        rotation = np.array(entry["rotation"], np.float64).reshape(3, 3)
        position = np.array(entry["position"], np.float64).reshape(3)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}: camera {index} has a pose that is not of 3x3 and 3 numbers ({error})") from None
    for key in ("width", "height", "fx", "fy"):
        if not isinstance(entry[key], (int, float)) or isinstance(entry[key], bool) or not math.isfinite(entry[key]):
            raise DataError(f"{path}: camera {index}: '{key}' is {entry[key]!r}, expected a number")
    width, height, fx, fy = int(entry["width"]), int(entry["height"]), float(entry["fx"]), float(entry["fy"])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ position
    name = str(entry.get("img_name", f"{index:05d}"))
    return Shot(name, viewmat, Lens(fx, fy, width / 2, height / 2, width, height), None)


FORMAT = Format("cameras.json of a 3DGS run", find, read)
