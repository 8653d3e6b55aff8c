"""Opening a capture: its format is found, and what it says is checked before anything is made of it."""

from __future__ import annotations

import filecmp
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..errors import DataError
from .camera import Cameras
from .formats import FORMATS, CaptureOptions, Format, Points, Shot
from .images import Photo, image_size, there
from .lens import Lens
from .masks import masked
from .origin import ZERO, Origin, far_origin
from .sizes import fit, require_memory
from .transforms import splats_from_capture
from .views import Capture, View, split

FARTHEST = 1e15  # world units; float32 holds its square
DEFAULTS = CaptureOptions()
DECODED, UNDISTORTED = 12, 24  # bytes per pixel of a photograph at most while it is decoded, and undistorted


def open_capture(source: str | Path, options: CaptureOptions = DEFAULTS) -> Capture:
    """Read the cameras of a capture and check that its photographs are there; pixels are read when asked for.

    source: a folder (or the JSON file itself) of one of FORMATS, or a name with the prefix of one. Raises DataError:
    no such folder, none of the formats, photographs missing or of another shape than their camera, no view left to
    train on, a dataparser that cannot be read.
    """
    format, path = find_format(source, options)
    scan = format.read(path, options)
    if not scan.shots:
        raise DataError(f"{path}: is an empty reconstruction: no photograph has a camera. Reconstruct it again")
    shots = sorted(scan.shots, key=lambda shot: shot.name)
    _check(path, shots)
    shots, masks = masked(shots, options.masks, Path(source))
    shots, points, origin = _recentred(shots, scan.points)
    views = [_view(shot, options) for shot in shots]
    train, test = split(len(views), options, path)
    notices, found = (*scan.notices, *masks), scan.found
    capture = Capture(path, views, train, test, points, notices, options, origin, scan.scene, scan.truths, found)
    if not options.dataparser:
        return capture
    back = torch.eye(4, dtype=torch.float64)
    back[:3, 3] = torch.tensor(origin, dtype=torch.float64)
    return capture.transformed(splats_from_capture(options.dataparser, path).double() @ back)


def has_prefix(source: str | Path) -> bool:
    """Whether `source` begins as those of a format do that are no paths (demo:statue)."""
    return any(format.prefix and str(source).startswith(format.prefix) for format in FORMATS.parts())


def find_format(source: str | Path, options: CaptureOptions) -> tuple[Format, Path]:
    """Which format `source` is of, and the path that it reads. Raises DataError where it is of none."""
    source = Path(source)
    names = FORMATS.names() if options.format is None else [options.format]
    formats = {name: FORMATS.get(name, "data.format") for name in names}
    if not there(source) and not has_prefix(source):
        raise DataError(f"data.source: {source}: no such file or folder")
    for format in formats.values():
        if str(source).startswith(format.prefix) and (path := format.find(source)) is not None:
            return format, path
    wanted = "; ".join(f"{name}: {format.looks_for}" for name, format in formats.items())
    held = "no such file or folder" if not there(source) else "a file"
    if there(source) and source.is_dir():
        held = ", ".join(sorted(p.name for p in source.iterdir())[:8])
    raise DataError(f"data.source: {source}: is no capture. Looked for {wanted}. Found {held or 'nothing'}")


def _check(source: Path, shots: list[Shot]) -> None:
    missing = [shot for shot in shots if shot.path is not None and not (there(shot.path) and shot.path.is_file())]
    if missing:
        count = f"{len(missing)} of {len(shots)} photographs are missing"
        raise DataError(f"{source}: {count}, first '{missing[0].path}'. Put them there, or set data.images")
    _require_different(source, shots)
    for shot in shots:
        shot.lens.check(f"{source}: the camera of '{shot.name}'")
        rotation = shot.viewmat[:3, :3]
        if not (np.abs(shot.viewmat) < FARTHEST).all():
            raise DataError(f"{source}: the pose of '{shot.name}' is not of finite numbers")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2) or not np.linalg.det(rotation) > 0:
            raise DataError(f"{source}: the pose of '{shot.name}' is not a rotation and a translation")


def _require_different(source: Path, shots: list[Shot]) -> None:
    """Raise DataError where one photograph stands there twice, under one name or as two files: what is held out would
    also be trained on."""
    paths: dict[Path, Shot] = {}
    poses: dict[bytes, list[Shot]] = {}
    for shot in shots:
        if shot.path is None:
            continue
        alike = [paths.get(shot.path.resolve()), *poses.get(shot.viewmat.tobytes(), ())]
        other = next((o for o in alike if o and (o.path == shot.path or filecmp.cmp(o.path, shot.path, False))), None)
        if other is not None:
            names = f"'{shot.name}'" if other.name == shot.name else f"'{other.name}' and '{shot.name}'"
            raise DataError(f"{source}: the photograph {names} is there twice. Take one out: one may be held out")
        paths[shot.path.resolve()] = shot
        poses.setdefault(shot.viewmat.tobytes(), []).append(shot)


def _recentred(shots: list[Shot], points: Points | None) -> tuple[list[Shot], Points | None, Origin]:
    """Cameras and points (float32) of a world that is far away moved to its middle, and where that is."""
    origin = far_origin(np.stack([-shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3] for shot in shots]))
    if points is not None:
        xyz = points.xyz.double() - torch.tensor(origin, dtype=torch.float64)
        points = Points(xyz.float(), points.rgb)
    if origin == ZERO:
        return shots, points, origin
    moved = []
    for shot in shots:
        viewmat = shot.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ np.array(origin)
        moved.append(replace(shot, viewmat=viewmat))
    return moved, points, origin


def _view(shot: Shot, options: CaptureOptions) -> View:
    lens = shot.lens if shot.path is None else _at_file_size(shot.lens, shot.path)
    if shot.path is not None:
        each, size = UNDISTORTED if lens.distorted else DECODED, f"{lens.width}x{lens.height}"
        require_memory(lens.width * lens.height * each, f"{shot.path}: {size} pixels", "Make smaller copies")
    window, width, height = fit(lens.width, lens.height, options)
    try:
        K, viewmat = torch.from_numpy(lens.pinhole().K), torch.from_numpy(shot.viewmat)
    except DataError as error:
        raise DataError(f"'{shot.name}': {error}") from error
    camera = Cameras(viewmat[None], K[None], lens.width, lens.height).cropped(*window).resized(width, height)
    photo = None if shot.path is None else Photo(shot.path, lens, window, width, height, shot.mask)
    return View(shot.name, camera.to(dtype=torch.float32), photo)


def _at_file_size(lens: Lens, path: Path) -> Lens:
    """The lens at the size of the image file, which may be a smaller copy (images_4) but not of another shape."""
    width, height = image_size(path)
    if abs(width * lens.height - height * lens.width) > 1.5 * max(lens.width, lens.height):  # 1.5 px: rounded copies
        turned = abs(width * lens.width - height * lens.height) <= 1.5 * max(lens.width, lens.height)
        hint = " It lies on its side: reconstruct with EXIF orientation removed." if turned else ""
        shapes = f"is {width}x{height}, which is not the shape of its camera, {lens.width}x{lens.height}"
        raise DataError(f"{path}: {shapes}.{hint}")
    return lens.scaled(width, height)
