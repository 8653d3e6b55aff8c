"""PlayCanvas's compressed PLY: 16 bytes for each splat, and one for each SH coefficient above degree 0.

Splats stand in chunks of 256 that lie together; the element `chunk` has each chunk's bounds of position, log scale and
colour, the element `vertex` four uint: position and scale as 11, 10 and 11 bits between the bounds, the quaternion
without its largest component (which it is in 2 bits, wxyz; 10 bits each), colour and opacity as 8 bits each. The
element `sh` has f_rest_* as bytes from -4 to 4, channel-major as in the PLY, whose axes they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt32

from ...data.origin import Origin
from ...errors import SceneError
from ...files import replacing
from ..gaussians import SH_C0, Gaussians
from ..plyfile import read_comments, read_elements, write_elements
from .api import Found, NoOptions, SplatFormat, require_room, with_suffix
from .quantized import (
    REST,
    assembled,
    drop_largest,
    morton_order,
    opacity_bytes,
    opacity_logits,
    restore_largest,
    sh_bytes,
    unit,
    world_positions,
)

CHUNK = 256  # splats
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
POSITION, SCALE, COLOR = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
LIMITS = [f"{end}_{axis}" for axes in (POSITION, SCALE, COLOR) for end in ("min", "max") for axis in axes]
THREE, FOUR = (11, 10, 11), (8, 8, 8, 8)  # bits
LOGS = 20.0  # log scales are held to +-20: some files have infinite ones
WIDTH = 8.0  # of the range of SH coefficients, around 0


def detect(path: Path, head: bytes) -> bool:
    return head.startswith((b"ply\n", b"ply\r")) and b"packed_" in head


def read(path: Path, origin: Origin) -> Found:
    tables = read_elements(path)
    vertex = _columns(path, tables, "vertex", PACKED)
    count = len(vertex[PACKED[0]])
    if count == 0:
        raise SceneError(f"{path}: holds zero splats; there is nothing to render or edit")
    require_room(path, count)
    colored = {"min_r", "max_b"} <= set((tables["chunk"].dtype.names if "chunk" in tables else None) or ())
    chunks = _columns(path, tables, "chunk", LIMITS if colored else LIMITS[:12])
    if len(chunks["min_x"]) * CHUNK < count:
        raise SceneError(f"{path}: has {len(chunks['min_x'])} chunks of {CHUNK}, and {count} compressed splats")

    def between(axes: tuple[str, ...], parts: np.ndarray) -> Float[np.ndarray, "N 3"]:
        low, high = (
            np.stack([chunks[f"{end}_{axis}"] for axis in axes], axis=1).repeat(CHUNK, axis=0)[:count]
            for end in ("min", "max")
        )
        return low * (1 - parts) + high * parts

    rgba = _unpacked(vertex["packed_color"], FOUR)
    rgb = between(COLOR, rgba[:, :3] / np.float32(255)) if colored else rgba[:, :3] / np.float32(255)
    turns = vertex["packed_rotation"]
    others = (_unpacked(turns & 0x3FFFFFFF, (10, 10, 10)) / np.float32(1023) - 0.5) * np.float32(np.sqrt(2))
    scene = assembled(
        between(POSITION, _fractions(vertex["packed_position"])),
        restore_largest((turns >> 30).astype(np.int64), others),
        between(SCALE, _fractions(vertex["packed_scale"])),
        opacity_logits(rgba[:, 3].astype(np.uint8)),
        (rgb - 0.5) / SH_C0,
        _sh(path, tables, count),
        origin,
    )
    return Found(scene)


def write(stem: Path, scene: Gaussians, origin: Origin, comments: Sequence[str], options: NoOptions) -> Path:
    count = len(scene)
    rgb = scene.sh0[:, 0].float().numpy() * SH_C0 + 0.5
    logs = np.clip(scene.log_scales.float().numpy(), -LOGS, LOGS)
    columns, parts = [], []
    for values in (world_positions(scene, origin).astype(np.float32), logs, rgb):
        low, high, part = _chunked(values)
        columns += [low, high]
        parts.append(part)
    chunk = np.concatenate(columns, axis=1).astype("<f4").view([(name, "<f4") for name in LIMITS])[:, 0]
    vertex = np.empty(count, [(name, "<u4") for name in PACKED])
    vertex["packed_position"] = _packed(parts[0], THREE)
    vertex["packed_scale"] = _packed(parts[1], THREE)
    colors = np.concatenate([parts[2], opacity_bytes(scene.logit_opacities.float().numpy())[:, None] / 255], axis=1)
    vertex["packed_color"] = _packed(colors, FOUR)
    largest, others = drop_largest(unit(scene.quats.float().numpy()))
    turns = _packed(others * np.float32(np.sqrt(0.5)) + 0.5, (10, 10, 10))
    vertex["packed_rotation"] = turns | largest.astype(np.uint32) << 30
    tables = {"chunk": chunk, "vertex": vertex}
    k = scene.shN.shape[1]
    if k:
        middles = scene.shN.float().numpy() - WIDTH / 512  # a byte stands for the middle of its step
        steps = np.ascontiguousarray(sh_bytes(middles, WIDTH, np.ones(k)).transpose(0, 2, 1)).reshape(count, 3 * k)
        tables["sh"] = steps.view([(f"f_rest_{i}", "u1") for i in range(3 * k)])[:, 0]
    path = with_suffix(stem, ".compressed.ply")
    with replacing(path) as part:
        write_elements(part, tables, comments)
    return path


def _columns(path: Path, tables: dict[str, np.ndarray], element: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The named columns of an element. Raises SceneError where one is missing."""
    if element not in tables:
        raise SceneError(f"{path}: holds compressed splats, but no element '{element}'; export it again")
    table = tables[element]
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise SceneError(f"{path}: compressed splats without '{missing[0]}' in the element '{element}'")
    return {name: table[name] for name in names}


def _sh(path: Path, tables: dict[str, np.ndarray], count: int) -> Float[np.ndarray, "N K 3"]:
    if "sh" not in tables:
        return np.zeros((count, 0, 3), np.float32)
    table = tables["sh"]
    names = [f"f_rest_{i}" for i in range(len(table.dtype.names or ()))]
    if set(names) != set(table.dtype.names or ()) or len(names) // 3 not in REST.values() or len(names) % 3:
        raise SceneError(f"{path}: the element 'sh' has {len(names)} properties, expected 9, 24 or 45 named f_rest_*")
    if len(table) != count:
        raise SceneError(f"{path}: {len(table)} rows of SH for {count} splats")
    steps = (np.arange(256) + 0.5) / 256
    steps[0], steps[-1] = 0, 1
    values = ((steps - 0.5) * WIDTH).astype(np.float32)
    packed = np.ascontiguousarray(table[names]).view(np.uint8) if list(table.dtype.names or ()) != names else table
    bytes_ = packed.view(np.uint8).reshape(count, 3, len(names) // 3)
    return values[np.ascontiguousarray(bytes_.transpose(0, 2, 1))]


def _chunked(values: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bounds of each chunk [C,3] twice, and where each value lies between them, in [0,1]."""
    count = len(values)
    starts = np.arange(0, count, CHUNK)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    size = (high - low).repeat(CHUNK, axis=0)[:count]
    parts = (values - low.repeat(CHUNK, axis=0)[:count]) / np.where(size > 0, size, 1)
    return low, high, parts


def _packed(parts: np.ndarray, bits: tuple[int, ...]) -> UInt32[np.ndarray, " N"]:
    """Fractions [N,k] as unsigned numbers of so many bits each, the first one highest."""
    out = np.zeros(len(parts), np.uint32)
    for column, width in zip(parts.T, bits, strict=True):
        top = (1 << width) - 1
        out = out << width | np.clip(np.floor(column * top + 0.5), 0, top).astype(np.uint32)
    return out


def _unpacked(packed: UInt32[np.ndarray, " N"], bits: tuple[int, ...]) -> UInt32[np.ndarray, "N k"]:
    """The numbers, the highest first."""
    ends = np.cumsum(bits[::-1])[::-1] - bits
    return np.stack(
        [packed >> end & ((1 << width) - 1) for end, width in zip(ends.tolist(), bits, strict=True)], axis=1
    )


def _fractions(packed: UInt32[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
    tops = np.array([(1 << width) - 1 for width in THREE], np.float32)
    return (_unpacked(packed, THREE) / tops).astype(np.float32)


FORMAT = SplatFormat(
    "compressed PLY (PlayCanvas)",
    (".compressed.ply", ".ply"),
    detect,
    read,
    write,
    loses="16 bytes a splat: positions and scales to 1/2048 of a chunk of 256 splats, 8 bits a colour, opacity and SH",
    order=morton_order,
    comments=read_comments,
)
