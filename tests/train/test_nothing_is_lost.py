"""Kills, signals, full disks, terminals and folders that go away: what a run had reached is still there, and goes on to
the bits of a run that nothing happened to. Runs are processes of their own, forked from one that imported once."""

from __future__ import annotations

import os
import random
import shutil
import signal
import tempfile
import time
from pathlib import Path

import pytest
from dreamcatalyst import files

from benchmarks import kills

KILLS = int(os.environ.get("KILLS", "20"))
SIGNALS = {"SIGINT": "Ctrl-C", "SIGTERM": "SIGTERM", "SIGHUP": "SIGHUP"}


class Runs(kills.Small):
    """The smallest run, begun in processes of their own."""

    def start(self, name, *more, journal=True, log="", **options):
        log = Path(log or self.folder / f"{name}.log")
        noted = self.folder / f"{name}.journal" if journal else None
        process = kills.processes().Process(
            target=kills.run, args=(self.arguments(name, *more), log, noted), kwargs=options
        )
        process.start()
        return process

    def log(self, name):
        file = self.folder / f"{name}.log"
        return file.read_text() if file.exists() else ""

    def wait_for(self, condition, process):
        until = time.monotonic() + kills.WAIT
        while not condition():
            assert process.is_alive() and time.monotonic() < until
            time.sleep(1e-3)

    def steps(self, name):
        return kills.expected(self.folder / f"{name}.journal")[1]

    def bits(self, name):
        return (self.trial(name) / "save" / "last.ply").read_bytes()

    def step_left(self, name):
        """Of the checkpoint, which must be whole and be the only thing in its folder that ends so."""
        state, sealed = files.load(self.trial(name) / "ckpts" / "last.ckpt")
        assert sealed and not kills.parts(self.trial(name))
        return state["global_step"]

    def resume(self, name, *more):
        process = self.start(name, f"resume={self.trial(name) / 'ckpts' / 'last.ckpt'}", *more)
        process.join()
        assert process.exitcode == 0, self.log(name)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    runs = Runs(tmp_path_factory.mktemp("runs"))
    runs.warm_up()
    return runs


@pytest.fixture(scope="module")
def whole(runs):
    """The splats of a run that nothing happened to."""
    process = runs.start("whole")
    process.join()
    assert process.exitcode == 0, runs.log("whole")
    return runs.bits("whole")


def test_no_kill_loses_more_than_the_work_since_the_last_checkpoint(runs, whole):
    found, ended = kills.kill_and_resume(runs, "killed", KILLS, random.Random(KILLS))
    assert [kill.fault for kill in found if kill.fault] == []
    assert len(found) == KILLS and sum(kill.inside for kill in found) >= KILLS // 4
    assert any(not kill.inside for kill in found) and ended >= 1
    for number in range(ended):
        assert runs.bits(f"killed{number}") == whole, number


@pytest.mark.parametrize("name", SIGNALS)
def test_a_signal_stops_after_the_step_and_one_line_says_what_is_there(runs, whole, name):
    process = runs.start(name)
    runs.wait_for(lambda: runs.steps(name) >= 3, process)
    os.kill(process.pid, getattr(signal, name))
    process.join()
    told, trial = runs.log(name), runs.trial(name)
    assert process.exitcode == 128 + getattr(signal, name), told
    last, checkpoint = trial / "save" / "last.ply", trial / "ckpts" / "last.ckpt"
    assert f"stopped by {SIGNALS[name]}; on disk: {last}, {checkpoint} (go on: resume={checkpoint})" in told
    assert "Traceback" not in told and 3 <= runs.step_left(name) < kills.STEPS and last.is_file()
    runs.resume(name)
    assert runs.bits(name) == whole


@pytest.mark.parametrize(("moment", "left"), [("train: ", "nothing was saved yet"), ("test ", "last.ply, ")])
def test_a_signal_before_training_or_after_it_says_what_is_there(runs, moment, left):
    name = f"at-{moment.strip(' :')}"
    process = runs.start(name, "system.report.video_frames=3000", "trainer.max_steps=3")
    runs.wait_for(lambda: moment in runs.log(name), process)
    os.kill(process.pid, signal.SIGTERM)
    process.join()
    told = runs.log(name).splitlines()[-1]
    assert process.exitcode == 143 and "Traceback" not in runs.log(name)
    assert told.startswith("stopped by SIGTERM; ") and (left in told or (moment == "train: " and "on disk: " in told))
    assert moment == "train: " or runs.step_left(name) == 3


def test_a_terminal_that_takes_no_words_costs_nothing(runs, whole):
    process = runs.start("silent", log="/dev/full")
    process.join()
    assert process.exitcode == 0 and runs.bits("silent") == whole


def test_a_disk_that_fills_up_leaves_the_last_good_state(runs, whole, tmp_path):
    """Every step adds a checkpoint, until there is no room."""
    from tests.conftest import mount

    folder = runs.folder / "filling"
    folder.mkdir()
    with mount(folder, 2 << 20) as disk:
        process = runs.start(
            "filling",
            *("checkpoint.every_n_train_steps=1", "checkpoint.save_top_k=-1", "checkpoint.minutes=0"),
            disk=0 if disk.mounted else 30_000,
        )
        process.join()
        told, trial = runs.log("filling"), runs.trial("filling")
        assert process.exitcode == 2 and "Traceback" not in told, told
        *_, stopped, error = told.splitlines()
        assert stopped.startswith("stopped by an error; on disk: ") and str(trial / "save" / "last.ply") in stopped
        assert error.startswith("error: ") and "cannot be written" in error
        if disk.mounted:
            step = runs.step_left("filling")
            assert step >= 1 and str(trial / "ckpts" / "last.ckpt") in stopped
            for checkpoint in (trial / "ckpts").glob("*=*.ckpt"):
                checkpoint.unlink()
            runs.resume("filling")
            assert runs.bits("filling") == whole


def test_the_temporary_folder_may_be_full_or_on_another_disk(runs, whole, small_disk):
    (small_disk.folder / "ballast").write_bytes(b"0" * (100 << 10))
    elsewhere = tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
    try:
        given = dict(temporary=str(small_disk.folder))
        for name, where in {"here": runs.folder, "elsewhere": Path(elsewhere)}.items():
            process = runs.start(name, f"exp_root_dir={where}", **given)
            process.join()
            assert process.exitcode == 0, runs.log(name)
            assert (where / name / "run" / "save" / "last.ply").read_bytes() == whole
    finally:
        shutil.rmtree(elsewhere)


def test_a_folder_that_is_removed_is_made_again_for_the_result(runs, whole):
    process = runs.start("removed")
    runs.wait_for(lambda: runs.steps("removed") >= 3, process)
    os.kill(process.pid, signal.SIGSTOP)
    shutil.rmtree(runs.trial("removed"))
    os.kill(process.pid, signal.SIGCONT)
    process.join()
    told = runs.log("removed")
    assert process.exitcode in (0, 2) and "Traceback" not in told, told
    if process.exitcode == 2:
        assert "error: " in told.splitlines()[-1]
        assert "stopped by an error; on disk: " in told
    runs.step_left("removed")
    if runs.step_left("removed") < kills.STEPS:
        runs.resume("removed")
    assert runs.bits("removed") == whole


def test_two_runs_that_begin_together_have_folders_of_their_own(runs, whole):
    both = [runs.start("together", "use_timestamp=true", journal=False) for _ in range(2)]
    for process in both:
        process.join()
        assert process.exitcode == 0, runs.log("together")
    folders = sorted((runs.folder / "together").iterdir())
    assert len(folders) == 2
    assert all((folder / "save" / "last.ply").read_bytes() == whole for folder in folders)


def test_a_run_is_neither_joined_nor_replaced(runs):
    process = runs.start("alone")
    runs.wait_for(lambda: runs.steps("alone") >= 1, process)
    os.kill(process.pid, signal.SIGSTOP)
    second = runs.start("alone", log=runs.folder / "second.log")
    second.join()
    os.kill(process.pid, signal.SIGCONT)
    process.join()
    assert (second.exitcode, process.exitcode) == (2, 0)
    assert "another process is running in this folder" in (runs.folder / "second.log").read_text()
    before = {path: path.read_bytes() for path in runs.trial("alone").rglob("*") if path.is_file()}
    third = runs.start("alone", log=runs.folder / "third.log")
    third.join()
    told = (runs.folder / "third.log").read_text()
    assert third.exitcode == 2 and "holds the results of another run" in told and "tag=" in told and "resume=" in told
    assert {path: path.read_bytes() for path in runs.trial("alone").rglob("*") if path.is_file()} == before
