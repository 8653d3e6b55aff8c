"""Masks from files and from numbers: what is taken, and what is refused in which words."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst import files
from dreamcatalyst.config import parse
from dreamcatalyst.errors import ConfigError, DataError, SceneError
from dreamcatalyst.segment.api import MaskConfig, make_mask
from dreamcatalyst.segment.box import Box
from dreamcatalyst.segment.files import Files, read_mask

SMALL = np.zeros((4, 6), np.uint8)
SMALL[1:3, 2:5] = 255


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


# --- files


@pytest.mark.parametrize("suffix", ["grey", "colour", "alpha", "opaque", "labels", "deep"])
def test_a_mask_may_be_stored_in_any_of_these_ways(suffix, tmp_path):
    colour = np.repeat(SMALL[..., None], 3, axis=2)
    noise = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    images = {
        "grey": SMALL,
        "colour": colour,
        "alpha": np.dstack([noise, SMALL]),
        "opaque": np.dstack([colour, np.full_like(SMALL, 255)]),
        "labels": SMALL // 255,
        "deep": SMALL.astype(np.uint16) * 257,
    }
    read = read_mask(write(tmp_path / "mask.png", images[suffix]), 6, 4)
    assert read.dtype == np.float32 and np.array_equal(read, SMALL.astype(np.float32) / 255)


def test_other_sizes_are_resized_and_other_shapes_refused(tmp_path):
    path = write(tmp_path / "mask.png", np.kron(SMALL, np.ones((5, 5), np.uint8)))
    assert np.array_equal(read_mask(path, 6, 4), SMALL.astype(np.float32) / 255)  # shrunk by areas: exact
    assert read_mask(path, 60, 40).shape == (40, 60)
    with pytest.raises(DataError, match="mask.png: is 30x20, which is not the shape of its view, 6x6"):
        read_mask(path, 6, 6)
    for content in (b"no picture", b""):
        (tmp_path / "broken.png").write_bytes(content)
        with pytest.raises(DataError, match="broken.png: is damaged"):
            read_mask(tmp_path / "broken.png", 6, 4)


def test_views_without_a_file_are_listed_with_the_nearest_name(disc_world, tmp_path):
    request = disc_world.request
    with pytest.raises(DataError, match="nowhere: no such folder"):
        Files(folder=str(tmp_path / "nowhere")).paths(request)
    write(tmp_path / "0000.png", SMALL)
    write(tmp_path / "photos" / "0002.png", SMALL)
    write(tmp_path / "0001_mask.png", SMALL)
    with pytest.raises(DataError) as error:
        Files(folder=str(tmp_path)).paths(request)
    for words in ("no mask for 2 of 4 views: '0001.png', '0004.png'", "Did you mean '0001_mask.png'?", "missing=true"):
        assert words in str(error.value)
    assert list(Files(folder=str(tmp_path), missing=True).paths(request)) == [0, 2]
    with pytest.raises(DataError, match="no mask for 4 of 4 views"):
        empty = tmp_path / "empty"
        empty.mkdir()
        Files(folder=str(empty), missing=True).paths(request)


def test_black_masks_are_an_empty_mask(disc_world, tmp_path):
    for i in range(5):
        write(tmp_path / f"{i:04d}.png", np.zeros((48, 56), np.uint8))
    with pytest.raises(SceneError, match=r"threshold 0.5 finds 0 of 650 splats \(0 at 0.375, .* highest weight is 0\)"):
        make_mask(MaskConfig(kind="files", options={"folder": str(tmp_path)}), disc_world.request)


# --- boxes


def box(request, **options):
    return make_mask(MaskConfig(kind="box", options=options), request)


def test_a_box_and_a_sphere_hold_the_centres_inside(disc_world):
    means = disc_world.request.scene.means
    inside = ((means >= -0.5) & (means <= torch.tensor([0.5, 0.4, 2.0]))).all(dim=1)
    found = box(disc_world.request, low=[-0.5, -0.5, -0.5], high=[0.5, 0.4, 2.0])
    assert torch.equal(found.mask, inside) and not found.images
    found = box(disc_world.request, center=[0.0, 0.0, 0.0], radius=0.7)
    assert torch.equal(found.mask, means.norm(dim=1) <= 0.7)
    with pytest.raises(SceneError, match="threshold 0.5 finds 0 of"):
        box(disc_world.request, center=[9.0, 0.0, 0.0], radius=0.5)


@pytest.mark.parametrize("view, window", [("photos/0003.jpg", "pixels"), (3, "fractions")])
def test_a_rectangle_in_one_view_holds_what_is_visible_there(view, window, disc_world):
    seen = (disc_world.views[3] > 0.5).nonzero()
    (top, left), (bottom, right) = seen.min(dim=0).values, seen.max(dim=0).values + 1
    size = (56, 48, 56, 48) if window == "fractions" else (1, 1, 1, 1)
    edges = [float(v) / s for v, s in zip((left, top, right, bottom), size, strict=True)]
    found = box(disc_world.request, view=view, window=edges)
    assert float(found.mask[disc_world.truth].float().mean()) > 0.95
    # The wall is in it only where it shows inside of the rectangle or lies right behind the disc.
    from dreamcatalyst.render.projection import project

    scene, camera = disc_world.request.scene, disc_world.request.cameras[3]
    xy = project(scene.means, scene.quats, scene.scales, camera).means2d[0]
    outside = (xy < torch.tensor([left, top]) - 4).any(dim=1) | (xy > torch.tensor([right, bottom]) + 4).any(dim=1)
    assert not bool(found.mask[outside & ~disc_world.truth].any())


def test_the_edge_of_a_rectangle_counts_in_part(disc_world):
    mask = Box(view="0", window=(1.25, 0.0, 3.0, 2.5)).rectangle(4, 4)
    assert mask[0].tolist() == [0.0, 0.75, 1.0, 0.0] and mask[:, 2].tolist() == [1.0, 1.0, 0.5, 0.0]


@pytest.mark.parametrize(
    "options, words",
    [
        ({}, "got nothing, expected one of: low and high"),
        ({"low": (0, 0, 0)}, "got low, expected one of"),
        ({"center": (0, 0, 0), "radius": 1.0, "view": "0", "window": (0, 0, 1, 1)}, "expected one of"),
        ({"low": (0, 0, 0), "high": (1, 0, 1)}, "must lie below high"),
        ({"center": (0, 0, 0), "radius": 0.0}, "radius: got 0.0"),
        ({"view": "0", "window": (0.5, 0, 0.2, 1)}, "left < right"),
        ({"view": "0", "window": (-0.5, 0, 0.2, 1)}, r"window\[0\]: got -0.5"),
        ({"view": "0", "window": (0, 0, float("nan"), 1)}, r"window\[2\]: got nan"),
        ({"low": (0, float("nan"), 0), "high": (1, 1, 1)}, r"low\[1\]: got nan .float., expected a finite number"),
        ({"center": (0, 0, 0), "radius": float("inf")}, "radius: got inf"),
    ],
)
def test_boxes_that_cannot_be(options, words):
    with pytest.raises(ConfigError, match=words):
        parse(Box, options, "system.mask.options")


def test_views_and_windows_that_are_not_there(disc_world):
    with pytest.raises(ConfigError, match=r"no view 'photos/0003.png'. Did you mean 'photos/0003.jpg'\?"):
        box(disc_world.request, view="photos/0003.png", window=[0, 0, 1, 1])
    with pytest.raises(ConfigError, match="no view '5'"):
        box(disc_world.request, view="5", window=[0, 0, 1, 1])
    with pytest.raises(ConfigError, match="lies outside of the view, 56x48"):
        box(disc_world.request, view="0", window=[60, 0, 70, 10])


# --- the cache


def test_masks_are_kept_under_all_that_made_them(disc_world, tmp_path, monkeypatch):
    from dreamcatalyst.segment.relevance import Relevance

    asked = []
    original = Relevance.__call__
    monkeypatch.setattr(Relevance, "__call__", lambda *args: (asked.append(1), original(*args))[1])
    request, config = disc_world.request, MaskConfig(kind="relevance", options={"draws": 1}, views=2)

    def make(config=config, request=request):
        before = len(asked)
        return make_mask(config, request, tmp_path / "masks"), len(asked) - before

    first, made = make()
    again, made_again = make()
    assert (made, made_again) == (1, 0) and torch.equal(first.weights, again.weights)
    assert all(torch.equal(first.images[v], again.images[v]) for v in first.images)
    # What comes after the weights does not make them anew.
    assert make(dataclasses.replace(config, threshold=0.3, grow=0.1, invert=True, feather=0.1))[1] == 0
    moved = dataclasses.replace(request.scene, means=request.scene.means + 1e-6)
    for change in (
        dict(config=dataclasses.replace(config, options={"draws": 1, "seed": 1})),
        dict(config=dataclasses.replace(config, views=3)),
        dict(config=dataclasses.replace(config, vote="gaussian-editor")),
        dict(config=dataclasses.replace(config, min_evidence=1.0)),
        dict(request=dataclasses.replace(request, scene=moved)),
        dict(request=dataclasses.replace(request, prompt="Make it fall")),
        dict(request=dataclasses.replace(request, background=(1.0, 1.0, 1.0))),
    ):
        assert make(**change)[1] == 1, change


@pytest.mark.parametrize("damage", ["cut short", "one bit", "foreign", "no mask", "odd types", "few", "nan"])
def test_a_damaged_or_foreign_file_is_made_again(damage, disc_world, tmp_path, caplog):
    config = MaskConfig(kind="box", options={"center": [0.0, 0.0, 1.0], "radius": 0.7}, cache=str(tmp_path))
    first = make_mask(config, disc_world.request)
    (file,) = tmp_path.glob("*.pt")
    if damage == "cut short":
        file.write_bytes(file.read_bytes()[:100])
    elif damage == "one bit":
        middle = file.stat().st_size // 2
        flipped = bytearray(file.read_bytes())
        flipped[middle] ^= 1
        file.write_bytes(flipped)
    elif damage == "odd types":
        torch.save({**torch.load(file, weights_only=True), "weights": torch.zeros(3, 3)}, file)
    elif damage in ("few", "nan"):
        kept, _ = files.load(file)
        few, nan = kept["weights"][:-1], torch.full_like(kept["weights"], math.nan)
        files.save(file, {**kept, "weights": few if damage == "few" else nan})
    elif damage == "foreign":
        kept = torch.load(file, weights_only=True)
        torch.save({**kept, "key": "another"}, file)
    else:
        torch.save([1, 2, 3], file)
    again = make_mask(config, disc_world.request)
    assert str(file) in caplog.text and "The mask is made again" in caplog.text
    assert torch.equal(first.weights, again.weights)
    assert torch.equal(torch.load(file, weights_only=True)["weights"], first.weights)


def test_a_mask_that_came_with_the_splats_is_known_by_its_values(disc_world, tmp_path):
    config, request = MaskConfig(kind="kept", cache=str(tmp_path)), disc_world.request
    assert torch.equal(make_mask(config, request).mask, disc_world.truth)
    other = request.scene.with_extra(mask=1 - disc_world.truth.float())
    assert torch.equal(make_mask(config, dataclasses.replace(request, scene=other)).mask, ~disc_world.truth)
    with pytest.raises(SceneError, match="kept needs splats with the property 'mask'"):
        bare = dataclasses.replace(request.scene, extra={})
        make_mask(config, dataclasses.replace(request, scene=bare))


def test_files_that_change_make_a_new_mask(disc_world, tmp_path):
    folder = tmp_path / "drawn"
    for i in range(5):
        write(folder / f"{i:04d}.png", (disc_world.views[i].clamp(0, 1) * 255).byte().numpy())
    config = MaskConfig(kind="files", options={"folder": str(folder)}, cache=str(tmp_path / "masks"))
    first = make_mask(config, disc_world.request)
    write(folder / "0001.png", np.full((48, 56), 255, np.uint8))
    assert not torch.equal(make_mask(config, disc_world.request).weights, first.weights)
