"""The line that long work shows while it goes: what is done, seconds per piece and the time that is left."""

from __future__ import annotations

import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from tqdm import tqdm

REDRAW = 0.1  # seconds between two drawings on a terminal: often enough to look alive
LINES = 15.0  # seconds between two lines in a log file
WINDOW = 20.0  # seconds over which a step's time is averaged, so that the compiling first step is soon forgotten


class Meter:
    """The line of one stage. On a terminal it is redrawn in place; elsewhere it is written anew every `LINES` seconds.

    total: steps in all, None where unknown. first: the step at which the stage begins (a resumed run's is not 0).
    passing: the stage interrupts another one, and leaves no line behind.
    """

    def __init__(self, name: str, total: float | None, unit: str, first: int = 0, passing: bool = False):
        self.name, self.unit, self.first, self.passing = name, unit, first, passing
        self.total = int(total) if total is not None and 0 < total < float("inf") else None
        self.terminal = sys.stderr.isatty()
        self.started = self.drawn = time.monotonic()
        self.samples = deque([(self.started, first)])  # (seconds, step), the last WINDOW seconds of them
        self.line = ""

    def update(self, n: int, metrics: Callable[[], Mapping[str, Any]] = dict) -> None:
        """`n` steps are done. `metrics` is called only when a line is due, since it may have to wait for the device."""
        now = time.monotonic()
        final = n == self.total and not self.passing
        if not final and now - self.drawn < (REDRAW if self.terminal else LINES):
            return
        while len(self.samples) > 1 and now - self.samples[0][0] > WINDOW:
            self.samples.popleft()
        (then, before), self.drawn = self.samples[0], now
        self.samples.append((now, n))
        pace = f"{(now - then) / (n - before):.3g}" if n > before else "?"
        self.line = tqdm.format_meter(
            n,
            self.total,  # pyright: ignore[reportArgumentType]: tqdm takes None for an unknown one
            now - self.started,
            ncols=shutil.get_terminal_size().columns if self.terminal else None,
            prefix=self.name,
            rate=(n - before) / (now - then) if n > before else None,
            postfix=", ".join(f"{key} {_show(value)}" for key, value in metrics().items()),
            initial=self.first,
            bar_format="{desc} {n_fmt}/{total_fmt} "
            + ("|{bar}| " if self.terminal and self.total else "")
            + f"{pace} s/{self.unit}, {{elapsed}} gone, {{remaining}} left{{postfix}}",
        )
        self.draw()

    def draw(self) -> None:
        sys.stderr.write(f"\r{self.line}\x1b[K" if self.terminal else f"{self.line}\n")
        sys.stderr.flush()

    def close(self) -> None:
        if self.terminal and self.line:
            sys.stderr.write("\r\x1b[K" if self.passing else "\n")


def _show(value: Any) -> str:
    """Counts with thousands' commas, measures with four digits."""
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def duration(seconds: float) -> str:
    """Seconds as one says them."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
