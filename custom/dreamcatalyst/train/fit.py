"""Splats from photographs: the optimisation of Kerbl et al. 2023."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from .. import plugin
from ..cache import ByteCache
from ..config import Between, Count, Fraction, NonNegative, Range
from ..data.camera import Cameras
from ..data.views import Capture
from ..diffusion.noise import keyed_generator
from ..errors import DataError, SceneError
from ..loss.image import photometric_loss
from ..render.api import Render
from ..report.clock import Clock
from ..scene.create import from_mesh, from_points
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from ..segment.text import CLIPSEG, EXAMPLES, MODELS, SAM, Text, model_type
from .exposure import Exposures
from .method import Method, MethodParts
from .plan import PlanBuilder
from .system import SplatSystem

PIXELS = 2**29  # bytes of masks and alpha that are kept in memory; the least recently used go


class FitMethod(Method):
    """Fits splats to the training photographs; begins with the reconstruction's points, a mesh, or a PLY of splats."""

    part: FitParts

    def __init__(self, cfg: Any, part: FitParts, clock: Clock):
        super().__init__(cfg, part, clock)
        self._pixels = ByteCache(PIXELS)

    def prepare(self) -> None:
        super().prepare()
        _ = self.finder  # its model is there, or it is said before anything long

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
        scene, index, camera = self.splats.scene, batch["index"], self.camera(batch["index"])
        background = self.background_at(step)
        target = torch.stack([self.target(i, background) for i in index]).to(scene.means)
        kept = self.weights(index, target)
        if self.is_coarse(step):
            camera = camera.resized((camera.width + 1) // 2, (camera.height + 1) // 2)
            target, kept = smaller(target, camera), None if kept is None else smaller(kept, camera).round()
        degree = self.sh_degree_at(step, scene)
        render = self.draw(scene, camera, background.to(scene.means), sh_degree=degree)
        seen = render.rgb if self.exposures is None else self.exposures(render.rgb, index)
        return {"photometric": photometric_loss(seen, target, self.cfg.ssim_weight, kept)}, render, {}

    def is_coarse(self, step: int) -> bool:
        """Whether a step takes views of half the size."""
        return step < self.cfg.coarse * self.context.max_steps()

    def after_update(self) -> None:
        if self.exposures is not None:
            self.exposures.step(self.context.step() / self.context.max_steps())

    # --- what a step is compared with

    @cached_property
    def exposures(self) -> Exposures | None:
        """Of the training photographs, where they are asked for."""
        rate = self.cfg.exposure
        return Exposures(self.capture.train, rate, self.context.device) if rate else None

    def background_at(self, step: int) -> Tensor:
        """What is behind the splats in a step, [3]: the run's, or one drawn by seed and step."""
        if not self.cfg.random_background:
            return torch.tensor(self.part.renderer.background)
        return torch.rand(3, generator=keyed_generator(self.cfg.seed, "background", step))

    def target(self, index: int, background: Tensor) -> Tensor:
        """The photograph of a view, [H,W,3], with `background` [3] behind it where it is transparent."""
        photo = self.photo(index)
        alpha = self._pixels.get(("alpha", index), lambda: self.capture.alpha(index)) if self._transparent else None
        if alpha is None:
            return photo
        return photo + (1 - alpha) * (background - torch.tensor(self.capture.options.background))

    @property
    def _transparent(self) -> bool:
        """Whether what is behind photographs is another thing than what they were laid over when they were read."""
        return self.cfg.random_background or self.part.renderer.background != self.capture.options.background

    def weights(self, index: list[int], target: Tensor) -> Tensor | None:
        """What counts of the photographs of these views, [B,H,W,1] of 0 and 1 beside `target` [B,H,W,3]; None: all."""
        kept = [self.kept(i) for i in index]
        if all(mask is None for mask in kept):
            return None
        return torch.stack([torch.ones_like(target[0, ..., :1]) if mask is None else mask for mask in kept])

    def kept(self, index: int) -> Tensor | None:
        """What counts of a photograph, [H,W,1] of 0 and 1; None: all of it."""
        if self.finder is None and not self.capture.has_masks:
            return None
        return self._pixels.get(("kept", index), lambda: self._find_kept(index))

    def _find_kept(self, index: int) -> Tensor | None:
        kept, device = self.capture.kept(index), self.context.device
        if self.finder is not None:
            found = 1 - self.finder(self.photo(index).to(device))[..., None].cpu()
            kept = found if kept is None else kept * found
        return None if kept is None else kept.to(device)

    @cached_property
    def finder(self) -> Callable[[Tensor], Tensor] | None:
        """What finds in a picture what words name."""
        words = self.part.leave_out
        return words.finder(self.context.device) if words.text else None

    def region(self, index: int) -> Tensor | None:
        return self.kept(index)

    def describe(self, plan: PlanBuilder) -> None:
        count, leaves_out = len(self.capture.train), self.finder is not None or self.capture.has_masks
        if self.exposures is not None:
            plan.add("exposures", f"an affine colour for each of {count} photographs", 4 * 4 * 12 * count)
        else:
            plan.leave_out("exposures", "system.exposure is 0")
        if leaves_out:
            plan.add("masks", "say what counts of the photographs; scores have a column for that, too")
        else:
            plan.leave_out("masks", "neither data.masks nor system.leave_out.text is given")

    # --- checkpoints and results

    def state_dict(self) -> dict[str, Any]:
        return {} if self.exposures is None else {"exposures": self.exposures.state_dict()}

    def load_state_dict(self, checkpoint: Mapping[str, Any]) -> None:
        if self.exposures is None:
            return
        if "exposures" not in checkpoint:
            raise SceneError("resume: the checkpoint has no exposures: it was made without them. Set system.exposure=0")
        self.exposures.load_state_dict(checkpoint["exposures"])

    @property
    def fitted(self) -> Fitted | None:
        if self.cfg.gs_source and self.context.step() == 0:  # nothing was fitted here yet
            return Fitted.of(self.cfg.gs_source)
        if not self.capture.has_photos:
            return None
        return Fitted.at([self.capture.views[i] for i in self.capture.train])

    def references(self, index: int) -> dict[str, Tensor]:
        return {"photo": self.photo(index)} if self.capture.has_photos else {}


def smaller(images: Tensor, camera: Cameras) -> Tensor:
    """Pictures [B,H,W,C] at the size of a camera, by means over areas."""
    return adaptive_avg_pool2d(images.permute(0, 3, 1, 2), (camera.height, camera.width)).permute(0, 2, 3, 1)


@dataclass(frozen=True)
class LeaveOutConfig:
    """Things in the photographs that move or are no part of the scene: found by words, and left out of the loss."""

    text: str = ""  # such as "person. sky"; empty: nothing
    path: str = EXAMPLES[CLIPSEG]  # CLIPSeg or Grounding DINO: folder, or id on Hugging Face
    sam: str = EXAMPLES[SAM]  # cuts out what Grounding DINO finds
    threshold: Between | None = None  # of a pixel (CLIPSeg: 0.4) or a box (Grounding DINO: 0.35)

    def finder(self, device: torch.device) -> Callable[[Tensor], Tensor]:
        """[H,W,3] in [0,1] to a mask [H,W] of 0 and 1 of what the words name. Raises ConfigError and PriorError."""
        options = Text(self.text, self.path, self.sam, self.threshold)
        return MODELS[model_type(self.path, *MODELS)](options, device)


@dataclass(frozen=True)
class FitParts(MethodParts):
    """The parsed sections of a fit."""

    leave_out: LeaveOutConfig


@plugin.register("dreamcatalyst-fit-system")
class FitSystem(SplatSystem):
    """A fit in Lightning."""

    Method = FitMethod
    Parts = FitParts

    @dataclass
    class Config(SplatSystem.Config):
        mesh: str = ""  # a mesh or point cloud whose surface gives the first splats, instead of the capture's points
        mesh_points: Annotated[int, Range("[1, 100000000]")] = 50_000  # splats sampled from the mesh
        sh_degree: Annotated[int, Range("[0, 3]")] = 3  # highest degree of the colour's spherical harmonics
        sh_every: Count = 1000  # steps after which the next degree is let in
        ssim_weight: Fraction = 0.2  # of D-SSIM in the loss, the rest is L1
        initial_opacity: Between = 0.1
        coarse: Fraction = 0.0  # of the run, from its start: steps that take views of half the size
        exposure: NonNegative = 0.0  # learning rate of an affine colour for each photograph (3DGS: 0.01); 0: none
        random_background: bool = False  # another one in each step, behind splats and transparent photographs
        leave_out: dict = field(default_factory=dict)  # what is left out of the photographs, by words

    method: FitMethod

    def cost(self, step: int) -> float:
        return 0.5 if self.method.is_coarse(step) else 1.0  # a quarter of the pixels, as many splats
