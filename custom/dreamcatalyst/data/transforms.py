"""nerfstudio's `transforms.json`, and the `dataparser_transforms.json` that leads from a capture to its splats."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from ..config import Range
from ..errors import DataError, unknown
from .formats import CaptureOptions, Format, Points, Scan, Shot, read_json
from .images import SUFFIXES, image_size, there
from .lens import FINITE, FOCAL, SIDE, Lens

NAME = "transforms.json"
FISHEYE = {"OPENCV_FISHEYE"}
MODELS = {"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", *FISHEYE}
NUMBERS = {
    **dict.fromkeys(("w", "h"), SIDE),
    **dict.fromkeys(("fl_x", "fl_y"), FOCAL),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), Range("(0, 3.1416)")),  # radians, of the whole side
    **dict.fromkeys(("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"), FINITE),
}
POSITIVE = Range("(0, inf)")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: y up, z backward -> y down, z forward


def find(source: Path) -> Path | None:
    """The file itself, or the one in the folder `source`."""
    path = source if source.suffix == ".json" and source.name.startswith("transforms") else source / NAME
    return path if path.is_file() else None


def read(path: Path, options: CaptureOptions) -> Scan:
    """Frames with intrinsics of their own or of the whole file. Raises DataError: a missing key, an unknown camera
    model, a matrix of another shape, a point cloud that is named but missing. A missing w, h is the photograph's size.
    """
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
        raise DataError(f"{path}: has no list 'frames', expected nerfstudio's transforms.json")
    shots = [_shot(path, meta, i, frame) for i, frame in enumerate(meta["frames"])]
    notices = []
    if "applied_transform" in meta:
        notices.append(
            f"{path}: its world is turned against that of the reconstruction (applied_transform); splats fitted to "
            "the COLMAP model do not belong to these cameras"
        )
    return Scan(shots, _points(path, meta), notices)


def splats_from_capture(dataparser: str | Path, source: Path) -> Tensor:
    """The similarity [4,4] from the world of a capture to that of the splats which nerfstudio trained on it.

    dataparser: dataparser_transforms.json of the export or training run: x_splats = scale (transform x_original).
    source: Capture.source. The world of a transforms.json is itself applied_transform of the original one (nerfstudio
    multiplies it and applied_scale into what it saves), that of any other capture is the original.
    Use with Capture.transformed. Raises DataError where keys are missing or misshapen.
    """
    path = Path(dataparser)
    saved = read_json(path)
    if not isinstance(saved, dict) or not {"transform", "scale"} <= saved.keys():
        raise DataError(f"{path}: expected the keys 'transform' and 'scale' of nerfstudio's dataparser_transforms.json")
    meta = read_json(source) if source.suffix == ".json" else {}
    meta = meta if isinstance(meta, dict) else {}
    applied = _matrix(meta.get("applied_transform", np.eye(4)), f"{source}: applied_transform")
    out = _matrix(saved["transform"], f"{path}: transform") @ np.linalg.inv(applied)
    applied_scale = _number(meta.get("applied_scale", 1.0), "applied_scale", str(source), POSITIVE)
    out[:3] *= _number(saved["scale"], "scale", str(path), POSITIVE) / applied_scale
    scaled = out[:3, :3] @ out[:3, :3].T / np.cbrt(np.linalg.det(out[:3, :3])) ** 2
    if not np.linalg.det(out[:3, :3]) > 0 or not np.allclose(scaled, np.eye(3), atol=1e-2):
        raise DataError(f"{path}: transform: is not a rotation and a translation")
    return torch.from_numpy(out)


def _shot(path: Path, meta: dict, index: int, frame: object) -> Shot:
    where = f"{path}: frame {index}"
    if not isinstance(frame, dict):
        raise DataError(f"{where} is {type(frame).__name__}, expected an object with 'file_path', 'transform_matrix'")
    for key in ("file_path", "transform_matrix"):
        if key not in frame:
            raise DataError(f"{where} has no '{key}' (found {', '.join(frame) or 'nothing'})")
    if not isinstance(frame["file_path"], str) or "\0" in frame["file_path"]:
        raise DataError(f"{where}: 'file_path' is {frame['file_path']!r}, expected the path of a photograph")
    photo = _photo(path.parent / frame["file_path"])
    camera_to_world = _matrix(frame["transform_matrix"], f"{where}, transform_matrix") @ OPENGL_TO_OPENCV
    name = Path(frame["file_path"]).as_posix()
    mask = frame.get("mask_path")
    if mask is not None and (not isinstance(mask, str) or "\0" in mask):
        raise DataError(f"{where}: 'mask_path' is {mask!r}, expected the path of a mask")
    beside = None if mask is None else path.parent / mask
    return Shot(name, np.linalg.inv(camera_to_world), _lens({**meta, **frame}, where, photo), photo, beside)


def _photo(path: Path) -> Path:
    """The file that `path` means: itself, or where it is missing and has no suffix, the same with one."""
    if there(path) or path.suffix.lower() in SUFFIXES:
        return path
    named = (path.with_name(path.name + suffix) for low in SUFFIXES for suffix in (low, low.upper()))
    return next((candidate for candidate in named if there(candidate)), path)


def _lens(meta: dict[str, Any], where: str, photo: Path) -> Lens:
    if not isinstance(meta.get("is_fisheye", False), bool):
        raise DataError(f"{where}: 'is_fisheye' is {meta['is_fisheye']!r}, expected true or false")
    model = meta.get("camera_model", "OPENCV_FISHEYE" if meta.get("is_fisheye") else "OPENCV")
    if not isinstance(model, str) or model not in MODELS:
        raise DataError(unknown("camera_model", model, MODELS, where))
    size = (
        image_size(photo) if there(photo) and photo.is_file() else (1, 1)
    )  # a missing photograph gets its own error later
    meta = {key: _number(value, key, where, NUMBERS[key]) for key, value in meta.items() if key in NUMBERS}
    width, height = int(meta.get("w", size[0])), int(meta.get("h", size[1]))
    fx, fy = _focal(meta, "x", width), _focal(meta, "y", height)
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    if fx is None or fy is None:
        raise DataError(f"{where} has no 'fl_x' (nor 'camera_angle_x'), and neither has the whole file")
    k1, k2, k3, k4, p1, p2 = (meta.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    fisheye = model in FISHEYE
    if k4 and not fisheye:
        raise DataError(f"{where}: k4={k4} belongs to OPENCV_FISHEYE, the camera model is {model}")
    return Lens(
        fx=fx,
        fy=fy,
        cx=meta.get("cx", width / 2),
        cy=meta.get("cy", height / 2),
        width=width,
        height=height,
        distortion=(k1, k2, k3, k4) if fisheye else (k1, k2, p1, p2, k3),
        fisheye=fisheye,
    )


def _number(value: Any, key: str, where: str, limits: Range) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{where}: '{key}' is {str(value)[:80]!r}, expected a number") from None
    if number not in limits:
        raise DataError(f"{where}: '{key}' is {value!r}, expected {limits}")
    return number


def _focal(meta: dict[str, float], axis: str, size: int) -> float | None:
    """Focal length in pixels, given so or as the field of view in radians (instant-ngp's and Blender's files)."""
    if f"fl_{axis}" in meta:
        return meta[f"fl_{axis}"]
    angle = meta.get(f"camera_angle_{axis}")
    return None if angle is None else size / (2 * math.tan(angle / 2))


def _matrix(value: Any, where: str) -> np.ndarray:
    """A matrix of 3x4 or 4x4 numbers as [4,4] float64."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise DataError(f"{where}: expected a matrix of 3x4 or 4x4 finite numbers")
    if not abs(np.linalg.det(matrix[:3, :3])) > 1e-12:
        raise DataError(f"{where}: is no rotation and scale: it makes everything flat")
    return np.concatenate([matrix[:3], [[0, 0, 0, 1.0]]])


def _points(path: Path, meta: dict) -> Points | None:
    """The point cloud that the file names, in the same world as its frames."""
    if "ply_file_path" not in meta:
        return None
    import trimesh

    if not isinstance(meta["ply_file_path"], str):
        raise DataError(f"{path}: 'ply_file_path' is {meta['ply_file_path']!r}, expected the path of a point cloud")
    cloud_path = path.parent / meta["ply_file_path"]
    if not there(cloud_path):
        raise DataError(f"{path}: its ply_file_path {cloud_path} is missing; remove the key to do without points")
    try:
        cloud = cast(Any, trimesh.load(cloud_path))  # of one of several kinds
        xyz = np.array(cloud.vertices, np.float64)
    except Exception as error:  # each of trimesh's readers raises its own kinds
        raise DataError(f"{cloud_path}: cannot be read as a point cloud ({type(error).__name__}: {error})") from error
    colors = np.asarray(getattr(cloud, "colors", None))
    rgb = colors[:, :3] / 255 if colors.shape[:1] == xyz.shape[:1] else np.full_like(xyz, 0.5)
    return Points(torch.from_numpy(xyz), torch.from_numpy(rgb).float())


FORMAT = Format("transforms.json", find, read)
