"""Splat files: the PLY layout of 3DGS (Kerbl et al. 2023, INRIA's `save_ply`), read and written bit for bit.

One `vertex` element with, per splat: x y z, nx ny nz (unused), f_dc_0..2, f_rest_* (channel-major: all of red, then
green, then blue), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz). All float, little endian, in this order when
written; any order, number type and byte order, and text, when read.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..data.origin import ZERO, Origin, far_origin
from ..errors import SceneError
from ..files import replacing
from .finite import finite
from .gaussians import SH_C0, Gaussians
from .plyfile import PlyTable, read_vertices, write_vertices

MEANS, NORMALS, DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALES, QUATS, RGB = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)], ["red", "green", "blue"]


def read_ply(path: str | Path, *, drop_nonfinite: bool = False, origin: Origin = ZERO) -> Gaussians:
    """Read splats; parameters become float32 whatever the file's number type.

    The SH degree is the file's. Without f_dc_*, colours come from red, green, blue (0..255), as nerfstudio may export.
    Properties that 3DGS does not know go to `extra` under their own name, in their own number type (ushort and uint
    as int32 and int64, which torch computes with); nx, ny, nz too, unless all are zero.
    drop_nonfinite: leave out splats with a NaN or infinite parameter and print how many, instead of raising.
    origin: the point of the file's world that becomes (0,0,0); taken off before positions become float32.
    Raises SceneError: no such file, not a PLY, truncated, no splats in it (a mesh, a point cloud, compressed
    splats), a missing property, no rows, rows that are not finite.
    """
    return finite(Path(path), read_rows(Path(path), origin), drop_nonfinite)


def read_rows(path: Path, origin: Origin = ZERO) -> Gaussians:
    """`read_ply` of all rows, also those that are not finite."""
    table = read_vertices(path)
    rest = _rest_names(path, table)
    colors = RGB if "f_dc_0" not in table.columns and set(RGB) <= set(table.columns) else DC
    _require_splats(path, table, colors)
    if table.count == 0:
        raise SceneError(f"{path}: holds zero splats; there is nothing to render or edit")

    sh0 = torch.from_numpy(table.matrix(colors))
    if colors is RGB:
        sh0 = (sh0 / 255 - 0.5) / SH_C0
    shN = torch.from_numpy(table.matrix(rest)).reshape(table.count, 3, len(rest) // 3)
    used = {*MEANS, *colors, *rest, "opacity", *SCALES, *QUATS}
    extra = {name: _tensor(table.columns[name]) for name in table.columns if name not in used}
    if all(not extra[name].any() for name in NORMALS if name in extra):
        extra = {name: value for name, value in extra.items() if name not in NORMALS}
    return Gaussians(
        means=torch.from_numpy(table.matrix(MEANS) if origin == ZERO else _positions(table, origin)),
        quats=torch.from_numpy(table.matrix(QUATS)),
        log_scales=torch.from_numpy(table.matrix(SCALES)),
        logit_opacities=torch.from_numpy(table.matrix(["opacity"]))[:, 0],
        sh0=sh0[:, None, :],
        shN=shN.transpose(1, 2).contiguous(),
        extra=extra,
    )


def write_ply(path: str | Path, scene: Gaussians, *, origin: Origin = ZERO, comments: Sequence[str] = ()) -> Path:
    """Write splats as float32 in INRIA's order, extras after them; returns the path. Folders are made as needed.

    Extras keep their number type (bool as uchar; int64 as uint or int where it fits; half types as float); an extra
    [N,k] becomes the k properties name_0 .. name_{k-1}. Normals are zero unless `extra` has nx, ny, nz.
    origin: as in `read_ply`; it is added to x, y, z, which are then written as doubles. comments: for the header.
    The file appears under its name only when it is complete. Raises SceneError where an extra cannot be written,
    FileError where the file cannot.
    """
    path = Path(path)
    scene = scene.detach().to("cpu")
    n, k = scene.shN.shape[:2]
    extra = _flat_extras(path, scene)
    normals = [extra.pop(name, np.zeros(n, np.float32)) for name in NORMALS]
    core = np.concatenate(
        [
            scene.means.float().numpy(),
            np.stack(normals, axis=1).astype(np.float32, copy=False),
            scene.sh0[:, 0].float().numpy(),
            scene.shN.float().transpose(1, 2).reshape(n, 3 * k).numpy(),
            scene.logit_opacities.float().numpy()[:, None],
            scene.log_scales.float().numpy(),
            scene.quats.float().numpy(),
        ],
        axis=1,
    )
    names = [*MEANS, *NORMALS, *DC, *[f"f_rest_{i}" for i in range(3 * k)], "opacity", *SCALES, *QUATS]
    clash = sorted(set(names) & set(extra))
    if clash:
        raise SceneError(f"{path}: extra '{clash[0]}' has the name of a splat property; rename it")
    before = {}
    if origin != ZERO:
        before = dict(zip(MEANS, (scene.means.double().numpy() + origin).T, strict=True))
        names, core = names[len(MEANS) :], core[:, len(MEANS) :]
    with replacing(path) as part:
        write_vertices(part, names, core, extra, before, comments)
    return path


def ply_origin(path: str | Path) -> Origin:
    """Where the splats (or points) of a file lie, for `read_ply`, by up to ten thousand of them; zero unless they are
    far away. Raises SceneError as `read_ply` does where there is no such file."""
    table = read_vertices(Path(path))
    every = max(1, table.count // 10_000)
    if not set(MEANS) <= set(table.columns):
        return ZERO
    some = np.stack([table.columns[name][::every] for name in MEANS], axis=1).astype(np.float64)
    return far_origin(some[np.isfinite(some).all(axis=1)])


def _positions(table: PlyTable, origin: Origin) -> np.ndarray:
    """Positions [N,3] float32 from `origin`, the difference taken in float64."""
    whole = np.stack([table.columns[name] for name in MEANS], axis=1).astype(np.float64)
    return (whole - origin).astype(np.float32)


def _rest_names(path: Path, table: PlyTable) -> list[str]:
    """The f_rest_* properties in the order of their numbers, which must be 0, 9, 24 or 45 without a gap."""
    count = sum(name.startswith("f_rest_") for name in table.columns)
    names = [f"f_rest_{i}" for i in range(count)]
    gap = next((name for name in names if name not in table.columns), None)
    if gap or count not in (0, 9, 24, 45):
        fault = f"property '{gap}' is missing" if gap else f"has {count} f_rest_* properties"
        raise SceneError(f"{path}: {fault}; expected f_rest_0 .. with 0, 9, 24 or 45 of them (SH degree 0 to 3)")
    return names


def _require_splats(path: Path, table: PlyTable, colors: list[str]) -> None:
    """Raise SceneError that says what the file is, where it is no 3DGS file."""
    wanted = [*MEANS, *colors, "opacity", *SCALES, *QUATS]
    missing = [name for name in wanted if name not in table.columns]
    if not missing:
        return
    if "packed_position" in table.columns:
        raise SceneError(f"{path}: holds compressed splats (packed_position ...); export an uncompressed PLY instead")
    if not any(name in table.columns for name in (*SCALES, *QUATS, "opacity", "f_dc_0")):
        kind = "a mesh (it has faces)" if table.elements.get("face") else "a plain point cloud"
        raise SceneError(
            f"{path}: is {kind}, not splats: found {_brief(table)}, no opacity, scale_*, rot_*. "
            "With photographs, configs/fit.yaml begins splats on it: system.mesh=<this file>"
        )
    hint = ""
    if missing == ["scale_2"] or missing == ["rot_3"]:
        hint = " 3DGS needs three scales and four rotation numbers (wxyz); is this a 2DGS export?"
    raise SceneError(f"{path}: property '{missing[0]}' is missing (found {_brief(table)}).{hint}")


def _brief(table: PlyTable) -> str:
    """Property names for a message, runs of numbered ones as first..last."""
    runs: dict[str, list[str]] = {}
    for name in table.columns:
        runs.setdefault(name.rstrip("0123456789"), []).append(name)
    shown = (names[0] if len(names) == 1 else f"{names[0]}..{names[-1]}" for names in runs.values())
    return ", ".join(shown) or "nothing"


def _tensor(column: np.ndarray) -> Tensor:
    widened = {"u2": np.int32, "u4": np.int64}.get(column.dtype.str[1:], column.dtype.newbyteorder("="))
    return torch.from_numpy(np.array(column, dtype=widened))


def _flat_extras(path: Path, scene: Gaussians) -> dict[str, np.ndarray]:
    """Extras as one column each, in number types that PLY has."""
    columns = {}
    for name, value in scene.extra.items():
        if value.dtype in (torch.bfloat16, torch.float16):
            value = value.float()
        flat = (value[:, None] if value.ndim == 1 else value.flatten(1)).numpy()
        if flat.dtype == bool:
            flat = flat.astype(np.uint8)
        if flat.dtype == np.int64:
            low, high = (int(flat.min()), int(flat.max())) if flat.size else (0, 0)
            fits = [t for t in (np.uint32, np.int32) if np.iinfo(t).min <= low and high <= np.iinfo(t).max]
            if not fits:
                raise SceneError(f"{path}: extra '{name}' holds numbers beyond 32 bits, which PLY cannot store")
            flat = flat.astype(fits[0])
        names = [name] if value.ndim == 1 else [f"{name}_{i}" for i in range(flat.shape[1])]
        columns.update(zip(names, flat.T, strict=True))
    return columns
