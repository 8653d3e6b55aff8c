"""What every change of a scene has that is there already: the source, its renders, where it may change, and the truth
that the outcome is compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from .. import plugin
from ..cache import ByteCache
from ..data.camera import Cameras
from ..data.truth import GroundTruth
from ..errors import ConfigError
from ..report.clock import Clock
from ..report.metrics import psnr
from ..report.run import Panels
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from ..scene.ply import write_ply
from ..segment.api import MaskConfig, MaskRequest
from .method import Method, MethodParts
from .region import EditRegion
from .source import SourceViews

PHOTO_WARNING_DB = 15.0  # below it a source render and its photograph have hardly anything in common


@dataclass(frozen=True)
class SourcedParts(MethodParts):
    """The parsed sections of a method that changes a part of a scene."""

    mask: MaskConfig


class SourcedMethod(Method):
    """Base of methods that change splats of gs_source (or those that the capture carries).

    source: the scene before, and its views; `load_source` makes it. truth: what it should become, where that is known.
    """

    part: SourcedParts
    source: SourceViews

    def __init__(self, cfg: Any, part: SourcedParts, clock: Clock):
        super().__init__(cfg, part, clock)
        part.mask.segmenter()  # what the kind of mask takes is looked at before anything is loaded
        self.truth: GroundTruth | None = None
        self._references = ByteCache(self._cache_bytes)
        self._regions: dict[int, Tensor | None] = {}

    @property
    def _cache_bytes(self) -> int:
        return self.cfg.source_cache_mib * 2**20

    # --- a scene to begin with

    def load_source(self) -> None:
        """Read the scene before. Raises ConfigError, DataError and SceneError."""
        self.check_detail()
        scene = self.scene_before().to(self.context.device)
        self.source = SourceViews(scene, self.draw, self.camera, lambda: self._splats, self._cache_bytes)

    def scene_before(self) -> Gaussians:
        """The splats that count as the source."""
        return self.given_scene()

    def first_scene(self) -> Gaussians:
        return self.source.scene

    @cached_property
    def fitted(self) -> Fitted | None:
        return Fitted.of(self.cfg.gs_source) if self.cfg.gs_source else None

    def check_detail(self) -> None:
        """Refuse splats that were fitted to smaller pictures than those of this run: it would work on a blur."""
        data = self.context.data
        if self.fitted is None or not data.cfg.source or self.cfg.allow_coarse_fit:
            return
        capture = data.open(None, self.cfg.gs_source)
        views = [capture.views[i] for i in capture.train]
        times = self.fitted.too_coarse_for(views)
        if times is not None:
            fit, shown = self.fitted, Fitted.at(views)
            side = math.ceil(max(fit.width, fit.height) * times)
            raise ConfigError(
                f"system.gs_source: '{self.cfg.gs_source}' was {fit.comment}, and this run draws it at {shown.width} x "
                f"{shown.height}, focal length {shown.focal:.1f}: the prior would see it blurred. Fit it again with "
                f"data.max_side={side} (configs/fit.yaml), or set system.allow_coarse_fit=true"
            )

    def mask_request(self, scene: Gaussians) -> MaskRequest:
        """What a segmenter may know of the run."""
        capture, renderer = self.context.data.open(scene, self.cfg.gs_source), self.part.renderer
        return MaskRequest(
            scene=scene,
            cameras=[capture.cameras([i]) for i in range(len(capture.views))],
            names=[view.name for view in capture.views],
            views=capture.train,
            extent=capture.extent,
            render=lambda index: self.source.render(index).clamp(0, 1),
            backend=renderer.backend,
            antialiased=renderer.antialiased,
            background=renderer.background,
            origin=self.origin,
        )

    def begin_at(self, scene: Gaussians, editable: Tensor, is_source: bool = True) -> None:
        """Remember what a confined change began with: bool [N], which splats of `scene` may change. is_source: whether
        it is the source, too, and not a change of it."""
        self.source.restrict(EditRegion(scene, editable, is_source))

    def scene_to_keep(self) -> Gaussians:
        """What the run writes as its source: a copy of it undoes the change."""
        return self.source.scene

    def begin_training(self) -> None:
        comments = [] if self.fitted is None else [self.fitted.comment]
        path, scene = self.context.save("source.ply"), self.scene_to_keep().to("cpu")
        write_ply(path, scene, origin=self.origin, comments=comments)
        self.compare_with_photos()

    def compare_with_photos(self) -> None:
        """Warn where renders of the source have nothing to do with the photographs of the same cameras."""
        capture = self.capture
        if not capture.has_photos or (capture.scene is not None and not self.cfg.gs_source):  # then they are the same
            return
        some = capture.train[:: max(1, len(capture.train) // 4)][:4]
        photos = [self.photo(i).cpu() for i in some]
        values = [psnr(self.source.render(i)[None].cpu(), photo[None]) for i, photo in zip(some, photos, strict=True)]
        mean = float(torch.cat(values).mean())
        if mean < PHOTO_WARNING_DB:
            plugin.warn(
                f"the splats' renders and the photographs of {capture.source} differ by {mean:.1f} dB PSNR "
                f"(under {PHOTO_WARNING_DB:.0f}): do these cameras and these splats belong together? "
                "data.source= left empty puts cameras around the splats"
            )

    # --- what it is compared with

    @torch.no_grad()
    def references(self, index: int) -> dict[str, Tensor]:
        return self._references.get(index, lambda: self.make_references(index))

    def make_references(self, index: int) -> dict[str, Tensor]:
        """What `references` keeps."""
        source = self.source.render(index)
        return {"source": source} if self.truth is None else {"truth": self.true_image(index), "source": source}

    def true_image(self, index: int) -> Tensor:
        """What one view should become, [H,W,3], where that is known."""
        return self.truth.image(self.draw, self.camera(index))

    def region(self, index: int) -> Tensor | None:
        """The thing itself where the truth is known, else what the mask lets change; None for an edit of everything."""
        if self.truth is not None:
            if index not in self._regions:
                self._regions[index] = self.truth.region(self.draw, self.camera(index))
            return self._regions[index]
        share = self.source.view(index)[1]
        return None if share is None else share.round()

    def known_scenes(self) -> dict[str, Any]:
        return {"source": self.source.scene, **({} if self.truth is None else {"truth": self.truth.scene})}

    def panels(self, index: int) -> Panels:
        source, references = self.source.render(index), self.references(index)
        shown = [("source", source), (f"edited, step {self.context.step()}", self.picture(index))]
        names = {"truth": "the truth", "edit": "the prior's edit"}
        return [*shown, *((label, references[name]) for name, label in names.items() if name in references)]

    def video_frame(self, cameras: Cameras) -> Panels:
        edited = self.draw_now(cameras).rgb[0]
        return [("source", self.draw(self.source.scene, cameras).rgb[0]), ("edited", edited)]
