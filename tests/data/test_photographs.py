"""Photographs and videos without cameras: the cameras that are found are those they were taken with, and are kept."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import find_format, open_capture
from dreamcatalyst.data.sfm import colmap, store
from dreamcatalyst.data.sfm.options import SfmOptions
from dreamcatalyst.errors import DataError
from PIL import Image

from tests.data import room

ORIENTATION, FOCAL35 = 0x0112, 0xA405


@pytest.fixture(scope="session")
def taken(tmp_path_factory):
    """Photographs of the room, seven on an arc, and where they were taken."""
    return room.photographs(tmp_path_factory.mktemp("room"), room.arc(7)), room.cameras(room.arc(7))


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("kept")


@pytest.fixture(autouse=True)
def kept(cache, monkeypatch):
    """What is found is kept for the tests of this file alone."""
    monkeypatch.setenv("DREAMCATALYST_CACHE", str(cache))


@pytest.fixture
def no_search(monkeypatch):
    """Whoever looks for features, matches or cameras fails."""

    def fail(*_, **__):
        raise AssertionError("it was looked for again")

    for name in ("extract", "match", "reconstruct"):
        monkeypatch.setattr(colmap, name, fail)


def errors(capture, truth) -> tuple[float, float]:
    found = torch.cat([view.camera.viewmats for view in capture.views]).double().numpy()
    centres = -np.einsum("vji,vj->vi", found[:, :3, :3], found[:, :3, 3])
    return room.errors(centres, found[:, :3, :3], truth)


def folder_of(capture) -> Path:
    return next(p for p in capture.views[0].photo.path.parents if (p / "report.json").is_file())


def test_the_cameras_are_those_of_the_truth(taken):
    photographs, truth = taken
    capture = open_capture(photographs)
    centres, degrees = errors(capture, truth)
    assert len(capture) == 7 and centres < 0.02 and degrees < 0.5
    focal = float(truth.Ks[0, 0, 0])
    assert float(capture.views[0].camera.Ks[0, 0, 0]) == pytest.approx(focal, rel=0.03)


def test_the_world_is_upright_and_of_the_size_one(taken):
    """y points down, as in COLMAP captures; what all look at is the middle; the farthest camera is 1 from the mean."""
    capture, truth = open_capture(taken[0]), taken[1]
    cameras = capture.cameras()
    centres = cameras.centers
    assert float((centres - centres.mean(0)).norm(dim=1).max()) == pytest.approx(1, abs=1e-3)
    up = torch.tensor([0, -1.0, 0])
    true_up = truth.viewmats[:, :3, :3].float() @ torch.tensor([0, 0, 1.0])
    found_up = cameras.viewmats[:, :3, :3] @ up
    assert float((true_up * found_up).sum(1).min()) > np.cos(np.radians(2))
    to_middle = torch.nn.functional.normalize(-centres, dim=1)
    assert float((to_middle * cameras.forward).sum(1).min()) > 0.9


def test_the_similarity_leads_back(taken):
    """x = s R x_colmap + t: its rotation is one, and undoing it on the cameras gives poses as good."""
    capture = open_capture(taken[0])
    told = json.loads((folder_of(capture) / "sparse/similarity.json").read_text())
    R, t, s = np.array(told["rotation"]), np.array(told["translation"]), told["scale"]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1) and s > 0 and t.shape == (3,)


def test_a_second_run_finds_nothing_again(taken, no_search, tmp_path):
    """The folder's name does not matter, its content does."""
    first = open_capture(taken[0])
    elsewhere = tmp_path / "moved and renamed"
    elsewhere.mkdir()
    for path in taken[0].iterdir():
        (elsewhere / path.name).write_bytes(path.read_bytes())
    again = open_capture(elsewhere)
    assert folder_of(again) == folder_of(first)
    with pytest.raises(AssertionError):
        open_capture(taken[0], CaptureOptions(sfm=SfmOptions(features=4096)))


def test_what_is_kept_is_a_colmap_capture(taken):
    """Another tool, or this one by the folder's name, reads the same cameras."""
    found = open_capture(taken[0])
    format, path = find_format(folder_of(found), CaptureOptions())
    assert "COLMAP" in format.looks_for
    again = open_capture(path)
    assert [view.name for view in again.views] == [view.name for view in found.views]
    torch.testing.assert_close(again.cameras().viewmats, found.cameras().viewmats)
    report = json.loads((folder_of(found) / "report.json").read_text())
    assert report["registered"] == report["photographs"] == 7 and report["reprojection_error"] < 1
    picture = cv2.imread(str(folder_of(found) / "cameras.png"))
    assert picture.shape == (640, 1280, 3) and picture.std() > 5


def test_an_interrupted_search_goes_on_where_it_was(taken, monkeypatch, tmp_path):
    monkeypatch.setenv("DREAMCATALYST_CACHE", str(tmp_path))
    real, compared = colmap.match, []

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(colmap, "match", stopped)
    with pytest.raises(KeyboardInterrupt):
        open_capture(taken[0])

    def counted(name, unit, items, size, work):
        compared.append((unit, len(items)))
        return in_blocks(name, unit, items, size, work)

    in_blocks = colmap.in_blocks
    monkeypatch.setattr(colmap, "match", real)
    monkeypatch.setattr(colmap, "in_blocks", counted)
    assert len(open_capture(taken[0])) == 7
    assert compared == [("photograph", 0), ("pair", 21)]


def test_photographs_on_their_side_are_turned_and_their_focal_length_is_used(taken, tmp_path):
    """As a telephone writes them: the pixels lie, EXIF says how they stand."""
    for i, path in enumerate(sorted(taken[0].iterdir())):
        image = Image.open(path)
        exif = Image.Exif()
        if i % 2:
            image, exif[ORIENTATION] = image.transpose(Image.Transpose.ROTATE_90), 6
        exif.get_ifd(0x8769)[FOCAL35] = 28
        image.save(tmp_path / path.name, quality=95, exif=exif)
    capture = open_capture(tmp_path)
    centres, degrees = errors(capture, taken[1])
    assert len(capture) == 7 and centres < 0.03 and degrees < 0.7
    assert {(v.camera.width, v.camera.height) for v in capture.views} == {(320, 240)}
    report = json.loads((folder_of(capture) / "report.json").read_text())
    assert len(report["cameras"]) == 1
    with colmap.library() as pycolmap, pycolmap.Database.open(folder_of(capture) / "plain.db") as data:
        assert all(camera.has_prior_focal_length for camera in data.read_all_cameras())


def test_a_video_of_the_room(tmp_path):
    """25 frames a second on a finer arc; each tenth is a blur, and none of those is taken."""
    truth = room.arc(60)
    path = room.video(tmp_path / "walk.mp4", truth, blurred=tuple(range(5, 60, 10)))
    capture = open_capture(path, CaptureOptions(sfm=SfmOptions(photographs=10)))
    numbers = [int(Path(view.name).stem.removeprefix("frame_")) for view in capture.views]
    assert 6 <= len(numbers) <= 10 and not any(n % 10 == 5 for n in numbers)
    centres, degrees = errors(capture, room.cameras(truth[numbers]))
    assert centres < 0.05 and degrees < 1
    assert any("frames are used" in notice for notice in capture.notices)


def test_a_camera_that_only_turns_is_an_error(tmp_path):
    with pytest.raises(DataError, match="from one place.*Walk around"):
        open_capture(room.photographs(tmp_path / "turned", room.turned(6)))


def test_nothing_in_common_is_an_error_that_names_the_photographs(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(4):
        picture = cv2.resize(rng.integers(0, 255, (48, 64, 3), np.uint8), (256, 192), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    with pytest.raises(DataError, match="0 of 4 photographs: '0.png', .* show nothing that the others show"):
        open_capture(tmp_path, CaptureOptions(sfm=SfmOptions(features=1024)))


def test_the_content_of_a_file_is_its_bytes(tmp_path):
    """Of a large file, blocks of it and its size."""
    path, other = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"one"), other.write_bytes(b"one")
    assert store.content(path) == store.content(other)
    other.write_bytes(b"two")
    assert store.content(path) != store.content(other)
