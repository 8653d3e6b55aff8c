"""What keeps a run's state on disk: its checkpoints, by the clock, at a signal, at an error and at the end."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from .. import files, plugin
from ..errors import FileError
from ..resume import MADE_BY
from ..signals import Stop, Stopped

LAST = "last.ckpt"  # as Lightning calls it


class Checkpoints(plugin.pl.plugins.CheckpointIO):
    """How Lightning writes and reads checkpoints here: whole or not at all, with a digest, and with `made_by`, the
    settings that a run which resumes from one is compared with.

    latest: when the latest one was written (time.monotonic). last_step: of `last.ckpt`, None where this process has
    written none.
    """

    def __init__(self, made_by: dict[str, Any]):
        self.made_by, self.latest = made_by, time.monotonic()
        self.last_step: int | None = None

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Raises FileError; an earlier checkpoint of the name then stays as it was."""
        files.save(path, {**checkpoint, MADE_BY: self.made_by})
        self.latest = time.monotonic()
        if Path(path).name == LAST:
            self.last_step = checkpoint["global_step"]

    def load_checkpoint(self, path: str | Path, *args: Any, **options: Any) -> dict[str, Any]:
        """Raises FileError for a file that is not to the bit what was written."""
        return files.load(path)[0]

    def remove_checkpoint(self, path: str | Path) -> None:
        """Lightning asks for it when a newer one has taken its place."""
        Path(path).unlink(missing_ok=True)


class Keeper(plugin.pl.Callback):
    """Writes `last.ckpt` every `minutes` of training in which no other checkpoint was written (0: never), and at the
    end, unless the trainer is to write none; before the last one, it has the system keep its result.

    At the first signal it stops training between two steps, where splats and optimizer agree, and has the system
    `save_now()`; at an error, too: systems raise theirs before a step changes anything. A second signal waits for
    nothing and saves nothing, since a step may be half done.

    began: the step at which training began, None before; a resumed run's is not 0.
    """

    def __init__(self, stop: Stop, checkpoints: Checkpoints, folder: Path, minutes: float):
        self.stop, self.checkpoints, self.folder, self.minutes = stop, checkpoints, folder, minutes
        self.training = self.writes = False
        self.began: int | None = None

    def _stop_if_asked(self, *hook_arguments: Any) -> None:
        if self.stop.asked is not None:
            self.stop.end()

    on_train_batch_start = on_validation_batch_start = _stop_if_asked

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self.stop.install()  # anew: Lightning has put its own before ours
        self.stop.waits = self.training = True
        self.began, self.checkpoints.latest = trainer.global_step, time.monotonic()
        self.writes = bool(trainer.checkpoint_callbacks) and not trainer.fast_dev_run

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *batch: Any) -> None:
        if trainer.global_step == trainer.max_steps:
            pl_module.keep_result()
        elif self.writes and self.minutes and time.monotonic() - self.checkpoints.latest >= 60 * self.minutes:
            trainer.save_checkpoint(self.folder / LAST)

    def on_fit_end(self, trainer: Any, pl_module: Any) -> None:
        self._stop_if_asked()
        if self.writes and self.checkpoints.last_step != trainer.global_step > self.began:
            trainer.save_checkpoint(self.folder / LAST)  # the config's interval does not hit the end
        self.stop.waits = self.training = False

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        training, self.training = self.training, False
        asked = isinstance(exception, Stopped)
        # After training nothing has changed since the last checkpoint, and an error in the first step left nothing new.
        if training and not self.stop.at_once and (asked or trainer.global_step > self.began):
            try:
                pl_module.save_now()
            except FileError as error:
                plugin.warn(f"the state of step {trainer.global_step} cannot be saved: {error}")
