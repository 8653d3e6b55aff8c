"""What a run shows while it goes: one line with step, losses, splats, seconds per step and the time that is left."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from typing import Any

from .. import plugin
from ..meter import Meter, duration

FORECAST = 5.0  # seconds of training after which it is said how long a run will take
LONG = 20.0  # seconds from which on that is worth a line


class Progress(plugin.pl.callbacks.ProgressBar):
    """Lightning's progress bar, drawn by `Meter`; while training it asks the system for its `progress_metrics()`."""

    def __init__(self) -> None:
        super().__init__()
        self.meters: list[Meter] = []  # the innermost is last: validation interrupts training
        self._first: tuple[float, int] | None = None  # seconds and step when the first step, which compiles, was done
        self._told = False

    def disable(self) -> None:
        """Lightning calls this on all processes but the first; there is only one."""

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        total = trainer.max_steps if trainer.max_steps > 0 else trainer.estimated_stepping_batches
        self.meters.append(Meter("train", total, "step", trainer.global_step))

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *batch: Any) -> None:
        self.meters[-1].update(trainer.global_step, pl_module.progress_metrics)
        if self.meters[-1].total and not self._told:
            self._forecast(trainer.global_step, self.meters[-1].total, pl_module.cost)

    def _forecast(self, step: int, total: int, cost: Callable[[int], float]) -> None:
        """Say how long the run will take, once the first steps have told."""
        now = time.monotonic()
        if self._first is None:
            self._first = now, step
        then, first = self._first
        if now - then < FORECAST:
            return
        self._told = True
        left = (now - then) / sum(map(cost, range(first, step))) * sum(map(cost, range(step, total)))
        if left > LONG:
            plugin.info(f"about {duration(left)} for the {total - step:,} steps to come, by those so far")

    def on_validation_start(self, trainer: Any, pl_module: Any) -> None:
        self.meters.append(Meter("validate", sum(trainer.num_val_batches), "view", passing=bool(self.meters)))

    def on_test_start(self, trainer: Any, pl_module: Any) -> None:
        self.meters.append(Meter("test", sum(trainer.num_test_batches), "view"))

    def on_predict_start(self, trainer: Any, pl_module: Any) -> None:
        self.meters.append(Meter("export", sum(trainer.num_predict_batches), "view"))

    def _count(self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int, *loader: Any) -> None:
        self.meters[-1].update(batch_idx + 1)

    on_validation_batch_end = on_test_batch_end = on_predict_batch_end = _count

    def _close(self, trainer: Any, pl_module: Any, *exception: Any) -> None:
        if self.meters:
            self.meters.pop().close()

    on_train_end = on_validation_end = on_test_end = on_predict_end = on_exception = _close


class AboveTheLine(logging.Handler):
    """Writes log messages above the progress line instead of into it."""

    def __init__(self, progress: Progress):
        super().__init__()
        self.progress = progress

    def emit(self, record: logging.LogRecord) -> None:
        meter = self.progress.meters[-1] if self.progress.meters else None
        on_line = meter is not None and meter.terminal and meter.line
        sys.stderr.write(f"\r\x1b[K{self.format(record)}\n" if on_line else f"{self.format(record)}\n")
        if on_line:
            meter.draw()
