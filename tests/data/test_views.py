"""Captures whatever their format: sizes, splits, the order of views, photographs and their cache."""

from __future__ import annotations

import json
import struct
import threading
import zlib
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.images import ImageCache, Photo, image_size
from dreamcatalyst.data.lens import Lens
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.data.sizes import fit
from dreamcatalyst.data.views import Capture, split, views_for_step
from dreamcatalyst.errors import DataError, DreamCatalystError
from hypothesis import given
from hypothesis import strategies as st

WIDTH, HEIGHT = 64, 48
ALL = CaptureOptions(test_every=0)


def capture(root: Path, n: int = 3, options: CaptureOptions = ALL, image=None) -> Capture:
    """`n` cameras in a row along x at distance 1 from each other, all with the same photograph."""
    frames = []
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8) if image is None else image
    for i in range(n):
        cv2.imwrite(str(root / f"{i:03d}.png"), image)
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append({"file_path": f"{i:03d}.png", "transform_matrix": pose.tolist()})
    (root / "transforms.json").write_text(json.dumps({"fl_x": 50, "fl_y": 50, "frames": frames}))
    return open_capture(root, options)


def test_every_eighth_view_is_held_out():
    train, test = split(20, CaptureOptions())
    assert test == [0, 8, 16] and sorted(train + test) == list(range(20))
    assert split(5, CaptureOptions(test_every=0)) == ([0, 1, 2, 3, 4], [])
    with pytest.raises(DataError, match="test_every=8 holds out all of its 1 views"):
        split(1, CaptureOptions())


@given(n=st.integers(2, 200), most=st.integers(1, 60))
def test_max_view_num_is_spread_over_the_capture(n, most):
    train, test = split(n, CaptureOptions(max_view_num=most))
    everything, _ = split(n, CaptureOptions())
    assert len(set(train)) == len(train) == min(most, len(everything)) and set(train) <= set(everything)
    if len(train) > 1:
        assert (train[0], train[-1]) == (everything[0], everything[-1])


@given(seed=st.integers(0, 9), n=st.integers(1, 12), batch=st.integers(1, 5))
def test_each_epoch_shows_each_view_once(seed, n, batch):
    drawn = [view for step in range(3 * n) for view in views_for_step(seed, step, n, batch)]
    for epoch in range(3 * batch):
        assert sorted(drawn[epoch * n : (epoch + 1) * n]) == list(range(n))


def test_orders_differ_between_epochs_and_seeds():
    first = [views_for_step(0, step, 30)[0] for step in range(60)]
    assert first[:30] != first[30:] and first[:30] != [views_for_step(1, step, 30)[0] for step in range(30)]


def test_sizes():
    assert fit(538, 957, CaptureOptions(downscale=4)) == ((0, 0, 538, 957), 134, 239)
    assert fit(100, 60, CaptureOptions(width=50)) == ((0, 0, 100, 60), 50, 30)
    assert fit(100, 60, CaptureOptions(height=30)) == ((0, 0, 100, 60), 50, 30)
    assert fit(100, 60, CaptureOptions(width=32, height=32)) == ((20, 0, 60, 60), 32, 32)
    assert fit(60, 100, CaptureOptions(width=64, height=32)) == ((0, 35, 60, 30), 64, 32)
    assert fit(3, 2, CaptureOptions(downscale=10)) == ((0, 0, 3, 2), 1, 1)


@given(st.integers(1, 300), st.integers(1, 300), st.integers(1, 300), st.integers(1, 300))
def test_a_crop_lies_inside_and_has_the_targets_aspect(width, height, out_width, out_height):
    (left, top, w, h), *size = fit(width, height, CaptureOptions(width=out_width, height=out_height))
    assert size == [out_width, out_height]
    assert 0 <= left <= left + w <= width and 0 <= top <= top + h <= height and w >= 1 and h >= 1
    assert w == width or h == height
    assert abs(left - (width - w) / 2) <= 0.5 and abs(top - (height - h) / 2) <= 0.5
    assert abs(w - h * out_width / out_height) <= 0.5 * max(1, out_width / out_height) or 1 in (w, h)


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(downscale=0.5), "data.downscale: got 0.5"),
        (dict(downscale="nan"), "data.downscale: got 'nan'"),
        (dict(width=1_000_000), "data.width: got 1000000"),
        (dict(orbit_views=1_000_000), "data.orbit_views: got 1000000"),
        (dict(downscale=2, width=64), "data.downscale and data.width"),
        (dict(width=0), "data.width: got 0"),
        (dict(test_every=-1), "data.test_every: got -1"),
        (dict(max_view_num=0), "data.max_view_num: got 0"),
        (dict(resident_gib=-1), "data.resident_gib"),
        (dict(background=(0, 0)), "data.background"),
    ],
)
def test_options_that_cannot_be(options, message):
    with pytest.raises(DreamCatalystError, match=message):
        parse(CaptureOptions, options, "data")


def test_photographs_of_more_pixels_than_pillow_takes_are_opened(tmp_path, monkeypatch):
    """Pillow refuses twice MAX_IMAGE_PIXELS; panoramas have more. What bounds them is memory."""
    from PIL import Image

    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert len(capture(tmp_path)) == 3 and Image.MAX_IMAGE_PIXELS == 1000
    monkeypatch.setattr("dreamcatalyst.data.sizes.free_memory", lambda: 12 * WIDTH * HEIGHT - 1)
    with pytest.raises(DataError, match="000.png: 64x48 pixels need .* GiB are free. Make smaller copies"):
        open_capture(tmp_path, CaptureOptions(max_side=2))


def test_views_that_memory_cannot_hold_are_refused(monkeypatch):
    monkeypatch.setattr("dreamcatalyst.data.sizes.free_memory", lambda: 2**30)
    with pytest.raises(DataError, match="views of 20000x10000 pixels need 18.6 GiB, and 1.0 GiB are free. Set data"):
        fit(20000, 10000, CaptureOptions())
    assert fit(20000, 10000, CaptureOptions(max_side=1000))[1:] == (1000, 500)


@pytest.mark.parametrize("keep", [0, 4, 30, 0.5])
def test_a_photograph_that_is_not_whole_is_refused_when_the_capture_is_opened(tmp_path, keep):
    capture(tmp_path, image=np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))
    whole = (tmp_path / "001.png").read_bytes()
    (tmp_path / "001.png").write_bytes(whole[: int(keep * len(whole)) if isinstance(keep, float) else keep])
    with pytest.raises(DataError, match="001.png: is (cut off|not an image)"):
        open_capture(tmp_path, ALL)


def test_a_picture_that_promises_more_than_its_bytes_can_hold_is_refused(tmp_path):
    """PNG's compression makes at most 1032 bytes of one."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", 16000, 12000, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(10))) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    with pytest.raises(DataError, match="a.png: is cut off or damaged: so few bytes do not hold 16000x12000 pixels"):
        image_size(tmp_path / "a.png")


def test_nothing_to_read(tmp_path):
    with pytest.raises(DataError, match="no such file or folder"):
        open_capture(tmp_path / "none")
    with pytest.raises(DataError, match="is no capture.*colmap.*inria.*nerfstudio.*Found nothing"):
        open_capture(tmp_path)


def test_the_extent_is_that_of_3dgs(tmp_path):
    assert capture(tmp_path, 5).extent == pytest.approx(1.1 * 2)


def test_a_similarity_moves_cameras_and_points_together(tmp_path):
    before = capture(tmp_path)
    similarity = torch.tensor([[0, -2.0, 0, 1], [2, 0, 0, 0], [0, 0, 2, -1], [0, 0, 0, 1]])
    after = before.transformed(similarity)
    x = torch.tensor([0.3, 0.2, -4.0, 1])
    for i in range(3):
        old, new = before.views[i].camera, after.views[i].camera
        torch.testing.assert_close(
            new.viewmats[0] @ similarity @ x, torch.tensor([2, 2, 2, 1.0]) * (old.viewmats[0] @ x)
        )
        torch.testing.assert_close(new.centers[0], (similarity @ torch.cat([old.centers[0], torch.ones(1)]))[:3])
    assert after.extent == pytest.approx(2 * before.extent, rel=1e-5)


def test_shrinking_averages_and_keeps_the_edges(tmp_path):
    """A black left half and a white right one: each target pixel is the mean of the area it covers."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, WIDTH // 2 :] = 255
    row = capture(tmp_path, 1, CaptureOptions(width=5, height=3, test_every=0), image).image(0)[1, :, 0]
    torch.testing.assert_close(row, torch.tensor([0, 0, 0.5, 1, 1]), atol=2 / 255, rtol=0)


def photo(path: Path, image: np.ndarray) -> Photo:
    cv2.imwrite(str(path), image)
    height, width = image.shape[:2]
    return Photo(path, Lens(50, 50, width / 2, height / 2, width, height), (0, 0, width, height), width, height)


def test_colours_alpha_and_depth_of_files(tmp_path):
    bgra = np.zeros((2, 2, 4), np.uint8)
    bgra[0, 0], bgra[1, 1] = (10, 20, 200, 255), (0, 0, 255, 51)
    loaded = photo(tmp_path / "a.png", bgra).load((0.0, 1.0, 0.0))
    assert loaded[0, 0].tolist() == [200, 20, 10]  # RGB
    assert loaded[0, 1].tolist() == [0, 255, 0]  # transparent
    assert loaded[1, 1].tolist() == [51, 204, 0]  # alpha 0.2
    assert photo(tmp_path / "b.png", np.full((2, 2), 77, np.uint8)).load()[0, 0].tolist() == [77] * 3
    assert photo(tmp_path / "c.png", np.full((2, 2, 3), 77 * 257, np.uint16)).load()[0, 0].tolist() == [77] * 3


def test_orientation_in_exif_is_ignored(tmp_path):
    """Cameras were calibrated on the pixels as stored."""
    from PIL import Image

    image, exif = Image.new("RGB", (WIDTH, HEIGHT)), Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees to view
    image.save(tmp_path / "a.jpg", exif=exif)
    view = Photo(tmp_path / "a.jpg", Lens(50, 50, 32, 24, WIDTH, HEIGHT), (0, 0, WIDTH, HEIGHT), WIDTH, HEIGHT)
    assert view.load().shape == (HEIGHT, WIDTH, 3)


def test_photographs_that_cannot_be_decoded(tmp_path):
    views = capture(tmp_path)
    whole = (tmp_path / "000.png").read_bytes()
    (tmp_path / "000.png").write_bytes(whole[:60])
    with pytest.raises(DataError, match="000.png.*damaged"):
        views.image(0)
    (tmp_path / "000.png").write_bytes(whole)
    assert views.image(0).shape == (HEIGHT, WIDTH, 3)  # an error is not remembered
    (tmp_path / "001.png").write_bytes(b"no image")
    with pytest.raises(DataError, match="001.png: is not an image"):
        open_capture(tmp_path)


def test_the_cache_keeps_to_its_limit_and_drops_the_oldest():
    loads = Counter()

    def load(index: int) -> np.ndarray:
        loads[index] += 1
        return np.full(10, index, np.uint8)

    cache = ImageCache(load, lambda index: 10, limit=30)
    for index in (0, 1, 2, 0, 3):  # 1 is the least recently used when 3 comes
        assert cache.get(index)[0] == index and cache.resident <= 30
    cache.get(0), cache.get(1)
    assert loads == {0: 1, 1: 2, 2: 1, 3: 1}
    cache.prefetch(range(10, 20))
    assert cache.resident == 30 and [cache.get(i)[0] for i in (10, 11, 12)] == [10, 11, 12]
    assert loads[12] == 1 and loads[13] == 0
    assert ImageCache(load, lambda index: 10, limit=0).get(5)[0] == 5  # one image is always kept


def test_prefetching_loads_in_parallel():
    together = threading.Barrier(2, timeout=20)

    def load(index: int) -> np.ndarray:
        together.wait()  # passes only where two are loaded at once
        return np.zeros(1, np.uint8)

    cache = ImageCache(load, lambda index: 1, limit=10)
    cache.prefetch([0, 1])
    cache.get(0), cache.get(1)


def test_opening_reads_no_pixels_and_2_gib_is_the_default(tmp_path, monkeypatch):
    def fails(*args):
        raise AssertionError("decoded")

    monkeypatch.setattr("cv2.imdecode", fails)
    views = capture(tmp_path)
    assert views.options.resident_gib == 2.0 and views._cache.limit == 2 * 2**30 and views.has_photos


def test_max_side_bounds_the_longer_side_unless_a_size_is_given():
    assert fit(538, 957, CaptureOptions(max_side=256))[1:] == (144, 256)
    assert fit(100, 50, CaptureOptions(max_side=256))[1:] == (100, 50)
    assert fit(538, 957, CaptureOptions(max_side=256, downscale=2))[1:] == (269, 478)
    assert fit(538, 957, CaptureOptions(max_side=256, width=400))[1:] == (400, 712)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_photograph_that_was_cut_off_is_refused_and_one_with_a_trailer_is_not(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    data = cv2.imencode(suffix, noise)[1].tobytes()
    path, lens = tmp_path / f"a{suffix}", Lens(50, 50, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    photo = Photo(path, lens, (0, 0, WIDTH, HEIGHT), WIDTH, HEIGHT)
    path.write_bytes(data)
    whole = photo.load()
    path.write_bytes(data + b"a telephone's film" * 99)
    assert np.array_equal(photo.load(), whole)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match=f"a{suffix}: is (cut off or )?damaged"):
        photo.load()
