"""Niantic's .spz: 20 bytes for each splat and one for each SH coefficient above degree 0, compressed.

Versions 1 to 3 are one gzip stream, version 4 one zstd stream for each attribute behind a table of contents. Positions
are 24-bit fixed point, log scales 16ths from -10 on, colours (SH of degree 0) 1/0.15 wide around 0, SH 128ths, the
quaternion three bytes (xyz, up to version 2) or, without its largest component (xyzw), 10 bits each with a sign. Axes
are right, up, back (RUB), unless an extension record of version 4 says otherwise: the PLY's are right, down, forward.
Source: the format's description and reference (nianticlabs/spz).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt32

from ...config import Range
from ...data.origin import Origin
from ...errors import SceneError
from ...files import write_bytes
from ..gaussians import Gaussians
from . import zstd
from .api import Found, SplatFormat, require_room, with_suffix
from .quantized import (
    REST,
    Signs,
    assembled,
    drop_largest,
    opacity_bytes,
    opacity_logits,
    restore_largest,
    sh_bytes,
    to_bytes,
    turned,
    unit,
    world_positions,
)

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")  # magic, version, splats, SH degree, fractional bits, flags, streams of version 4
CONTENTS = struct.Struct("<QQ")  # of one stream: bytes compressed and not
FLIPPED: Signs = (1, -1, -1)  # between right, down, forward and right, up, back: its own inverse
AXES = {1: "LDB", 2: "RDB", 3: "LUB", 4: "RUB", 5: "LDF", 6: "RDF", 7: "LUF", 8: "RUF"}  # of the extension record
AXES_RECORD, RDF, HAS_RECORDS = 0xADBE0003, 6, 2
COLOR, SH, LOGS, LOWEST = 0.15 * 255, 128, 16, -10.0
MOST = 1032  # times as long as its compressed bytes a deflate stream is at most
TOP = (1 << 23) - 1  # of a position
BITS = 12  # of a position behind the point, as the reference writes them
GZIP_LEVEL = 4  # a fifth slower at 6, and 2 % smaller


USUAL = (
    "its axes are taken to be right, up, back, as .spz has them. Some tools leave the PLY's (right, down, forward): "
    "if it stands on its head, let them write a PLY"
)


@dataclass(frozen=True)
class SpzOptions:
    """How a .spz is written."""

    version: Annotated[int, Range("[3, 4]")] = 3  # 4 needs the package zstandard
    sh1_bits: Annotated[int, Range("[1, 8]")] = 5  # of SH coefficients of degree 1; the reference's
    sh_bits: Annotated[int, Range("[1, 8]")] = 4  # of those above
    axes: str = field(
        default="RUB", metadata={"choices": ("RUB", "RDF")}
    )  # RDF: for tools that turn nothing; in version 4 it says so


@dataclass(frozen=True)
class Header:
    """Of a file: version, splats, SH degree, bits of a position behind the point, flags, streams."""

    version: int
    count: int
    degree: int
    bits: int
    flags: int
    streams: int

    @property
    def sizes(self) -> list[int]:
        """Bytes of positions, opacities, colours, scales, quaternions and SH."""
        each = (9, 1, 3, 3, 3 if self.version < 3 else 4, 3 * REST[self.degree])
        return [self.count * n for n in each]


def detect(path: Path, head: bytes) -> bool:
    if head.startswith(MAGIC):
        return True
    try:
        return head.startswith(GZIP) and zlib.decompressobj(31).decompress(head, 4) == MAGIC
    except zlib.error:
        return False


def read(path: Path, origin: Origin) -> Found:
    return decode(path, path.read_bytes(), origin)


def decode(path: Path, data: bytes, origin: Origin, signs: Signs = FLIPPED) -> Found:
    """Splats of the bytes of a .spz. signs: of its axes in the PLY's, where the file itself says nothing."""
    notices = [] if signs != FLIPPED else [USUAL]
    if data.startswith(MAGIC):
        header = _header(path, data)
        if header.version < 4:
            raise SceneError(f"{path}: is .spz version {header.version} without compression, expected 4")
        parts = _streams(path, data, header)
        told = _axes(path, data, header)
        signs, notices = (signs, notices) if told is None else told
    elif not data.startswith(GZIP):
        raise SceneError(f"{path}: is no .spz: it begins neither with NGSP nor as gzip does")
    else:
        header, parts = _legacy(path, data)
    positions, opacities, colors, scales, quats, sh = parts
    count, k = header.count, REST[header.degree]
    scene = assembled(
        _fixed24(positions).reshape(count, 3) * (0.5**header.bits) * np.array(signs),
        np.ones((count, 4), np.float32),
        scales.reshape(count, 3) / np.float32(LOGS) + np.float32(LOWEST),
        opacity_logits(opacities),
        (colors.reshape(count, 3) - np.float32(127.5)) / np.float32(COLOR),
        ((np.arange(256) - 128) / SH).astype(np.float32)[sh].reshape(count, k, 3),
        origin,
    )
    unpack = _three_bytes if header.version < 3 else _smallest_three
    turn = turned(replace(scene, quats=torch.from_numpy(unpack(quats.reshape(count, -1)))), signs)
    return Found(replace(turn, means=scene.means), notices)


def write(stem: Path, scene: Gaussians, origin: Origin, comments: Sequence[str], options: SpzOptions) -> Path:
    signs: Signs = FLIPPED if options.axes == "RUB" else (1, 1, 1)
    path, count = with_suffix(stem, ".spz"), len(scene)
    positions = world_positions(scene, origin) * signs
    scene = turned(scene, signs)
    bits = _bits(path, positions, scene)
    largest, others = drop_largest(unit(scene.quats.float().numpy())[:, [1, 2, 3, 0]])
    parts = [
        _to_fixed24(positions * 2.0**bits),
        opacity_bytes(scene.logit_opacities.float().numpy()),
        to_bytes(scene.sh0[:, 0].float().numpy() * COLOR + 127.5),
        to_bytes((scene.log_scales.float().numpy() - LOWEST) * LOGS),
        _packed_three(largest, others),
        _sh_bytes(scene.shN.float().numpy(), options),
    ]
    head = HEADER.pack(MAGIC, options.version, count, scene.sh_degree, bits, 0, 0)
    whole = [part.reshape(-1).view(np.uint8).data for part in parts]
    if options.version == 3:
        squeeze = zlib.compressobj(GZIP_LEVEL, zlib.DEFLATED, 31)
        return write_bytes(path, b"".join([*map(squeeze.compress, [head, *whole]), squeeze.flush()]))
    whole = whole if scene.sh_degree else whole[:-1]
    squeezed = [zstd.compress(bytes(part)) for part in whole]
    contents = [CONTENTS.pack(len(short), len(part)) for short, part in zip(squeezed, whole, strict=True)]
    record = b"" if options.axes == "RUB" else struct.pack("<III", AXES_RECORD, 4, RDF)
    flags, start = HAS_RECORDS if record else 0, 32 + len(record)
    head = HEADER.pack(MAGIC, 4, count, scene.sh_degree, bits, flags, len(whole)) + struct.pack("<I12x", start)
    return write_bytes(path, b"".join([head, record, *contents, *squeezed]))


# --- the two containers


def _header(path: Path, data: bytes) -> Header:
    if len(data) < HEADER.size:
        raise SceneError(f"{path}: is truncated: {len(data)} bytes, the header of a .spz alone has {HEADER.size}")
    magic, version, count, degree, bits, flags, streams = HEADER.unpack(data[: HEADER.size])
    if magic != MAGIC:
        raise SceneError(f"{path}: is no .spz: it does not begin with NGSP")
    if not 1 < version < 5:
        raise SceneError(f"{path}: is .spz version {version}, expected 2, 3 or 4")
    if degree not in REST:
        raise SceneError(f"{path}: has SH degree {degree}, and splats here have 3 at most. Export it with less")
    if bits > 24:
        raise SceneError(f"{path}: has {bits} bits behind the point, expected 24 at most; it is damaged")
    if count == 0:
        raise SceneError(f"{path}: holds zero splats; there is nothing to render or edit")
    return Header(version, count, degree, bits, flags, streams)


def _legacy(path: Path, data: bytes) -> tuple[Header, list[np.ndarray]]:
    """Header and attributes of one gzip stream."""
    loose = zlib.decompressobj(31)
    try:
        head = loose.decompress(data, HEADER.size)
        header = _header(path, head)
        if header.version > 3:
            raise SceneError(f"{path}: is .spz version {header.version} in gzip, expected 2 or 3")
        total = sum(header.sizes)
        if total > MOST * len(data):
            raise SceneError(f"{path}: is truncated: {len(data)} bytes cannot hold the {header.count} splats promised")
        require_room(path, header.count)
        body = loose.decompress(loose.unconsumed_tail, total)
    except zlib.error as error:
        raise SceneError(f"{path}: is damaged: its gzip stream cannot be read ({error})") from error
    if len(body) < total:
        held = len(body) * header.count // max(total, 1)
        raise SceneError(f"{path}: is truncated: promises {header.count} splats, holds about {held}. Copy it again")
    if not loose.eof:
        _check_end(path, loose)
    ends = np.cumsum([0, *header.sizes])
    whole = np.frombuffer(body, np.uint8)
    return header, [whole[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]


def _check_end(path: Path, loose: "zlib._Decompress") -> None:  # noqa: UP037
    """Read on to the stream's checksum, over at most 16 MB of records behind the attributes."""
    try:
        loose.decompress(loose.unconsumed_tail, 1 << 24)
    except zlib.error as error:
        raise SceneError(f"{path}: is damaged: {error}") from error
    if not loose.eof and not loose.unconsumed_tail:
        raise SceneError(f"{path}: is truncated: its gzip stream does not end. Copy it again")


def _streams(path: Path, data: bytes, header: Header) -> list[np.ndarray]:
    """The attributes of version 4."""
    expected = header.sizes if header.degree else header.sizes[:-1]
    start = int.from_bytes(data[16:20], "little")
    at = start + CONTENTS.size * header.streams
    if header.streams != len(expected) or start < 32 or at > len(data):
        raise SceneError(f"{path}: is damaged: {header.streams} streams from byte {start}, expected {len(expected)}")
    require_room(path, header.count)
    parts = []
    for place, size in enumerate(expected):
        short, whole = CONTENTS.unpack_from(data, start + CONTENTS.size * place)
        if whole != size or at + short > len(data):
            raise SceneError(f"{path}: is truncated or damaged: stream {place} has {whole} bytes, expected {size}")
        parts.append(np.frombuffer(zstd.decompress(path, data[at : at + short], size), np.uint8))
        at += short
    return parts if header.degree else [*parts, np.zeros(0, np.uint8)]


def _axes(path: Path, data: bytes, header: Header) -> tuple[Signs, list[str]] | None:
    """How the axes that a record of version 4 names are turned into the PLY's, and what there is to say; None where it
    names none."""
    at, end = 32, int.from_bytes(data[16:20], "little")
    while header.flags & HAS_RECORDS and at + 8 <= end:
        kind, size = struct.unpack_from("<II", data, at)
        if kind == AXES_RECORD and size == 4 and at + 12 <= end:
            code = int.from_bytes(data[at + 8 : at + 12], "little")
            if code == 0:
                return None
            if code not in AXES:
                raise SceneError(
                    f"{path}: its axes have the number {code}, expected 1 to 8 ({', '.join(AXES.values())})"
                )
            right, down, forward = (1 if a == b else -1 for a, b in zip(AXES[code], "RDF", strict=True))
            return (right, down, forward), [f"its axes are {AXES[code]}"]
        at += 8 + size
    return None


# --- numbers


def _bits(path: Path, positions: Float[np.ndarray, "N 3"], scene: Gaussians) -> int:
    """Bits of a position behind the point: the reference's 12, more where splats are so small that an eighth of their
    median size asks for it, fewer where the world is so large."""
    fit = int(np.floor(np.log2(TOP / max(float(np.abs(positions).max()), 1e-9))))
    if fit < 0:
        raise SceneError(f"{path}: .spz holds positions up to {TOP}, got {np.abs(positions).max():.4g}")
    fine = int(np.ceil(3 - float(scene.log_scales.median()) / np.log(2)))
    return min(fit, max(BITS, fine), 23)


def _fixed24(bytes_: UInt8[np.ndarray, " M"]) -> np.ndarray:
    """Signed numbers of three bytes each, as float64."""
    wide = np.zeros((len(bytes_) // 3, 4), np.uint8)
    wide[:, 1:] = bytes_.reshape(-1, 3)
    return (wide.view("<i4")[:, 0] >> 8).astype(np.float64)


def _to_fixed24(values: Float[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 9"]:
    whole = np.clip(np.rint(values), -TOP, TOP).astype("<i4")
    return np.ascontiguousarray(whole.view(np.uint8).reshape(len(values), 3, 4)[:, :, :3]).reshape(-1, 9)


def _packed_three(largest: np.ndarray, others: Float[np.ndarray, "N 3"]) -> UInt32[np.ndarray, " N"]:
    sizes = np.minimum(np.abs(others) * np.float32(511 * np.sqrt(2)) + 0.5, 511).astype(np.uint32)
    signed = sizes | (others < 0).astype(np.uint32) << 9
    return (largest.astype(np.uint32) << 30 | signed[:, 0] << 20 | signed[:, 1] << 10 | signed[:, 2]).astype("<u4")


def _smallest_three(bytes_: UInt8[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Quaternions wxyz."""
    packed = np.ascontiguousarray(bytes_).view("<u4")[:, 0]
    parts = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    sizes = (parts & 511) * np.float32(np.sqrt(0.5) / 511)
    return restore_largest((packed >> 30).astype(np.int64), np.where(parts & 512, -sizes, sizes))[:, [3, 0, 1, 2]]


def _three_bytes(bytes_: UInt8[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    """Quaternions wxyz of xyz with w positive."""
    return restore_largest(np.zeros(len(bytes_), np.int64), bytes_ / np.float32(127.5) - 1)


def _sh_bytes(shN: Float[np.ndarray, "N K 3"], options: SpzOptions) -> UInt8[np.ndarray, "N K 3"]:
    """128ths around 128, of so many bits: multiples of a step, 128 among them."""
    bits = np.array([options.sh1_bits] * 3 + [options.sh_bits] * 12)[: shN.shape[1]]
    return sh_bytes(shN, 2.0, 2 ** (8 - bits))


FORMAT = SplatFormat(
    ".spz (Niantic)",
    (".spz",),
    detect,
    read,
    write,
    SpzOptions,
    loses="fixed-point positions, scales to 1/16 of a logarithm, 8 bits a colour and opacity, 4 to 8 bits an SH number",
)
