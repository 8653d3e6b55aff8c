"""Signals, kills and disks: runs in processes of their own, forked from one that has imported what takes long."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch

from .cases import Case, Outcome, Place, arguments, launched
from .things import NAMED, SCENE, TRIAL

G = "process"
LONG = [*SCENE, *NAMED, "trainer.max_steps=1000000", "checkpoint.every_n_train_steps=1000000", "system.report.every=0"]
PATIENCE = 120.0  # seconds for what must come
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["torch", "lightning.pytorch", "omegaconf", "cv2"])


def child(words: Sequence[str], folder: str, out: str, environment: dict[str, str]) -> None:
    """What `python launch.py` does, in a new process. Exits with its status; an error prints its traceback."""
    sink = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(sink, number)
    os.environ.update(environment, OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    torch.set_num_threads(1)
    os.chdir(folder)
    sys.argv[:] = ["launch.py", *words]
    sys.stdout, sys.stderr = (open(number, "w", buffering=1, closefd=False) for number in (1, 2))  # noqa: SIM115, PTH123
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    import launch

    launch.end_by_ctrl_c()
    sys.exit(launch.main(list(words)))


class Job:
    """A launch in a process of its own, in the case's folder."""

    def __init__(self, place: Place, words: Sequence[str], name: str = "", **environment: str):
        self.place, self.out = place, place.root.with_suffix(f".{name}out")
        self.process = SERVER.Process(target=child, args=(list(words), str(place.work), str(self.out), environment))
        self.process.start()

    @property
    def text(self) -> str:
        return self.out.read_text(encoding="utf-8", errors="replace") if self.out.exists() else ""

    def until(self, happened: Callable[[], object], what: str) -> None:
        """Wait for something. Raises TimeoutError where it does not happen, or the process has ended before."""
        end = time.monotonic() + PATIENCE
        while not happened():
            if time.monotonic() > end or not self.process.is_alive():
                self.kill()
                raise TimeoutError(f"{what} did not happen; it printed:\n{self.text}")
            time.sleep(0.001)

    def begun(self) -> None:
        """Wait until training has begun and gone on for some steps."""
        self.until(lambda: list(self.place.work.glob("outputs/**/plan.json")), "the training")
        time.sleep(0.5)

    def send(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def kill(self) -> None:
        self.process.kill()
        self.process.join()

    def outcome(self) -> Outcome:
        """Wait for its end. The status of a process that a signal ended is 128 and its number, as a shell has it."""
        self.process.join(PATIENCE)
        if self.process.is_alive():
            self.kill()
            return self.place.finish(Outcome(None, f"{self.text}\nnot ended after {PATIENCE:.0f} s"))
        code = self.process.exitcode
        return self.place.finish(Outcome(128 - code if code < 0 else code, self.text))


def process(name: str, run: Callable[[Place], Outcome], *says: str, status: int = 2) -> Case:
    """A case that looks after its processes itself."""

    def guarded(place: Place) -> Outcome:
        try:
            return run(place)
        except (TimeoutError, OSError, subprocess.CalledProcessError) as error:
            return Outcome(None, "", faults=[f"{type(error).__name__}: {error}"])

    return Case(G, name, guarded, says, status)


def inputs(place: Place) -> None:
    place.copy("scene.ply")
    place.copy("capture")
    place.remember()


def usable(place: Place, *names: str) -> list[str]:
    """What of the trial's files is missing or cannot be loaded."""
    from dreamcatalyst.scene.ply import read_ply

    found = []
    for name in names:
        try:
            path = place.work / TRIAL / name
            read_ply(path) if path.suffix == ".ply" else torch.load(path, weights_only=True)
        except Exception as error:
            found.append(f"{name} is lost ({type(error).__name__})")
    return found


def signalled(*numbers: int) -> Callable[[Place], Outcome]:
    """A run that gets signals while it trains: it must leave checkpoint and splats."""

    def run(place: Place) -> Outcome:
        inputs(place)
        job = Job(place, arguments("closed-form", LONG))
        job.begun()
        for number in numbers:
            job.send(number)
            time.sleep(0.02)
        outcome = job.outcome()
        if len(set(numbers)) == len(numbers):  # a second one of a kind means: at once
            outcome.faults += usable(place, "ckpts/last.ckpt", "save/last.ply")
        return outcome

    return run


def early(place: Place) -> Outcome:
    """Ctrl-C before training has begun."""
    inputs(place)
    job = Job(place, arguments("closed-form", LONG))
    job.until(lambda: "train" in job.text, "the first line")
    job.send(signal.SIGINT)
    return job.outcome()


def testing(place: Place) -> Outcome:
    """Ctrl-C after training, while pictures and video are made: the splats are there already."""
    inputs(place)
    job = Job(place, arguments("closed-form", [*SCENE, *NAMED, "system.report.video_frames=5000"]))
    job.until(lambda: list(place.work.glob("outputs/**/summary.json")), "the report")
    job.send(signal.SIGINT)
    outcome = job.outcome()
    outcome.faults += usable(place, "save/last.ply", "ckpts/last.ckpt")
    return outcome


def killed_writing(place: Place) -> Outcome:
    """SIGKILL in the middle of writing a checkpoint, three times: whatever bears a checkpoint's name can be loaded."""
    inputs(place)
    every = [*SCENE, *NAMED, "trainer.max_steps=1000000", "checkpoint.every_n_train_steps=1", "system.report.every=0"]
    found: list[str] = []
    folder = place.work / TRIAL / "ckpts"
    for turn in range(3):
        shutil.rmtree(place.work / "outputs", ignore_errors=True)
        job = Job(place, arguments("closed-form", every), name=str(turn))
        job.until((folder / "last.ckpt").exists, "the first checkpoint")
        before = {path.name for path in folder.iterdir()}
        job.until(lambda seen=before: {path.name for path in folder.iterdir()} - seen, "another file")
        time.sleep(0.0005 * turn)
        job.kill()
        names = [f"ckpts/{path.name}" for path in folder.glob("[!.]*.ckpt")]
        found += usable(place, *names)
    return place.finish(Outcome(137, job.text, faults=found))


def killed_by_default(place: Place) -> Outcome:
    """SIGKILL of a run in which only the clock says when to keep a checkpoint."""
    inputs(place)
    job = Job(place, arguments("closed-form", [*LONG, "checkpoint.minutes=0.03"]))
    job.until((place.work / TRIAL / "ckpts/last.ckpt").exists, "a checkpoint by the clock")
    job.kill()
    return place.finish(Outcome(137, job.text, faults=usable(place, "ckpts/last.ckpt")))


# --- disks


@contextlib.contextmanager
def small_disk(folder: Path, kib: int) -> Iterator[Callable[[int, int], None]]:
    """A file system of so many KiB at `folder`, and what fills it but for some KiB: fill(process, room). Where none may
    be mounted, the process cannot write files longer than the room from then on."""
    folder.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(folder)]
    mounted = subprocess.run(mount, capture_output=True).returncode == 0

    def fill(pid: int, room: int) -> None:
        if not mounted:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (room * 1024, room * 1024))
            return
        free = shutil.disk_usage(folder).free - room * 1024
        (folder / "filler").write_bytes(bytes(max(free, 0)))

    try:
        yield fill
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def full(place: Place, every: int, steps: int, room: int, wanted: Sequence[str]) -> Outcome:
    """The disk fills while a run trains, after its first checkpoint if it makes any."""
    inputs(place)
    words = [
        *SCENE,
        *NAMED,
        f"trainer.max_steps={steps}",
        f"checkpoint.every_n_train_steps={every}",
        "trainer.log_every_n_steps=1000000",
        "system.report.every=0",
    ]
    with small_disk(place.work / "outputs", 4096) as fill:
        job = Job(place, arguments("closed-form", words))
        job.until(lambda: list(place.work.glob("outputs/**/plan.json")), "the training")
        if every < steps:
            job.until((place.work / TRIAL / "ckpts/last.ckpt").exists, "the first checkpoint")
        fill(job.process.pid, room)
        outcome = job.outcome()
        outcome.faults += usable(place, *wanted)
        outcome.lost.clear()
        outcome.left.pop("work/outputs/filler", None)
        return outcome


def full_temporary(place: Place) -> Outcome:
    """A full folder for temporary files, on another file system than the output."""
    inputs(place)
    with small_disk(place.work / "tmp", 16) as fill:
        (place / "tmp/filler").write_bytes(b"")
        fill(os.getpid(), 0) if os.geteuid() == 0 else None
        job = Job(place, arguments("closed-form", [*SCENE, *NAMED]), TMPDIR=str(place.work / "tmp"))
        outcome = job.outcome()
        outcome.faults += usable(place, "ckpts/last.ckpt", "save/last.ply")
        return outcome


def removed(place: Place) -> Outcome:
    """The output folder is removed while a run trains, which is then asked to stop."""
    inputs(place)
    job = Job(place, arguments("closed-form", LONG))
    job.begun()
    shutil.rmtree(place.work / "outputs")
    job.send(signal.SIGINT)
    outcome = job.outcome()
    outcome.faults += usable(place, "ckpts/last.ckpt", "save/last.ply")
    return outcome


def two_at_once(place: Place) -> Outcome:
    """Two runs by the same command at the same moment: two results."""
    inputs(place)
    words = arguments("closed-form", [*SCENE, "tag=trial"])
    jobs = [Job(place, words, name=str(i)) for i in range(2)]
    outcomes = [job.outcome() for job in jobs]
    results = list(place.work.glob("outputs/closed-form/*/save/last.ply"))
    faults = [] if len(results) == 2 else [f"{len(results)} results of two runs"]
    faults += [f"one ended with {o.status}" for o in outcomes if o.status != 0]
    return Outcome(0, outcomes[0].text, left=outcomes[1].left, lost=outcomes[1].lost, faults=faults)


def two_in_turn(place: Place) -> Outcome:
    """Two runs by the same command in one process, one right after the other, most often in the same second."""
    words = arguments("closed-form", ["tag=trial", "trainer.max_steps=1"])
    for _ in range(2):
        place.copy("scene.ply")
        outcome = launched(place, words)
        place.root.with_suffix(".out").unlink()
        if outcome.status != 0:
            return outcome
    results = list(place.work.glob("outputs/closed-form/*/save/last.ply"))
    outcome.faults += [] if len(results) == 2 else [f"{len(results)} results of two runs"]
    return outcome


def broken_kernels(place: Place) -> Outcome:
    """Compiled kernels in numba's cache that were cut off: they are compiled anew."""
    cache = os.environ.get("NUMBA_CACHE_DIR")
    if cache and Path(cache).is_dir():
        shutil.copytree(cache, place / "kernels")
    inputs(place)
    words = arguments("closed-form", [*SCENE, *NAMED])
    first = Job(place, [*words, "name=first"], name="first", NUMBA_CACHE_DIR=str(place / "kernels")).outcome()
    if first.status != 0:
        return first
    for path in (place / "kernels").rglob("*.nb[ic]"):
        os.truncate(path, path.stat().st_size // 2)
    place.remember()
    outcome = Job(place, [*words, "name=second"], NUMBA_CACHE_DIR=str(place / "kernels")).outcome()
    outcome.lost.clear()
    return outcome


CASES: list[Case] = [
    process("Ctrl-C while training", signalled(signal.SIGINT), "last.ckpt", status=130),
    process("Ctrl-C twice", signalled(signal.SIGINT, signal.SIGINT), "stopped by Ctrl-C", status=130),
    process("Ctrl-C while loading", early, "stopped by Ctrl-C", status=130),
    process("Ctrl-C while the result is pictured", testing, "stopped by Ctrl-C", status=130),
    process("SIGTERM, as a batch system sends", signalled(signal.SIGTERM), "last.ckpt", status=143),
    process("SIGHUP, as a closed terminal sends", signalled(signal.SIGHUP), "last.ckpt", status=129),
    process("SIGKILL while a checkpoint is written, three times", killed_writing, status=137),
    process("SIGKILL of a run with checkpoints by the clock", killed_by_default, status=137),
    process(
        "the disk fills after a checkpoint: it stays good",
        lambda p: full(p, 2, 10**6, 0, ["ckpts/last.ckpt"]),
        "cannot be written",
        "No space left",
    ),
    process(
        "the disk has room for the splats alone at the end",
        lambda p: full(p, 1500, 1500, 16, ["save/last.ply"]),
        "cannot be written",
        "No space left",
    ),
    process("the temporary folder is full", full_temporary, "wrote", status=0),
    process("the output folder is removed while training", removed, "last.ckpt", status=130),
    process("two runs at the same moment", two_at_once, "wrote", status=0),
    process("two runs one right after the other", two_in_turn, "wrote", status=0),
    process("numba's kernels cut off", broken_kernels, "wrote", status=0),
]
