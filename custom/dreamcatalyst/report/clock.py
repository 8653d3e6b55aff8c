"""Where the time of a run goes: seconds by stage, at the price of two looks at the clock for each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

LOGGING, OTHER = "logging", "other"
STAGES = ("render", "encode", "unet", "backward", "optimizer", "densify", OTHER, LOGGING)


class Clock:
    """Runs from `start` to `stop`, and books each moment on the innermost open stage, on "other" where none is open.

    A stage inside "logging" is logging, too, whatever it is called: what a report draws is the report's. wait: called
    at each change of stage, so that a device that works on its own is done with what it was asked for; without it such
    a device's work would be booked on the stage that first needs a result. A step waits for its numbers more often than
    that anyway (losses, norms, what is not finite), so it costs little.
    """

    def __init__(self, wait: Callable[[], None] | None = None):
        self.stages: dict[str, float] = dict.fromkeys(STAGES, 0.0)  # seconds
        self.wait = wait
        self._open = [OTHER]
        self._since: float | None = None  # None while it stands still

    def start(self) -> None:
        """Run on."""
        self._since = time.perf_counter()

    def stop(self) -> None:
        """Stand still."""
        self._book()
        self._since = None

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Around what belongs to a stage."""
        self._book()
        self._open.append(LOGGING if self._open[-1] == LOGGING else name)
        try:
            yield
        finally:
            self._book()
            self._open.pop()

    def _book(self) -> None:
        if self._since is None:
            return
        if self.wait is not None:
            self.wait()
        now = time.perf_counter()
        self.stages[self._open[-1]] += now - self._since
        self._since = now

    @property
    def seconds(self) -> float:
        """Time spent so far, reports left out."""
        self._book()
        return sum(value for name, value in self.stages.items() if name != LOGGING)

    @property
    def reporting(self) -> float:
        """Seconds of reports so far."""
        self._book()
        return self.stages[LOGGING]

    def state_dict(self) -> dict[str, float]:
        """What a resumed run counts on from."""
        self._book()
        return dict(self.stages)

    def load_state_dict(self, stages: Mapping[str, float]) -> None:
        """Count on from an earlier run's."""
        self.stages.update(stages)
