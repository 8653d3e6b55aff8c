"""Worlds far from their origin: what is moved, by how much, and that cameras, points and splats stay together."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.data.origin import ZERO, far_origin
from dreamcatalyst.scene.ply import ply_origin, read_ply, write_ply
from dreamcatalyst.scene.plyfile import read_vertices

from benchmarks.stiff.splats import cloud

FAR = (431_250.5, -5_411_000.25, 120.0)  # metres, as geographic grids have them


def capture_at(folder, offset):
    """Three cameras around `offset`, as 3DGS writes them; returns the capture."""
    axes, lens = np.eye(3).tolist(), {"width": 20, "height": 16, "fx": 25.0, "fy": 25.0}
    places = [(np.array(offset) + [x, 0.3, 0.1]).tolist() for x in (-1.1, 0.0, 1.3)]
    folder.mkdir()
    (folder / "cameras.json").write_text(json.dumps([{"position": p, "rotation": axes, **lens} for p in places]))
    return open_capture(folder)


@pytest.mark.parametrize("offset", [ZERO, (5.0, 0, 0), (300.0, -200.0, 0)])
def test_worlds_near_their_origin_stay_as_they_are(tmp_path, offset):
    capture = capture_at(tmp_path / "near", offset)
    assert capture.origin == ZERO
    expected = torch.tensor(offset) + torch.tensor([-1.1, 0.3, 0.1])
    torch.testing.assert_close(capture.views[0].camera.centers[0], expected)


def test_cameras_far_away_keep_their_places_to_the_last_digit_of_float32(tmp_path):
    near, far = capture_at(tmp_path / "near", ZERO), capture_at(tmp_path / "far", FAR)
    shift = torch.tensor(FAR, dtype=torch.float64) - torch.tensor(far.origin, dtype=torch.float64)
    assert all(value == round(value) for value in far.origin) and shift.abs().max() <= 2
    for a, b in zip(near.views, far.views, strict=True):
        assert (b.camera.centers.double() - shift - a.camera.centers.double()).abs().max() < 1e-6
    assert far.extent == pytest.approx(near.extent, rel=1e-6)


def test_one_camera_or_coincident_ones_have_no_spread_to_be_far_by():
    assert far_origin(np.array([[1e6, 0, 0]])) == far_origin(np.full((3, 3), 1e6)) == ZERO
    assert far_origin(np.zeros((0, 3))) == ZERO


def test_splats_far_away_are_read_and_written_in_double(tmp_path):
    scene = cloud(50)
    path = write_ply(tmp_path / "far.ply", scene, origin=FAR)
    columns = read_vertices(path).columns
    assert columns["x"].dtype == np.float64 and columns["rot_0"].dtype == np.float32
    assert list(columns)[:4] == ["x", "y", "z", "nx"]
    assert np.array_equal(columns["x"], scene.means[:, 0].numpy() + FAR[0])
    origin = ply_origin(path)
    assert np.abs(np.subtract(origin, FAR)).max() < 6  # the middle of the cloud
    again = read_ply(write_ply(tmp_path / "again.ply", read_ply(path, origin=origin), origin=origin), origin=FAR)
    assert (again.means.double() - scene.means).abs().max() < 1e-6
    assert ply_origin(write_ply(tmp_path / "near.ply", scene)) == ZERO
