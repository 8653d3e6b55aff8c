"""nerfstudio's files: axes, intrinsics, and the way into the world of splats that nerfstudio trained."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.data.transforms import splats_from_capture
from dreamcatalyst.errors import DataError

# A camera at (1, 2, 3) whose OpenGL axes are the world's: it looks along -z, y is up.
POSE = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
LENS = dict(fl_x=50.0, fl_y=54.0, cx=31.0, cy=25.0, w=64, h=48, camera_model="OPENCV")
ALL = CaptureOptions(test_every=0)


def frame(name: str = "images/a.png", **more) -> dict:
    return {"file_path": name, "transform_matrix": POSE, **more}


def write(root: Path, frames: list | None = None, photos=("images/a.png",), drop=(), **meta) -> Path:
    for name in photos:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / name), np.full((48, 64, 3), 90, np.uint8))
    content = {k: v for k, v in {**LENS, **meta}.items() if k not in drop}
    (root / "transforms.json").write_text(json.dumps({**content, "frames": [frame()] if frames is None else frames}))
    return root


@pytest.mark.parametrize("where", ["", "transforms.json"])
def test_axes(tmp_path, where):
    camera = open_capture(write(tmp_path) / where, ALL).views[0].camera
    torch.testing.assert_close(camera.centers, torch.tensor([[1.0, 2, 3]]))
    torch.testing.assert_close(camera.forward, torch.tensor([[0, 0, -1.0]]))
    torch.testing.assert_close(camera.viewmats[0, 1, :3], torch.tensor([0, -1.0, 0]))  # image down is world -y
    torch.testing.assert_close(camera.Ks[0], torch.tensor([[50.0, 0, 31], [0, 54, 25], [0, 0, 1]]))


@pytest.mark.parametrize("lens", [dict(k1=-0.1, k2=0.02, p1=0.003, p2=-0.002), dict(k1=0.05, k4=0.001, fisheye=True)])
def test_a_point_is_where_its_blob_was_photographed(tmp_path, lens):
    """The blob is painted where the distortion's formulas put the point (OpenCV's documentation of both models)."""
    fisheye = lens.pop("fisheye", False)
    write(tmp_path, camera_model="OPENCV_FISHEYE" if fisheye else "OPENCV", **lens)
    k1, k2, k4, p1, p2 = (lens.get(key, 0.0) for key in ("k1", "k2", "k4", "p1", "p2"))
    x, y = 0.3, -0.2  # of a point at depth 2: in the world (1 + 0.6, 2 + 0.4, 3 - 2)
    r2, theta = x * x + y * y, math.atan(math.hypot(x, y))
    if fisheye:
        grow = theta * (1 + k1 * theta**2 + k4 * theta**8) / math.sqrt(r2)
        u, v = grow * x, grow * y
    else:
        radial = 1 + k1 * r2 + k2 * r2 * r2
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    scale = 10
    cols, rows = np.meshgrid(np.arange(64 * scale) + 0.5, np.arange(48 * scale) + 0.5)
    at = (scale * (50 * u + 31), scale * (54 * v + 25))
    blob = 255 * np.exp(-((cols - at[0]) ** 2 + (rows - at[1]) ** 2) / (2 * 6**2))
    cv2.imwrite(str(tmp_path / "images/a.png"), blob.round().astype(np.uint8))

    capture = open_capture(tmp_path, CaptureOptions(downscale=2.5, test_every=0))
    camera, image = capture.views[0].camera, capture.image(0)[..., 0]
    point = torch.tensor([1.6, 2.4, 1.0, 1.0])
    projected = camera.Ks[0] @ (camera.viewmats[0] @ point)[:3]
    image = image * (image > 0.1)
    rows, cols = torch.meshgrid(torch.arange(192) + 0.5, torch.arange(256) + 0.5, indexing="ij")
    seen = torch.stack([(image * cols).sum(), (image * rows).sum()]) / image.sum()
    torch.testing.assert_close(seen, projected[:2] / projected[2], atol=0.06, rtol=0)


def test_intrinsics_of_a_frame_go_before_those_of_the_file(tmp_path):
    write(tmp_path, [frame(fl_x=70, w=64, h=48)])
    assert open_capture(tmp_path, ALL).views[0].camera.Ks[0, 0, 0] == 70


def test_defaults_are_the_photographs_size_and_its_middle(tmp_path):
    write(tmp_path, drop=["w", "h", "cx", "cy", "fl_x", "fl_y"], camera_angle_x=2 * math.atan(0.5))
    torch.testing.assert_close(
        open_capture(tmp_path, ALL).views[0].camera.Ks[0], torch.tensor([[64.0, 0, 32], [0, 64, 24], [0, 0, 1]])
    )


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPG"])
def test_file_paths_without_a_suffix(tmp_path, suffix):
    write(tmp_path, [frame("./images/a")], photos=["images/a" + suffix])
    assert open_capture(tmp_path, ALL).image(0).shape == (48, 64, 3)


def test_points_beside_the_file(tmp_path):
    write(tmp_path, ply_file_path="sparse_pc.ply", applied_transform=[[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
    (tmp_path / "sparse_pc.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n"
        "1 2 3 255 0 51\n4 5 6 0 255 0\n"
    )
    capture = open_capture(tmp_path, ALL)
    torch.testing.assert_close(capture.points.xyz, torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    torch.testing.assert_close(capture.points.rgb, torch.tensor([[1, 0, 0.2], [0, 1, 0]]))
    assert any("applied_transform" in notice for notice in capture.notices)
    (tmp_path / "sparse_pc.ply").unlink()
    with pytest.raises(DataError, match="ply_file_path .*sparse_pc.ply is missing"):
        open_capture(tmp_path, ALL)


NO_NUMBERS = [
    *(("fl_x", value) for value in (0, -30, math.nan, math.inf, True)),
    *(("fl_y", 0), ("cx", math.nan), ("cy", -math.inf), ("k1", math.nan), ("p2", math.inf)),
    *((key, value) for key in ("w", "h") for value in (0, -24, math.inf, math.nan)),
]
FAR = [[1, 0, 0, 1e30], [0, 1, 0, 0], [0, 0, 1, 0]]


def test_a_file_that_begins_with_a_mark_of_its_encoding_is_read(tmp_path):
    path = write(tmp_path) / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(open_capture(tmp_path, ALL)) == 1


def test_one_place_photographed_twice_is_two_views(tmp_path):
    """A tripod: the same pose, other pictures."""
    write(tmp_path, [frame(), frame("b.png")])
    cv2.imwrite(str(tmp_path / "b.png"), np.full((48, 64, 3), 91, np.uint8))
    assert len(open_capture(tmp_path, ALL)) == 2


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(frames=[frame("images/b.png")]), "1 of 1 photographs are missing.*b.png"),
        (dict(frames=[frame("images/b")]), "1 of 1 photographs are missing.*images/b"),
        (dict(frames=[{"file_path": "images/a.png"}]), "frame 0 has no 'transform_matrix' .found file_path"),
        (dict(frames=[{"transform_matrix": POSE}]), "frame 0 has no 'file_path'"),
        (dict(frames=["a.png"]), "frame 0 is str"),
        (dict(frames=[]), "empty reconstruction"),
        (dict(drop=["fl_x", "fl_y"]), "frame 0 has no 'fl_x'"),
        (dict(fl_x="wide"), "'fl_x' is 'wide', expected a number"),
        (dict(camera_model="OPENCV_FISHEY"), "unknown camera_model 'OPENCV_FISHEY'. Did you mean 'OPENCV_FISHEYE'"),
        (dict(k4=0.1), "k4=0.1 belongs to OPENCV_FISHEYE"),
        (
            dict(frames=[frame(transform_matrix=[[1, 2], [3, 4]])]),
            "frame 0, transform_matrix: expected a matrix of 3x4",
        ),
        (dict(frames=[frame(transform_matrix=np.diag([1.0, 2, 1, 1]).tolist())]), "'images/a.png' is not a rotation"),
        (dict(w=48, h=64), "not the shape of its camera, 48x64. It lies on its side"),
        *((dict([wrong]), f"frame 0: '{wrong[0]}' is .*, expected ") for wrong in NO_NUMBERS),
        *(
            (dict(drop=["fl_x", "fl_y"], camera_angle_x=angle), "'camera_angle_x' is")
            for angle in (0, -1, 40, math.nan)
        ),
        (dict(fl_x=10**400), "'fl_x' is '10*', expected a number"),
        (dict(frames=[frame(5)]), "frame 0: 'file_path' is 5, expected the path of a photograph"),
        (dict(frames=[frame("a\0.png")]), "frame 0: 'file_path' is"),
        (dict(frames=[frame(None)]), "frame 0: 'file_path' is None"),
        (dict(camera_model=["PINHOLE"]), "unknown camera_model"),
        (dict(is_fisheye="no"), "frame 0: 'is_fisheye' is 'no', expected true or false"),
        (dict(frames=[frame("a" * 5000)]), "1 of 1 photographs are missing"),
        (dict(k1=1e8), "'images/a.png': camera: the distortion"),
        (dict(ply_file_path=5), "'ply_file_path' is 5"),
        (dict(frames=[frame(transform_matrix=np.zeros((4, 4)).tolist())]), "frame 0, transform_matrix: is no rotation"),
        (
            dict(frames=[frame(transform_matrix=np.full((4, 4), np.nan).tolist())]),
            "frame 0, transform_matrix: expected",
        ),
        (dict(frames=[frame(transform_matrix=FAR)]), "pose of 'images/a.png' is not of finite numbers"),
        (dict(frames=[frame(), frame()]), "photograph 'images/a.png' is there twice"),
        (dict(frames=[frame(), frame("./images/../images/a.png")]), "'images/a.png' is there twice"),
        (
            dict(frames=[frame(), frame("b.png")], photos=("images/a.png", "b.png")),
            "'b.png' and 'images/a.png' is there",
        ),
    ],
)
def test_files_that_cannot_be_used(tmp_path, change, message):
    write(tmp_path, **change)
    with pytest.raises(DataError, match=message):
        open_capture(tmp_path, ALL)


def test_json_that_is_none(tmp_path):
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(DataError, match="cannot be read as JSON"):
        open_capture(tmp_path)
    (tmp_path / "transforms.json").write_text("[]")
    with pytest.raises(DataError, match="no list 'frames'"):
        open_capture(tmp_path)


def test_cameras_follow_nerfstudio_into_the_splats_world(tmp_path):
    """nerfstudio trains in x' = s (T x) of the file's world x and saves T after applied_transform A: T A, with s.
    Splats at x' must be seen where the same points x were before."""
    A = np.array([[0, 1, 0, 0.5], [0, 0, 1, 0], [1, 0, 0, -1], [0, 0, 0, 1]], float)
    T = np.array([[0, -1, 0, 0.3], [1, 0, 0, 0.1], [0, 0, 1, -2], [0, 0, 0, 1]], float)
    s = 0.25
    write(tmp_path, applied_transform=A[:3].tolist())
    saved = tmp_path / "dataparser_transforms.json"
    saved.write_text(json.dumps({"transform": (T @ A)[:3].tolist(), "scale": s}))
    x = np.array([1.4, 2.2, 1.0, 1.0])
    moved = s * (T @ x)[:3]
    np.testing.assert_allclose((splats_from_capture(saved, tmp_path / "transforms.json").numpy() @ x)[:3], moved)

    plain = open_capture(tmp_path, ALL).views[0].camera
    capture = open_capture(tmp_path, CaptureOptions(test_every=0, dataparser=str(saved)))
    camera = capture.views[0].camera
    before = plain.viewmats[0] @ torch.from_numpy(x).float()
    after = camera.viewmats[0] @ torch.tensor([*moved, 1]).float()
    torch.testing.assert_close(after[:3], s * before[:3])  # the same direction, s times the depth
    rotation = camera.viewmats[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3))

    saved.write_text(json.dumps({"scale": s}))
    with pytest.raises(DataError, match="'transform' and 'scale'"):
        splats_from_capture(saved, tmp_path)
