"""The cameras.json of 3DGS: cameras without photographs."""

from __future__ import annotations

import json
import math

import pytest
import torch
from dreamcatalyst.data import inria
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.errors import DataError

# At (1, 2, 3), camera to world: image right is world y, image down is world z, forward is world x.
ENTRY = dict(
    id=0,
    img_name="b",
    width=64,
    height=48,
    position=[1, 2, 3],
    rotation=[[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    fx=50,
    fy=54,
)


def test_axes_and_size(tmp_path):
    (tmp_path / "cameras.json").write_text(json.dumps([ENTRY, {**ENTRY, "img_name": "a"}]))
    capture = open_capture(tmp_path, CaptureOptions(downscale=2, test_every=0))
    assert [view.name for view in capture.views] == ["a", "b"] and not capture.has_photos
    camera = capture.views[1].camera
    torch.testing.assert_close(camera.centers, torch.tensor([[1.0, 2, 3]]))
    torch.testing.assert_close(camera.viewmats[0, :3, :3], torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]))
    torch.testing.assert_close(camera.Ks[0], torch.tensor([[25.0, 0, 16], [0, 27, 12], [0, 0, 1]]))
    with pytest.raises(DataError, match="view 'a' has a camera but no photograph"):
        capture.image(0)


def test_the_file_is_found_from_the_splats_that_belong_to_it(tmp_path):
    splats = tmp_path / "point_cloud/iteration_30000/point_cloud.ply"
    splats.parent.mkdir(parents=True)
    assert inria.beside(splats) is None
    (tmp_path / "cameras.json").write_text("[]")
    assert inria.beside(splats) == tmp_path.resolve() / "cameras.json"


@pytest.mark.parametrize(
    "content, message",
    [
        ({}, "list of cameras as 3DGS writes it, got dict"),
        ([{k: v for k, v in ENTRY.items() if k != "rotation"}], "camera 0 has no 'rotation'"),
        ([{**ENTRY, "rotation": [[1, 0], [0, 1]]}], "camera 0 has a pose that is not of 3x3 and 3 numbers"),
        ([], "empty reconstruction"),
        ([5], "camera 0 is 5, expected an object with width, height"),
        ([ENTRY, None], "camera 1 is None"),
        ([{**ENTRY, "width": math.inf}], "camera 0: 'width' is inf, expected a number"),
        ([{**ENTRY, "height": None}], "camera 0: 'height' is None"),
        ([{**ENTRY, "fx": math.nan}], "camera 0: 'fx' is nan"),
        ([{**ENTRY, "fx": -5}], "camera of 'b': focal length fx is -5.0, expected a number in"),
        ([{**ENTRY, "height": 0}], "camera of 'b': height is 0"),
        ([{**ENTRY, "position": [math.nan, 0, 0]}], "pose of 'b' is not of finite numbers"),
        ([{**ENTRY, "width": 10**9}], "camera of 'b': width is 1000000000"),
        ([{**ENTRY, "width": 60000, "height": 60000}], "views of 60000x60000 pixels, expected 32766 a side at most"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, content, message):
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=message):
        open_capture(tmp_path)
