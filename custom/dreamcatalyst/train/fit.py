"""Splats from photographs: the optimisation of Kerbl et al. 2023."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from .. import plugin
from ..config import Between, Count, Fraction, Range
from ..data.views import Capture
from ..errors import DataError
from ..loss.image import photometric_loss
from ..render.api import Render
from ..scene.create import from_mesh, from_points
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from .method import Method
from .system import SplatSystem


class FitMethod(Method):
    """Fits splats to the training photographs; begins with the reconstruction's points, a mesh, or a PLY of splats."""

    def first_scene(self) -> Gaussians:
        cfg = self.cfg
        if cfg.gs_source:  # which may also be shown and exported, without photographs
            return self.given_scene()
        capture = self.require_photos()
        if cfg.mesh:
            return from_mesh(cfg.mesh, cfg.mesh_points, cfg.seed, sh_degree=cfg.sh_degree)
        if capture.points is None:
            raise DataError(
                f"{capture.source}: there are no reconstructed points to begin with. "
                "Give some: system.mesh=<point cloud or mesh>, or system.gs_source=<PLY of splats>."
            )
        return from_points(*capture.points, sh_degree=cfg.sh_degree, initial_opacity=cfg.initial_opacity)

    def require_photos(self) -> Capture:
        """The capture. Raises DataError where it has no photographs."""
        capture = self.context.data.open()
        if not capture.has_photos:
            raise DataError(f"{capture.source}: has cameras but no photographs, and a fit needs some.")
        return capture

    def begin_training(self) -> None:
        self.require_photos()

    def sh_degree_at(self, step: int, scene: Gaussians) -> int:
        """The degree that has been let in by `step`."""
        return min(step // self.cfg.sh_every if self.cfg.sh_every > 0 else 3, scene.sh_degree)

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[dict[str, Tensor], Render, dict[str, float]]:
        scene = self.splats.scene
        target = torch.stack([self.photo(i) for i in batch["index"]]).to(scene.means)
        render = self.draw(scene, self.camera(batch["index"]), sh_degree=self.sh_degree_at(step, scene))
        return {"photometric": photometric_loss(render.rgb, target, self.cfg.ssim_weight)}, render, {}

    @property
    def fitted(self) -> Fitted | None:
        if not self.capture.has_photos:
            return Fitted.of(self.cfg.gs_source) if self.cfg.gs_source else None
        return Fitted.at([self.capture.views[i] for i in self.capture.train])

    def references(self, index: int) -> dict[str, Tensor]:
        return {"photo": self.photo(index)} if self.capture.has_photos else {}


@plugin.register("dreamcatalyst-fit-system")
class FitSystem(SplatSystem):
    """A fit in Lightning."""

    Method = FitMethod

    @dataclass
    class Config(SplatSystem.Config):
        mesh: str = ""  # a mesh or point cloud whose surface gives the first splats, instead of the capture's points
        mesh_points: Annotated[int, Range("[1, 100000000]")] = 50_000  # splats sampled from the mesh
        sh_degree: Annotated[int, Range("[0, 3]")] = 3  # highest degree of the colour's spherical harmonics
        sh_every: Count = 1000  # steps after which the next degree is let in
        ssim_weight: Fraction = 0.2  # of D-SSIM in the loss, the rest is L1
        initial_opacity: Between = 0.1
