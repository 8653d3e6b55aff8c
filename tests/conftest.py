"""What tests of several places share."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import jaxtyping
import pytest

WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
THREADS = max(1, (os.cpu_count() or 1) // WORKERS)
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):  # read by torch when it is imported, and by child processes
    os.environ.setdefault(_name, str(THREADS))
os.environ.setdefault("NUMBA_NUM_THREADS", str(max(2, THREADS)))  # two: tests show that their number changes no bit
_kept = tempfile.TemporaryDirectory(prefix="kept-")  # what is kept between runs: never the user's own
os.environ["DREAMCATALYST_CACHE"] = _kept.name
os.environ.setdefault("GOMP_SPINCOUNT", "50000")  # as the launcher has it, but before torch is imported

import numba  # noqa: E402
import torch  # noqa: E402

from tests import shapes  # noqa: E402

shapes.install()
numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))

ROOT = Path(__file__).resolve().parent.parent
SMALL = ["data.width=24", "data.height=24", "system.report.video_frames=0", "trainer.accelerator=cpu"]

for _number, _handler in ((signal.SIGHUP, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
    if signal.getsignal(_number) is signal.SIG_IGN:  # whoever started the tests had it ignored (nohup, &)
        signal.signal(_number, _handler)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One worker for each core; none where a single file is asked for, which starts faster without."""
    paths = [Path(argument.split("::")[0]) for argument in config.args]
    single = len(paths) == 1 and paths[0].is_file()
    return 0 if single else (os.cpu_count() or 1)


@pytest.fixture(scope="module")
def one_thread():
    """Small models gain nothing from threads, and lose much where several processes share the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def unchecked():
    """Without the check of annotations, as in a run: for tests of what functions themselves refuse."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@dataclass(frozen=True)
class SmallDisk:
    """A folder in which a process that calls `limit` at its start has little room. mounted: on a file system of its
    own that is full then; else the process's files are limited in size, each for itself."""

    folder: Path
    size: int  # bytes
    mounted: bool

    def limit(self) -> None:
        if not self.mounted:
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.size, self.size))


@contextmanager
def mount(folder: Path, size: int) -> Iterator[SmallDisk]:
    """`folder` as a disk of `size` bytes, as well as this machine lets us."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = shutil.which("mount") is not None and subprocess.run(command, capture_output=True).returncode == 0
    try:
        yield SmallDisk(folder, size, mounted)
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def small_disk(tmp_path):
    """192 KiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    with mount(folder, 192 << 10) as disk:
        yield disk


@pytest.fixture
def gsplat_here(monkeypatch):
    """The backend "gsplat" draws on this machine, whatever it is."""
    from tests.render.gsplat_on_cpu import install

    install(monkeypatch)


@pytest.fixture
def launch(tmp_path, monkeypatch):
    """Run the launcher in this process on a small statue; returns the trial's folder."""
    monkeypatch.syspath_prepend(str(ROOT))
    import launch as launcher

    def run(config: str, *overrides: str, mode: str = "--train", name: str = "run", status: int = 0) -> Path:
        """A run that does not resume has a folder of its own: name, or where there is one of it, name-2, name-3, ..."""
        taken = sum(f.name == name or f.name.startswith(f"{name}-") for f in tmp_path.iterdir())
        if taken and not any(o.startswith("resume=") for o in overrides):
            name = f"{name}-{taken + 1}"
        arguments = ["--config", str(ROOT / "configs" / config), mode, "data.source=demo:statue", *SMALL]
        arguments += [f"exp_root_dir={tmp_path}", f"name={name}", "tag=trial", "use_timestamp=false", *overrides]
        monkeypatch.setattr(sys, "argv", ["launch.py", *arguments])
        assert launcher.main(arguments) == status
        return tmp_path / name / "trial"

    return run
