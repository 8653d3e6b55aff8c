"""Kill a run again and again, inside the writing of its checkpoints and at random moments, and resume it each time.

python benchmarks/kills.py --runs 200

Every life of the run goes on from the last checkpoint of the one before. After every kill the checkpoint must be whole
and be the last one whose writing was over (or the one being written, if it was renamed already); at the end the splats
must have the bits of a run that was never disturbed. Prints a line for each kill; exits with 1 where one lost anything.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "custom")]

from dreamcatalyst import files  # noqa: E402
from dreamcatalyst.demo.worlds import make_world  # noqa: E402
from dreamcatalyst.scene.ply import write_ply  # noqa: E402

PRELOAD = ["launch", "dreamcatalyst.train.edit", "dreamcatalyst.train.datamodule", "dreamcatalyst.render.cpu.api"]
PRELOAD += ["lightning.pytorch", "dreamcatalyst.train.keeper", "dreamcatalyst.train.progress"]
STEPS = 40
WAIT = 120.0  # seconds after which a life that does nothing is given up


def processes() -> multiprocessing.context.BaseContext:
    """Where processes come from: forks of one that has imported everything once, which takes seconds."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    return context


def run(arguments: list[str], log: Path, journal: Path | None = None, disk: int = 0, temporary: str = "") -> None:
    """A launch in a process of its own, which says to `log` what it has to say and, to `journal`, each checkpoint
    before and after it was written: "begun 3", "done 3". disk: limit on the size of its files, 0: none. temporary: its
    folder for temporary files."""
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115, PTH123
    import torch
    from dreamcatalyst.train.keeper import Checkpoints

    import launch

    torch.set_num_threads(1)
    sys.argv = ["launch.py", *arguments]
    if temporary:
        os.environ["TMPDIR"], tempfile.tempdir = temporary, None
    if disk:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (disk, disk))
    if journal is not None:
        noted = os.open(journal, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        save = Checkpoints.save_checkpoint

        def save_and_note(self: Checkpoints, checkpoint: dict, path: Path, storage_options: object = None) -> None:
            if Path(path).name == "last.ckpt":
                os.write(noted, f"begun {checkpoint['global_step']}\n".encode())
            save(self, checkpoint, path, storage_options)
            if Path(path).name == "last.ckpt":
                os.write(noted, f"done {checkpoint['global_step']}\n".encode())

        Checkpoints.save_checkpoint = save_and_note
    sys.exit(launch.main(arguments))


@dataclass
class Small:
    """The smallest run: an edit of a few hundred splats, without weights, a checkpoint after every step."""

    folder: Path

    def __post_init__(self) -> None:
        self.ply = self.folder / "few.ply"
        if not self.ply.exists():
            write_ply(self.ply, make_world("statue").scene[::50])

    def warm_up(self) -> None:
        """Have the renderer's kernels compiled and kept on disk: the process that compiles them rounds otherwise than
        those that load them, and is no run to compare bits with."""
        process = processes().Process(
            target=run, args=(self.arguments("warm", "trainer.max_steps=2"), self.folder / "w")
        )
        process.start()
        process.join()

    def arguments(self, name: str, *more: str) -> list[str]:
        """Of a run called `name`."""
        given = ["--config", str(ROOT / "configs" / "closed-form.yaml"), "--train", f"system.gs_source={self.ply}"]
        given += ["data.source=", "data.width=16", "data.height=16", "data.orbit_views=6", "data.test_every=3"]
        given += ["system.report.video_frames=0", "system.report.views=1", "system.report.every=0"]
        given += ["trainer.accelerator=cpu", f"trainer.max_steps={STEPS}", "system.renderer.backend=cpu"]
        given += [f"exp_root_dir={self.folder}", f"name={name}", "tag=run", "use_timestamp=false"]
        return [*given, "checkpoint.minutes=1e-9", *more]

    def trial(self, name: str) -> Path:
        """Its folder."""
        return self.folder / name / "run"


def parts(trial: Path) -> list[Path]:
    """Files in `ckpts` that are being written."""
    folder = trial / "ckpts"
    return [Path(entry.path) for entry in os.scandir(folder) if ".part" in entry.name] if folder.is_dir() else []


def _size(path: Path) -> int:
    """0 where it is gone again."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def expected(journal: Path) -> tuple[int, int]:
    """The step of the last checkpoint whose writing was over, and of the last one that was begun (0: none)."""
    lines = [line.split() for line in journal.read_text().splitlines()] if journal.exists() else []
    done, begun = ([int(step) for word, step in lines if word == kind] for kind in ("done", "begun"))
    return (done or [0])[-1], (begun or [0])[-1]


@dataclass(frozen=True)
class Kill:
    """What one kill found. step: of the checkpoint that was left, 0 where there is none yet; inside: whether a
    checkpoint was half written; fault: what was lost, empty where nothing was."""

    step: int
    inside: bool
    fault: str


def killed(
    process: multiprocessing.process.BaseProcess, trial: Path, journal: Path, steps: int, when: float | None
) -> Kill | None:
    """Kill `process` after it has trained `steps` steps: as soon as it writes a checkpoint, or `when` seconds later.
    None where it was over before."""
    give_up, deadline, first = time.monotonic() + WAIT, None, expected(journal)[1]
    while process.is_alive() and time.monotonic() < give_up:
        if deadline is None and expected(journal)[1] < first + steps:
            time.sleep(1e-3)
        elif when is None:
            if any(_size(part) for part in parts(trial)):
                break
        elif deadline is None:
            deadline = time.monotonic() + when
        elif time.monotonic() >= deadline:
            break
    if process.is_alive():
        os.kill(process.pid, signal.SIGKILL)
    process.join()
    if process.exitcode != -signal.SIGKILL:
        return None
    inside, last = bool(parts(trial)), trial / "ckpts" / "last.ckpt"
    done, begun = expected(journal)
    if not last.exists():
        return Kill(0, inside, "" if done == 0 else f"step {done} was saved, and there is no checkpoint")
    try:
        state, sealed = files.load(last)
    except files.FileError as error:
        return Kill(0, inside, str(error))
    step = state["global_step"]
    fault = "" if sealed and step in (done, begun) else f"step {done} was saved, the checkpoint is of step {step}"
    return Kill(step, inside, fault)


def kill_and_resume(small: Small, name: str, kills: int, draw: random.Random, say=print) -> tuple[list[Kill], int]:
    """Kill the run `name` that often, inside a checkpoint and at random in turn, and let it end. It begins anew, in the
    same folder's next number, where it ends before that. Returns the kills and how many runs came to their end."""
    context, found, ended, number = processes(), [], 0, 0
    while True:
        trial, journal = small.trial(f"{name}{number}"), small.folder / f"{name}{number}.journal"
        last, log = trial / "ckpts" / "last.ckpt", small.folder / f"{name}{number}.log"
        more = [f"resume={last}"] if last.exists() else []
        over = last.exists() and files.load(last)[0]["global_step"] >= STEPS
        if over:  # killed after its last step: what is left is to be looked at
            more += ["--test"]
        arguments = [a for a in small.arguments(f"{name}{number}", *more) if not (over and a == "--train")]
        process = context.Process(target=run, args=(arguments, log, journal))
        process.start()
        if len(found) >= kills:
            process.join()
            result = None
        else:
            when = None if len(found) % 2 == 0 else draw.random() * 0.1
            result = killed(process, trial, journal, draw.randrange(1, 6), when)
        if result is not None:
            found.append(result)
            with journal.open("a", encoding="utf-8") as file:  # what the next life goes on from was saved
                file.write(f"done {result.step}\n" if result.step else "")
            say(f"kill {len(found)}: step {result.step}, {'inside' if result.inside else 'between'} {result.fault}")
            continue
        if process.exitcode != 0:
            found.append(Kill(0, False, f"a resumed run ended with {process.exitcode}: {log.read_text()[-500:]}"))
            return found, ended
        ended, number = ended + 1, number + 1
        if len(found) >= kills:
            return found, ended


def main() -> int:
    """Kill, resume, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200, help="kills in all")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        small, faults = Small(Path(temporary)), 0
        small.warm_up()
        kills, ended = kill_and_resume(small, "killed", args.runs, random.Random(args.seed))
        for kill in kills:
            if kill.fault:
                print(kill.fault)
        whole = processes().Process(target=run, args=(small.arguments("whole"), Path(temporary) / "whole.log"))
        whole.start()
        whole.join()
        bits = (small.trial("whole") / "save" / "last.ply").read_bytes()
        for number in range(ended):
            if (small.trial(f"killed{number}") / "save" / "last.ply").read_bytes() != bits:
                faults += 1
                print(f"killed{number}: its splats are not those of the undisturbed run")
        faults += sum(bool(kill.fault) for kill in kills)
        inside = sum(kill.inside for kill in kills)
        print(f"{len(kills)} kills, {inside} inside the writing of a checkpoint, {ended} runs ended; {faults} faults")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
