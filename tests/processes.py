"""Processes that begin where the libraries are imported already, which takes seconds; nothing of ours or the host's is.

Each is a fork of one that imports them once, and has a folder, arguments, output and exit status of its own. Tests for
which the imports themselves are the fact start Python anew.
"""

from __future__ import annotations

import functools
import importlib
import json
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

LIBRARIES = ["torch", "pytorch_lightning", "lightning.pytorch", "numba", "scipy", "cv2", "diffusers", "transformers"]


@functools.cache
def _server() -> subprocess.Popen:
    """Ends with this process, which holds the other end of its stdin."""
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, __file__], stdin=pipe, stdout=pipe, text=True, cwd=tempfile.gettempdir())


def python(arguments: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """`python *arguments` in `folder`: a script and its arguments, or -c and code."""
    server = _server()
    with tempfile.TemporaryDirectory() as temporary:
        files = [Path(temporary) / name for name in ("out", "err")]
        job = {"arguments": list(arguments), "folder": str(folder), "files": list(map(str, files))}
        print(json.dumps(job), file=server.stdin, flush=True)
        status = int(server.stdout.readline())
        return subprocess.CompletedProcess(arguments, status, *(file.read_text(encoding="utf-8") for file in files))


def _serve() -> None:
    """Returns in a fork after its job; an error of the job's is the fork's."""
    for name in LIBRARIES:
        importlib.import_module(name)
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if child == 0:
            _run(**job)
            return
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def _run(arguments: list[str], folder: str, files: list[str]) -> None:
    for number, file in enumerate(files, start=1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    sys.stdin = open(os.devnull)  # noqa: SIM115, PTH123
    os.chdir(folder)
    sys.path[0] = folder
    if arguments[0] == "-c":
        sys.argv = ["-c", *arguments[2:]]
        exec(compile(arguments[1], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv = list(arguments)
        runpy.run_path(arguments[0], run_name="__main__")


if __name__ == "__main__":
    _serve()
