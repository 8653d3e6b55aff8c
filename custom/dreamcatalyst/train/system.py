"""What fitting and editing share: splats in a Lightning loop, density control, checkpoints, results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import plugin
from ..config import Seed
from ..data.camera import Cameras
from ..data.views import Capture
from ..diffusion.noise import keyed_generator
from ..errors import ConfigError, NumericalError, SceneError, choose
from ..loss.terms import gradient_shares, total, update_share
from ..render.api import Backend, Render, find_backend, rasterize
from ..render.frozen import Frozen
from ..report.clip import ClipJudge
from ..report.clock import LOGGING, Clock
from ..report.metrics import compare
from ..report.pictures import picture_row, write_png
from ..scene.edit import Splats
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from ..scene.generations import Generations
from ..scene.ply import read_splats, write_ply
from . import results, scores, summary
from .base import System
from .densify import STATISTICS, DensifyConfig, densify, observe, reset_opacity, screen_statistics
from .finite import give_back, gradient_norms, kept_copy, leave_out, require_finite
from .optim import LearningRates
from .plan import Draft, Plan
from .record import Record
from .renderer import RendererConfig
from .results import ReportConfig


class SplatSystem(System):
    """Base of the fit and the edit system. Subclasses say where the scene comes from, what the loss of a step is, and
    against which images it is measured: `first_scene`, `step_loss`, `references`."""

    parts: dict[str, type] = {
        "renderer": RendererConfig,
        "learning_rates": LearningRates,
        "densify": DensifyConfig,
        "report": ReportConfig,
    }

    @dataclass
    class Config(System.Config):
        gs_source: str = ""  # a PLY of splats to begin with
        drop_nonfinite: bool = False  # leave NaN and Inf rows of the PLY out, instead of refusing it
        nonfinite: str = "stop"  # a step with a NaN or Inf ends the run, or is left out and counted: stop | skip
        seed: Seed = 0  # of everything that is drawn at random
        renderer: dict = field(default_factory=dict)
        learning_rates: dict = field(default_factory=dict)
        densify: dict = field(default_factory=dict)
        report: dict = field(default_factory=dict)

    # --- to be said by subclasses

    def first_scene(self) -> Gaussians:
        """The splats to begin with."""
        return self.given_scene()

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[dict[str, Tensor], Render, dict[str, float]]:
        """The terms of a step's loss by name, the render whose screen gradients drive densification, and numbers to
        report."""
        raise SceneError(f"{type(self).__name__} has no training step")

    def references(self, index: int) -> dict[str, Tensor]:
        """What the render of a view is compared with, by name: [H,W,3] each, the first one being the aim."""
        return {}

    def region(self, index: int) -> Tensor | None:
        """Where a view is meant to change, [H,W,1] of 0 and 1; None: everywhere."""

    def timestep(self, step: int) -> int | None:
        """The prior's timestep at `step`, None where there is none."""

    def known_scenes(self) -> dict[str, Gaussians]:
        """Further scenes, by name, with which the splats' consistency between views is compared."""
        return {}

    def make_splats(self, scene: Gaussians) -> Splats:
        """The trainable form of `scene`."""
        return Splats(scene)

    def describe(self, draft: Draft) -> None:
        """Add to the plan what only this system builds or leaves out."""

    def after_update(self) -> None:
        """What else moves splats in a step, after the optimizer has."""

    # --- setting up

    def configure(self) -> None:
        super().configure()
        self.splats: Splats | None = None
        self.generations: Generations | None = None  # of hierarchical splats, where a subclass keeps them
        self._frozen: tuple[Gaussians | None, Frozen | None] = None, None
        self._data: Any = None  # a data module, where there is no trainer to ask for it
        choose("choice", self.cfg.nonfinite, ("stop", "skip"), "system.nonfinite")
        self.record, self.plan_text = Record(self.part["report"]), ""
        self.judge: ClipJudge | None = None
        self._outcomes: dict[int, dict[str, float]] = {}
        self._cap_announced = False
        self._kept_at: int | None = None  # the step whose splats are in last.ply, of those that this process trained

    @property
    def backend(self) -> Backend:
        """What draws this run. Raises ConfigError and SceneError as `find_backend`."""
        return find_backend(self.part["renderer"].backend, self.root_device)

    def prepare(self) -> None:
        """What is made sure of before anything is loaded: that this machine can draw."""
        prepare = self.backend.prepare
        if prepare is not None:
            prepare()

    def setup(self, stage: str) -> None:
        self.prepare()
        if self.splats is None:
            self.splats = self.make_splats(self.first_scene().to(self.root_device))
            self.splats.state.update(screen_statistics(self.splats))
        self.judge = self.judge or self.part["report"].judge(self.root_device)
        _ = self.capture  # opened here, since after this Lightning asks for the loaders of any stage

    def given_scene(self) -> Gaussians:
        """The splats of gs_source, or of the made world. Raises ConfigError where there are neither."""
        if self.cfg.gs_source:
            return read_splats(self.cfg.gs_source, drop_nonfinite=self.cfg.drop_nonfinite, origin=self.origin)
        if self.data.world is not None:
            return self.data.world.scene
        if self.data.cfg.source:  # where that is wrong, too, it is the first thing to say
            self.data.open()
        raise ConfigError(
            "system.gs_source: no splats are given. Name a PLY; configs/fit.yaml makes one from photographs."
        )

    @property
    def data(self) -> Any:
        """The run's data module."""
        return self._data or self.trainer.datamodule

    @property
    def capture(self) -> Capture:
        """The run's views."""
        if self.data.capture is None:
            self.data.open(self.splats.scene.detach() if self.splats else None, self.cfg.gs_source)
        return self.data.capture

    @property
    def origin(self) -> tuple[float, float, float]:
        """The point of the files' world that is (0,0,0) in this run."""
        return self.data.origin(self.cfg.gs_source)

    @property
    def root_device(self) -> torch.device:
        """Where the splats live: the device that the trainer was given, or without a trainer this module's own."""
        return self.device if self._trainer is None else self.trainer.strategy.root_device

    def camera(self, index: int | list[int]) -> Cameras:
        """The cameras of these views, one batch."""
        return self.capture.cameras([index] if isinstance(index, int) else index)

    def draw(self, scene: Gaussians, cameras: Cameras, **options: Any) -> Render:
        """Render with this run's settings."""
        renderer: RendererConfig = self.part["renderer"]
        with self.clock.stage("render"):
            return rasterize(
                scene,
                cameras,
                background=scene.means.new_tensor(renderer.background),
                antialiased=renderer.antialiased,
                backend=renderer.backend,
                **options,
            )

    @property
    def frozen(self) -> Frozen | None:
        """The splats that never change, with what is kept of their renders."""
        given = self.splats.frozen
        if given is not self._frozen[0]:
            limit = self.part["renderer"].cache_mib * 2**20
            self._frozen = given, None if given is None else Frozen(given, limit)
        return self._frozen[1]

    def draw_now(self, cameras: Cameras) -> Render:
        """Render the splats of the moment, differentiable in the editable ones."""
        return self.draw(self.splats.edited, cameras, frozen=self.frozen)

    @torch.no_grad()
    def picture(self, index: int) -> Tensor:
        """The present render of one view, [H,W,3] in [0,1]."""
        return self.draw_now(self.camera(index)).rgb[0].clamp(0, 1)

    # --- training

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return self.splats.make_optimizer(self.rates(0), self.part["learning_rates"].beta2)

    def rates(self, step: int) -> dict[str, float]:
        """Learning rates at `step`."""
        return self.part["learning_rates"].at(step, self.max_steps, self.capture.extent, self.true_current_epoch)

    @property
    def max_steps(self) -> int:
        """Length of the run in optimizer steps."""
        steps = self.trainer.max_steps
        if steps < 1:
            raise ConfigError("trainer.max_steps: got none, expected the number of steps: schedules run over it.")
        return steps

    def plan(self) -> Plan:
        """What this run builds and leaves out."""
        draft = Draft(self)
        self.describe(draft)
        return draft.finish()

    def on_train_start(self) -> None:
        plan = self.plan()
        plan.write(self.report_dir / "plan.json")
        self.plan_text = plan.text()
        plugin.info(self.plan_text)
        if self.cfg.nonfinite == "skip" and self._scaler is not None:
            raise ConfigError("system.nonfinite=skip: mixed precision with a loss scale skips by itself; leave it out.")
        self.record.begin(self)

    @property
    def clock(self) -> Clock:
        """Time spent in training so far, by stage."""
        return self.record.clock

    @property
    def _scaler(self) -> Any:
        """Of mixed precision in fp16: it scales the loss, and leaves out steps that overflow."""
        return getattr(self.trainer.strategy.precision_plugin, "scaler", None)

    def training_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        step = self.true_global_step
        try:
            self.record.numbers = self._step(batch, step)
        except NumericalError as error:
            leave_out(self, error, batch, step)
        with self.clock.stage("densify"):
            self._density_control(step + 1)

    def _step(self, batch: Mapping[str, Any], step: int) -> dict[str, float]:
        """One update of the splats, and its numbers. Raises NumericalError, and leaves the splats as they were."""
        optimizer, rates, stage = self.optimizers(), self.rates(step), self.clock.stage
        for group in self.splats.optimizer.param_groups:
            group["lr"] = rates[group["name"]]
        terms, render, numbers = self.step_loss(batch, step)
        loss = total(terms)
        require_finite("render", colours=render.rgb)
        require_finite("loss", loss=loss)
        render.means2d.retain_grad()
        optimizer.zero_grad()
        wanted = self.record.wanted(step + 1, self.max_steps)
        pulled = self.generations is not None and "anchor" not in terms
        if len(terms) > 1 and wanted:
            with stage(LOGGING):
                shares = gradient_shares(terms, self.splats.parameters)
            render.means2d.grad = None  # what arrived there on the way is not the step's
            numbers |= {f"share_{name}": share for name, share in shares.items()}
        with stage("backward"), torch.autocast(loss.device.type, enabled=False):  # it is for what goes forward only
            self.manual_backward(loss)
            norms = {} if self._scaler is not None else gradient_norms(self.splats.parameters)
        observe(self.splats, render, 1.0 if self._scaler is None else float(self._scaler.get_scale()))
        with stage("optimizer"):
            kept = kept_copy(self.splats.parameters)
            with self.splats.scaled_update():
                optimizer.step()
                moved = kept_copy(self.splats.parameters) if wanted and pulled else None
                self.after_update()
                if moved is not None:  # an anchor that is a step of its own has no gradient
                    numbers["share_anchor_step"] = update_share(kept, moved, list(self.splats.parameters.values()))
            try:
                require_finite("optimizer", **self.splats.parameters)
            except NumericalError:
                give_back(self.splats.parameters, kept)
                raise
        return {"loss": float(loss.detach()), **numbers, **{f"norm_{name}": norm for name, norm in norms.items()}}

    def _density_control(self, step: int) -> None:
        config: DensifyConfig = self.part["densify"]
        if step >= self.max_steps:  # what would be added then, or made opaque again, no step could improve
            return
        if config.every and config.start <= step < config.stop and step % config.every == 0:
            generator = keyed_generator(self.cfg.seed, "split", step)
            explore = config.candidates > 0 and step <= config.candidates_until * self.max_steps
            done = densify(self.splats, config, self.capture.extent, generator, self.generations, explore)
            if done.held_back and not self._cap_announced:
                self._cap_announced = True
                plugin.warn(
                    f"densification at step {step}: {done.held_back:,} splats to be divided have no room beside "
                    f"{len(self.splats):,} editable ones; raise system.densify.max_splats ({config.max_splats:,})"
                )
        if config.reset_every and step < config.stop and step % config.reset_every == 0:
            reset_opacity(self.splats)

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        if self.record.wanted(self.true_global_step, self.max_steps):
            self.record.add(self, self.true_global_step)

    def on_train_end(self) -> None:
        self.clock.stop()
        if self.true_global_step < self.max_steps:  # ended by something else, such as trainer.max_time
            self.save_now()
        else:
            self.keep_result()  # before any test can fail

    @property
    def title(self) -> str:
        """What the run is about, for its report."""
        return "Splats from photographs"

    def progress_metrics(self) -> dict[str, float]:
        """What the progress bar shows besides step and speed."""
        known = {"loss": self.record.numbers["loss"]} if "loss" in self.record.numbers else {}
        skipped = {"skipped": self.record.skipped} if self.record.skipped else {}
        return {**known, "splats": self.splats.total, **skipped}

    # --- measuring

    def score(self, index: int, image: Tensor | None = None, brief: bool = False) -> dict[str, float]:
        """Metrics of one view against each of its references (`report.metrics.compare`). image: the picture of the
        view, where it is there already."""
        image = self.picture(index) if image is None else image
        return compare(image, self.references(index), self.region(index), brief)

    def validation_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        for index in batch["index"]:
            self._outcomes[index] = self.score(index)
            write_png(self.save_path(f"it{self.true_global_step}-{index}.png"), picture_row(self.panels(index)))

    def on_validation_epoch_end(self) -> None:
        scores.print_scores(self._outcomes, self.capture)
        scores.log_scores(self, self._outcomes, "val")
        self._outcomes = {}

    def test_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        for index in batch["index"]:
            self._outcomes[index] = self.score(index)
            write_png(self.save_path(f"it{self.true_global_step}-test/{index}.png"), picture_row(self.panels(index)))

    def on_test_epoch_end(self) -> None:
        results.write_all(self, self._outcomes)
        self._outcomes = {}

    def predict_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        """Export needs no view of its own."""

    def on_predict_epoch_end(self) -> None:
        folder = f"it{self.true_global_step}-export"
        results.write_video_along(self, self.save_path(f"{folder}/video.mp4"))
        plugin.info(f"exported to {self.write_splats(f'{folder}/point_cloud.ply').parent}")

    def panels(self, index: int) -> list[tuple[str, Tensor]]:
        """Labelled pictures of one view, side by side in what is written."""
        return [*self.references(index).items(), (f"step {self.true_global_step}", self.picture(index))]

    def video_frame(self, cameras: Cameras) -> list[tuple[str, Tensor]]:
        """Labelled pictures of one moment of the video."""
        return [("", self.draw(self.splats.scene.detach(), cameras).rgb[0])]

    # --- files and checkpoints

    def save_path(self, name: str) -> Path:
        """A file under the run's save folder."""
        return Path(self.get_save_path(name))

    @property
    def report_dir(self) -> Path:
        """The run's report folder, beside save/."""
        return Path(self.get_save_dir()).parent / "report"

    @property
    def fitted(self) -> Fitted | None:
        """At what size the splats were fitted, where that is known."""

    def write_splats(self, name: str) -> Path:
        """Write the splats of the moment as a 3DGS PLY under the save folder."""
        path = self.save_path(name)
        comments = [] if self.fitted is None else [self.fitted.comment]
        write_ply(path, self.splats.scene.detach().to("cpu"), origin=self.origin, comments=comments)
        return path

    def keep_result(self) -> None:
        if self._kept_at != self.true_global_step or not self.save_path("last.ply").is_file():
            self.write_splats("last.ply")
            self._kept_at = self.true_global_step

    def keep_tested(self) -> Path:
        """Write the splats that were scored: the run's result, unless there is one already and a checkpoint, perhaps an
        earlier one, was only looked at again."""
        result = self.save_path("last.ply")
        if self._kept_at is None and result.is_file():
            return self.write_splats(f"it{self.true_global_step}-test/point_cloud.ply")
        self.keep_result()
        return result

    def savers(self) -> list[Callable[[], Any]]:
        splats, report = partial(self.write_splats, "last.ply"), partial(summary.write_report, self, {})
        return [splats, *super().savers(), report]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["splats"] = self.splats.state_dict()
        checkpoint["run"] = {"system": type(self).__name__, **self.record.state_dict()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        lacking = {"splats", "run"} - set(checkpoint)
        if lacking:
            raise SceneError(
                f"resume: the checkpoint holds no {' and no '.join(lacking)} (found {', '.join(checkpoint)})."
            )
        maker, mine = checkpoint["run"]["system"], type(self).__name__
        if maker != mine:
            hint = "To begin from its splats, give their PLY: system.gs_source=<trial>/save/last.ply"
            raise SceneError(f"resume: the checkpoint is of a {maker}, expected one of a {mine}. {hint}")
        self.splats = Splats.from_state_dict(checkpoint["splats"], self.root_device)
        missing = [name for name in STATISTICS if name not in self.splats.state]
        if missing:
            raise SceneError(f"resume: the checkpoint lacks the per-splat state {', '.join(missing)}.")
        self.record.load_state_dict(checkpoint["run"])
