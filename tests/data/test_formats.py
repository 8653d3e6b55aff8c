"""Every dataset format: a tiny capture of it is found by its files, and its cameras come out in OpenCV's axes.

A new format is picked up by its name in FORMATS, and needs a function of that name in FIXTURES that writes one camera.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.data.camera import look_at
from dreamcatalyst.data.formats import FORMATS, CaptureOptions
from dreamcatalyst.data.loader import find_format, open_capture
from dreamcatalyst.errors import ConfigError, DataError

from tests.data import room

WIDTH, HEIGHT = 64, 48
# The camera of every fixture: at (1, 2, 3), looking along the world's x; the image's right is y, down is z.
AXES = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
CENTER = torch.tensor([1.0, 2, 3])


def photograph(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))


def colmap(root: Path) -> str:
    """World to camera as a quaternion wxyz and a translation: (x, y, z) -> (y, z, x) is a turn by 120 degrees."""
    photograph(root / "images" / "a.png")
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 50 54 32 24\n")
    (folder / "images.txt").write_text("1 0.5 -0.5 -0.5 -0.5 -2 -3 -1 1 a.png\n\n")
    (folder / "points3D.txt").write_text("")
    return str(root)


def nerfstudio(root: Path) -> str:
    """Camera to world in OpenGL's axes: columns right, up, backward."""
    photograph(root / "images" / "a.png")
    pose = np.eye(4)
    pose[:3] = np.stack([AXES[0], -AXES[1], -AXES[2], CENTER], 1)
    frame = {"file_path": "images/a.png", "transform_matrix": pose.tolist()}
    lens = dict(w=WIDTH, h=HEIGHT, fl_x=50, fl_y=54, cx=32, cy=24)
    (root / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    return str(root)


def inria(root: Path) -> str:
    """Camera to world in OpenCV's axes: columns right, down, forward."""
    entry = dict(img_name="a", width=WIDTH, height=HEIGHT, fx=50, fy=54, position=CENTER.tolist())
    (root / "cameras.json").write_text(json.dumps([{**entry, "rotation": AXES.T.tolist()}]))
    return str(root)


def demo(root: Path) -> str:
    return "demo:statue"


def photographs(root: Path) -> str:
    """Of a room, whose cameras are found."""
    return str(room.photographs(root / "photographs", room.arc(5)))


def video(root: Path) -> str:
    """Of the same room."""
    return str(room.video(root / "walk.mp4", room.arc(24)))


FIXTURES = {
    "colmap": colmap,
    "demo": demo,
    "inria": inria,
    "nerfstudio": nerfstudio,
    "photographs": photographs,
    "video": video,
}
FOUND = ("photographs", "video")  # formats whose cameras are found, in a world of their own
OPTIONS = CaptureOptions(test_every=0)


@pytest.mark.parametrize("name", FORMATS.names())
def test_a_capture_is_found_by_its_files_and_by_its_name(tmp_path, name):
    source = FIXTURES[name](tmp_path)
    for options in (OPTIONS, CaptureOptions(test_every=0, format=name)):
        format, path = find_format(source, options)
        assert format is FORMATS.get(name) and len(format.read(path, options).shots) >= 1
    for other in set(FORMATS.names()) - {name}:
        with pytest.raises(DataError, match=f"is no capture. Looked for {other}: "):
            find_format(source, CaptureOptions(format=other))


@pytest.mark.parametrize("name", FORMATS.names())
def test_axes_go_round(tmp_path, name):
    """What a camera sees where is that of its pose, and its rotation is one: no axis is mirrored."""
    capture = open_capture(FIXTURES[name](tmp_path), OPTIONS)
    assert name not in FOUND or len(capture) >= 3
    camera = capture.views[0].camera
    rotation = camera.viewmats[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(rotation.det()) > 0.99
    if name == "demo":  # an orbit that looks at the statue's middle, upright
        eye, target = camera.centers, torch.tensor([0.0, 0, 0.46])
        torch.testing.assert_close(camera.viewmats, look_at(eye, target, torch.tensor([0.0, 0, 1])), atol=1e-4, rtol=0)
        return
    if name in FOUND:  # all look at the middle, and none stands on its head
        assert float((torch.nn.functional.normalize(-camera.centers, dim=1) * camera.forward).sum()) > 0.9
        assert float(rotation[1] @ torch.tensor([0.0, 1, 0])) > 0.7
        return
    torch.testing.assert_close(camera.centers[0], CENTER)
    torch.testing.assert_close(rotation, AXES)
    torch.testing.assert_close(camera.Ks[0], torch.tensor([[50.0, 0, 32], [0, 54, 24], [0, 0, 1]]))
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)


def test_what_is_no_capture_is_told_what_each_format_looks_for(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DataError, match="is no capture.*Found notes.txt") as error:
        open_capture(tmp_path)
    assert all(f"{name}: {FORMATS.get(name).looks_for}" in str(error.value) for name in FORMATS)
    with pytest.raises(ConfigError, match="data.format: unknown dataset format 'colmop'. Did you mean 'colmap'"):
        open_capture(tmp_path, CaptureOptions(format="colmop"))
