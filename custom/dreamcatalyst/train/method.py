"""What fitting and editing are, in plain torch: a scene, the loss of a step, and what its views are compared with.

`system.py` runs a method in Lightning; nothing here knows of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..data.camera import Cameras
from ..data.views import Capture
from ..errors import ConfigError
from ..render.api import Backend, Frozen, Render
from ..report.clock import Clock
from ..report.run import Panels, ReportConfig
from ..scene.fitted import Fitted
from ..scene.formats.api import read_splats
from ..scene.gaussians import Gaussians
from ..scene.generations import Generations
from ..scene.trainable import Splats
from .datamodule import SplatData
from .density import DensifyConfig
from .drawing import Drawer, RendererConfig
from .optim import LearningRates
from .plan import Plan, PlanBuilder


@dataclass(frozen=True)
class MethodParts:
    """The parsed sections that every method has."""

    renderer: RendererConfig
    learning_rates: LearningRates
    densify: DensifyConfig
    report: ReportConfig


@dataclass(frozen=True)
class Context:
    """What a run gives its method. device: where the splats live. step: updates so far, of max_steps (asked for when
    it is needed, since a run without training has none). save: a name to a path under the trial's save/. resumed:
    whether a checkpoint follows."""

    data: SplatData
    device: torch.device
    step: Callable[[], int]
    max_steps: Callable[[], int]
    save: Callable[[str], Path]
    resumed: bool = False


class Method:
    """Base of fit and edit. Subclasses say where the scene comes from, what the loss of a step is, and against which
    images it is measured: `first_scene`, `step_loss`, `references`.

    cfg: the system's config; part: its parsed sections; clock: of the run. context: set before anything is asked.
    generations: of hierarchical splats, where a subclass keeps them.
    """

    context: Context

    title = "Splats from photographs"  # what the run is about, for its report
    pulled = False  # whether after_update moves splats by itself

    def __init__(self, cfg: Any, part: MethodParts, clock: Clock):
        self.cfg, self.part, self.clock = cfg, part, clock
        self.draw, self.density = Drawer(part.renderer, clock), part.densify.make()
        self.generations: Generations | None = None
        self._splats: Splats | None = None

    # --- to be said by subclasses

    def first_scene(self) -> Gaussians:
        """The splats to begin with."""
        return self.given_scene()

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[dict[str, Tensor], Render, dict[str, float]]:
        """The terms of a step's loss by name, the render whose screen gradients drive densification, and numbers to
        report. batch: "index", the views of the step."""
        raise NotImplementedError

    def references(self, index: int) -> dict[str, Tensor]:
        """What the render of a view is compared with, by name: [H,W,3] each, the first one being the aim."""
        return {}

    def region(self, index: int) -> Tensor | None:
        """Where a view is meant to change, [H,W,1] of 0 and 1; None: everywhere."""

    def timestep(self, step: int) -> int | None:
        """The prior's timestep at `step`, None where there is none."""

    def known_scenes(self) -> dict[str, Any]:
        """Further scenes, by name, with which the splats' consistency between views is compared."""
        return {}

    def make_splats(self, scene: Gaussians) -> Splats:
        """The trainable form of `scene`."""
        return Splats(scene)

    @property
    def counts(self) -> Mapping[str, int]:
        """Further numbers for the report's page, by what they count."""
        return {}

    def describe(self, plan: PlanBuilder) -> None:
        """Add to the plan what only this method builds or leaves out."""

    def begin_training(self) -> None:
        """What is written and compared once, before the first step."""

    def after_update(self) -> None:
        """What else moves splats in a step, after the optimizer has."""

    def panels(self, index: int) -> Panels:
        """Labelled pictures of one view."""
        return [*self.references(index).items(), (f"step {self.context.step()}", self.picture(index))]

    def video_frame(self, cameras: Cameras) -> Panels:
        """Labelled pictures of one moment of the video."""
        return [("", self.draw(self.splats.scene.detach(), cameras).rgb[0])]

    @property
    def fitted(self) -> Fitted | None:
        """At what size the splats were fitted, where that is known."""

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the splats."""
        return {}

    def check_checkpoint(self, checkpoint: Mapping[str, Any]) -> None:
        """Raise SceneError for a checkpoint that this method cannot go on from."""

    def load_state_dict(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on from a checkpoint, whose splats are there."""

    # --- a scene to begin with

    def prepare(self) -> None:
        """What is made sure of before anything is loaded: that this machine can draw."""
        prepare = self.backend.prepare
        if prepare is not None:
            prepare()

    def begin(self) -> None:
        """Load the scene, where no checkpoint has brought one. Raises ConfigError, DataError and SceneError."""
        self.prepare()
        if self._splats is None:
            self.splats = self.make_splats(self.first_scene().to(self.context.device))
            self.density.begin(self.splats)

    def given_scene(self) -> Gaussians:
        """The splats of gs_source, or those that the capture carries. Raises ConfigError where there are neither."""
        data = self.context.data
        if self.cfg.gs_source:
            return read_splats(self.cfg.gs_source, drop_nonfinite=self.cfg.drop_nonfinite, origin=self.origin)
        if data.cfg.source:  # where that is wrong, too, it is the first thing to say
            capture = data.open()
            if capture.scene is not None:
                return capture.scene
        raise ConfigError(
            "system.gs_source: no splats are given. Name a splat file; configs/fit.yaml makes one from photographs."
        )

    def plan(self) -> Plan:
        """What this run builds and leaves out."""
        plan, camera, context = PlanBuilder(), self.camera(self.capture.train[0]), self.context
        self.describe(plan)
        counted = () if self.generations is None else self.generations.states
        size, cache = camera.width * camera.height, self.part.renderer.cache_bytes
        plan.splats(self.splats, counted, self.backend, cache, len(self.capture), size)
        plan.density(self.part.densify, len(self.splats), context.max_steps())
        plan.leave_out("depth", "no output asks for it")
        return plan.finish(context.data.cfg.batch_size * size)

    @property
    def splats(self) -> Splats:
        """The splats of the moment; there are some from `begin` on."""
        if self._splats is None:
            raise RuntimeError(f"{type(self).__name__} has not begun: it has no splats yet")
        return self._splats

    @splats.setter
    def splats(self, splats: Splats) -> None:
        self._splats = splats

    # --- views

    @property
    def capture(self) -> Capture:
        """The run's views."""
        return self.context.data.open(self._splats.scene.detach() if self._splats else None, self.cfg.gs_source)

    @property
    def origin(self) -> tuple[float, float, float]:
        """The point of the files' world that is (0,0,0) in this run."""
        return self.context.data.origin(self.cfg.gs_source)

    def camera(self, index: int | list[int]) -> Cameras:
        """The cameras of these views, one batch."""
        return self.capture.cameras([index] if isinstance(index, int) else index)

    @torch.no_grad()
    def photo(self, index: int) -> Tensor:
        """The photograph of one view, [H,W,3] in [0,1]; of a capture that carries splats, their render."""

        def render(scene: Any, camera: Cameras) -> Tensor:
            return self.draw(scene.to(self.context.device), camera).rgb[0].clamp(0, 1)

        return self.capture.image(index, render)

    # --- drawing

    @property
    def backend(self) -> Backend:
        """What draws. Raises ConfigError and SceneError as `find_backend`."""
        return self.part.renderer.find(self.context.device)

    @property
    def frozen(self) -> Frozen | None:
        """The splats that never change, with what is kept of their renders."""
        return self.draw.frozen(self.splats)

    def draw_now(self, cameras: Cameras) -> Render:
        """Render the splats of the moment, differentiable in the editable ones."""
        return self.draw(self.splats.edited, cameras, frozen=self.frozen)

    @torch.no_grad()
    def picture(self, index: int) -> Tensor:
        """The present render of one view, [H,W,3] in [0,1]."""
        return self.draw_now(self.camera(index)).rgb[0].clamp(0, 1)

    def rates(self, step: int, epoch: int) -> dict[str, float]:
        """Learning rates at `step`, by parameter."""
        return self.part.learning_rates.at(step, self.context.max_steps(), self.capture.extent, epoch)
