"""PLY files: of other tools, damaged, empty, in text, with values that no splat has."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .cases import Case, Place, case

ORBIT = ["data.source=", "data.orbit_views=4", "data.test_every=2", "system.gs_source=scene.ply"]
NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
ply = partial(case, "PLY")


def table(n: int = 20) -> dict[str, np.ndarray]:
    """Columns of n good splats."""
    draw = np.random.default_rng(0)
    columns = {name: draw.uniform(-0.5, 0.5, n) for name in NAMES}
    columns |= {f"scale_{i}": np.full(n, -2.0) for i in range(3)}
    return columns | {"rot_0": np.ones(n), "opacity": np.full(n, 2.0)}


def encode(columns: dict[str, np.ndarray], format: str = "binary_little_endian", count: int | None = None) -> bytes:
    """A PLY of these columns. count: how many rows the header promises, if not those that there are."""
    rows = np.stack(list(columns.values()), axis=1)
    head = f"ply\nformat {format} 1.0\nelement vertex {len(rows) if count is None else count}\n"
    head += "".join(f"property float {name}\n" for name in columns) + "end_header\n"
    if format == "ascii":
        return (head + "\n".join(" ".join(map(str, row)) for row in rows) + "\n").encode()
    return head.encode() + rows.astype(">f4" if "big" in format else "<f4").tobytes()


def given(content: bytes | str, *more: str) -> Callable[[Place], Sequence[str]]:
    """An edit of scene.ply with this content."""
    return lambda place: [*ORBIT, *more] if place.write("scene.ply", content) else []


def with_values(count: int = 1, **values: float) -> Callable[[Place], Sequence[str]]:
    """The first `count` splats with other values."""
    columns = table()
    for name, value in values.items():
        columns[name][:count] = value
    return given(encode(columns))


def without(*names: str) -> Callable[[Place], Sequence[str]]:
    """Splats that lack properties."""
    return given(encode({name: column for name, column in table().items() if name not in names}))


def header(*lines: str) -> Callable[[Place], Sequence[str]]:
    """A header of one's own, and no rows."""
    return given("\n".join(["ply", *lines, "end_header", ""]))


def mesh() -> str:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    return head + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def named(name: str) -> Callable[[Place], Sequence[str]]:
    """A file under another name than the one that is given."""
    return lambda place: [*ORBIT[:-1], f"system.gs_source={name}"] if place.copy("scene.ply") else []


def folder(place: Place) -> Sequence[str]:
    (place / "scene.ply").mkdir()
    return ORBIT


def loop(place: Place) -> Sequence[str]:
    (place / "scene.ply").symlink_to("scene.ply")
    return ORBIT


def pipe(place: Place) -> Sequence[str]:
    os.mkfifo(place / "scene.ply")
    return ORBIT


GOOD = encode(table())
CASES: list[Case] = [
    ply("no such file", named("point_cloud.ply"), "point_cloud.ply", "no such file"),
    ply("another letter case in the name", named("Scene.ply"), "Scene.ply", "no such file"),
    ply("the file's name without .ply", named("scene"), "no such file"),
    ply("a folder", folder, "scene.ply", "folder"),
    ply("a link that leads to itself", loop, "scene.ply"),
    ply("a pipe", pipe, "scene.ply"),
    ply("an empty file", given(b""), "scene.ply", "not a PLY"),
    ply("a web page (a download that failed)", given("<!DOCTYPE html><html>404</html>"), "not a PLY"),
    ply(
        "a pointer of Git LFS", given("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"), "not a PLY"
    ),
    ply("a .splat file under this name", given(bytes(range(256)) * 8), "not a PLY"),
    ply("a zip archive", given(b"PK\x03\x04" + bytes(99)), "not a PLY"),
    ply("cut off in the rows", given(GOOD[: len(GOOD) // 2]), "truncated"),
    ply("cut off in the header", given(GOOD[:60]), "end_header"),
    ply("a mesh", given(mesh()), "is a mesh", "system.mesh"),
    ply(
        "a point cloud with colours",
        given(encode({n: table()[n] for n in "xyz"} | {c: table()["x"] for c in ("red", "green", "blue")})),
        "point cloud",
    ),
    ply(
        "compressed splats",
        given(encode({"packed_position": np.zeros(9), "packed_rotation": np.zeros(9)})),
        "compressed",
    ),
    ply("a 2DGS export", without("scale_2"), "scale_2", "2DGS"),
    ply("without opacity", without("opacity"), "opacity"),
    ply("without rotations", without("rot_0", "rot_1", "rot_2", "rot_3"), "rot_0"),
    ply("without colours", without("f_dc_0", "f_dc_1", "f_dc_2"), "f_dc_0"),
    ply("f_rest_* with a gap", given(encode(table() | {f"f_rest_{i}": np.zeros(20) for i in (0, 2)})), "f_rest_1"),
    ply("seven f_rest_*", given(encode(table() | {f"f_rest_{i}": np.zeros(20) for i in range(7)})), "7 f_rest_"),
    ply("no rows", given(encode({name: column[:0] for name, column in table().items()})), "zero splats"),
    ply(
        "a property twice",
        header("format ascii 1.0", "element vertex 1", "property float x", "property float x"),
        "twice",
        "'x'",
    ),
    ply(
        "an element twice",
        header("format ascii 1.0", "element vertex 0", "property float x", "element vertex 0", "property float x"),
        "scene.ply",
    ),
    ply("a format that is not known", header("format binary 1.0", "element vertex 1"), "format"),
    ply("a number type that is not known", header("format ascii 1.0", "element vertex 1", "property half x"), "half x"),
    ply("a negative count", header("format ascii 1.0", "element vertex -5", "property float x"), "vertex -5"),
    ply("a count that is no number", header("format ascii 1.0", "element vertex many"), "vertex many"),
    ply("a property before any element", header("format ascii 1.0", "property float x"), "float x"),
    ply("text with 4e9 rows announced", given(encode(table(), "ascii", 4_000_000_000)), "truncated"),
    ply("binary with 4e9 rows announced", given(encode(table(), count=4_000_000_000)), "truncated"),
    ply("binary with 1e30 rows announced", given(encode(table(), count=10**30)), "scene.ply"),
    ply("text with too few numbers in a row", given(encode(table(), "ascii").replace(b" 1.0 ", b" ", 1)), "scene.ply"),
    ply("text with a word for a number", given(encode(table(), "ascii").replace(b"2.0", b"two", 1)), "scene.ply"),
    ply("text with decimal commas", given(encode(table(), "ascii").replace(b"-2.0", b"-2,0")), "scene.ply"),
    ply("text with rows missing", given(encode(table(), "ascii", 30)), "truncated"),
    ply(
        "a list property in the rows",
        given("ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int i\nend_header\n"),
        "list property",
    ),
    ply("NaN positions", with_values(3, x=np.nan), "3 of 20", "system.drop_nonfinite"),
    ply("infinite scales", with_values(2, scale_0=np.inf), "2 of 20"),
    ply(
        "all NaN and drop_nonfinite", lambda p: [*with_values(20, x=np.nan)(p), "system.drop_nonfinite=true"], "all 20"
    ),
    ply("huge scales (not logarithms: 1e30)", with_values(3, scale_0=1e30), "scale"),
    ply("scales whose exponential overflows", with_values(20, scale_0=100, scale_1=100, scale_2=100), "scale"),
    ply(
        "zero quaternions: the run goes on",
        with_values(3, rot_0=0, rot_1=0, rot_2=0, rot_3=0),
        "wrote",
        status=0,
        seconds=30,
    ),
    ply("positions of 1e30", with_values(20, x=1e30), "scene.ply"),
    ply(
        "another PLY as the original that is not there",
        lambda p: [*given(GOOD)(p), "system.original=none.ply"],
        "none.ply",
    ),
    case("mesh", "not there", ["system.mesh=bunny.obj"], "bunny.obj", config="fit"),
    case(
        "mesh",
        "an empty file",
        lambda p: p.write("bunny.obj", "") and ["system.mesh=bunny.obj"],
        "bunny.obj",
        config="fit",
    ),
    case(
        "mesh",
        "of another kind",
        lambda p: p.write("bunny.blend", b"BLENDER-v300") and ["system.mesh=bunny.blend"],
        "bunny.blend",
        config="fit",
    ),
]
