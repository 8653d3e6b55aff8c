"""Tables of bytes as lossless WebP pictures."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from ...errors import SceneError

LONGEST = 16383  # pixels a side


def encode(table: UInt8[np.ndarray, "H W C"]) -> bytes:
    """RGB or RGBA. Where A is 0, RGB may come back changed."""
    import cv2

    order = [2, 1, 0, 3][: table.shape[2]]
    done, data = cv2.imencode(".webp", table[:, :, order], [cv2.IMWRITE_WEBP_QUALITY, 101])  # over 100: lossless
    if not done:
        raise SceneError(f"a table of {table.shape} bytes cannot be written as WebP")
    return data.tobytes()


def decode(where: str, data: bytes, largest: int) -> UInt8[np.ndarray, "H W 4"]:
    """RGBA. largest: pixels at most; a picture that says it has more is not decoded. Raises SceneError."""
    import cv2

    width, height = size(where, data)
    if width * height > largest:
        raise SceneError(f"{where}: is {width}x{height} pixels, expected {largest} together at most")
    table = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if table is None or table.ndim != 3 or table.dtype != np.uint8 or table.shape[:2] != (height, width):
        raise SceneError(f"{where}: is damaged: it cannot be decoded as WebP")
    if table.shape[2] == 3:
        table = np.concatenate([table, np.full_like(table[:, :, :1], 255)], axis=2)
    return table[:, :, [2, 1, 0, 3]]


def size(where: str, data: bytes) -> tuple[int, int]:
    """Width and height by the first bytes. Raises SceneError where it is no WebP."""
    kind = data[12:16]
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30:
        if kind == b"VP8X":
            return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
        if kind == b"VP8L" and data[20] == 0x2F:
            bits = int.from_bytes(data[21:25], "little")
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if kind == b"VP8 ":
            raise SceneError(f"{where}: is a lossy WebP, which a SOG cannot be made of")
    raise SceneError(f"{where}: is no WebP picture, or is truncated ({len(data)} bytes)")


def square(count: int) -> tuple[int, int]:
    """Width and height, multiples of 4, of a picture with room for `count` pixels. Raises SceneError beyond WebP's."""
    width = max(4, -(-int(np.ceil(np.sqrt(count))) // 4) * 4)
    rows = -(-count // width)
    height = max(4, -(-rows // 4) * 4)
    if max(width, height) > LONGEST:
        raise SceneError(f"{count} splats do not fit a WebP of {LONGEST}x{LONGEST} pixels")
    return width, height
