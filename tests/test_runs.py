"""The folder of a run: its own, or an error."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from dreamcatalyst.config import ExperimentConfig
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.runs import claimed, left_in, told


def config(tmp_path, **given):
    folders = dict(exp_root_dir=str(tmp_path), exp_dir=str(tmp_path / "n"), trial_name="t@now")
    folders |= dict(trial_dir=str(tmp_path / "n" / "t@now"), timestamp="@now", tag="t", name="n")
    return dataclasses.replace(ExperimentConfig(), **folders, **given)


def write(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("something")
    return path


def test_runs_of_the_same_second_are_numbered(tmp_path):
    taken = []
    for number in ("", "-2", "-3"):
        with claimed(config(tmp_path), numbered=True, writes=True) as run:
            write(Path(run.trial_dir) / "save" / "last.ply")
            assert run.trial_name == f"t@now{number}" and run.timestamp == f"@now{number}"
            taken.append(run.trial_dir)
    assert len(set(taken)) == 3 and all(Path(folder).is_dir() for folder in taken)


def test_a_folder_is_for_one_process_at_a_time(tmp_path):
    with claimed(config(tmp_path), numbered=False, writes=True):
        with (
            pytest.raises(ConfigError, match="another process is running in this folder"),
            claimed(config(tmp_path), numbered=False, writes=True),
        ):
            raise AssertionError
        with claimed(config(tmp_path), numbered=False, writes=False):
            pass  # looking at it does not disturb it
    with claimed(config(tmp_path), numbered=False, writes=True):
        pass


@pytest.mark.parametrize("result", ["save/last.ply", "ckpts/last.ckpt", "ckpts/epoch=0-step=5.ckpt"])
def test_results_are_not_replaced_unless_they_are_resumed_from(tmp_path, result):
    path = write(Path(config(tmp_path).trial_dir) / result)
    with (
        pytest.raises(ConfigError, match="holds the results of another run") as error,
        claimed(config(tmp_path), numbered=False, writes=True),
    ):
        raise AssertionError
    assert ("resume=" in str(error.value)) == (path.suffix == ".ckpt") and "tag=" in str(error.value)
    assert path.read_text() == "something"
    if path.suffix == ".ckpt":
        with claimed(config(tmp_path, resume=str(path)), numbered=True, writes=True) as run:
            assert run.trial_name == "t@now"


def test_a_run_in_which_nothing_was_written_leaves_no_folder(tmp_path):
    with pytest.raises(ZeroDivisionError), claimed(config(tmp_path), numbered=True, writes=True):
        raise ZeroDivisionError
    assert not Path(config(tmp_path).trial_dir).exists()


def test_what_a_killed_writer_left_is_cleared(tmp_path):
    folder = Path(config(tmp_path).trial_dir)
    part, kept = write(folder / "ckpts" / ".last.ckpt.123.part"), write(folder / "ckpts" / "notes.txt")
    assert left_in(folder) == [] and told(folder) == "nothing was saved yet"
    with claimed(config(tmp_path), numbered=False, writes=True):
        assert not part.exists() and kept.exists()


@pytest.mark.parametrize("place", ["", "n", "n/t@now", "n/t@now/save", "n/t@now/ckpts", "n/t@now/report"])
def test_a_file_where_a_folder_has_to_be_is_named(tmp_path, place):
    root = tmp_path / "root"
    write(root / place)
    with (
        pytest.raises(ConfigError, match=r"root.*(is a file|File exists|Not a directory)"),
        claimed(config(root), numbered=False, writes=True),
    ):
        raise AssertionError
    assert (root / place).read_text() == "something"


def test_a_place_that_cannot_be_written_to_is_named():
    with (
        pytest.raises(ConfigError, match="exp_root_dir: '/proc/nowhere'"),
        claimed(config(Path("/proc/nowhere")), numbered=True, writes=True),
    ):
        raise AssertionError
