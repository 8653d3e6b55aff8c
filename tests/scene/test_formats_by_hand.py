"""Splat formats: files made by hand, byte by byte as their formats are described, are read as what they say."""

from __future__ import annotations

import base64
import gzip
import json
import math
import struct

import numpy as np
import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.formats import webp
from dreamcatalyst.scene.formats.api import read_splats, write_splats
from dreamcatalyst.scene.formats.palette import codebook, palette
from dreamcatalyst.scene.formats.quantized import morton_order, turned
from scipy.spatial.transform import Rotation

from .splatfiles import apart, splats

C0 = 0.28209479177387814


def close(values, expected, tolerance=1e-5):
    assert torch.allclose(values.double(), torch.tensor(expected).double(), atol=tolerance), (values, expected)


def spz(version: int, quats: bytes, degree: int = 0, sh: bytes = b"", count: int = 1) -> bytes:
    """One splat at (1.5, -2, 0.25), right, up, back."""
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0)
    position = b"".join(int(x * 4096).to_bytes(3, "little", signed=True) for x in (1.5, -2.0, 0.25))
    return gzip.compress(head + position + bytes([204, 255, 0, 128, 160, 144, 112]) + quats + sh, mtime=0)


def test_spz_by_hand(tmp_path):
    path = tmp_path / "a.spz"
    turn = math.sin(math.pi / 8)  # of half a right angle about x
    smallest = struct.pack("<I", 3 << 30 | round(turn * math.sqrt(2) * 511) << 20)  # w is the largest
    sh = bytes([128 + 64, 128, 128, 128, 128 - 32, 128, 128, 128, 128 + 96])  # y red, z green, x blue
    path.write_bytes(spz(3, smallest, 1, sh))
    scene = read_splats(path)
    close(scene.means, [[1.5, 2.0, -0.25]])  # y and z look the other way in a PLY
    close(scene.opacities, [0.8])
    close(scene.sh0, [[[0.5 / 0.15, -0.5 / 0.15, 0.5 / 255 / 0.15]]])
    close(scene.log_scales, [[0.0, -1.0, -3.0]])
    close(scene.quats, [[math.cos(math.pi / 8), turn, 0.0, 0.0]], 1e-3)
    close(scene.shN, [[[-0.5, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.75]]])  # y and z are odd in their axes
    path.write_bytes(spz(2, bytes([128, 218, 128])))  # xyz; y = 0.71
    close(read_splats(path).quats, [[0.704, 0.004, -0.71, -0.004]], 2e-3)


@pytest.mark.parametrize(("content", "says"), [
    (spz(5, bytes(4)), "version 5 in gzip|version 5, expected"),
    (spz(3, bytes(4), degree=4), "SH degree 4.*3 at most"),
    (spz(3, bytes(4), count=0), "zero splats"),
    (spz(3, bytes(2)), "truncated: promises 1 splats"),
    (gzip.compress(b"no splats at all", mtime=0), "does not begin with NGSP"),
    (spz(3, bytes(4))[:-3], "truncated|damaged"),
    (b"NGSP" + struct.pack("<IIBBBBI12x", 4, 1, 0, 12, 0, 9, 32), "9 streams"),
    (b"NGSP" + struct.pack("<IIBBBBI12x", 4, 1, 0, 12, 0, 5, 32) + bytes(80), "stream 0 has 0 bytes, expected 9"),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
def test_spz_that_cannot_be_read(tmp_path, content, says):
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(SceneError, match=says):
        read_splats(tmp_path / "a.spz")


def test_splat_by_hand(tmp_path):
    row = struct.pack("<6f", 1, 2, 3, 1.0, math.e, 0.5) + bytes([255, 0, 51, 102, 128, 255, 128, 128])
    (tmp_path / "a.splat").write_bytes(row * 2)
    scene = read_splats(tmp_path / "a.splat")[:1]
    close(scene.means, [[1.0, 2.0, 3.0]])
    close(scene.log_scales, [[0.0, 1.0, math.log(0.5)]])
    close(scene.opacities, [0.4])
    close(scene.sh0 * C0 + 0.5, [[[1.0, 0.0, 0.2]]])
    close(scene.quats, [[0.0, 1.0, 0.0, 0.0]])


def ksplat(grade: int, degree: int) -> bytes:
    """Three splats in two sections, the first one with a full bucket of one splat and a partial one of another."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    head = bytearray(4096)
    head[:2] = bytes([0, 1])
    head[4:20] = struct.pack("<4I", 2, 2, 3, 3)
    head[20:22] = struct.pack("<H", grade)
    head[36:44] = struct.pack("<2f", -2.0, 2.0)
    position = {0: "<3f"}.get(grade, "<3H")
    number = "f" if grade == 0 else "e"
    sh = {0: f"<{rest}f", 1: f"<{rest}e", 2: f"<{rest}B"}[grade]
    values = [255 if grade == 2 else 2.0, *([51 if grade == 2 else -1.2] * (rest - 1))] if rest else []

    def row(*where: float) -> bytes:
        body = struct.pack(position, *where) + struct.pack(f"<3{number}", 1, 1, 2)
        return body + struct.pack(f"<4{number}", 1, 0, 0, 1) + bytes([255, 0, 0, 51]) + struct.pack(sh, *values)

    at = (1.0, 2.0, 3.0) if grade == 0 else (32767 + 16384, 32767, 0)
    sections, data = b"", b""
    for count, full, sizes in ((2, 1, [1]), (1, 1, [])):
        section = bytearray(1024)
        section[:20] = struct.pack("<4If", count, count, 1, full + len(sizes), 10.0)
        section[20:22] = struct.pack("<H", 12)
        section[24:28] = struct.pack("<I", 32767)
        section[32:42] = struct.pack("<IIH", full, len(sizes), degree)
        sections += bytes(section)
        middles = b"".join(struct.pack("<3f", 10 * i, 0, 0) for i in range(full + len(sizes)))
        data += b"".join(struct.pack("<I", size) for size in sizes) + middles + row(*at) * count
    return bytes(head) + sections + data


@pytest.mark.parametrize("grade", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_ksplat_by_hand(tmp_path, grade, degree):
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat(grade, degree))
    scene = read_splats(path)
    bucket = [2.5003, 0.0, -5.0]
    expected = [[1.0, 2.0, 3.0]] * 3 if grade == 0 else [bucket, [12.5003, 0.0, -5.0], bucket]
    close(scene.means, expected, 1e-3)
    close(scene.log_scales, [[0.0, 0.0, math.log(2)]] * 3, 1e-3)
    close(scene.quats, [[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]] * 3, 1e-3)
    close(scene.opacities, [0.2] * 3)
    assert scene.sh_degree == degree
    if degree:
        close(scene.shN[:, 0], [[2.0, -1.2, -1.2]] * 3, 1e-2)
        close(scene.shN[:, 1:].amax(), -1.2, 1e-2)
    path.write_bytes(ksplat(grade, degree)[:-1])
    with pytest.raises(SceneError, match="truncated"):
        read_splats(path)


def test_sog_of_version_1_by_hand(tmp_path):
    def picture(name, rows, width=4):
        table = np.zeros((4, width, 4), np.uint8)
        table.reshape(-1, 4)[: len(rows)] = rows
        (tmp_path / f"{name}.webp").write_bytes(webp.encode(table))
        return f"{name}.webp"

    meta = {
        "means": {"shape": [2, 3], "mins": [0, 0, -2.0], "maxs": [1.0, 2.0, 2.0]},
        "scales": {"mins": [-4.0] * 3, "maxs": [0.0, -2.0, -4.0]},
        "sh0": {"mins": [-1.0, 0.0, 0.0, -5.0], "maxs": [1.0, 2.0, 1.0, 5.0]},
        "quats": {},
        "shN": {"mins": -2.0, "maxs": 2.0},
    }
    files = {"means": ["means_l", "means_u"], "scales": ["scales"], "quats": ["quats"], "sh0": ["sh0"]}
    meta["means"]["files"] = [
        picture("means_l", [[255, 0, 0, 255]] * 2),
        picture("means_u", [[255, 0, 0, 255], [0, 128, 255, 255]]),
    ]
    for part, row in (("scales", [0, 255, 128, 255]), ("sh0", [255, 0, 51, 204]), ("quats", [255, 128, 128, 252])):
        meta[part]["files"] = [picture(files[part][0], [row] * 2)]
    entries = np.zeros((64 * 3, 4), np.uint8)
    entries[:, 3], entries[3:6, 0] = 255, (0, 51, 255)
    labels = picture("labels", [[1, 0, 0, 255]] * 2)
    meta["shN"]["files"] = [picture("centroids", np.tile(entries, (4, 1)), 192), labels]
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    scene = read_splats(tmp_path)
    close(scene.means[0], [math.e - 1, 0.0, -(math.e**2 - 1)])
    assert scene.means[1, 1] == pytest.approx(math.expm1(2 * 32768 / 65535), 1e-4)
    close(scene.log_scales[0], [-4.0, -2.0, -4.0])
    close(scene.sh0[0, 0], [1.0, 0.0, 0.2])
    close(scene.logit_opacities, [3.0, 3.0])
    close(scene.quats[0], [math.sqrt(0.5), math.sqrt(0.5), 0.003, 0.003], 1e-2)
    close(scene.shN[0, :, 0], [-2.0, -1.2, 2.0])


def gltf(**node) -> dict:
    """Two splats in a .gltf whose data are inside it."""
    numbers = {
        "POSITION": ([1, 2, 3, 4, 5, 6], "VEC3"),
        "KHR_gaussian_splatting:ROTATION": ([0, 0, 0, 1] * 2, "VEC4"),
        "KHR_gaussian_splatting:SCALE": ([1, math.e, 1] * 2, "VEC3"),
        "KHR_gaussian_splatting:OPACITY": ([0.25, 0.75], "SCALAR"),
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": ([0.5] * 6, "VEC3"),
        **{f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{n}": ([n + 1] * 6, "VEC3") for n in range(3)},
    }
    data = b"".join(struct.pack(f"<{len(values)}f", *values) for values, _ in numbers.values())
    views, accessors = [], []
    for values, kind in numbers.values():
        start = views[-1]["byteOffset"] + views[-1]["byteLength"] if views else 0
        views.append({"buffer": 0, "byteOffset": start, "byteLength": 4 * len(values)})
        accessors.append({"bufferView": len(accessors), "componentType": 5126, "count": 2, "type": kind})
    extension = {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    attributes = {name: i for i, name in enumerate(numbers)}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": attributes, "extensions": extension}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
    }


def read_gltf(folder, tree):
    (folder / "a.gltf").write_text(json.dumps(tree))
    return read_splats(folder / "a.gltf")


def test_gltf_by_hand(tmp_path):
    scene = read_gltf(tmp_path, gltf())
    close(scene.means, [[-1.0, -2.0, 3.0], [-4.0, -5.0, 6.0]])  # left, up, forward
    close(scene.log_scales, [[0.0, 1.0, 0.0]] * 2)
    close(scene.opacities, [0.25, 0.75])
    close(scene.shN[0, :, 0], [-1.0, 2.0, -3.0])  # y and x look the other way
    moved = read_gltf(tmp_path, gltf(translation=[10, 0, 0], scale=[2, 2, 2], rotation=[0, 0, 1, 0]))
    close(moved.means, [[-10 + 2.0, 4.0, 6.0], [-10 + 8.0, 10.0, 12.0]])
    close(moved.log_scales, [[math.log(2), 1 + math.log(2), math.log(2)]] * 2)
    close(moved.shN[0, :, 0], [1.0, 2.0, 3.0])
    two = gltf()
    two["nodes"] += [{"children": [0], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]}]
    two["scenes"] = [{"nodes": [0, 1]}]
    assert read_gltf(tmp_path, two).means[:, 2].tolist() == [3.0, 6.0, 8.0, 11.0]


def test_a_node_of_a_gltf_turns_splats_with_their_colours(tmp_path):
    path = write_splats(tmp_path / "a", splats(40, 3), "gltf", options={"separate": True}).path
    tree = json.loads(path.read_text())
    q = np.array([0.1, -0.3, 0.4, 0.8])
    tree["nodes"][0]["rotation"] = (q / np.linalg.norm(q)).tolist()
    node = torch.from_numpy(Rotation.from_quat(q).as_matrix()).float()
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    before, after = read_splats(path), read_gltf(tmp_path, tree)
    turn = torch.eye(4)
    turn[:3, :3] = flip @ node @ flip  # of the PLY's axes
    K = torch.tensor([[[30.0, 0, 16], [0, 30.0, 16], [0, 0, 1]]])
    viewmat = look_at(
        torch.tensor([[5.0, -3.0, -9.0]]), torch.tensor([[5.0, -3.0, 1.0]]), torch.tensor([0.0, -1.0, 0.0])
    )
    views = [Cameras(viewmat.float() @ m, K, 32, 32) for m in (torch.eye(4), turn.T)]
    images = [rasterize(s, v, backend="reference").rgb for s, v in zip((before, after), views, strict=True)]
    assert torch.allclose(images[0], images[1], atol=1e-4) and float(images[0].max()) > 0.1
    tree["nodes"][0] = {"mesh": 0, "matrix": [0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
    with pytest.raises(SceneError, match="mirrors"):
        read_gltf(tmp_path, tree)


def test_gltf_with_packed_splats(tmp_path):
    tree, blob = gltf(), spz(3, struct.pack("<I", 3 << 30))
    tree["buffers"] = [{"byteLength": len(blob), "uri": "data:;base64," + base64.b64encode(blob).decode()}]
    tree["bufferViews"] = [{"buffer": 0, "byteLength": len(blob)}]
    primitive = tree["meshes"][0]["primitives"][0]
    packed = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    primitive["extensions"]["KHR_gaussian_splatting"]["extensions"] = packed
    close(read_gltf(tmp_path, tree).means, [[-1.5, 2.0, 0.25]])


def without(tree, *names):
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    for name in names:
        attributes.pop(f"KHR_gaussian_splatting:{name}")
    return tree


@pytest.mark.parametrize(("tree", "says"), [
    (without(gltf(), "OPACITY"), "no attribute KHR_gaussian_splatting:OPACITY"),
    (without(gltf(), "SH_DEGREE_1_COEF_2"), "SH_DEGREE_1_COEF_2"),
    (gltf(scale=[1, 2, 1]), "stretches its splats"),
    (gltf() | {"buffers": [{"byteLength": 3, "uri": "data:;base64,AAAA"}]}, "truncated: bufferViews"),
    (gltf() | {"buffers": [{"byteLength": 3, "uri": "https://example.org/a.bin"}]}, "are not there"),
    (gltf() | {"nodes": [{"children": [0]}]}, "below itself"),
    (gltf() | {"meshes": [{"primitives": []}]}, "without splats"),
    (gltf() | {"asset": {"version": "1.0"}}, "glTF version '1.0'"),
    (gltf() | {"accessors": []}, r"accessors\[0\], which is not there"),
])  # fmt: skip
def test_gltf_that_cannot_be_read(tmp_path, tree, says):
    with pytest.raises(SceneError, match=says):
        read_gltf(tmp_path, tree)


# --- parts


def test_a_world_with_other_axes_looks_the_same_from_a_camera_that_turned_with_it():
    scene = splats(60, 3, seed=3)
    scene = scene.map(torch.clone)
    scene.means.copy_(torch.randn(60, 3, generator=torch.Generator().manual_seed(1)))
    scene.log_scales.add_(2.0)
    K = torch.tensor([[[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]])
    viewmat = look_at(torch.tensor([[1.0, -2.0, -6.0]]), torch.zeros(1, 3), torch.tensor([0.0, -1.0, 0.0])).float()
    image = rasterize(scene, Cameras(viewmat, K, 32, 32), backend="reference").rgb
    for signs in ((1, -1, -1), (-1, -1, 1)):
        flip = torch.diag(torch.tensor([*signs, 1.0]))
        same = rasterize(turned(scene, signs), Cameras(viewmat @ flip, K, 32, 32), backend="reference").rgb
        assert torch.allclose(image, same, atol=1e-5)
    mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1]))  # seen in a mirror
    mirrored = Cameras(mirror @ viewmat @ mirror, K, 32, 32)
    assert torch.allclose(
        image.flip(2), rasterize(turned(scene, (-1, 1, 1)), mirrored, backend="reference").rgb, atol=1e-5
    )


def test_a_palette_finds_groups_and_a_codebook_few_numbers():
    draw = torch.Generator().manual_seed(0)
    groups = torch.randn(64, 9, generator=draw) * 10
    vectors = groups.repeat(40, 1) + 0.01 * torch.randn(64 * 40, 9, generator=draw)
    entries, labels = palette(vectors, 512)
    assert len(entries) <= 512 and float((entries[labels] - vectors).norm(dim=1).max()) < 0.1
    few, which = palette(vectors[:100], 512)
    assert torch.equal(few[which], vectors[:100])
    values = np.random.default_rng(0).choice(np.linspace(-3, 3, 20), 5000).astype(np.float32)
    numbers, chosen = codebook(values)
    assert np.abs(numbers[chosen] - values).max() < 0.5 * 6 / 255 and (np.diff(numbers) >= 0).all()


def test_neighbours_on_mortons_curve_are_neighbours_in_space():
    scene = splats(500)
    ordered = scene.means[morton_order(scene)]
    step = (ordered[1:] - ordered[:-1]).norm(dim=1).mean()
    assert step < 0.4 * (scene.means[1:] - scene.means[:-1]).norm(dim=1).mean()
    assert sorted(morton_order(scene).tolist()) == list(range(500))


def test_what_was_packed_once_is_not_changed_by_packing_it_again(tmp_path):
    once = read_splats(write_splats(tmp_path / "a", splats(300), "spz").path)
    again = read_splats(write_splats(tmp_path / "b", once, "spz").path)
    assert max(apart(once, again).values()) < 1e-5
