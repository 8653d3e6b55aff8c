"""The parts of structure from motion that are our own: what is chosen, prepared, compared, and turned upright."""

from __future__ import annotations

import struct
import sys

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.data.camera import look_at
from dreamcatalyst.data.images import decode
from dreamcatalyst.data.sfm import choose, frames, orient, pairs, prepare, retrieval
from dreamcatalyst.data.sfm.check import turned
from dreamcatalyst.data.sfm.options import SfmOptions
from dreamcatalyst.errors import DataError
from PIL import Image

from tests.data import room

OPTIONS = SfmOptions()
RNG = np.random.default_rng(0)


def picture(seed: int, width: int = 160, height: int = 120) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


def write(path, seed: int = 0):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture(seed))
    return path


def beside(root, name: str = "copies"):
    return root.with_name(f"{root.name}-{name}")


def prepared(root, folder, options=OPTIONS):
    chosen, _ = choose.choose(root, options)
    return prepare.prepare(root, chosen, folder, options, lambda n: None)


# --- which photographs


def test_photographs_are_found_in_folders_in_the_order_in_which_people_count(tmp_path):
    names = ["b/img_10.jpg", "b/img_2.JPG", "a/1.png", ".hidden.jpg", "__MACOSX/1.jpg", "notes.txt", "c/d/e/f/deep.jpg"]
    for i, name in enumerate(names):
        write(tmp_path / name, i) if not name.endswith("txt") else (tmp_path / name).touch()
    write(tmp_path / "other" / "images" / "1.jpg")
    (tmp_path / "other" / "sparse").mkdir()
    found = [path.relative_to(tmp_path).as_posix() for path in choose.photographs_below(tmp_path)]
    assert found == ["a/1.png", "b/img_2.JPG", "b/img_10.jpg"]


def test_too_many_are_thinned_evenly_and_that_is_said(tmp_path):
    for i in range(41):
        write(tmp_path / f"{i}.png", i)
    chosen, said = choose.choose(tmp_path, SfmOptions(photographs=5))
    assert [path.stem for path in chosen] == ["0", "10", "20", "30", "40"]
    assert "5 of 41 photographs are used" in said[0] and "data.sfm.photographs" in said[0]


def test_copies_are_used_once(tmp_path):
    for name in ("a.png", "b.png", "b (1).png", "c.png"):
        write(tmp_path / name, seed=ord(name[0]))
    (tmp_path / "a.heic").write_bytes(b"the original of a.png")
    chosen, said = choose.choose(tmp_path, OPTIONS)
    assert [path.name for path in chosen] == ["a.png", "b (1).png", "c.png"]
    assert any("HEIC" in text for text in said) and any("twice" in text for text in said)


# --- working copies


@pytest.mark.parametrize("orientation", range(1, 9))
def test_copies_stand_upright(tmp_path, orientation):
    """Each of the eight ways in which EXIF says that a photograph lies (EXIF 2.32, tag 0x0112)."""
    upright = np.zeros((120, 160, 3), np.uint8)
    upright[:40, :50] = 255  # the upper left corner is white
    undo = {1: None, 2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE", 6: "ROTATE_90"}
    undo |= {7: "TRANSVERSE", 8: "ROTATE_270"}
    for i in range(3):
        image, exif = Image.fromarray(np.roll(upright, i, 1)), Image.Exif()
        if undo[orientation]:
            image = image.transpose(Image.Transpose[undo[orientation]])
        exif[0x0112] = orientation
        image.save(tmp_path / f"{i}.jpg", exif=exif, quality=95)
    pictures, _ = prepared(tmp_path, beside(tmp_path))
    copy = decode(beside(tmp_path) / pictures[0].name, (0.0, 0, 0))
    assert copy.shape == upright.shape and np.abs(copy.astype(int) - upright).mean() < 2
    assert Image.open(beside(tmp_path) / pictures[0].name).getexif().get(0x0112, 1) == 1


def test_every_kind_of_picture_becomes_one_of_eight_bits_under_a_plain_name(tmp_path):
    grey16, alpha = (picture(0)[..., 0].astype(np.uint16) * 257), np.dstack([picture(1), picture(2)[..., 0]])
    for name, image in {"grey 16.png": grey16, "ünï code.tiff": picture(3), "alpha.png": alpha}.items():
        path = tmp_path / name
        path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    Image.fromarray(picture(4)).convert("CMYK").save(tmp_path / "print.jpg")
    Image.fromarray(picture(5)).convert("P").save(tmp_path / "palette.png")
    Image.fromarray(picture(6)).convert("L").save(tmp_path / "grey.jpg")
    pictures, said = prepared(tmp_path, beside(tmp_path))
    assert len(pictures) == 6 and not said
    for each in pictures:
        assert " " not in each.name and (tmp_path / each.original).is_file()
        image = Image.open(beside(tmp_path) / each.name)
        assert image.size == (160, 120) and image.mode in ("RGB", "L", "RGBA")
    (kept,) = (each.name for each in pictures if each.original == "alpha.png")
    assert (beside(tmp_path) / kept).read_bytes() == (tmp_path / "alpha.png").read_bytes()


def test_heic_is_read_where_its_package_is_there_and_asked_for_where_not(tmp_path, monkeypatch):
    heif = pytest.importorskip("pillow_heif")
    for i in range(3):
        heif.from_pillow(Image.fromarray(picture(i))).save(tmp_path / f"{i}.heic")
    pictures, _ = prepared(tmp_path, beside(tmp_path))
    assert [each.name for each in pictures] == ["0.jpg", "1.jpg", "2.jpg"]
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(DataError, match="0.heic: is a HEIC photograph.*pip install pillow-heif"):
        prepared(tmp_path, beside(tmp_path, "others"))


def test_a_few_that_cannot_be_read_are_left_aside_and_most_are_an_error(tmp_path):
    for i in range(5):
        write(tmp_path / f"{i}.png", i)
    (tmp_path / "1.png").write_bytes(b"no picture")
    pictures, said = prepared(tmp_path, beside(tmp_path))
    assert len(pictures) == 4 and "1 of 5 photographs cannot be read" in said[0]
    for i in (0, 2):
        (tmp_path / f"{i}.png").write_bytes(f"none {i}".encode())
    with pytest.raises(DataError, match="3 of 5 photographs cannot be read"):
        prepared(tmp_path, beside(tmp_path, "others"))


def test_who_shares_intrinsics(tmp_path):
    for folder, size in (("a", (160, 120)), ("b", (160, 120)), ("b", (120, 160))):
        (tmp_path / folder).mkdir(exist_ok=True)
        for i in range(2):
            Image.fromarray(RNG.integers(0, 255, (size[1], size[0], 3), np.uint8)).save(
                tmp_path / folder / f"{size[0]}-{i}.png"
            )
    for cameras, count in {"auto": 3, "one": 2, "folder": 3, "each": 6}.items():
        found, _ = prepared(tmp_path, beside(tmp_path), SfmOptions(cameras=cameras))
        assert len({each.camera for each in found}) == count, cameras


# --- frames of a video


def test_frames_are_the_sharpest_at_equal_steps_of_the_view():
    """A camera that stands, walks at twice the pace, and stands: frames go by the way and not by the clock."""
    motion = np.concatenate([np.zeros(50), np.linspace(0, 1, 101), np.ones(50)])
    sharpness = np.ones(len(motion))
    sharpness[50:151:5] = 9.0
    kept = frames.choose_frames(motion.tolist(), sharpness.tolist(), 0.1, 100)
    assert len(kept) == 11
    assert np.allclose(np.diff(motion[kept]), 0.1, atol=0.051) and all(sharpness[i] == 9 for i in kept[1:-1])
    assert len(frames.choose_frames(motion.tolist(), sharpness.tolist(), 0.01, 7)) <= 7
    assert frames.choose_frames([0.0] * 9, [1.0] * 9, 0.1, 9) == [0]


def test_a_rotation_flag_turns_the_frames(tmp_path):
    """A telephone held upright: the matrix of the track's header (ISO 14496-12, tkhd) says that frames are to be turned
    clockwise when they are shown."""
    path = room.video(tmp_path / "walk.mp4", room.arc(2))
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 44
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 240 << 16, 0, 1 << 30)
    upright = tmp_path / "upright.mp4"
    upright.write_bytes(data)
    shown = []
    for each in (path, upright):
        frames.write_frames(each, [1], tmp_path / each.stem, lambda n: None)
        shown.append(cv2.imread(str(tmp_path / each.stem / "frame_000001.jpg")).astype(int))
    assert shown[1].shape == (320, 240, 3)
    assert np.abs(np.rot90(shown[0], -1) - shown[1]).mean() < 3


# --- pairs


def test_pairs_of_a_walk_are_neighbours_and_where_it_comes_back():
    near = pairs.NEXT
    assert {j for i, j in pairs.sequential(5 * near) if i == 0} == {*range(1, near + 1), 2 * near, 4 * near}
    circle = np.cos(np.subtract.outer(np.arange(40), np.arange(40)) * 2 * np.pi / 40)
    closed = pairs.choose_pairs(40, True, SfmOptions(pairs="sequential"), lambda: circle)
    assert (0, 39) in closed and (0, 20) not in closed
    assert len(pairs.choose_pairs(10, False, OPTIONS, lambda: circle)) == 45
    many = pairs.choose_pairs(400, False, OPTIONS, lambda: np.eye(400))
    assert 400 < len(many) < 400 * 25 and all(i < j for i, j in many)


def test_photographs_of_the_same_thing_are_the_most_alike():
    """Three walls, four views of each: their own SIFT tells them apart."""
    sift, descriptors = cv2.SIFT_create(400), []
    for wall in room.textures():
        for shift in range(4):
            view = cv2.warpAffine(wall, np.array([[1, 0.02 * shift, 9.0 * shift], [0, 1, 4.0]]), (300, 300))
            descriptors.append(sift.detectAndCompute(view, None)[1].astype(np.uint8))
    alike = retrieval.likeness(descriptors)
    np.fill_diagonal(alike, -1)
    assert all({int(j) // 4 for j in np.argsort(-alike[i])[:3]} == {i // 4} for i in range(12))
    np.testing.assert_array_equal(retrieval.likeness(descriptors), retrieval.likeness(descriptors))
    assert retrieval.likeness([np.zeros((0, 128), np.uint8)] * 2).shape == (2, 2)


# --- up, and what was turned only


def test_up_is_across_the_cameras_x_axes():
    """An orbit that looks down by 30 degrees: the mean of the pictures' up is not up, what is across their rows is."""
    angle = torch.linspace(0, 4.0, 9).double()
    eye = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full_like(angle, 1.2)], 1)
    views = look_at(eye, torch.zeros(3).double(), torch.tensor([0, 0, 1.0]).double()).numpy()
    rotations, centres = views[:, :3, :3], eye.numpy()
    np.testing.assert_allclose(orient.up_of(rotations), [0, 0, 1], atol=1e-6)
    scale, R, t = orient.similarity(rotations, centres, np.zeros((0, 3)))
    np.testing.assert_allclose(R @ [0, 0, 1], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(t, 0, atol=1e-6)
    assert np.linalg.det(R) == pytest.approx(1)
    one_way = np.repeat(rotations[:1], 3, axis=0)
    np.testing.assert_allclose(orient.up_of(one_way), -rotations[0, 1], atol=1e-9)


def test_a_turn_is_told_from_a_step():
    points = RNG.uniform((-2, -2, 4), (2, 2, 9), (200, 3))
    R = cv2.Rodrigues(np.array([0.02, 0.3, 0.01]))[0]

    def seen(world):
        return world[:, :2] / world[:, 2:] * 500

    assert turned(seen(points), seen(points @ R.T) + RNG.normal(0, 0.5, (200, 2)), 1000)
    assert not turned(seen(points), seen(points @ R.T + (1.0, 0, 0)), 1000)
