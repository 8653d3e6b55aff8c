"""Ctrl-C, SIGTERM, SIGHUP and a terminal that is gone: none of them ends a run in the middle of something."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any, TextIO

CAUGHT = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stopped(BaseException):
    """A signal ends the run here. Not an Exception, so that nothing on the way takes it for an error."""


class Stop:
    """What a signal has asked for. Where `waits` is true, the first one is only noted, in `asked`, for the one who set
    it to `end()` at the next good place; else, and at the second one, it raises Stopped at once.

    Stopped is raised once. A signal that comes while it makes its way up would raise another out of the middle of what
    takes care of the first: it is only counted, and one more of them ends the process on the spot.

    asked: number of the signal, None while there was none. at_once: whether Stopped was raised in the middle of
    something that `waits` was to protect.
    """

    def __init__(self) -> None:
        self.asked: int | None = None
        self.waits = self.at_once = False
        self._ending = self._late = False

    def __call__(self, signum: int, frame: Any = None) -> None:
        if self._ending:
            if self._late:
                signal.signal(signum, signal.SIG_DFL)
                os.kill(os.getpid(), signum)
            self._late = True
            return
        first, self.asked = self.asked is None, signum
        if first and self.waits:
            # Not by way of a logger or a stream, in whose own code the signal may have come.
            with contextlib.suppress(OSError):
                os.write(2, f"\r{self.name}: stopping after this step (once more: at once)\n".encode())
            return
        self.at_once = self.waits
        self.end()

    def end(self) -> None:
        """Stop here, as a signal has asked."""
        self._ending = True
        raise Stopped(self.name)

    @property
    def name(self) -> str:
        """As a user knows it."""
        return "Ctrl-C" if self.asked == signal.SIGINT else signal.Signals(self.asked).name

    @property
    def status(self) -> int:
        """The exit status that a shell gives to a process that the signal ended."""
        return 128 + (self.asked or 0)

    def install(self) -> None:
        """Take the signals, but for those that whoever started us has us ignore (nohup)."""
        if threading.current_thread() is threading.main_thread():
            for signum in CAUGHT:
                if signal.getsignal(signum) != signal.SIG_IGN:
                    signal.signal(signum, self)

    @contextlib.contextmanager
    def installed(self) -> Iterator[Stop]:
        """Take the signals inside the block."""
        before = {signum: signal.getsignal(signum) for signum in CAUGHT}
        self.install()
        try:
            yield self
        finally:
            if threading.current_thread() is threading.main_thread():
                for signum, handler in before.items():
                    signal.signal(signum, handler)


class Lasting:
    """A text stream whose reader may go away: what is written after that goes nowhere, and the run goes on."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        try:
            return self.stream.write(text)
        except OSError:
            self._give_up()
            return len(text)

    def flush(self) -> None:
        try:
            self.stream.flush()
        except OSError:
            self._give_up()

    def _give_up(self) -> None:
        """Lead the stream to nowhere, with what still waits in its buffer, which the interpreter flushes at its end."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, self.stream.fileno())
        finally:
            os.close(nowhere)


@contextlib.contextmanager
def lasting_streams() -> Iterator[None]:
    """Have stdout and stderr be Lasting inside the block."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and Lasting(stream) for stream in before)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream:
                stream.flush()
        sys.stdout, sys.stderr = before
