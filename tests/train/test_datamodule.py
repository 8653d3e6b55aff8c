"""The data of a run: where cameras come from when nothing, a PLY, a world or a folder is named; what a step takes."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.data.orbit import video_path
from dreamcatalyst.errors import ConfigError, DataError
from dreamcatalyst.scene.gaussians import Gaussians
from dreamcatalyst.train.datamodule import SplatData

SPLAT = Gaussians.from_colors(torch.zeros(1, 3), torch.ones(1, 3), torch.ones(1, 3), torch.full((1,), 0.5))
CAMERA = dict(width=64, height=48, rotation=np.eye(3).tolist(), fx=50, fy=54)


def photographs(root: Path, sizes: list[tuple[int, int]], step: float = 1.0) -> Path:
    """A nerfstudio capture of photographs of these sizes, each `step` further along x, the n-th with brightness n."""
    frames = []
    for i, (width, height) in enumerate(sizes):
        cv2.imwrite(str(root / f"{i:03d}.png"), np.full((height, width, 3), i, np.uint8))
        pose = np.eye(4)
        pose[0, 3] = step * i
        frames.append(dict(file_path=f"{i:03d}.png", transform_matrix=pose.tolist(), fl_x=float(width)))
    (root / "transforms.json").write_text(json.dumps({"frames": frames}))
    return root


def test_without_a_source_cameras_lie_beside_the_splats_or_go_round_them(tmp_path):
    ply = tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    ply.parent.mkdir(parents=True)
    ply.touch()
    orbit = SplatData().open(SPLAT, str(ply))
    assert len(orbit) == 48 and str(orbit.source) == "orbit"
    assert "data.orbit_up" in orbit.notices[0]
    entries = [dict(CAMERA, img_name=f"{i}", position=[i, 0, 0]) for i in range(9)]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    beside = SplatData().open(SPLAT, str(ply))
    assert len(beside) == 9 and beside.source.name == "cameras.json"
    assert len(SplatData({"source": None}).open(SPLAT)) == 48
    assert str(SplatData({"source": "demo:statue"}).open(SPLAT, str(ply)).source) == "demo:statue"


def test_a_batch_must_fit_into_memory_and_have_one_size(tmp_path):
    mixed = photographs(tmp_path, [(8, 6), (16, 10), (8, 6), (10, 10)])
    with pytest.raises(ConfigError, match="data.batch_size: got 2, expected 1: the views are of different sizes"):
        SplatData({"source": str(mixed), "test_every": 0, "batch_size": 2}).open()
    assert len(SplatData({"source": str(mixed), "test_every": 0}).open()) == 4
    many = {"source": str(mixed), "width": 8, "height": 6, "batch_size": 10**12}
    with pytest.raises(DataError, match="data.batch_size=1000000000000: so many views of 8x6 pixels need"):
        SplatData(many).open()


def test_a_capture_is_opened_once(tmp_path):
    data = SplatData({"source": str(photographs(tmp_path, [(8, 6)] * 3))})
    assert data.open() is data.open(SPLAT)


def test_no_source_and_no_splats():
    with pytest.raises(ConfigError, match="data.source: nothing is given"):
        SplatData().open()
    with pytest.raises(ConfigError, match="unknown demo scene 'stature'. Did you mean 'statue'"):
        SplatData({"source": "demo:stature"})
    with pytest.raises(ConfigError, match="data.batch_size: got 0"):
        SplatData({"batch_size": 0})


@pytest.mark.parametrize(
    ("given", "error"),
    [({"format": "blender"}, "data.format.*nerfstudio"), ({"orbit_up": "up"}, "data.orbit_up.*Known: -x, -y")],
)
def test_names_are_checked_for_a_world_too(given, error):
    with pytest.raises(ConfigError, match=error):
        SplatData({"source": "demo:statue", **given})


@pytest.mark.parametrize("batch", [1, 3])
def test_a_resumed_run_goes_on_with_the_same_views(tmp_path, batch):
    data = SplatData({"source": str(photographs(tmp_path, [(8, 6)] * 11)), "batch_size": batch, "seed": 5})
    train = data.open().train

    def steps(first: int, n: int) -> list:
        data.trainer = SimpleNamespace(global_step=first)
        return [b["index"] for b in islice(iter(data.train_dataloader()), n)]

    whole = steps(0, 40)
    assert steps(17, 23) == whole[17:]
    drawn = [view for index in whole for view in index]
    for epoch in range(len(drawn) // len(train)):
        assert sorted(drawn[epoch * len(train) : (epoch + 1) * len(train)]) == train
    assert not set(drawn) & set(data.capture.test)


def test_held_out_views_are_scored_or_else_all(tmp_path):
    root = photographs(tmp_path, [(8, 6)] * 9)
    for every, expected in ((4, [0, 4, 8]), (0, list(range(9)))):
        data = SplatData({"source": str(root), "test_every": every})
        data.open()
        for loader in (data.val_dataloader(), data.test_dataloader(), data.predict_dataloader()):
            assert [batch["index"] for batch in loader] == [[i] for i in expected]


def test_photographs_of_several_sizes_have_a_video_path_but_no_common_batch(tmp_path):
    """The commonest size and its median focal length; every centre is still a training camera's."""
    root = photographs(tmp_path, [(8, 6), (16, 10), (8, 6), (8, 6), (10, 10)])
    capture = open_capture(root, CaptureOptions(test_every=0))
    cameras = capture.training_cameras
    assert (cameras.width, cameras.height) == (8, 6)
    torch.testing.assert_close(cameras.centers[:, 0], torch.arange(5.0))
    torch.testing.assert_close(cameras.Ks, torch.tensor([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]).expand(5, 3, 3))
    assert len(video_path(cameras, 6)) == 6
    with pytest.raises(DataError, match="different image sizes .*8x6, 10x10, 16x10. Set data.width and data.height"):
        capture.cameras()
    same = open_capture(root, CaptureOptions(test_every=0, width=6, height=6))
    assert torch.equal(same.training_cameras.Ks, same.cameras().Ks)


def test_cameras_at_one_place_have_an_extent(tmp_path):
    """Learning rates and density control are scaled by it: 0 would freeze the one and prune everything by the other."""
    root = photographs(tmp_path, [(8, 6)] * 3, step=0.0)
    assert open_capture(root, CaptureOptions(test_every=0)).extent == 1.0
