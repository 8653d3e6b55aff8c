"""Splat files: what 3DGS tools write is read, what is written comes back bit for bit, all else says why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from dreamcatalyst.errors import FileError, SceneError
from dreamcatalyst.scene.formats.api import read_splats
from dreamcatalyst.scene.gaussians import SH_C0, Gaussians
from dreamcatalyst.scene.ply import read_ply, write_ply
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

TYPES = {"<f4": "float", ">f4": "float", "<f8": "double", "u1": "uchar", "<u2": "ushort", "<i4": "int", "<u4": "uint"}
BITS = st.floats(width=32, allow_nan=False, allow_infinity=False)


def names(degree: int = 3, normals: bool = True) -> list[str]:
    """INRIA's properties in INRIA's order."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    scales, quats = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    colors = ["f_dc_0", "f_dc_1", "f_dc_2", *rest]
    return ["x", "y", "z", *(["nx", "ny", "nz"] if normals else []), *colors, "opacity", *scales, *quats]


def table(properties: list[str], n: int = 3, code: str = "<f4") -> np.ndarray:
    """Row r of property p holds 100 r + p."""
    out = np.zeros(n, [(name, code) for name in properties])
    for p, name in enumerate(properties):
        out[name] = 0 if name in ("nx", "ny", "nz") else 100 * np.arange(n) + p
    return out


def dump(path: Path, rows: np.ndarray, order: str = "binary_little_endian", count: int | None = None) -> Path:
    """A PLY written by hand, independently of the product."""
    lines = ["ply", f"format {order} 1.0", "comment by hand", f"element vertex {len(rows) if count is None else count}"]
    codes = [(name, TYPES[rows.dtype[name].str.replace("|", "")]) for name in rows.dtype.names]
    lines += [f"property {kind} {name}" for name, kind in codes] + ["end_header\n"]
    body = "\n".join(" ".join(repr(v) for v in row) for row in rows.tolist()).encode() + b"\n"
    path.write_bytes("\n".join(lines).encode() + (body if order == "ascii" else rows.tobytes()))
    return path


def random_scene(n: int = 5, degree: int = 3, **extra: torch.Tensor) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, (degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=g) for shape in shapes), extra=extra)


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(x, y) for (_, x), (_, y) in zip(a.parameters(), b.parameters(), strict=True))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_layout_is_inrias(tmp_path, degree):
    properties = names(degree)
    scene = read_ply(dump(tmp_path / "a.ply", table(properties)))
    at = {name: p for p, name in enumerate(properties)}
    assert scene.sh_degree == degree and not scene.extra
    assert scene.means[2].tolist() == [200, 201, 202]
    assert scene.quats[1].tolist() == [100.0 + at[f"rot_{i}"] for i in range(4)]  # wxyz
    assert scene.log_scales[0].tolist() == [at[f"scale_{i}"] for i in range(3)]
    assert scene.logit_opacities.tolist() == [at["opacity"] + 100 * r for r in range(3)]
    assert scene.sh0[0, 0].tolist() == [6, 7, 8]
    k = (degree + 1) ** 2 - 1
    for channel in range(3):  # f_rest_* is channel-major
        assert scene.shN[0, :, channel].tolist() == [at[f"f_rest_{channel * k + i}"] for i in range(k)]


def test_a_file_comes_back_byte_for_byte(tmp_path):
    first = dump(tmp_path / "a.ply", table(names()))
    write_ply(tmp_path / "b.ply", read_ply(first))
    assert (tmp_path / "b.ply").read_bytes() == first.read_bytes().replace(b"comment by hand\n", b"")


@settings(max_examples=25, deadline=None)
@given(data=st.data(), n=st.integers(1, 6), degree=st.integers(0, 3))
def test_round_trip_is_exact(tmp_path_factory, data, n, degree):
    k = (degree + 1) ** 2 - 1

    def draw(*shape: int) -> torch.Tensor:
        return torch.from_numpy(data.draw(arrays(np.float32, shape, elements=BITS)))

    scene = Gaussians(draw(n, 3), draw(n, 4), draw(n, 3), draw(n), draw(n, 1, 3), draw(n, k, 3), {"e": draw(n)})
    back = read_ply(write_ply(tmp_path_factory.mktemp("ply") / "a.ply", scene))
    assert same(scene, back) and torch.equal(scene.extra["e"], back.extra["e"])


def test_extras_survive_in_their_type(tmp_path):
    n = 5
    scene = random_scene(
        n,
        mask=torch.tensor([True, False, True, True, False]),
        generation=torch.tensor([0, 1, 2, 2**31, 2**32 - 1]),
        level=torch.tensor([-1, 0, 1, 2, 3]),
        depth=torch.linspace(0, 1, n, dtype=torch.float64),
        half=torch.ones(n, dtype=torch.float16),
        anchor=torch.arange(2.0 * n).reshape(n, 2),
    )
    back = read_ply(write_ply(tmp_path / "a.ply", scene))
    assert back.extra["mask"].dtype == torch.uint8 and torch.equal(back.extra["mask"].bool(), scene.extra["mask"])
    assert torch.equal(back.extra["generation"], scene.extra["generation"])
    assert torch.equal(back.extra["level"], scene.extra["level"].int())
    assert torch.equal(back.extra["depth"], scene.extra["depth"])
    assert torch.equal(back.extra["half"], torch.ones(n))
    assert torch.equal(back.extra["anchor_1"], scene.extra["anchor"][:, 1])
    again = read_ply(write_ply(tmp_path / "b.ply", back))
    assert all(
        torch.equal(again.extra[k], back.extra[k]) and again.extra[k].dtype == v.dtype for k, v in back.extra.items()
    )


def test_normals_survive_where_they_are_not_zero(tmp_path):
    rows = table(names())
    rows["ny"] = 1
    path = dump(tmp_path / "a.ply", rows)
    scene = read_ply(path)
    assert scene.extra["ny"].tolist() == [1, 1, 1]
    assert write_ply(tmp_path / "b.ply", scene).read_bytes() == path.read_bytes().replace(b"comment by hand\n", b"")


@pytest.mark.parametrize(
    "order, code", [("binary_big_endian", ">f4"), ("ascii", "<f4"), ("binary_little_endian", "<f8")]
)
def test_other_encodings(tmp_path, order, code):
    truth = read_ply(dump(tmp_path / "a.ply", table(names())))
    assert same(truth, read_ply(dump(tmp_path / "b.ply", table(names(), code=code), order)))


def test_text_is_exact(tmp_path):
    rows = table(names(1), n=4)
    for name in rows.dtype.names:
        rows[name] = np.random.default_rng(1).normal(size=4).astype(np.float32)
    assert same(read_ply(dump(tmp_path / "a.ply", rows)), read_ply(dump(tmp_path / "b.ply", rows, "ascii")))


def test_another_order_without_normals_and_with_unsigned_numbers(tmp_path):
    properties = names(2, normals=False)
    rows = table(properties)
    mixed = np.zeros(3, [("id", "<u4"), ("tag", "<u2"), *[(name, "<f4") for name in reversed(properties)]])
    for name in properties:
        mixed[name] = rows[name]
    mixed["id"], mixed["tag"] = [2**32 - 1, 1, 2], [65535, 1, 2]
    scene = read_ply(dump(tmp_path / "b.ply", mixed))
    assert same(scene, read_ply(dump(tmp_path / "a.ply", rows)))
    assert scene.extra["id"].tolist() == [2**32 - 1, 1, 2] and scene.extra["tag"].tolist() == [65535, 1, 2]


def test_plain_colours_as_nerfstudio_may_export_them(tmp_path):
    kept = [name for name in names(0) if not name.startswith("f_dc")]
    rows = np.zeros(2, [(name, "<f4") for name in kept] + [(c, "u1") for c in ("red", "green", "blue")])
    rows["red"], rows["green"] = 255, 51
    scene = read_ply(dump(tmp_path / "a.ply", rows))
    assert scene.sh_degree == 0 and not scene.extra
    torch.testing.assert_close(0.5 + SH_C0 * scene.sh0[0, 0], torch.tensor([1, 0.2, 0]))


def test_elements_before_and_behind_are_passed_over(tmp_path):
    rows = table(names(0))
    dump(tmp_path / "a.ply", rows)
    for order, before in (("binary_little_endian", b"\x01\x02\x03\x04" * 2), ("ascii", b"7\n8\n")):
        text = dump(tmp_path / "b.ply", rows, order).read_bytes()
        head, body = text.split(b"end_header\n", 1)
        head = head.replace(b"element vertex", b"element camera 2\nproperty int number\nelement vertex")
        (tmp_path / "b.ply").write_bytes(
            head + b"element face 0\nproperty list uchar int i\nend_header\n" + before + body
        )
        assert same(read_ply(tmp_path / "b.ply"), read_ply(tmp_path / "a.ply"))


def test_a_name_appears_only_when_the_file_is_complete(tmp_path, monkeypatch):
    path = write_ply(tmp_path / "new" / "a.ply", random_scene())
    before = path.read_bytes()

    def fails(*args):
        Path(args[0]).write_bytes(b"ply half")
        raise OSError("disk full")

    monkeypatch.setattr("dreamcatalyst.scene.ply.write_vertices", fails)
    with pytest.raises(FileError, match="a.ply: cannot be written: disk full"):
        write_ply(path, random_scene(7))
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == ["a.ply"]


def test_rows_that_are_not_finite(tmp_path, capsys):
    rows = table(names(0), n=4)
    rows["rot_1"][1], rows["opacity"][3] = np.nan, np.inf
    path = dump(tmp_path / "a.ply", rows)
    with pytest.raises(SceneError, match=r"2 of 4 splats have NaN or infinite.*row 1.*drop_nonfinite"):
        read_ply(path)
    scene = read_ply(path, drop_nonfinite=True)
    assert scene.means[:, 0].tolist() == [0, 200]
    assert "2 of 4 splats" in capsys.readouterr().out
    for name in ("x", "scale_0"):
        rows[name] = np.nan
    with pytest.raises(SceneError, match="all 4 splats"):
        read_ply(dump(path, rows), drop_nonfinite=True)


def without(*gone: str) -> list[str]:
    return [name for name in names(1) if name not in gone]


@pytest.mark.parametrize(
    "properties, message",
    [
        (without("rot_3"), r"'rot_3' is missing \(found .*rot_0..rot_2\).*2DGS"),
        (without("scale_2"), r"'scale_2' is missing.*2DGS"),
        (without("opacity"), "'opacity' is missing"),
        (without("f_rest_4"), "'f_rest_4' is missing.*0, 9, 24 or 45"),
        (without("f_rest_8"), "8 f_rest_.*0, 9, 24 or 45"),
        (["x", "y", "z"], "plain point cloud, not splats: found x, y, z.*system\\.mesh"),
        (["packed_position", "packed_color"], "compressed splats.*uncompressed"),
    ],
)
def test_missing_properties(tmp_path, properties, message):
    with pytest.raises(SceneError, match=message):
        read_ply(dump(tmp_path / "a.ply", table(properties)))


def test_a_mesh_instead_of_splats(tmp_path):
    import trimesh

    trimesh.creation.box().export(tmp_path / "a.ply")
    with pytest.raises(SceneError, match=r"a mesh \(it has faces\), not splats.*system\.mesh"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_truncated_files_and_zero_splats(tmp_path, order):
    path = dump(tmp_path / "a.ply", table(names(0)), order, count=5)
    with pytest.raises(SceneError, match="truncated: the header promises 5 splats, the file holds 3"):
        read_ply(path)
    with pytest.raises(SceneError, match="zero splats"):
        read_ply(dump(path, table(names(0), n=0), order))
    header = path.read_bytes()[:60]
    path.write_bytes(header)
    with pytest.raises(SceneError, match="end_header"):
        read_ply(path)


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_more_rows_than_the_file_has_bytes_take_no_memory(tmp_path, order):
    """Four thousand million splats would be 268 GiB."""
    path = dump(tmp_path / "a.ply", table(names(0)), order, count=4_000_000_000)
    with pytest.raises(SceneError, match="truncated: the header promises 4000000000 splats"):
        read_ply(path)


def test_splats_that_nobody_can_draw_are_refused_or_left_out(tmp_path, capsys):
    """Scales that are no logarithms, and places whose squares float32 does not hold; far worlds are no such place."""
    rows = table(names(0), n=4)
    for name in ("x", "y", "z", "scale_0", "scale_1", "scale_2"):
        rows[name] = -2.0
    rows["x"] += 3e6
    assert len(read_splats(dump(tmp_path / "a.ply", rows))) == 4
    rows["scale_1"][2], rows["x"][1] = 100.0, 1e30
    path = dump(tmp_path / "b.ply", rows)
    with pytest.raises(SceneError, match=r"1 of 4 splats have positions beyond 1e\+15 .first: row 1"):
        read_splats(path)
    assert len(read_splats(path, drop_nonfinite=True)) == 2
    assert "scale_* are logarithms" in capsys.readouterr().out
    rows["x"] = 1e30
    with pytest.raises(SceneError, match="4 of 4 splats have positions"):  # also where that is the world's middle
        read_splats(dump(tmp_path / "c.ply", rows), origin=(1e30, 0.0, 0.0))


def test_files_that_are_no_ply(tmp_path):
    with pytest.raises(SceneError, match="no such file"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(SceneError, match="is a folder"):
        read_ply(tmp_path)
    path = tmp_path / "a.ply"
    for content, message in [
        (b"\x00\x01", "not a PLY"),
        (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "header line 'format binary_middle_endian 1.0'"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n", "header line 'property quad x'"),
        (b"ply\nelement vertex 1\nend_header\n", "names no format"),
        (b"ply\nformat ascii 1.0\nelement edge 1\nend_header\n", "no element 'vertex' .found edge"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\nb\n", "rows of text"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1 1\n2 2\n", "2 numbers in a row"),
    ]:
        path.write_bytes(content)
        with pytest.raises(SceneError, match=message):
            read_ply(path)


def test_extras_that_cannot_be_written(tmp_path):
    with pytest.raises(SceneError, match="beyond 32 bits"):
        write_ply(tmp_path / "a.ply", random_scene(2, big=torch.tensor([0, 2**33])))
    with pytest.raises(SceneError, match="'opacity' has the name"):
        write_ply(tmp_path / "a.ply", random_scene(2, opacity=torch.zeros(2)))
    assert not list(tmp_path.iterdir())


def test_other_precisions_are_written_as_float(tmp_path):
    scene = random_scene()
    assert same(scene, read_ply(write_ply(tmp_path / "a.ply", scene.to(dtype=torch.float64))))


def test_a_scene_without_rows_keeps_its_properties(tmp_path):
    scene = Gaussians.from_colors(torch.zeros(0, 3), torch.ones(0, 3), torch.zeros(0, 3), torch.zeros(0))
    path = write_ply(
        tmp_path / "none.ply", scene.with_extra(part=torch.zeros(0, dtype=torch.uint8), pair=torch.zeros(0, 2))
    )
    header = path.read_bytes().decode()
    assert "element vertex 0" in header and "uchar part" in header and "float pair_1" in header
