"""Things taken away: the splats that a mask names go, and the hole behind them is healed (healing.py) and settled.

After GaussianEditor's deletion (Chen et al. 2024): delete, let the border change, repair by inpainted views. There each
view is inpainted alone, where the border's splats are drawn; here the hole is what no view has seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import plugin
from ..cache import ByteCache
from ..errors import ConfigError, SceneError
from ..inpaint.api import InpaintConfig, inpaint
from ..loss.image import photometric_loss
from ..render.api import Render
from ..report.clock import Clock
from ..report.pictures import picture_row, write_png
from ..scene.gaussians import Gaussians
from ..scene.trainable import Splats
from ..segment.api import EXTRA, NONE, SEGMENTERS, make_mask
from ..segment.pictures import overlay
from .edit_config import FirstFitConfig
from .finite import require_finite
from .healing import HealConfig, Healed, Healer
from .plan import PlanBuilder, scene_bytes
from .region import PICTURES, write_mask_pictures
from .sourced import SourcedMethod, SourcedParts


@dataclass(frozen=True)
class DeleteParts(SourcedParts):
    """The parsed sections of a deletion."""

    inpaint: InpaintConfig
    heal: HealConfig
    first_fit: FirstFitConfig


class DeleteMethod(SourcedMethod):
    """Takes the masked splats of gs_source (or of those that the capture carries) away.

    counts: what went and what came, in words. pictures: views whose holes were filled, uint8 [H,W,3]: what they are
    fitted to; the others are fitted to what they were when the hole had been filled. thing: bool [N], which splats of
    the source are gone. start: the editable splats when the hole had been filled.
    """

    part: DeleteParts
    thing: Tensor
    start: Gaussians

    def __init__(self, cfg: Any, part: DeleteParts, clock: Clock):
        super().__init__(cfg, part, clock)
        if part.mask.kind == NONE:
            kinds = ", ".join(SEGMENTERS.names())
            raise ConfigError(f"system.mask.kind: none names nothing that could be taken away. Known: {kinds}.")
        self.inpainter, self._loaded, self._loads = part.inpaint.inpainter(), None, True
        self.pictures: dict[int, Tensor] = {}
        self._counts: dict[str, int] = {}
        self._aims = ByteCache(self._cache_bytes)
        self._prepared = False

    @property
    def title(self) -> str:
        return f"Taken away: {self.cfg.thing or 'what the mask names'}"

    @property
    def counts(self) -> Mapping[str, int]:
        return self._counts

    # --- a scene to begin with

    def load_inpainter(self) -> None:
        """Load what fills pictures. Raises PriorError and ConfigError."""
        if self._loads:
            self._loaded, self._loads = self.inpainter.load(self.context.device), False

    def prepare(self) -> None:
        """Load the inpainter and then the scene, so that a model that is missing is found first."""
        super().prepare()
        if self._prepared:
            return
        self.load_inpainter()
        self.load_source()
        if self.context.data.cfg.source and self.cfg.thing:
            truth = self.context.data.open().truth(f"Remove the {self.cfg.thing}")
            self.truth = None if truth is None else truth.to(self.context.device)
        self._prepared = True

    def make_splats(self, scene: Gaussians) -> Splats:
        if self.context.resumed:  # a checkpoint brings what came of it
            return Splats(scene)
        request, picture = self.mask_request(scene), self.context.save("mask.png")
        found = make_mask(self.part.mask, request, picture.parents[2] / "masks")
        if found is None:
            raise SceneError("mask: none was found")
        write_mask_pictures(found, request, picture)
        views = request.spread(self.part.heal.views)
        healer = Healer(self.part.heal, self.draw, {view: self.camera(view) for view in views}, self.fill)
        with self.clock.stage("heal"):
            healed = healer(scene, found.mask)
        self.thing = found.mask
        self._counts = {
            "splats taken away": healed.taken,
            "splats that came to light, and went, too": healed.unseen,
            "splats put in": healed.added,
            "splats around the hole that may change": healed.border,
        }
        self.pictures = {view: to_bytes(filled) for view, filled in healed.pictures.items()}
        self.say(healed)
        weights = healed.editable.to(scene.means)  # an edit after it may be confined to what was healed: mask.kind=kept
        splats = Splats(healed.scene.with_extra(**{EXTRA: weights}), {}, healed.editable)
        self.start = splats.edited.detach().clone()
        return splats

    def fill(self, picture: Tensor, hole: Tensor) -> Tensor:
        """A picture [H,W,3] in [0,1] without its hole [H,W]."""
        return inpaint(self.inpainter, self._loaded, picture, hole)

    def say(self, healed: Healed) -> None:
        """Tell what was done, and write the filled views, if any, as fill.png."""
        plugin.info("; ".join(f"{count:,} {what}" for what, count in self._counts.items()))
        if not healed.pictures:
            plugin.info("no hole: other views have seen all that is behind it")
            return
        rows = []
        for view in list(healed.pictures)[:PICTURES]:
            before, filled = self.source.render(view), healed.pictures[view]
            hole = overlay(before, healed.holes[view].to(filled))
            rows.append(picture_row([("source", before), ("never seen", hole), ("filled", filled)]))
        widest = max(row.shape[1] for row in rows)
        padded = [np.pad(row, ((0, 0), (0, widest - row.shape[1]), (0, 0))) for row in rows]
        write_png(self.context.save("fill.png"), np.vstack(padded))

    # --- a step

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[dict[str, Tensor], Render, dict[str, float]]:
        index = batch["index"]
        render = self.draw_now(self.camera(index))
        require_finite("render", colours=render.rgb)
        aims = torch.stack([self.aim(view) for view in index]).to(render.rgb)
        return {"photometric": photometric_loss(render.rgb, aims, self.cfg.ssim_weight)}, render, {}

    @torch.no_grad()
    def aim(self, view: int) -> Tensor:
        """What a view is fitted to, [H,W,3]: its filled picture, or what it was when the hole had been filled."""
        if view in self.pictures:
            return self.pictures[view].to(self.context.device) / 255

        return self._aims.get(view, lambda: self.draw(self.start, self.camera(view), frozen=self.frozen).rgb[0])

    # --- what it is compared with

    def region(self, index: int) -> Tensor | None:
        """Where the thing was, [H,W,1]."""
        if self.truth is None and index not in self._regions:
            share = self.thing[:, None].to(self.source.scene.means)
            self._regions[index] = self.draw(self.source.scene, self.camera(index), features=share).features[0].round()
        return self._regions[index] if self.truth is None else super().region(index)

    def describe(self, plan: PlanBuilder) -> None:
        plan.add("source", f"{len(self.source.scene):,} splats before it", scene_bytes(self.source.scene))
        plan.mask(self.part.mask.kind)
        plan.add("inpainter", f"{self.part.inpaint.kind}, {len(self.pictures)} views were filled")
        for what, count in self.counts.items():
            plan.add(what, f"{count:,}")

    # --- checkpoints

    def state_dict(self) -> dict[str, Any]:
        return {
            "deletion": {
                "thing": self.thing,
                "pictures": self.pictures,
                "counts": self._counts,
                "start": dict(self.start.parameters()),
            }
        }

    def check_checkpoint(self, checkpoint: Mapping[str, Any]) -> None:
        if "deletion" not in checkpoint:
            raise SceneError(
                "resume: the checkpoint is of a run that took nothing away, and a deletion cannot go on from it. Begin "
                "one with its splats: system.gs_source=<that run>/save/last.ply"
            )

    def load_state_dict(self, checkpoint: Mapping[str, Any]) -> None:
        state, device = checkpoint["deletion"], self.context.device
        self.thing, self.pictures, self._counts = state["thing"].to(device), state["pictures"], state["counts"]
        self.start = Gaussians(**state["start"]).to(device)


def to_bytes(image: Tensor) -> Tensor:
    """A picture [H,W,3] in [0,1] in 8 bits, on the CPU."""
    return (image * 255).round().to("cpu", torch.uint8)
