"""COLMAP reconstructions, binary and text: `sparse/0` or `sparse` beside a folder of photographs."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..errors import DataError, unknown
from .formats import CaptureOptions, Format, Points, Scan, Shot
from .images import SUFFIXES
from .lens import Lens

if TYPE_CHECKING:
    import pycolmap

# COLMAP's order of parameters (its src/colmap/sensor/models.h): how many focal lengths come before cx, cy, then which
# of OpenCV's coefficients the others are, and whether they are of OpenCV's fisheye.
MODELS: dict[str, tuple[int, tuple[int, ...], bool]] = {
    "SIMPLE_PINHOLE": (1, (), False),
    "PINHOLE": (2, (), False),
    "SIMPLE_RADIAL": (1, (0,), False),
    "RADIAL": (1, (0, 1), False),
    "OPENCV": (2, (0, 1, 2, 3), False),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7), False),
    "SIMPLE_FISHEYE": (1, (), True),
    "FISHEYE": (2, (), True),
    "SIMPLE_RADIAL_FISHEYE": (1, (0,), True),
    "RADIAL_FISHEYE": (1, (0, 1), True),
    "OPENCV_FISHEYE": (2, (0, 1, 2, 3), True),
}
PARTS = ("cameras", "images", "points3D")


def find(source: Path) -> Path | None:
    """`source`, where it has a folder `sparse`."""
    return source if (source / "sparse").is_dir() else None


def read(source: Path, options: CaptureOptions) -> Scan:
    """Cameras, photographs and points. Raises DataError: no model, a damaged one, a camera model we cannot undistort,
    no folder of photographs."""
    folder, notices = _model_folder(source)
    model = _load(folder)
    photos = source / options.images
    if not photos.is_dir():
        raise DataError(f"{source}: has no folder '{options.images}' of photographs; name it with data.images")
    lenses = {number: lens(camera, folder) for number, camera in model.cameras.items()}
    images = [model.images[number] for number in model.reg_image_ids()]
    shots = [Shot(image.name, _viewmat(image), lenses[image.camera_id], photos / image.name) for image in images]
    registered = {image.name for image in images}
    present = sorted(p.relative_to(photos).as_posix() for p in photos.rglob("*") if p.suffix.lower() in SUFFIXES)
    aside = [name for name in present if name not in registered]
    if aside and shots:
        count = f"{len(aside)} of {len(present)} photographs are not registered in the reconstruction"
        notices.append(f"{photos}: {count} and are left out, first '{aside[0]}'")
    points = list(model.points3D.values())
    if not points:
        return Scan(shots, None, [*notices, f"{folder}: has no points to begin with"])
    xyz, rgb = np.array([p.xyz for p in points]), np.array([p.color for p in points]) / 255
    return Scan(shots, Points(torch.from_numpy(xyz).double(), torch.from_numpy(rgb).float()), notices)


def lens(camera: pycolmap.Camera, where: object = "camera") -> Lens:
    """OpenCV's form of a COLMAP camera. Raises DataError for a model that has none."""
    name, params = camera.model.name, [float(p) for p in camera.params]
    if name not in MODELS:
        remedy = "Undistort the capture first (colmap image_undistorter)."
        raise DataError(f"{unknown('camera model', name, MODELS, str(where))} {remedy}")
    focals, places, fisheye = MODELS[name]
    fx, fy, (cx, cy) = params[0], params[focals - 1], params[focals : focals + 2]
    distortion = [0.0] * (8 if len(places) > 4 else 4 if places or fisheye else 0)
    for place, value in zip(places, params[focals + 2 :], strict=True):
        distortion[place] = value
    return Lens(fx, fy, cx, cy, camera.width, camera.height, tuple(distortion), fisheye)


def _model_folder(source: Path) -> tuple[Path, list[str]]:
    """The folder of the model, and a notice where there are others beside it."""
    for folder in (source / "sparse" / "0", source / "sparse"):
        for suffix in (".bin", ".txt"):
            missing = [part + suffix for part in PARTS if not (folder / (part + suffix)).is_file()]
            if not missing:
                others = sorted(p.name for p in (source / "sparse").glob("[1-9]*") if p.is_dir())
                note = f"{source / 'sparse'}: has more models ({', '.join(others)}); only 0 is used"
                return folder, [note] if others and folder.name == "0" else []
            if len(missing) < len(PARTS):
                raise DataError(f"{folder}: the sparse model is incomplete, {', '.join(missing)} is missing")
    wanted = ", ".join(PARTS)
    raise DataError(f"{source}: has no sparse model: looked for {wanted} (.bin or .txt) in sparse/0 and in sparse")


def _load(folder: Path) -> pycolmap.Reconstruction:
    import pycolmap

    binary = folder / "cameras.bin"
    if binary.is_file():
        _require_whole(folder / "images.bin", _image_end)
        _require_whole(folder / "points3D.bin", _point_end)
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (RuntimeError, ValueError, IndexError, KeyError) as error:
        raise DataError(f"{folder}: the sparse model cannot be read, it may be damaged ({error})") from error
    # Per camera: id 4, model 4, width 8, height 8, parameters of 8 bytes.
    if binary.is_file() and binary.stat().st_size != 8 + sum(24 + 8 * len(c.params) for c in model.cameras.values()):
        raise DataError(f"{binary}: is truncated or damaged; copy it again")
    return model


def _require_whole(path: Path, end: Callable[[mmap.mmap, int], int]) -> None:
    """Raise DataError where a binary file does not end with its last record: of a truncated one, pycolmap takes
    whatever bytes as counts, and fills the memory. end: (file, where a record begins) -> where it ends."""
    size, place = path.stat().st_size, 8
    if size >= place:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (count,) = struct.unpack_from("<Q", data)
            while count and place < size:
                place, count = end(data, place), count - 1
        if place == size and count == 0:
            return
    raise DataError(f"{path}: is truncated or damaged; copy it again")


def _image_end(data: mmap.mmap, start: int) -> int:
    """id 4, pose 56, camera 4, name that ends with 0, count of keypoints 8, keypoints of 24 bytes."""
    name_end = data.find(b"\0", start + 64)
    return _after(data, name_end + 1, 24) if name_end >= 0 else len(data) + 1


def _point_end(data: mmap.mmap, start: int) -> int:
    """id 8, xyz 24, rgb 3, error 8, length of the track 8, its elements of 8 bytes."""
    return _after(data, start + 43, 8)


def _after(data: mmap.mmap, place: int, size: int) -> int:
    """Behind a count at `place` and as many elements of `size` bytes."""
    if place + 8 > len(data):
        return len(data) + 1
    return place + 8 + size * struct.unpack_from("<Q", data, place)[0]


def _viewmat(image: pycolmap.Image) -> np.ndarray:
    pose = image.cam_from_world
    pose = pose() if callable(pose) else pose  # a method since pycolmap 3.12, an attribute before
    return np.concatenate([pose.matrix(), [[0, 0, 0, 1.0]]])


FORMAT = Format("a folder sparse with a COLMAP model", find, read)
