"""What a run says of itself while it goes: a row of numbers each so many steps, within a share of the run's time."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .clock import LOGGING, OTHER, Clock
from .curve import Curve
from .machine import peak_memory, waiter
from .run import ReportConfig, RunFacts
from .scores import mean_scores


class Record:
    """The rows of `curve`. Each holds what costs nothing: step, seconds in all (without reports) and by stage, both
    since the start; splats, memory, and the numbers of the step. Errors at held-out views are measured in the first
    row, in the last, and in as many between as keep rows within `report.overhead` of the run's time."""

    def __init__(self, config: ReportConfig):
        self.config, self.clock, self.curve = config, Clock(), Curve()
        self.numbers: dict[str, float] = {}  # of the latest step
        self.skipped = 0  # steps that were left out because something in them was not finite
        self._cost, self._measured = 0.0, 0  # seconds and step of the latest measurement
        self._seen: tuple[float, dict[int, Float[Tensor, "H W 3"]]] | None = None  # the seconds and the pictures of it

    def begin(self, run: RunFacts, last: int) -> None:
        """Start the clock, and of a new run, add the row of step 0. last: step at which the run ends."""
        run.picture(self.views(run)[0])  # the first picture may compile the renderer: no part of any run
        self.clock.wait = waiter(run.device)
        self.clock.start()
        if run.step == 0:
            self.add(run, last)

    def views(self, run: RunFacts) -> Sequence[int]:
        """The held-out views that are measured along the way."""
        return run.held_out[:: max(1, len(run.held_out) // self.config.views)][: self.config.views]

    def wanted(self, step: int, last: int) -> bool:
        """Whether `step` has a row."""
        return step >= last or bool(self.config.every and step % self.config.every == 0)

    def skip(self) -> int:
        """Count a step that was left out, and forget its numbers; returns how many there are."""
        self.skipped, self.numbers = self.skipped + 1, {}
        return self.skipped

    def add(self, run: RunFacts, last: int) -> None:
        """Add the row of this step; it takes the place of an earlier one of the same step. last: as in `begin`."""
        clock, step = self.clock, run.step
        with clock.stage(LOGGING):
            row = {"step": step, "seconds": round(clock.seconds, 3), "splats": run.splats}
            row |= {f"seconds_{name}": round(value, 6) for name, value in clock.stages.items()}
            memory = peak_memory(run.device)
            row |= {} if memory is None else {"memory_mib": round(memory, 1)}
            row |= {"skipped": self.skipped} if self.skipped else {}
            measured = self._due(step, last)
            self.curve.add(**row, **self.numbers, **(self._errors(run) if measured else {}))
            if measured:
                self._measured = step
                self.curve.write_csv(run.report / "error.csv")

    def _due(self, step: int, last: int) -> bool:
        """Whether the errors of this row are measured: so that the rows that can still be paid for, if the run goes on
        as fast as so far, are spread evenly over the steps that are left."""
        if step == 0 or step >= last:
            return True
        budget = self.config.overhead * self.clock.seconds * last / step
        rows = (budget - self.clock.reporting) / max(self._cost, 1e-6) - 1  # the last one is put by
        return rows >= 1 and (step - self._measured) * rows >= last - step

    def _errors(self, run: RunFacts) -> dict[str, float]:
        """Scores at the views of `views`, mean over them, and how fast the pictures change."""
        views = self.views(run)
        for index in views:  # drawn once, and no part of what the next row will take
            run.references(index)
        began = time.perf_counter()
        pictures = {index: run.picture(index) for index in views}
        errors = mean_scores([run.score(index, picture, brief=True) for index, picture in pictures.items()])
        if self._seen is not None and self.clock.seconds > self._seen[0]:
            then, before = self._seen
            moved = torch.stack([(pictures[index] - before[index]).abs().mean() for index in pictures]).mean()
            errors["change_per_second"] = float(moved) / (self.clock.seconds - then)
        self._seen = self.clock.seconds, pictures
        self._cost = time.perf_counter() - began
        return errors

    # --- what a checkpoint keeps

    def state_dict(self) -> dict[str, Any]:
        """Rows, clock and count."""
        return {"curve": self.curve.rows, "stages": self.clock.state_dict(), "skipped": self.skipped}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from an earlier run's. One that kept no stages has its seconds in one piece."""
        self.curve = Curve(state["curve"])
        self.clock.load_state_dict(state["stages"] if "stages" in state else {OTHER: state["seconds"]})
        self.skipped = state.get("skipped", 0)
