"""Masks of photographs: by COLMAP's names, by nerfstudio's key, and what is wrong with them."""

import json

import cv2
import numpy as np
import pytest
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.errors import DataError

from benchmarks.faulty.things import HEIGHT, WIDTH, colmap, nerfstudio


def write(path, left_out, size=(HEIGHT, WIDTH)):
    """A mask that is black in the columns below `left_out`."""
    mask = np.full(size, 255, np.uint8)
    mask[:, :left_out] = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", mask)[1].tobytes())


@pytest.fixture
def capture(tmp_path):
    colmap(tmp_path / "capture")
    return tmp_path / "capture"


@pytest.mark.parametrize("name", ["{}.png.png", "{}.png"])
def test_a_folder_beside_the_photographs_or_anywhere_else(capture, tmp_path, name):
    for i in range(8):
        write(capture / "masks" / name.format(f"{i:03d}"), 2 * i)
    for folder in ("masks", str(capture / "masks")):
        read = open_capture(capture, CaptureOptions(masks=folder))
        for i in range(8):
            assert read.kept(i)[..., 0].sum(1).tolist() == [WIDTH - 2 * i] * HEIGHT
    smaller = open_capture(capture, CaptureOptions(masks="masks", downscale=2))
    assert smaller.kept(3)[..., 0].sum(1).tolist() == [WIDTH / 2 - 3] * (HEIGHT // 2)


def test_without_masks_all_counts_and_what_has_none_is_counted(capture):
    assert open_capture(capture).kept(0) is None and not open_capture(capture).has_masks
    write(capture / "masks/002.png", 5)
    read = open_capture(capture, CaptureOptions(masks="masks"))
    assert read.kept(2) is not None and read.kept(0) is None
    assert any("7 of 8 photographs have no mask" in notice for notice in read.notices)


def test_nerfstudio_names_them_in_its_file(tmp_path):
    nerfstudio(tmp_path / "capture")
    path = tmp_path / "capture/transforms.json"
    meta = json.loads(path.read_text())
    for frame in meta["frames"]:
        frame["mask_path"] = "kept/one.png"
    path.write_text(json.dumps(meta))
    with pytest.raises(DataError, match="kept/one.png of .* is missing"):
        open_capture(tmp_path / "capture")
    write(tmp_path / "capture/kept/one.png", 4)
    assert open_capture(tmp_path / "capture").kept(0)[..., 0].mean() == pytest.approx(1 - 4 / WIDTH)


def test_the_alpha_of_a_photograph(capture):
    assert open_capture(capture).alpha(0) is None
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
    (capture / "images/000.png").write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    np.testing.assert_allclose(open_capture(capture).alpha(0)[..., 0] * 255, pixels[..., 3], atol=1e-3)


def test_what_is_wrong_with_a_mask_is_said_with_its_name(capture):
    with pytest.raises(DataError, match="data.masks: there is no folder 'mask'"):
        open_capture(capture, CaptureOptions(masks="mask"))
    with pytest.raises(DataError, match="a mask of none of the 8 photographs. Looked for '000.png.png', found 0"):
        open_capture(capture, CaptureOptions(masks="sparse"))
    write(capture / "masks/001.png", 3, (HEIGHT, WIDTH + 1))
    with pytest.raises(DataError, match=f"001.png: is {WIDTH + 1}x{HEIGHT}, and its photograph {WIDTH}x{HEIGHT}"):
        open_capture(capture, CaptureOptions(masks="masks"))
