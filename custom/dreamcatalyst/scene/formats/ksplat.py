"""The .ksplat of mkkellogg's viewer, which is read alone: sections of splats in three grades of compression.

A header of 4096 bytes and one of 1024 for each section; then each section's buckets and rows. Grade 0 has floats,
grades 1 and 2 positions as 16 bits around the middle of a bucket, and half floats for scales and the quaternion (wxyz);
SH coefficients are floats, half floats, or bytes between two bounds; within each degree all of red comes first, then
green and blue. Axes are those of the PLY.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...data.origin import Origin
from ...errors import SceneError
from .api import Found, SplatFormat, require_room
from .quantized import REST, assembled, byte_colors, opacity_logits, unit

HEADER, SECTION = 4096, 1024  # bytes
GRADES = [("<f4", "<f4", 1), ("<u2", "<f2", 32767), ("<u2", "u1", 32767)]  # of positions and SH; half a bucket's steps
SMALLEST = 1e-30  # of a scale, whose logarithm is to be finite


@dataclass(frozen=True)
class Header:
    """Of a file: how many sections there is room for and are used, splats, grade, bounds of SH as bytes."""

    room: int
    sections: int
    splats: int
    grade: int
    bounds: tuple[float, float]


def read(path: Path, origin: Origin) -> Found:
    data = np.fromfile(path, np.uint8)
    header = _header(path, data)
    require_room(path, header.splats)
    at, parts = HEADER + header.room * SECTION, []
    for index in range(header.sections):
        part, at = _section(path, data, header, HEADER + index * SECTION, at)
        if part is not None:
            parts.append(part)
    count = sum(len(part[0]) for part in parts)
    if count != header.splats or count == 0:
        raise SceneError(f"{path}: its header promises {header.splats} splats, its sections hold {count}")
    most = max(part[-1].shape[1] for part in parts)
    columns = [np.concatenate(column) for column in list(zip(*parts, strict=True))[:-1]]
    shN = np.zeros((count, most, 3), np.float32)
    rows = 0
    for part in parts:
        shN[rows : rows + len(part[0]), : part[-1].shape[1]] = part[-1]
        rows += len(part[0])
    means, quats, logs, logits, sh0 = columns
    return Found(assembled(means, quats, logs, logits, sh0, shN, origin))


def _header(path: Path, data: np.ndarray) -> Header:
    if len(data) < HEADER:
        raise SceneError(f"{path}: is truncated, or no .ksplat: {len(data)} bytes, its header alone has {HEADER}")
    if data[0] != 0 or data[1] < 1:
        raise SceneError(f"{path}: is of .ksplat version {data[0]}.{data[1]}, expected 0.1, or is no .ksplat at all")
    room, sections, _, splats = (int(n) for n in data[4:20].view("<u4"))
    grade = int(data[20:22].view("<u2")[0])
    if grade >= len(GRADES):
        raise SceneError(f"{path}: has compression level {grade}, expected 0, 1 or 2")
    if HEADER + room * SECTION > len(data) or sections > room:
        raise SceneError(f"{path}: is truncated: {len(data)} bytes cannot hold {room} sections")
    low, high = (float(n) for n in data[36:44].view("<f4"))
    return Header(room, sections or room, splats, grade, (low or -1.5, high or 1.5))


def _section(path: Path, data: np.ndarray, header: Header, head: int, at: int) -> tuple[tuple | None, int]:
    """The arrays of a section whose data begin at byte `at`, None for an empty one, and where the next one begins."""
    count, room, size, buckets = (int(n) for n in data[head : head + 16].view("<u4"))
    block = float(data[head + 16 : head + 20].view("<f4")[0])
    stored = int(data[head + 20 : head + 22].view("<u2")[0])
    steps = int(data[head + 24 : head + 28].view("<u4")[0])
    full, partial = (int(n) for n in data[head + 32 : head + 40].view("<u4"))
    degree = int(data[head + 40 : head + 42].view("<u2")[0])
    if degree not in REST:
        raise SceneError(f"{path}: has SH degree {degree}, expected 0 to 3")
    row = _row(header.grade, REST[degree])
    rows = at + 4 * partial + stored * buckets
    end = rows + row.itemsize * room
    if count > room or rows + row.itemsize * count > len(data):
        raise SceneError(f"{path}: is truncated: a section promises {count} splats, which would end at byte {end}")
    if count == 0:
        return None, end
    table = data[rows : rows + row.itemsize * count].view(row)
    means = table["means"].astype(np.float32)
    if header.grade:
        if full + partial > buckets or stored < 12:
            raise SceneError(f"{path}: has {full + partial} filled buckets of {buckets}, {stored} bytes each")
        middles = np.ascontiguousarray(data[at + 4 * partial :][: 12 * buckets]).view("<f4").reshape(-1, 3)
        sizes = np.concatenate([np.full(full, size), data[at : at + 4 * partial].view("<u4")]).astype(np.float64)
        bucket = np.searchsorted(np.cumsum(sizes), np.arange(count), side="right")
        if bucket[-1] >= len(sizes):
            raise SceneError(f"{path}: its buckets hold {sizes.sum():.0f} splats, expected {count}")
        half = steps or GRADES[header.grade][2]
        means = (means - half) * np.float32(block / 2 / half) + middles[bucket]
    logs = np.log(np.maximum(table["scales"].astype(np.float32), SMALLEST))
    sh0, logits = byte_colors(table["rgb"]), opacity_logits(table["opacity"])
    sh = _sh(table["sh"], header, degree)
    return (means, unit(table["quats"].astype(np.float32)), logs, logits, sh0, sh), end


def _row(grade: int, rest: int) -> np.dtype:
    position, sh, _ = GRADES[grade]
    number = "<f4" if grade == 0 else "<f2"
    kinds = [("means", position, 3), ("scales", number, 3), ("quats", number, 4), ("rgb", "u1", 3), ("opacity", "u1")]
    return np.dtype([*kinds, ("sh", sh, (3 * rest,))])


def _sh(values: np.ndarray, header: Header, degree: int) -> np.ndarray:
    """Coefficients [N,K,3] of rows [N,3K] in which each degree is channel-major."""
    numbers = values.astype(np.float32)
    if header.grade == 2:
        low, high = header.bounds
        numbers = low + numbers * np.float32((high - low) / 255)
    bands = [
        numbers[:, 3 * REST[d - 1] : 3 * REST[d]].reshape(len(numbers), 3, 2 * d + 1) for d in range(1, degree + 1)
    ]
    return np.concatenate([np.zeros((len(numbers), 3, 0), np.float32), *bands], axis=2).transpose(0, 2, 1)


FORMAT = SplatFormat(
    ".ksplat (mkkellogg)", (".ksplat",), lambda path, head: False, read, loses="16 bits a position, 8 a colour"
)
