"""What fitting and editing share: splats in a Lightning loop, density control, checkpoints, results."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import plugin
from ..config import parse
from ..data.camera import Cameras
from ..data.views import Capture
from ..diffusion.noise import keyed_generator
from ..errors import ConfigError, NumericalError, SceneError
from ..render.api import Render, rasterize
from ..render.frozen import Frozen
from ..report.curve import Curve
from ..report.metrics import METRICS
from ..report.pictures import picture_row, write_png
from ..scene.edit import Splats
from ..scene.gaussians import Gaussians
from ..scene.generations import Generations
from ..scene.ply import read_ply, write_ply
from . import results
from .densify import STATISTICS, DensifyConfig, densify, observe, reset_opacity, screen_statistics
from .optim import LearningRates
from .plan import Draft, Plan
from .results import ReportConfig


@dataclass(frozen=True)
class RendererConfig:
    """How splats are drawn."""

    backend: str = "auto"  # reference | cpu | gsplat; auto: by the device
    antialiased: bool = False  # Mip-Splatting's 2D filter
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB in [0,1]
    cache_mib: int = 1024  # what is kept of renders of splats that never change; the least recently used goes

    def __post_init__(self) -> None:
        if self.cache_mib < 0:
            raise ConfigError(f"cache_mib: got {self.cache_mib}, expected 0 or more MiB.")
        if not all(0 <= value <= 1 for value in self.background):
            raise ConfigError(f"background: got {self.background}, expected red, green and blue in [0,1].")


class SplatSystem(plugin.BaseSystem):
    """Base of the fit and the edit system. Subclasses say where the scene comes from, what the loss of a step is, and
    against which images it is measured: `first_scene`, `step_loss`, `references`."""

    parts: dict[str, type] = {
        "renderer": RendererConfig,
        "learning_rates": LearningRates,
        "densify": DensifyConfig,
        "report": ReportConfig,
    }

    @dataclass
    class Config(plugin.BaseSystem.Config):
        gs_source: str = ""  # a PLY of splats to begin with
        drop_nonfinite: bool = False  # leave NaN and Inf rows of the PLY out, instead of refusing it
        seed: int = 0  # of everything that is drawn at random
        renderer: dict = field(default_factory=dict)
        learning_rates: dict = field(default_factory=dict)
        densify: dict = field(default_factory=dict)
        report: dict = field(default_factory=dict)

    # --- to be said by subclasses

    def first_scene(self) -> Gaussians:
        """The splats to begin with."""
        return self.given_scene()

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[Tensor, Render, dict[str, float]]:
        """The loss of a step, the render whose screen gradients drive densification, and numbers to report."""
        raise SceneError(f"{type(self).__name__} has no training step")

    def references(self, index: int) -> dict[str, Tensor]:
        """What the render of a view is compared with, by name: [H,W,3] each, the first one being the aim."""
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
        self.automatic_optimization = False
        self.part = {name: parse(cls, getattr(self.cfg, name), f"system.{name}") for name, cls in self.parts.items()}
        self.splats: Splats | None = None
        self.generations: Generations | None = None  # of hierarchical splats, where a subclass keeps them
        self._frozen: tuple[Gaussians | None, Frozen | None] = None, None
        self._data: Any = None  # a data module, where there is no trainer to ask for it
        self.curve, self._seconds, self._started = Curve(), 0.0, None
        self._numbers: dict[str, float] = {}
        self._outcomes: dict[int, dict[str, float]] = {}

    def setup(self, stage: str) -> None:
        if self.splats is None:
            self.splats = self.make_splats(self.first_scene().to(self.root_device))
            self.splats.state.update(screen_statistics(self.splats))
        _ = self.capture  # opened here, since after this Lightning asks for the loaders of any stage

    def given_scene(self) -> Gaussians:
        """The splats of gs_source, or of the made world. Raises ConfigError where there are neither."""
        if self.cfg.gs_source:
            return read_ply(self.cfg.gs_source, drop_nonfinite=self.cfg.drop_nonfinite)
        if self.data.world is not None:
            return self.data.world.scene
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
    def root_device(self) -> torch.device:
        """Where the splats live: the device that the trainer was given, or without a trainer this module's own."""
        return self.device if self._trainer is None else self.trainer.strategy.root_device

    def camera(self, index: int | list[int]) -> Cameras:
        """The cameras of these views, one batch."""
        return self.capture.cameras([index] if isinstance(index, int) else index)

    def draw(self, scene: Gaussians, cameras: Cameras, **options: Any) -> Render:
        """Render with this run's settings."""
        renderer: RendererConfig = self.part["renderer"]
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
        plugin.info(plan.text())
        self._started = time.perf_counter()
        if self.true_global_step == 0:
            self.report_row(0)

    @property
    def seconds(self) -> float:
        """Time spent in training so far, reports left out."""
        return self._seconds + (time.perf_counter() - self._started if self._started is not None else 0.0)

    def training_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        step, optimizer = self.true_global_step, self.optimizers()
        rates = self.rates(step)
        for group in self.splats.optimizer.param_groups:
            group["lr"] = rates[group["name"]]
        loss, render, numbers = self.step_loss(batch, step)
        if not torch.isfinite(loss):
            raise self._not_finite(f"the loss is {float(loss.detach())}", step, batch)
        render.means2d.retain_grad()
        optimizer.zero_grad()
        self.manual_backward(loss)
        scaler = getattr(self.trainer.strategy.precision_plugin, "scaler", None)
        observe(self.splats, render, 1.0 if scaler is None else float(scaler.get_scale()))
        if scaler is None:  # else it looks itself, and leaves out steps that overflow
            for name, value in self.splats.parameters.items():
                if value.grad is not None and not torch.isfinite(value.grad.sum()):
                    raise self._not_finite(f"the gradient of {name} is not finite", step, batch)
        with self.splats.scaled_update():
            optimizer.step()
            self.after_update()
        self._density_control(step + 1)
        self._numbers = {"loss": float(loss.detach()), **numbers}

    def _not_finite(self, what: str, step: int, batch: Mapping[str, Any]) -> NumericalError:
        views = ", ".join(self.capture.views[i].name for i in batch["index"])
        return NumericalError(f"step {step}, view {views}: {what}. The splats are those of the step before.")

    def _density_control(self, step: int) -> None:
        config: DensifyConfig = self.part["densify"]
        if config.every and config.start <= step < config.stop and step % config.every == 0:
            generator = keyed_generator(self.cfg.seed, "split", step)
            densify(self.splats, config, self.capture.extent, generator, self.generations)
        if config.reset_every and step < config.stop and step % config.reset_every == 0:
            reset_opacity(self.splats)

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        step, every = self.true_global_step, self.part["report"].every
        if step >= self.max_steps or (every and step % every == 0):
            self.report_row(step)

    def on_train_end(self) -> None:
        self._pause()
        if self.true_global_step < self.max_steps:  # ended by something else, such as trainer.max_time
            self.save_now()
        else:
            self.write_splats("last.ply")  # before any test can fail

    def _pause(self) -> None:
        if self._started is not None:
            self._seconds, self._started = self.seconds, None

    def progress_metrics(self) -> dict[str, float]:
        """What the progress bar shows besides step and speed."""
        known = {"loss": self._numbers["loss"]} if "loss" in self._numbers else {}
        return {**known, "splats": self.splats.total}

    # --- measuring

    def score(self, index: int) -> dict[str, float]:
        """Every metric of one view against each of its references, as "<metric>_<reference>"."""
        image = self.picture(index)[None]
        return {
            f"{metric}_{name}": float(METRICS.get(metric)(image, reference.to(image)[None].clamp(0, 1)))
            for name, reference in self.references(index).items()
            for metric in ("psnr", "ssim", "l1")
        }

    def report_row(self, step: int) -> None:
        """Measure some held-out views and add a row to the error curve; the clock stands still meanwhile."""
        running, seconds = self._started is not None, self.seconds
        self._pause()
        held_out = self.data.held_out
        chosen = held_out[:: max(1, len(held_out) // max(self.part["report"].views, 1))][: self.part["report"].views]
        row = {"step": step, "seconds": round(seconds, 3), "splats": self.splats.total, **self._numbers}
        self.curve.add(**row, **results.mean_scores([self.score(i) for i in chosen]))
        if running:
            self._started = time.perf_counter()

    def validation_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        for index in batch["index"]:
            self._outcomes[index] = self.score(index)
            write_png(self.save_path(f"it{self.true_global_step}-{index}.png"), picture_row(self.panels(index)))

    def on_validation_epoch_end(self) -> None:
        results.print_scores(self._outcomes, self.capture)
        results.log_scores(self, self._outcomes, "val")
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

    def write_splats(self, name: str) -> Path:
        """Write the splats of the moment as a 3DGS PLY under the save folder."""
        path = self.save_path(name)
        write_ply(path, self.splats.scene.detach().to("cpu"))
        return path

    def save_now(self) -> list[Path]:
        """Keep the state of the moment (after an interruption): a checkpoint to resume from, and the PLY."""
        checkpoint = Path(self.get_save_dir()).parent / "ckpts" / "last.ckpt"
        self.trainer.save_checkpoint(checkpoint)
        return [checkpoint, self.write_splats("last.ply")]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["splats"] = self.splats.state_dict()
        checkpoint["run"] = {"system": type(self).__name__, "seconds": self.seconds, "curve": self.curve.rows}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "splats" not in checkpoint:
            raise SceneError(f"resume: the checkpoint holds no splats (found {', '.join(checkpoint)}).")
        maker, mine = checkpoint["run"]["system"], type(self).__name__
        if maker != mine:
            hint = "To begin from its splats, give their PLY: system.gs_source=<trial>/save/last.ply"
            raise SceneError(f"resume: the checkpoint is of a {maker}, expected one of a {mine}. {hint}")
        self.splats = Splats.from_state_dict(checkpoint["splats"], self.root_device)
        missing = [name for name in STATISTICS if name not in self.splats.state]
        if missing:
            raise SceneError(f"resume: the checkpoint lacks the per-splat state {', '.join(missing)}.")
        self._seconds, self.curve = checkpoint["run"]["seconds"], Curve(checkpoint["run"]["curve"])
