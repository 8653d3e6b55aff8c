"""The PLY container: header, and the table of the `vertex` element, binary of both byte orders and text."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import SceneError

TYPES = dict(char="i1", uchar="u1", short="i2", ushort="u2", int="i4", uint="u4", float="f4", double="f8")
ALIASES = dict(int8="i1", uint8="u1", int16="i2", uint16="u2", int32="i4", uint32="u4", float32="f4", float64="f8")
NAMES = {code: name for name, code in TYPES.items()}
ORDERS = dict(binary_little_endian="<", binary_big_endian=">", ascii="")
BLOCK = 4096  # rows, about 1 MB of splats
HEADER_LIMIT = 1 << 16  # bytes; a header of splats has about 2 KB


@dataclass(frozen=True)
class PlyTable:
    """The vertices of a file. columns: name -> [count], views of one table. elements: name -> rows of each."""

    columns: dict[str, np.ndarray]
    count: int
    elements: dict[str, int]

    def matrix(self, names: list[str]) -> np.ndarray:
        """The named columns side by side, a new float32 array [count, len(names)]."""
        out = np.empty((self.count, len(names)), np.float32)
        for start in range(0, self.count, BLOCK):  # rows lie together on disk: column by column misses the cache
            rows = slice(start, start + BLOCK)
            for i, name in enumerate(names):
                out[rows, i] = self.columns[name][rows]
        return out


@dataclass
class Element:
    """One element of a header. properties: name -> type code; a list property has the code "list"."""

    name: str
    count: int
    properties: dict[str, str]

    def add(self, name: str, code: str) -> None:
        """Append a property. Raises KeyError where the name is taken."""
        if name in self.properties:
            raise KeyError(f"property '{name}' is there twice")
        self.properties[name] = code

    def dtype(self, path: Path, order: str) -> np.dtype:
        listed = [name for name, code in self.properties.items() if code == "list"]
        if listed:
            raise SceneError(f"{path}: list property '{listed[0]}' of element '{self.name}' cannot be skipped")
        return np.dtype([(name, order + code) for name, code in self.properties.items()])


def read_vertices(path: Path) -> PlyTable:
    """Read the `vertex` element of a PLY file, of any byte order or in text.

    Raises SceneError: no such file, not a PLY, a header that cannot be read, fewer rows than the header says.
    """
    with _opened(path) as file:
        order, elements, _ = _header(path, file)
        before = list(itertools.takewhile(lambda e: e.name != "vertex", elements))
        if len(before) == len(elements):
            found = ", ".join(e.name for e in elements) or "none"
            raise SceneError(f"{path}: has no element 'vertex' (found {found}), so it holds no splats")
        vertex = elements[len(before)]
        if not vertex.properties:
            raise SceneError(f"{path}: its element 'vertex' has no properties, so it holds no splats")
        if order:
            skip = sum(e.count * e.dtype(path, order).itemsize for e in before)
            table = _binary(path, file, vertex, vertex.dtype(path, order), skip)
        else:
            table = _text(path, file, vertex, skip=sum(e.count for e in before))
    columns = {name: table[name] for name in vertex.properties}
    return PlyTable(columns, vertex.count, {e.name: e.count for e in elements})


def read_elements(path: Path) -> dict[str, np.ndarray]:
    """All elements of a binary PLY without lists: name -> structured table [rows].

    Raises SceneError as `read_vertices` does, and for text.
    """
    with _opened(path) as file:
        order, elements, _ = _header(path, file)
        if not order:
            raise SceneError(f"{path}: is a PLY in text, expected a binary one for packed splats")
        tables = {}
        for element in elements:
            dtype = element.dtype(path, order)
            if dtype.itemsize:
                tables[element.name] = _binary(path, file, element, dtype, 0)
    return tables


def read_comments(path: Path) -> list[str]:
    """The comments in the header of a PLY file. Raises SceneError as `read_vertices` does for a header."""
    with _opened(path) as file:
        return _header(path, file)[2]


def write_vertices(
    path: Path,
    names: list[str],
    core: np.ndarray,
    extra: dict[str, np.ndarray],
    before: dict[str, np.ndarray] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write one `vertex` element, binary little endian: the columns `before`, `core` [N, len(names)] as float, and the
    columns `extra`. comments: lines of the header, ASCII."""
    rows, before = len(core), before or {}

    def kinds_of(columns: dict[str, np.ndarray]) -> list[tuple[str, str]]:
        return [(NAMES[column.dtype.str[1:]], name) for name, column in columns.items()]

    kinds = [*kinds_of(before), *(("float", name) for name in names), *kinds_of(extra)]
    header = "ply\nformat binary_little_endian 1.0\n{}element vertex {}\n{}end_header\n".format(
        "".join(f"comment {line}\n" for line in comments),
        rows,
        "".join(f"property {kind} {name}\n" for kind, name in kinds),
    )
    first, last = ([(name, "<" + c.dtype.str[1:]) for name, c in columns.items()] for columns in (before, extra))
    table = np.empty(rows, [*first, (" core", "<f4", (len(names),)), *last])
    table[" core"] = core
    for name, column in {**before, **extra}.items():
        table[name] = column
    with path.open("wb") as file:
        file.write(header.encode())
        file.write(table.view(np.uint8).data)  # `tofile` would not say why it cannot


def write_elements(path: Path, tables: dict[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Write structured tables as elements, binary little endian."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    for name, table in tables.items():
        lines.append(f"element {name} {len(table)}")
        fields = (table.dtype.fields or {}).items()
        lines += [f"property {NAMES[kind[0].str[1:]]} {column}" for column, kind in fields]
    with path.open("wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        for table in tables.values():
            file.write(table.view(np.uint8).data)


def _opened(path: Path) -> BinaryIO:
    if not path.is_file():
        raise SceneError(f"{path}: no such file" if not path.is_dir() else f"{path}: is a folder, expected a PLY file")
    return path.open("rb")


def _header(path: Path, file: BinaryIO) -> tuple[str, list[Element], list[str]]:
    """Byte order, elements and comments."""
    if file.readline(16).strip() != b"ply":
        raise SceneError(f"{path}: is not a PLY file (it does not begin with 'ply')")
    order, elements, comments = None, [], []
    while (line := file.readline(HEADER_LIMIT)).endswith(b"\n") and file.tell() < HEADER_LIMIT:
        words = line.decode("latin-1").split()
        if words == ["end_header"]:
            break
        try:
            if not words or words[0] in ("comment", "obj_info"):
                comments += [" ".join(words[1:])] if words[:1] == ["comment"] else []
                continue
            if words[0] == "format":
                order = ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(Element(words[1], _count(words[2]), {}))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].add(words[4], "list")
            elif words[0] == "property":
                elements[-1].add(words[2], (TYPES | ALIASES)[words[1]])
            else:
                raise KeyError(words[0])
        except (KeyError, IndexError, ValueError) as error:
            reason = f": {error.args[0]}" if isinstance(error, KeyError) and " " in str(error.args[0]) else ""
            raise SceneError(f"{path}: cannot read the header line '{' '.join(words)[:80]}'{reason}") from None
    else:
        raise SceneError(f"{path}: the header has no 'end_header'; the file is truncated or not a PLY")
    if order is None:
        raise SceneError(f"{path}: the header names no format, expected one of {', '.join(ORDERS)}")
    return order, elements, comments


def _count(word: str) -> int:
    if not word.isdecimal():
        raise ValueError(word)
    return int(word)


def _binary(path: Path, file: BinaryIO, vertex: Element, dtype: np.dtype, skip: int) -> np.ndarray:
    held = max(path.stat().st_size - file.tell() - skip, 0) // max(dtype.itemsize, 1)
    if held < vertex.count:
        raise SceneError(_truncated(path, vertex.count, held))
    return np.fromfile(file, dtype, count=vertex.count, offset=skip)


def _text(path: Path, file: BinaryIO, vertex: Element, skip: int) -> np.ndarray:
    # In text a number takes two bytes at least, its blank included, and every row but the last a line's end.
    held = (path.stat().st_size - file.tell() + 1) // max(2 * len(vertex.properties), 1)
    if held < vertex.count:
        raise SceneError(_truncated(path, vertex.count, f"no more than {held}"))
    table = np.empty(vertex.count, vertex.dtype(path, "="))
    if vertex.count == 0:
        return table
    rows = itertools.islice(filter(bytes.strip, file), skip, skip + vertex.count)
    try:
        numbers = np.loadtxt(rows, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise SceneError(f"{path}: cannot read the rows of text: {error}") from None
    if len(numbers) < vertex.count:
        raise SceneError(_truncated(path, vertex.count, len(numbers)))
    if numbers.shape[1] != len(vertex.properties):
        raise SceneError(f"{path}: {numbers.shape[1]} numbers in a row, expected {len(vertex.properties)}")
    for name, column in zip(vertex.properties, numbers.T, strict=True):
        table[name] = column
    return table


def _truncated(path: Path, expected: int, got: int | str) -> str:
    return f"{path}: is truncated: the header promises {expected} splats, the file holds {got}. Copy or export it again"
