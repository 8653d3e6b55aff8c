"""Reading a SOG (see sog.py), of version 1 or 2, from its archive or its folder."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from ...data.origin import Origin
from ...errors import SceneError
from . import webp
from .api import Found, require_room
from .quantized import assembled, opacity_logits, restore_largest

META, META_LIMIT = "meta.json", 1 << 24  # bytes
ROW = 64  # entries of the palette in a row of its picture
QUATS = 252
Parts = Callable[[str, int], bytes]  # a name and bytes at most, to the content


def read(path: Path, origin: Origin) -> Found:
    return _Reader(path).found(origin)


def comments(path: Path) -> list[str]:
    """Those that meta.json carries."""
    asset = _meta(path, _parts(path)).get("asset")
    listed = asset.get("comments", []) if isinstance(asset, dict) else []
    return [line for line in listed if isinstance(line, str)] if isinstance(listed, list) else []


class _Reader:
    """One SOG. meta: what its meta.json says."""

    def __init__(self, path: Path):
        self.path, self.parts = path, _parts(path)
        self.meta = _meta(path, self.parts)
        self.old = "version" not in self.meta
        if not self.old and self.meta["version"] != 2:
            raise SceneError(f"{path}: is SOG version {self.meta['version']!r}, expected 1 or 2")
        count = self.numbers("means", "shape")[0] if self.old else self.meta.get("count")
        if isinstance(count, bool) or not isinstance(count, (int, float)) or not 0 < count < 2**32:
            raise SceneError(f"{path}: its meta.json promises {count!r} splats, expected a whole number from 1 on")
        self.count = int(count)
        require_room(path, self.count)

    def found(self, origin: Origin) -> Found:
        low, high = self.numbers("means", "mins", 3), self.numbers("means", "maxs", 3)
        bytes_ = [self.pixels("means", place)[:, :3].astype(np.float64) for place in (0, 1)]
        logs = low + (bytes_[0] + 256 * bytes_[1]) / 65535 * (high - low)
        quats = self.pixels("quats", 0)
        kind = quats[:, 3].astype(np.int64) - QUATS
        others = (quats[:, :3] / np.float32(255) - 0.5) * np.float32(np.sqrt(2))
        rotations = restore_largest(np.clip(kind, 0, 3), others)
        rotations[kind < 0] = (1, 0, 0, 0)
        colors = self.pixels("sh0", 0)
        if self.old:
            sh0, opacities = self.between("sh0", colors[:, :3]), self.between("sh0", colors[:, 3:], 3)[:, 0]
            scales = self.between("scales", self.pixels("scales", 0)[:, :3])
        else:
            sh0, opacities = self.numbers("sh0", "codebook", 256)[colors[:, :3]], opacity_logits(colors[:, 3])
            scales = self.numbers("scales", "codebook", 256)[self.pixels("scales", 0)[:, :3]]
        means = np.sign(logs) * np.expm1(np.abs(logs))
        return Found(assembled(means, rotations, scales, opacities, sh0, self.sh(), origin))

    def sh(self) -> Float[np.ndarray, "N K 3"]:
        """Coefficients above degree 0."""
        if not self.meta.get("shN"):
            return np.zeros((self.count, 0, 3), np.float32)
        entries = self.picture("shN", 0, 65536 * 15 + ROW * 15)
        labels = self.pixels("shN", 1).astype(np.int64)
        chosen = labels[:, 0] + 256 * labels[:, 1]
        k = entries.shape[1] // ROW
        if entries.shape[1] % ROW or k not in (3, 8, 15):
            raise SceneError(f"{self.path}: its palette is {entries.shape[1]} pixels wide, expected 192, 512 or 960")
        flat = entries.reshape(-1, k, 4)[:, :, :3]
        if int(chosen.max()) >= len(flat):
            raise SceneError(f"{self.path}: asks for entry {chosen.max()} of a palette of {len(flat)}")
        if not self.old:
            return self.numbers("shN", "codebook", 256).astype(np.float32)[flat][chosen]
        low, high = self.number("shN", "mins"), self.number("shN", "maxs")
        return (low + flat.astype(np.float32) * np.float32((high - low) / 255))[chosen]

    def between(self, part: str, bytes_: UInt8[np.ndarray, "N C"], first: int = 0) -> Float[np.ndarray, "N C"]:
        """Bytes between the bounds of their channels, of which the first one is `first` (version 1)."""
        chosen = slice(first, first + bytes_.shape[1])
        low, high = (self.numbers(part, name, first + bytes_.shape[1])[chosen] for name in ("mins", "maxs"))
        return low + bytes_ / 255 * (high - low)

    def pixels(self, part: str, place: int) -> UInt8[np.ndarray, "N 4"]:
        """RGBA of each splat."""
        table = self.picture(part, place, 8 * self.count + (1 << 20)).reshape(-1, 4)
        if len(table) < self.count:
            raise SceneError(f"{self.path}: {self.file(part, place)} has {len(table)} pixels for {self.count} splats")
        return table[: self.count]

    def picture(self, part: str, place: int, largest: int) -> UInt8[np.ndarray, "H W 4"]:
        name = self.file(part, place)
        return webp.decode(f"{self.path}: {name}", self.parts(name, 5 * largest + 4096), largest)

    # --- meta.json

    def section(self, part: str) -> dict[str, Any]:
        found = self.meta.get(part)
        if not isinstance(found, dict):
            raise SceneError(f"{self.path}: its meta.json has no '{part}', or it is no object")
        return found

    def file(self, part: str, place: int) -> str:
        """The name of a part's picture, which lies beside meta.json."""
        files = self.section(part).get("files")
        name = files[place] if isinstance(files, list) and len(files) > place else None
        if not isinstance(name, str) or not name or Path(name).name != name or "\\" in name:
            raise SceneError(f"{self.path}: file {place} of '{part}' in meta.json is {name!r}, expected a name")
        return name

    def numbers(self, part: str, name: str, count: int = 1) -> Float[np.ndarray, " P"]:
        """`count` or more finite numbers."""
        listed = self.section(part).get(name)
        numbers = np.array([n for n in map(_number, listed) if n is not None] if isinstance(listed, list) else [])
        if len(numbers) < count or not isinstance(listed, list) or len(numbers) != len(listed):
            raise SceneError(f"{self.path}: {part}.{name} in meta.json is no list of {count} finite numbers")
        return numbers

    def number(self, part: str, name: str) -> float:
        found = _number(self.section(part).get(name))
        if found is None:
            raise SceneError(f"{self.path}: {part}.{name} in meta.json is no finite number")
        return found


def _number(found: Any) -> float | None:
    """A finite number; None for anything else."""
    return float(found) if type(found) in (int, float) and abs(found) < 1e300 else None


def _meta(path: Path, parts: Parts) -> dict[str, Any]:
    try:
        meta = json.loads(parts(META, META_LIMIT))
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: its meta.json cannot be read ({error})") from error
    if not isinstance(meta, dict):
        raise SceneError(f"{path}: its meta.json is no object")
    return meta


def _parts(path: Path) -> Parts:
    """The files of an archive, or of the folder in which `path` is the meta.json."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            if not file.read(64).lstrip().startswith(b"{"):
                raise SceneError(f"{path}: is no SOG: neither a zip archive nor a meta.json, or is truncated")
        return lambda name, limit: _beside(path, path if name == META else path.with_name(name), limit)
    return lambda name, limit: _inside(path, name, limit)


def _beside(path: Path, file: Path, limit: int) -> bytes:
    if not file.is_file():
        raise SceneError(f"{path}: its picture {file.name} is missing beside it")
    if file.stat().st_size > limit:
        raise SceneError(f"{file}: has {file.stat().st_size} bytes, expected {limit} at most")
    return file.read_bytes()


def _inside(path: Path, name: str, limit: int) -> bytes:
    """Never more than `limit` bytes, whatever the archive says."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(name) as file:
            data = file.read(limit + 1)
    except KeyError:
        raise SceneError(f"{path}: has no {name} in it, so it is no whole SOG") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise SceneError(f"{path}: is damaged: {name} cannot be read ({error})") from error
    if len(data) > limit:
        raise SceneError(f"{path}: {name} is more than {limit} bytes long, as no part of these splats is")
    return data
