"""Files: whole or not at all, with a digest, under names that any file system takes."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from dreamcatalyst import files
from dreamcatalyst.errors import FileError
from dreamcatalyst.report.curve import Curve
from dreamcatalyst.report.pictures import write_png, write_video
from dreamcatalyst.scene.gaussians import Gaussians
from dreamcatalyst.scene.ply import write_ply
from hypothesis import given
from hypothesis import strategies as st

STATE = {"numbers": torch.arange(1000.0), "words": ["a", {"b": None}]}


def test_what_was_saved_is_read_again_and_by_torch_itself(tmp_path):
    path = files.save(tmp_path / "new" / "a.ckpt", STATE)
    state, sealed = files.load(path)
    assert sealed and state["words"] == STATE["words"] and torch.equal(state["numbers"], STATE["numbers"])
    assert torch.equal(torch.load(path, weights_only=True)["numbers"], STATE["numbers"])
    assert [p.name for p in path.parent.iterdir()] == ["a.ckpt"]


def test_a_single_flipped_bit_is_found_wherever_it_is(tmp_path):
    written = files.save(tmp_path / "a.ckpt", STATE).read_bytes()
    draw = random.Random(0)
    places = [draw.randrange(len(written)) for _ in range(100)] + list(range(len(written) - 100, len(written)))
    for place in places:
        flipped = bytearray(written)
        flipped[place] ^= 1 << draw.randrange(8)
        (tmp_path / "b.ckpt").write_bytes(flipped)
        with pytest.raises(FileError, match="b.ckpt"):
            files.load(tmp_path / "b.ckpt")


def test_a_file_that_is_cut_short_or_of_another_kind_is_refused(tmp_path):
    written = files.save(tmp_path / "a.ckpt", STATE).read_bytes()
    for length in (0, 1, 50, len(written) // 2, len(written) - 1):
        (tmp_path / "b.ckpt").write_bytes(written[:length])
        with pytest.raises(FileError, match="b.ckpt"):
            files.load(tmp_path / "b.ckpt")
    np.savez(tmp_path / "c.npz", a=np.zeros(3))
    for path in (tmp_path / "c.npz", Path(__file__), tmp_path, tmp_path / "nowhere"):
        with pytest.raises(FileError):
            files.load(path)


def test_a_file_without_a_digest_is_read_and_its_own_sums_are_checked(tmp_path):
    path = tmp_path / "a.ckpt"
    torch.save(STATE, path)
    state, sealed = files.load(path)
    assert not sealed and torch.equal(state["numbers"], STATE["numbers"])
    flipped = bytearray(path.read_bytes())
    flipped[flipped.index(STATE["numbers"].numpy().tobytes()) + 10] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(FileError, match="damaged"):
        files.load(path)


def test_code_in_a_file_is_never_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.system, ("exit 1",)

    torch.save({"a": Evil()}, tmp_path / "a.ckpt")
    with pytest.raises(FileError, match="UnpicklingError"):
        files.load(tmp_path / "a.ckpt")


def test_a_write_that_fails_leaves_the_earlier_file_and_nothing_else(tmp_path):
    path = files.write_text(tmp_path / "a.txt", "before")
    with pytest.raises(ZeroDivisionError), files.replacing(path) as part:
        part.write_text("half")
        raise ZeroDivisionError
    with pytest.raises(FileError, match="a.txt: cannot be written"), files.replacing(path):
        pass  # nothing is written
    assert path.read_text() == "before" and [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    with pytest.raises(FileError, match="Not a directory|File exists"):
        files.write_text(path / "b.txt", "")


def big(folder: Path, n: int) -> None:
    """Write one of each kind, n times its small size."""
    side = 16 * n
    pixels = np.random.default_rng(0).integers(0, 255, (side, side, 3), np.uint8)
    count = 100 * n * n
    flat, sh = (torch.zeros(count, k) for k in (3, 4, 3)), (torch.zeros(count, k, 3) for k in (1, 0))
    scene = Gaussians(*flat, torch.zeros(count), *sh)
    writers = {
        "a.ckpt": lambda path: files.save(path, {"a": torch.randn(1000 * n * n)}),
        "a.ply": lambda path: write_ply(path, scene),
        "a.png": lambda path: write_png(path, pixels),
        "a.csv": lambda path: Curve([{"step": i, "x": i / 3} for i in range(100 * n * n)]).write_csv(path),
        "a.html": lambda path: files.write_text(path, "x" * 3000 * n * n),
        "a.mp4": lambda path: write_video(path, (pixels ^ np.uint8(37 * i % 256) for i in range(n))),
    }
    for name, write in writers.items():
        if n == 1:
            write(folder / name)
            continue
        before = (folder / name).read_bytes()
        try:
            write(folder / name)
        except FileError as error:
            print(name, error.full, error)
        assert (folder / name).read_bytes() == before, name
    assert {path.name for path in folder.iterdir()} == set(writers)


def test_on_a_full_disk_every_kind_of_file_stays_as_it_was(small_disk):
    """In a process of its own, which is given little room by the file system or, where none can be mounted, by a
    limit on the size of its files."""
    code = "import sys, test_files, pathlib; [test_files.big(pathlib.Path(sys.argv[1]), n) for n in (1, 24)]"
    paths = [str(Path(__file__).parent), str(Path(files.__file__).parents[1])]
    done = subprocess.run(
        [sys.executable, "-c", code, str(small_disk.folder)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        preexec_fn=small_disk.limit,
    )
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()
    assert [line.split()[0] for line in told] == ["a.ckpt", "a.ply", "a.png", "a.csv", "a.html", "a.mp4"]
    for line in told:
        assert "cannot be written" in line
        assert line.split()[1] == "True" or line.startswith("a.mp4"), line  # ffmpeg does not say why


# --- names


@given(st.text(max_size=300))
def test_any_text_gives_the_name_of_one_folder(text):
    name = files.folder_name(text)
    assert len(os.fsencode(name)) <= files.NAME_BYTES
    assert "/" not in name and "\\" not in name and "\0" not in name
    assert not name.startswith(".") and not name.endswith((".", " "))
    assert bool(name) == bool(text)
    assert (Path("root") / name).parent == Path("root") or not text


@given(st.lists(st.text(alphabet="ab/.\\ \n" + "ü" * 2, max_size=200), unique=True, min_size=2, max_size=20))
def test_different_texts_give_different_names(texts):
    assert len({files.folder_name(text) for text in texts}) == len(texts)


def test_a_plain_name_stays_as_it_is():
    for text in ("Turn_the_bear_statue_into_a_panda", "trial@20260101-120000", "größer, in 3D!", ""):
        assert files.folder_name(text) == text
