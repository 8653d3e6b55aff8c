"""PlayCanvas's SOG: splats as lossless WebP pictures with a meta.json, in a zip archive (.sog) or a folder.

A pixel is a splat. Positions are sign(x) ln(1 + |x|) in 16 bits between bounds, low and high bytes in two pictures. The
quaternion is three bytes without its largest component, and which that is (wxyz) as 252 + 0..3. Log scales and colours
(SH of degree 0) are bytes, which choose from 256 numbers each (version 2) or lie between bounds (version 1); the
opacity stands beside the colour. The SH above are one of up to 65536 entries of a palette, itself a picture. Axes are
the PLY's.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from ...config import Range
from ...data.origin import Origin
from ...files import replacing, write_bytes, write_text
from ..gaussians import Gaussians
from . import webp
from .api import SplatFormat, with_suffix
from .palette import codebook, palette
from .quantized import drop_largest, morton_order, opacity_bytes, to_bytes, unit, world_positions
from .sog_read import META, comments, read

ROW = 64  # entries of the palette in a row of its picture
LARGEST = 65536  # entries of a palette: their number is two bytes
QUATS = 252  # of the byte that says which component is left out


@dataclass(frozen=True)
class SogOptions:
    """How a SOG is written."""

    bundle: bool = True  # one .sog; false: a folder of pictures with a meta.json
    palette: Annotated[int, Range("[64, 65536]")] = LARGEST  # entries for SH above degree 0 at most


def detect(path: Path, head: bytes) -> bool:
    if head.startswith(b"PK\x03\x04"):
        return zipfile.is_zipfile(path) and META in zipfile.ZipFile(path).namelist()
    return head.lstrip().startswith(b"{") and b'"means"' in head


def write(stem: Path, scene: Gaussians, origin: Origin, comments: Sequence[str], options: SogOptions) -> Path:
    count = len(scene)
    shape = webp.square(count)
    pictures: dict[str, np.ndarray] = {}

    def table(name: str, columns: np.ndarray) -> str:
        out = np.zeros((shape[0] * shape[1], columns.shape[1]), np.uint8)
        out[:count] = columns
        pictures[f"{name}.webp"] = out.reshape(shape[1], shape[0], -1)
        return f"{name}.webp"

    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "dreamcatalyst", "comments": list(comments)}}
    meta["count"] = count
    logs, low, high = _log_positions(world_positions(scene, origin))
    files = [table("means_l", (logs & 255).astype(np.uint8)), table("means_u", (logs >> 8).astype(np.uint8))]
    meta["means"] = {"mins": low, "maxs": high, "files": files}
    sizes, chosen = codebook(scene.log_scales.float().numpy().reshape(-1))
    meta["scales"] = {"codebook": sizes.tolist(), "files": [table("scales", chosen.reshape(count, 3))]}
    largest, others = drop_largest(unit(scene.quats.float().numpy()))
    steps = to_bytes((others * np.float32(np.sqrt(0.5)) + 0.5) * 255)
    kind = (largest + QUATS).astype(np.uint8)
    meta["quats"] = {"files": [table("quats", np.concatenate([steps, kind[:, None]], axis=1))]}
    colors, chosen = codebook(scene.sh0[:, 0].float().numpy().reshape(-1))
    opacities = opacity_bytes(scene.logit_opacities.float().numpy())[:, None]
    rgba = np.concatenate([chosen.reshape(count, 3), opacities], axis=1)
    meta["sh0"] = {"codebook": colors.tolist(), "files": [table("sh0", rgba)]}
    if scene.sh_degree:
        meta["shN"], picture, labels = _sh(scene, options.palette)
        pictures["shN_centroids.webp"] = picture
        low_high = np.stack([labels & 255, labels >> 8, 0 * labels], axis=1).astype(np.uint8)
        meta["shN"]["files"] = ["shN_centroids.webp", table("shN_labels", low_high)]
    encoded = {name: webp.encode(picture) for name, picture in pictures.items()}
    return _bundle(stem, meta, encoded) if options.bundle else _folder(stem, meta, encoded)


def _log_positions(positions: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, list[float], list[float]]:
    """Positions as 16 bits, and their bounds, both of their logarithms."""
    logs = np.sign(positions) * np.log1p(np.abs(positions))
    low, high = logs.min(axis=0), logs.max(axis=0)
    size = np.where(high > low, high - low, 1)
    return np.rint((logs - low) / size * 65535).astype(np.uint32), low.tolist(), high.tolist()


def _sh(scene: Gaussians, most: int) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """What meta.json says of the palette, its picture, and each splat's entry."""
    count, k = scene.shN.shape[:2]
    size = min(most, 1 << max(6, math.floor(math.log2(count))))
    entries, labels = palette(scene.shN.float().reshape(count, 3 * k), size)
    numbers, chosen = codebook(entries.numpy().reshape(-1))
    rows = -(-len(entries) // ROW)
    picture = np.zeros((rows * ROW, k, 3), np.uint8)
    picture[: len(entries)] = chosen.reshape(len(entries), k, 3)
    meta = {"count": len(entries), "bands": scene.sh_degree, "codebook": numbers.tolist()}
    return meta, picture.reshape(rows, ROW * k, 3), labels.numpy()


def _bundle(stem: Path, meta: dict[str, Any], pictures: dict[str, bytes]) -> Path:
    path = with_suffix(stem, ".sog")
    with replacing(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {META: json.dumps(meta).encode(), **pictures}.items():
            archive.writestr(zipfile.ZipInfo(name), data)  # without a date: the same splats give the same bytes
    return path


def _folder(stem: Path, meta: dict[str, Any], pictures: dict[str, bytes]) -> Path:
    """The pictures first: a folder without meta.json is no SOG yet."""
    for name, data in pictures.items():
        write_bytes(stem / name, data)
    return write_text(stem / META, json.dumps(meta))


FORMAT = SplatFormat(
    "SOG (PlayCanvas)",
    (".sog", "meta.json"),
    detect,
    read,
    write,
    SogOptions,
    loses="16-bit logarithmic positions, 8 bits a scale, rotation, colour and opacity, SH from a palette",
    order=morton_order,
    comments=comments,
    implied={"meta.json": {"bundle": False}},
)
