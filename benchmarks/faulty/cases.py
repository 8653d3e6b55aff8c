"""What a case of the table of faults is, how it is run, and how it is judged."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import re
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

import launch

ROOT = Path(launch.__file__).resolve().parent
SECONDS = 8.0  # processor seconds until an error comes at most: nothing long may have been begun
HANG = 40  # seconds after which a case is ended
MEMORY = 8 * 2**30  # bytes that a case may ask for: what would take more fails there, and not the machine
COMMAND = ("cmd.txt", "configs/raw.yaml", "configs/parsed.yaml")  # of a trial: how it was begun, or resumed
# Standard output and error for the whole process: libraries that are imported in a case hold on to them.
STREAMS = [open(n, "w", 1, "utf-8", "replace", closefd=False) for n in (1, 2)]  # noqa: SIM115, PTH123
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
TINY = {
    "data.max_side": "24",
    "trainer.max_steps": "2",
    "trainer.accelerator": "cpu",
    "system.report.video_frames": "0",
    "system.report.views": "1",
    "system.report.pictures": "1",
}
FIXED = {"use_timestamp": "false", "tag": "trial"}


class TooLong(BaseException):
    """A case that did not end by itself. No Exception, so that nothing on the way catches it."""


@dataclass
class Outcome:
    """What came of a case. status: the exit status, None where there is none (a traceback, a hang, SIGKILL); text: all
    that was printed; seconds: of the processor; left: files that are new, with their sizes, relative to the case's
    folder; lost: files that were there and are gone or changed; faults: what else was found to be wrong."""

    status: int | None
    text: str
    seconds: float = 0.0
    left: dict[str, int] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    @property
    def errors(self) -> list[str]:
        """The lines that say what is wrong: ours, and argparse's."""
        return re.findall(r"^(?:launch\.py: )?error: (.*)$", self.text, re.MULTILINE)


@dataclass(frozen=True)
class Case:
    """One place to add bad input or a fault. name: what is given, in words. run: does it in a folder of its own.
    status: the exit status that is due; says: texts that the line must contain, such as the key that is to blame."""

    group: str
    name: str
    run: Callable[[Place], Outcome]
    says: tuple[str, ...] = ()
    status: int = 2
    seconds: float = SECONDS

    def faults(self, outcome: Outcome) -> list[str]:
        """What is wrong with what came, in words; empty: nothing."""
        found = list(outcome.faults)
        if "Traceback (most recent call last)" in outcome.text:
            found.append("a traceback")
        elif outcome.status != self.status:
            found.append(f"exit status {outcome.status}, due is {self.status}")
        line = outcome.errors[-1] if outcome.errors and self.status == 2 else outcome.text
        if self.status == 2 and outcome.status == 2:
            if len(outcome.errors) != 1:
                found.append(f"{len(outcome.errors)} error lines, due is one")
            elif not outcome.text.rstrip().endswith(line):
                found.append("the error is not one line, or not the last")
        missing = [text for text in self.says if text not in line]
        if missing:
            found.append(f"does not say {', '.join(map(repr, missing))}")
        if outcome.lost:
            found.append(f"lost or changed: {', '.join(outcome.lost[:3])}")
        if outcome.seconds > self.seconds:
            found.append(f"{outcome.seconds:.0f} s, due are at most {self.seconds:.0f}")
        return found


# --- the folder of a case


class Place:
    """The folder in which a case is run, with a folder `work` that is the current one. shop: what is made once."""

    def __init__(self, root: Path, shop: Path):
        self.root, self.shop, self.work = root, shop, root / "work"
        self.work.mkdir(parents=True)
        self._before: dict[str, str] | None = None

    def __truediv__(self, name: str) -> Path:
        path = self.work / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write(self, name: str, content: str | bytes) -> Path:
        """A file in the current folder."""
        path = self / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def copy(self, thing: str, name: str | None = None) -> Path:
        """A copy of one of the things that are made once (things.py), under `name`."""
        from .things import make

        source, target = make(self.shop, thing), self / (name or thing)
        copy = shutil.copytree if source.is_dir() else shutil.copy
        return Path(copy(source, target))

    def take(self, thing: str) -> None:
        """What lies in a folder of things.py, copied into the current folder: a trial and its inputs."""
        from .things import make

        shutil.copytree(make(self.shop, thing), self.work, dirs_exist_ok=True)

    def files(self) -> dict[str, Path]:
        """All files below the case's folder, links not followed."""
        found = {}
        for folder, _, names in os.walk(self.root):
            found |= {str(Path(folder, name).relative_to(self.root)): Path(folder, name) for name in names}
        return found

    def remember(self) -> None:
        """What is there before the case begins: none of it may be lost."""
        self._before = {name: digest(path) for name, path in self.files().items()}

    def finish(self, outcome: Outcome) -> Outcome:
        """The outcome with what is left on disk, and what was lost. A run that goes on may write into its trial, and
        one that resumes writes there at once by which command it did."""
        now, before = self.files(), self._before or {}
        outcome.left = {name: path.lstat().st_size for name, path in sorted(now.items()) if name not in before}
        own = "work/outputs/" if outcome.status == 0 else "no folder"
        outcome.lost += [
            name
            for name, was in before.items()
            if name not in now or (digest(now[name]) != was and not name.startswith(own) and not name.endswith(COMMAND))
        ]
        return outcome


def digest(path: Path) -> str:
    """A file's content, or where a link leads."""
    if path.is_symlink():
        return f"link {path.readlink()}"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "no file"


# --- running the launcher in this process


@contextlib.contextmanager
def printed(path: Path) -> Iterator[None]:
    """All that is printed, by Python or below it, goes into the file."""
    with path.open("a") as file:
        sys.stdout.flush(), sys.stderr.flush()
        kept = [os.dup(number) for number in (1, 2)]
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        try:
            with contextlib.redirect_stdout(STREAMS[0]), contextlib.redirect_stderr(STREAMS[1]):
                yield
        finally:
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                os.close(copy)


@contextlib.contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """In `folder`, and then everything that a launch changes in its process is as it was."""
    here, environment, path, argv, mask = Path.cwd(), dict(os.environ), list(sys.path), list(sys.argv), os.umask(0o022)
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    limit, log = resource.getrlimit(resource.RLIMIT_AS), logging.getLogger("dreamcatalyst")
    state = torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_num_threads()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    os.chdir(folder)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limit[1]))
    try:
        with warnings.catch_warnings():
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)
        os.chdir(here)
        os.umask(mask)
        os.environ.clear()
        os.environ.update(environment)
        sys.path[:], sys.argv[:] = path, argv
        for number, handler in handlers.items():
            signal.signal(number, handler)
        log.handlers.clear()
        torch.set_default_dtype(state[0])
        torch.set_grad_enabled(state[1])
        torch.set_num_threads(state[2])


def launched(place: Place, arguments: Sequence[str]) -> Outcome:
    """What `python launch.py` does with these arguments, in this process and in the case's folder."""

    def end(signum: int, frame: object) -> None:
        raise TooLong(f"not ended after {HANG} s")

    out, status = place.root.with_suffix(".out"), None
    place.remember()
    began = time.process_time()
    with unchanged(place.work), printed(out):
        sys.argv[:] = ["launch.py", *arguments]
        signal.signal(signal.SIGALRM, end)
        signal.setitimer(signal.ITIMER_REAL, HANG)
        try:
            status = launch.main(list(arguments))
        except SystemExit as error:  # argparse
            status = error.code if isinstance(error.code, int) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    seconds = time.process_time() - began
    return place.finish(Outcome(status, out.read_text(encoding="utf-8", errors="replace"), seconds))


# --- the ways to write a case down

Given = Sequence[str] | Callable[[Place], Sequence[str] | None]
Check = Callable[[Place, Outcome], Sequence[str]]


def arguments(config: str, overrides: Sequence[str], **base: str) -> list[str]:
    """The command of a tiny run of configs/<config>.yaml. overrides: what the case adds; flags too."""
    first = {**TINY, **base}
    return ["--config", str(ROOT / f"configs/{config}.yaml"), *(f"{k}={v}" for k, v in first.items()), *overrides]


def case(group: str, name: str, given: Given, *says: str, config: str = "closed-form", **options: object) -> Case:
    """A tiny run of a config, by default of an edit of a synthetic scene, with `given` added: what is given is refused,
    by a line that says `says`. given: arguments, or what makes files and returns arguments."""
    check: Check | None = options.pop("check", None)

    def run(place: Place) -> Outcome:
        added = given(place) if callable(given) else given
        outcome = launched(place, arguments(config, list(added or ())))
        outcome.faults += list(check(place, outcome)) if check else []
        return outcome

    return Case(group, name, run, says, **options)


def command(group: str, name: str, given: Given, *says: str, **options: object) -> Case:
    """As `case`, but `given` is the whole command."""

    def run(place: Place) -> Outcome:
        return launched(place, list(given(place) if callable(given) else given))

    return Case(group, name, run, says, **options)
