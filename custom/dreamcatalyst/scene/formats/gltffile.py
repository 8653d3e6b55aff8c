"""The glTF 2.0 container: JSON and binary data in one file (.glb), or beside one another (.gltf)."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np

from ...errors import SceneError

MAGIC, JSON_CHUNK, BIN_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class GltfFile:
    """One file. tree: its JSON. Raises SceneError for what is no glTF 2.0, or damaged."""

    def __init__(self, path: Path):
        self.path = path
        self._buffers: dict[Any, bytes | memoryview] = {}
        data = path.read_bytes()
        text = data
        if data.startswith(MAGIC):
            text, self._buffers[0] = self._chunks(data)
        try:
            tree = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise SceneError(f"{path}: is no glTF: its JSON cannot be read ({error})") from error
        if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
            raise SceneError(f"{path}: is no glTF: its JSON has no 'asset'")
        self.tree = tree
        if str(tree["asset"].get("version", "")).split(".")[0] != "2":
            raise SceneError(f"{path}: is glTF version {tree['asset'].get('version')!r}, expected 2.0")

    def _chunks(self, data: bytes) -> tuple[bytes, memoryview]:
        """The JSON and the binary data of a .glb."""
        if len(data) < 20:
            raise SceneError(f"{self.path}: is truncated: {len(data)} bytes, expected 20 of a .glb's header")
        version, total = struct.unpack_from("<II", data, 4)
        if version != 2:
            raise SceneError(f"{self.path}: is a .glb of version {version}, expected 2")
        if total > len(data):
            raise SceneError(f"{self.path}: is truncated: promises {total} bytes, holds {len(data)}. Copy it again")
        found, at = {}, 12
        while at + 8 <= total:
            size, kind = struct.unpack_from("<II", data, at)
            if at + 8 + size > total:
                raise SceneError(f"{self.path}: is damaged: a chunk of {size} bytes ends behind the file")
            found.setdefault(kind, memoryview(data)[at + 8 : at + 8 + size])
            at += 8 + size
        if JSON_CHUNK not in found:
            raise SceneError(f"{self.path}: is a .glb without JSON; it is damaged")
        return bytes(found[JSON_CHUNK]), found.get(BIN_CHUNK, memoryview(b""))

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of one of the lists at the top (accessors, nodes ...)."""
        listed = self.tree.get(kind)
        good = isinstance(listed, list) and type(index) is int and 0 <= index < len(listed)
        if not good or not isinstance(listed[index], dict):
            raise SceneError(f"{self.path}: refers to {kind}[{index!r}], which is not there; it is damaged")
        return listed[index]

    def number(self, item: Mapping[str, Any], name: str, default: int | None = None) -> int:
        """A whole number from 0 on."""
        found = item.get(name, default)
        if type(found) is not int or found < 0:
            raise SceneError(f"{self.path}: {name} is {found!r}, expected a whole number")
        return found

    def view(self, index: Any) -> memoryview:
        """The bytes of a bufferView."""
        item = self.item("bufferViews", index)
        data = self._buffer(item.get("buffer"))
        start, size = self.number(item, "byteOffset", 0), self.number(item, "byteLength")
        if start + size > len(data):
            raise SceneError(
                f"{self.path}: is truncated: bufferViews[{index}] ends at byte {start + size} of {len(data)}"
            )
        return data[start : start + size]

    def accessor(self, index: Any, width: int) -> np.ndarray:
        """Numbers [N,width]; normalized ones as float32."""
        item = self.item("accessors", index)
        count, offset = self.number(item, "count"), self.number(item, "byteOffset", 0)
        kind, width_here = item.get("componentType"), WIDTHS.get(str(item.get("type")))
        if kind not in NUMBERS or width_here != width:
            raise SceneError(
                f"{self.path}: accessors[{index}] is {item.get('type')!r} of {kind!r}, expected {width} numbers a splat"
            )
        if "sparse" in item or "bufferView" not in item:
            raise SceneError(f"{self.path}: accessors[{index}] is sparse or empty, which splats are not read from")
        number = np.dtype(NUMBERS[kind])
        data, row = self.view(item["bufferView"]), number.itemsize * width
        stride = self.number(self.item("bufferViews", item["bufferView"]), "byteStride", row)
        if count and (stride < row or offset + stride * (count - 1) + row > len(data)):
            raise SceneError(
                f"{self.path}: is truncated: accessors[{index}] promises {count} rows, its data hold fewer"
            )
        rows = np.ndarray((count, width), number, data, offset, (stride, number.itemsize))
        if item.get("normalized") and number.kind != "f":
            return np.maximum(rows / np.float32(np.iinfo(number).max), -1).astype(np.float32)
        return rows

    def _buffer(self, index: Any) -> memoryview:
        if index not in self._buffers:
            self._buffers[index] = self._load(self.item("buffers", index), index)
        return memoryview(self._buffers[index])

    def _load(self, item: Mapping[str, Any], index: Any) -> bytes:
        uri = item.get("uri")
        if not isinstance(uri, str):
            raise SceneError(f"{self.path}: buffers[{index}] has no data; the file is damaged")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise SceneError(f"{self.path}: buffers[{index}] cannot be decoded ({error})") from error
        file = self.path.parent / unquote(uri)
        if "://" in uri or not file.is_file():
            raise SceneError(f"{self.path}: its data {uri[:80]!r} are not there: they belong beside it")
        return file.read_bytes()

    # --- the scene

    def instances(self) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
        """(matrix [4,4] to the file's world, primitive) of all meshes in the scene."""
        scenes = self.tree.get("scenes")
        if scenes:
            roots = self.item("scenes", self.tree.get("scene", 0)).get("nodes", [])
        else:
            roots = list(range(len(self.tree.get("nodes") or [])))
        todo: list[tuple[Any, np.ndarray, tuple]] = [(node, np.eye(4), ()) for node in _listed(roots)]
        while todo:
            index, parent, above = todo.pop(0)
            node = self.item("nodes", index)
            if index in above:
                raise SceneError(f"{self.path}: nodes[{index}] is below itself; the file is damaged")
            matrix = parent @ self._matrix(node, index)
            if "mesh" in node:
                for primitive in _listed(self.item("meshes", node["mesh"]).get("primitives")):
                    if isinstance(primitive, dict):
                        yield matrix, primitive
            todo += [(child, matrix, (*above, index)) for child in _listed(node.get("children"))]

    def _matrix(self, node: Mapping[str, Any], index: Any) -> np.ndarray:
        def numbers(name: str, default: list[float]) -> np.ndarray:
            listed = node.get(name, default)
            good = (
                isinstance(listed, list)
                and len(listed) == len(default)
                and all(type(n) in (int, float) for n in listed)
            )
            if not good or not np.isfinite(np.array(listed, np.float64)).all():
                raise SceneError(f"{self.path}: {name} of nodes[{index}] is no list of {len(default)} finite numbers")
            return np.array(listed, np.float64)

        if "matrix" in node:
            return numbers("matrix", [0.0] * 16).reshape(4, 4).T
        x, y, z, w = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
        out = np.eye(4)
        out[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        out[:3, :3] *= numbers("scale", [1.0, 1.0, 1.0])
        out[:3, 3] = numbers("translation", [0.0, 0.0, 0.0])
        return out


def _listed(found: Any) -> list[Any]:
    return cast(list, found) if isinstance(found, list) else []


def glb(tree: Mapping[str, Any], size: int) -> bytes:
    """What stands before `size` bytes of binary data (a multiple of 4) in a .glb."""
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + size
    if total >= 1 << 32:
        raise SceneError(f"a .glb holds 4 GiB, and these splats take {total / 2**30:.1f}: export.options.separate=true")
    head = MAGIC + struct.pack("<II", 2, total) + struct.pack("<II", len(text), JSON_CHUNK)
    return head + text + struct.pack("<II", size, BIN_CHUNK)
