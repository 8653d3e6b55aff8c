"""A method in Lightning: hooks, updates, checkpoints and reports. What the method is, nothing here knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from .. import plugin
from ..config import Seed
from ..errors import ConfigError, NumericalError, choose
from ..report.summary import write_report
from .density import Moment
from .measured import MeasuredSystem
from .method import Context
from .result import RESULT, splats_from
from .update import Updater


class SplatSystem(MeasuredSystem):
    """Base of the systems that fit and edit."""

    @dataclass
    class Config(MeasuredSystem.Config):
        gs_source: str = ""  # a PLY of splats to begin with
        drop_nonfinite: bool = False  # leave NaN and Inf rows of the PLY out, instead of refusing it
        nonfinite: str = "stop"  # a step with a NaN or Inf ends the run, or is left out and counted: stop | skip
        seed: Seed = 0  # of everything that is drawn at random
        renderer: dict = field(default_factory=dict)
        learning_rates: dict = field(default_factory=dict)
        densify: dict = field(default_factory=dict)
        report: dict = field(default_factory=dict)

    def configure(self) -> None:
        super().configure()
        choose("choice", self.cfg.nonfinite, ("stop", "skip"), "system.nonfinite")

    def enter(self, data: Any, device: torch.device) -> None:
        """Give the method what it runs with."""
        self.method.context = Context(
            data, device, lambda: self.true_global_step, lambda: self.max_steps, self.save_path, self.resumed
        )

    def look_ahead(self, data: Any) -> None:
        """Find what will not do, such as words that a prior does not know, while the long work before a run (a fit to
        photographs) is not begun. Raises what `setup` would."""
        self.enter(data, self.device)

    def setup(self, stage: str) -> None:
        self.enter(self.trainer.datamodule, self.trainer.strategy.root_device)
        self.method.begin()
        self.judge = self.judge or self.part.report.judge(self.method.context.device)
        _ = self.method.capture  # opened here, since after this Lightning asks for the loaders of any stage
        if stage == "fit":
            self.method.begin_training()

    # --- training

    @property
    def max_steps(self) -> int:
        """Length of the run in optimizer steps."""
        steps = self.trainer.max_steps
        if steps < 1:
            raise ConfigError("trainer.max_steps: got none, expected the number of steps: schedules run over it.")
        return steps

    def configure_optimizers(self) -> torch.optim.Optimizer:
        method = self.method
        return method.splats.make_optimizer(method.rates(0, self.true_current_epoch), self.part.learning_rates.beta2)

    def on_train_start(self) -> None:
        plan = self.method.plan()
        plan.write(self.report_dir / "plan.json")
        self.plan_text = plan.text()
        plugin.info(self.plan_text)
        if self.cfg.nonfinite == "skip" and self._scaler is not None:
            raise ConfigError("system.nonfinite=skip: mixed precision with a loss scale skips by itself; leave it out.")
        self.record.begin(self.facts(), self.max_steps)

    @property
    def _scaler(self) -> Any:
        """Of mixed precision in fp16: it scales the loss, and leaves out steps that overflow."""
        return getattr(self.trainer.strategy.precision_plugin, "scaler", None)

    def training_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        step, method = self.true_global_step, self.method
        try:
            self.record.numbers = self._step(batch, step)
        except NumericalError as error:
            self._skip_step(error, batch, step)
        with self.record.clock.stage("densify"):
            moment = Moment(step + 1, self.max_steps, method.capture.extent, self.cfg.seed, method.generations)
            method.density.after_step(method.splats, moment)

    def _step(self, batch: Mapping[str, Any], step: int) -> dict[str, float]:
        """One update of the splats, and its numbers. Raises NumericalError, and leaves the splats as they were."""
        method, scaler = self.method, self._scaler
        terms, render, numbers = method.step_loss(batch, step)
        terms |= method.density.terms(method.splats)
        update = Updater(
            method.splats,
            method.density,
            self.record.clock,
            self.manual_backward,
            self.optimizers(),
            method.after_update,
            None if scaler is None else float(scaler.get_scale()),
        )
        shares = self.record.wanted(step + 1, self.max_steps)
        done = update(terms, render, method.rates(step, self.true_current_epoch), shares, method.pulled)
        return {"loss": done.pop("loss"), **numbers, **done}

    def _skip_step(self, error: NumericalError, batch: Mapping[str, Any], step: int) -> None:
        """End the run with the place of what is not finite, or where `system.nonfinite` is skip, leave the step out and
        count it. Nothing of the step has reached the splats. Raises NumericalError."""
        views, timestep = self.method.capture.views, self.method.timestep(step)
        names = ", ".join(views[i].name for i in batch["index"])
        place = f"step {step}, {'' if timestep is None else f'timestep {timestep}, '}view {names}"
        if self.cfg.nonfinite == "stop":
            raise NumericalError(f"{place}: {error}. The splats are those of the step before.") from error
        skipped = self.record.skip()
        if skipped.bit_count() == 1:  # said at the first, the second, the fourth, the eighth ... time
            plugin.warn(f"{place}: {error}. The step is left out, {skipped} so far.")
        if self.true_global_step == step:  # a step without gradients changes nothing, and is counted
            self.optimizers().zero_grad()
            self.optimizers().step()

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        if self.record.wanted(self.true_global_step, self.max_steps):
            self.record.add(self.facts(), self.max_steps)

    def on_train_end(self) -> None:
        self.record.clock.stop()
        if self.true_global_step < self.max_steps:  # ended by something else, such as trainer.max_time
            self.save_now()
        else:
            self.keep_result()  # before any test can fail

    def progress_metrics(self) -> dict[str, float]:
        """What the progress bar shows besides step and speed."""
        known = {"loss": self.record.numbers["loss"]} if "loss" in self.record.numbers else {}
        skipped = {"skipped": self.record.skipped} if self.record.skipped else {}
        return {**known, "splats": self.method.splats.total, **skipped}

    # --- files and checkpoints

    def keep_result(self) -> None:
        self.files.keep(self.true_global_step, self.write_splats)

    def savers(self) -> list[Callable[[], Any]]:
        splats, report = self.write_splats, write_report
        return [lambda: splats(RESULT), *super().savers(), lambda: report(self.facts(), self.record, {})]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["splats"] = self.method.splats.state_dict()
        checkpoint["run"] = {"system": type(self).__name__, **self.record.state_dict()}
        checkpoint.update(self.method.state_dict())

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        method = self.method
        method.check_checkpoint(checkpoint)
        method.splats = splats_from(checkpoint, type(self).__name__, method.density, method.context.device)
        self.record.load_state_dict(checkpoint["run"])
        method.load_state_dict(checkpoint)
