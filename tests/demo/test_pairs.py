"""Training pairs: readable, resumable to the bit, masked where the object is, of training worlds only."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from dreamcatalyst.demo import pairs, photographs
from dreamcatalyst.demo.edits import EDITS, find_edit
from dreamcatalyst.demo.pairs import EDITS_PER_SOURCE, SEEN, VISIBLE, make_pairs, photograph_pairs, read_pairs
from dreamcatalyst.demo.random_world import HELD_OUT
from dreamcatalyst.errors import ConfigError, DataError

COUNT, SIZE = 30, 32


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pairs, "SHARD", 13)
        place = tmp_path_factory.mktemp("pairs")
        make_pairs(place, COUNT, seed=3, size=SIZE)
        yield place


@pytest.fixture(scope="module")
def made(folder):
    return read_pairs(folder)


def same(a, b):
    assert a.keys() == b.keys()
    for key in a:
        assert np.array_equal(a[key], b[key]), key


def test_pairs_have_the_shapes_that_training_reads(folder, made):
    assert [file.name for file in sorted(folder.glob("*.npz"))] == [f"pairs-0000{i}.npz" for i in range(3)]
    for key in ("source", "edited"):
        assert (made[key].shape, made[key].dtype) == ((COUNT, SIZE, SIZE, 3), np.uint8)
    assert (made["mask"].shape, made["mask"].dtype) == ((COUNT, SIZE, SIZE), np.uint8)
    assert made["world"].dtype == np.int64 and made["world"].min() >= HELD_OUT
    assert made["instruction"].shape == made["edit"].shape == (COUNT,)
    assert set(np.unique(made["mask"])) <= {0, 255}


def test_instructions_name_their_edits(made):
    for said, name in zip(made["instruction"], made["edit"], strict=True):
        assert find_edit(str(said)).name == name


def test_object_edits_change_nothing_outside_their_mask(made):
    for i, name in enumerate(made["edit"]):
        edit, mask = EDITS[str(name)], made["mask"][i] > 0
        change = np.abs(made["source"][i].astype(int) - made["edited"][i].astype(int)).max(-1)
        if edit.scope == "global":
            assert mask.all()
        else:
            assert SEEN < mask.mean() < 1 and change[~mask].max() <= 2 * VISIBLE * 255 + 1
        assert (change.max() == 0) == (edit.name == "nothing")


def test_an_interrupted_making_is_continued_to_the_same_bits(folder, made, tmp_path):
    make_pairs(tmp_path, 16, seed=3, size=SIZE)  # the second shard is short
    (tmp_path / "pairs-00000.npz").unlink()
    (tmp_path / "pairs-00002.part").write_bytes(b"half a shard")
    make_pairs(tmp_path, COUNT, seed=3, size=SIZE)
    same(read_pairs(tmp_path), made)
    stamp = (tmp_path / "pairs-00001.npz").stat().st_mtime_ns
    make_pairs(tmp_path, COUNT, seed=3, size=SIZE)
    assert (tmp_path / "pairs-00001.npz").stat().st_mtime_ns == stamp  # what is there is kept


def test_pairs_of_other_settings_are_not_mixed(folder, tmp_path):
    with pytest.raises(DataError, match="holds pairs made with .*'seed': 3.*asked for are .*'seed': 4"):
        make_pairs(folder, COUNT, seed=4, size=SIZE)
    with pytest.raises(DataError, match="no training pairs"):
        read_pairs(tmp_path)


def test_what_is_complete_needs_no_photographs(folder, made, monkeypatch):
    monkeypatch.setattr(photographs, "PHOTOGRAPHS", (("no_such_package", "no-such-package", {}),))
    make_pairs(folder, COUNT, seed=3, size=SIZE, photographs=lambda name: lambda x: x)
    same(read_pairs(folder), made)


def test_photographs_are_edited_as_wholes():
    image = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    made = list(photograph_pairs([image], lambda name: lambda x: 1 - x, 24, np.random.default_rng(1)))
    assert len(made) == EDITS_PER_SOURCE
    for pair in made:
        assert pair["world"] == -1 and (pair["mask"] == 255).all() and EDITS[pair["edit"]].scope == "global"
        expected = pair["source"] if pair["edit"] == "nothing" else 255 - pair["source"]
        assert np.array_equal(pair["edited"], expected)


def test_missing_photographs_name_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(photographs, "PHOTOGRAPHS", (("no_such_package", "no-such-package", {}),))
    with pytest.raises(ConfigError, match="'no-such-package'.*not installed.*prior-training"):
        make_pairs(tmp_path, 1, seed=0, size=16, photographs=lambda name: lambda x: x)
    assert not list(tmp_path.iterdir())


def test_photographs_come_with_their_packages():
    for package, _, files in photographs.PHOTOGRAPHS:
        if find_spec(package) is None:
            pytest.skip("the prior-training extra is not installed")
        assert all(files.values())  # each says its licence
    images = photographs.load_photographs()
    assert len(images) == 6 and all(image.shape[2] == 3 and min(image.shape[:2]) >= 300 for image in images)


GOOD = dict(
    source=np.zeros((2, 4, 4, 3), np.uint8),
    edited=np.zeros((2, 4, 4, 3), np.uint8),
    mask=np.zeros((2, 4, 4), np.uint8),
    instruction=np.array(["snow", "snow"]),
    edit=np.array(["snow", "snow"]),
    world=np.array([1, 2]),
)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"mask": None}, "has no 'mask'"),
        ({"source": GOOD["source"] / 255}, "'source' is float64"),
        ({"edited": GOOD["edited"][:1]}, r"'edited' is uint8 \[1, 4, 4, 3\], expected uint8 \[2, 4, 4, 3\]"),
        ({"source": GOOD["source"][..., 0]}, "'source' is uint8"),
        ({"instruction": np.arange(2)}, "'instruction' is int64"),
        ({"world": GOOD["edit"]}, "'world' is <U4"),
        ({"edit": np.array([{}, {}])}, "is no shard of pairs"),
        ({name: array[:0] for name, array in GOOD.items()}, r"'world' is int64 \[0\]"),
    ],
)
def test_a_shard_of_anything_else_is_refused_by_its_name(tmp_path, arrays, said):
    np.savez(tmp_path / "pairs-00000.npz", **GOOD)
    assert len(read_pairs(tmp_path)["world"]) == 2
    spoiled = {name: array for name, array in {**GOOD, **arrays}.items() if array is not None}
    np.savez(tmp_path / "pairs-00001.npz", **spoiled)
    with pytest.raises(DataError, match=f"pairs-00001.npz: {said}"):
        read_pairs(tmp_path)


def test_a_shard_that_is_no_archive_is_refused(tmp_path):
    for junk in (b"", b"junk", b"PK" + bytes(99)):
        (tmp_path / "pairs-00000.npz").write_bytes(junk)
        with pytest.raises(DataError, match="pairs-00000.npz: is no shard of pairs, or is damaged"):
            read_pairs(tmp_path)
