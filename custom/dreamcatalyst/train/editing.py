"""How splats are edited: renders of the scene, what guidance makes of them, and the way back into the splats."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import plugin
from ..cache import ByteCache
from ..data.camera import Cameras
from ..data.truth import GroundTruth, normalised
from ..errors import ConfigError, PriorError, SceneError, choose, nearest
from ..guidance.config import chosen_prior
from ..guidance.guidance import Guidance
from ..loss.anchor import anchor_loss, anchor_step
from ..loss.perceptual import Lpips
from ..render.api import Render
from ..report.clock import Clock
from ..report.metrics import psnr
from ..report.pictures import write_png
from ..report.run import Panels
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from ..scene.ply import read_splats, write_ply
from ..scene.trainable import Splats
from ..segment.api import MaskRequest
from .edit_config import EditParts
from .finite import require_finite
from .method import Method
from .plan import PlanBuilder, scene_bytes
from .preview import preview_sheet
from .region import EditRegion, dilate, restrict_to_mask
from .source import SourceViews

PHOTO_WARNING_DB = 15.0  # below it a source render and its photograph have hardly anything in common


def warn_of_unknown(taught: Mapping[str, Sequence[str]] | None, prompt: str) -> None:
    """Say so where a prior that was taught a list of edits has not heard of this one."""
    if taught is None or normalised(prompt) in {normalised(text) for texts in taught.values() for text in texts}:
        return
    plugin.warn(
        f'"{prompt}" is nothing that this small model was taught, and what comes of it is chance. It knows, in several '
        f"wordings: {', '.join(taught)}. InstructPix2Pix is open to any instruction: configs/dc-ge-ip2p.yaml"
    )


class EditMethod(Method):
    """Edits the splats of gs_source (or those that the capture carries) as the instruction says.

    guidance, source: the prior with its rule, and the scene before the edit; `prepare` loads them. perceptual: LPIPS,
    where the loss has it. truth: what the edit should become, where that is known.
    """

    part: EditParts
    guidance: Guidance
    source: SourceViews

    def __init__(self, cfg: Any, part: EditParts, clock: Clock):
        super().__init__(cfg, part, clock)
        if cfg.mode:
            choose("mode", cfg.mode, cfg.steps, "system.mode")
        chosen_prior(part.guidance)  # what the kinds of prior and mask take is looked at before any is made
        part.mask.segmenter()
        self.truth: GroundTruth | None = None
        self.perceptual: Lpips | None = None
        self.generations = part.anchor.generations()
        self._references = ByteCache(self._cache_bytes)
        self._regions: dict[int, Tensor | None] = {}
        self._prepared = False

    @property
    def _cache_bytes(self) -> int:
        return self.cfg.source_cache_mib * 2**20

    @property
    def title(self) -> str:
        return self.part.prompt_processor.prompt

    # --- a scene to begin with

    def prepare(self) -> None:
        """Load the prior and then the source scene, so that a prior or a prompt that will not do is found first."""
        super().prepare()
        if self._prepared:
            return
        device, words, losses = self.context.device, self.part.prompt_processor, self.part.loss
        self.guidance = Guidance(self.part.guidance, words.prompt, words.source_prompt, device=device)
        self.guidance.stage = self.clock.stage
        warn_of_unknown(self.guidance.prior.instructions, words.prompt)
        if losses.lambda_perceptual:
            if not self.guidance.objective.gives_pictures:
                raise ConfigError(
                    f"system.loss.lambda_perceptual: rule '{self.guidance.rule.name}' delivers no picture to compare "
                    "with. Set it to 0, or use the rule in2n."
                )
            self.perceptual = Lpips(losses.perceptual_weights, device, "system.loss.perceptual_weights")
        self.check_detail()
        scene = self.given_scene() if not self.cfg.original else read_splats(self.cfg.original, origin=self.origin)
        self.source = SourceViews(scene.to(device), self.draw, self.camera, lambda: self._splats, self._cache_bytes)
        self._find_truth()
        self._prepared = True

    def _find_truth(self) -> None:
        # Splats of one's own are another scene, and a prior that is exact has a truth of its own.
        prior, prompt = self.guidance.prior, self.part.prompt_processor.prompt
        whole = not (self.cfg.gs_source or self.cfg.original or prior.exact)
        if not self.context.data.cfg.source or not (whole or prior.takes_truth):
            return
        capture = self.context.data.open()
        truth = capture.truth(prompt)
        self.truth = None if truth is None else truth.to(self.context.device)
        if prior.takes_truth and truth is None and capture.truths is not None:
            known = capture.truths.instructions
            raise PriorError(
                f"system.guidance.prior_type: no outcome of '{prompt}' is known in {capture.source}."
                f"{nearest(prompt, known)} Known, in several wordings: {', '.join(known)}."
            )
        if prior.takes_truth and self.truth is not None:
            truth = self.truth
            prior.tell_truth(lambda index: truth.image(self.draw, self.camera(index)))

    @cached_property
    def fitted(self) -> Fitted | None:
        return Fitted.of(self.cfg.gs_source) if self.cfg.gs_source else None

    def check_detail(self) -> None:
        """Refuse splats that were fitted to smaller pictures than the prior is to see: it would judge a blur."""
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

    def first_scene(self) -> Gaussians:
        return self.given_scene() if self.cfg.original else self.source.scene

    def make_splats(self, scene: Gaussians) -> Splats:
        state, editable = {}, None
        if self.part.mask.kind != "none" and not self.context.resumed:  # a checkpoint knows what is editable
            picture = self.context.save("mask.png")
            masks = picture.parents[2] / "masks"  # of all runs of this name
            scene, state, editable = restrict_to_mask(self.part.mask, self.mask_request(scene), masks, picture)
            if editable is None:
                self.guidance.forget_sources()  # a mask is sought in clamped renders
            else:
                self.begin_at(scene, editable)
        splats = Splats(scene, state, editable)
        if self.generations is not None:
            self.generations.begin(splats)
        return splats

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
            guidance=self.guidance,
            prompt=self.part.prompt_processor.prompt,
            backend=renderer.backend,
            antialiased=renderer.antialiased,
            background=renderer.background,
            origin=self.origin,
        )

    def begin_at(self, scene: Gaussians, editable: Tensor) -> None:
        """Remember what a masked edit began with: bool [N], which splats of `scene` may change."""
        self.source.restrict(EditRegion(scene, editable, is_source=not self.cfg.original))
        self.guidance.forget_sources()

    def begin_training(self) -> None:
        comments = [] if self.fitted is None else [self.fitted.comment]
        path, scene = self.context.save("source.ply"), self.source.scene.to("cpu")
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

    # --- a step

    @torch.no_grad()
    def editable_share(self, index: list[int]) -> Tensor | None:
        """How much of each pixel of these views is of editable splats, [B,H,W,1] in [0,1]: of those of the moment, or
        with loss.region=start of those that the run began with. None where all of all may change."""
        region = self.part.loss.region
        if self.source.region is None or region == "everywhere":
            return None
        if region == "start":
            return torch.stack([share for i in index if (share := self.source.view(i)[1]) is not None])
        scene, camera = self.splats.scene.detach(), self.camera(index)
        share = scene.means.new_ones(len(scene), 1)
        share[: len(scene) - len(self.splats)] = 0
        return self.draw(scene, camera, features=share).features

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[dict[str, Tensor], Render, dict[str, float]]:
        index, losses, max_steps = batch["index"], self.part.loss, self.context.max_steps()
        render = self.draw_now(self.camera(index))
        require_finite("render", colours=render.rgb)
        sources, shown = torch.stack([self.source.render(i) for i in index]), render.rgb
        share = self.editable_share(index)
        if share is not None:  # elsewhere the prior sees the source, and asks for nothing
            shown = torch.lerp(sources, shown, dilate(share, losses.reach if losses.region == "current" else 0.0))
        guided = self.guidance.step(shown, sources, index, step, max_steps, batch.get("visit"))
        numbers = {"t": guided.timestep, "residual": guided.gradient_rms}
        terms = {"guidance": losses.lambda_guidance * guided.loss}
        if share is not None and losses.lambda_outside:
            leak = self.guidance.objective.in_balance(((1 - share) * (render.rgb - sources)).abs().mean(), guided)
            terms["outside"], numbers["outside"] = losses.lambda_outside * leak, float(leak.detach())
        if self.perceptual is not None and guided.target is not None:
            distance = self.perceptual(shown, guided.target)
            terms["perceptual"] = losses.lambda_perceptual * distance
            numbers["perceptual"] = float(distance.detach())
        if self.generations is not None and self.part.anchor.form == "loss":
            terms["anchor"] = anchor_loss(self.splats, self.generations, self.part.anchor)
            numbers["anchor"] = float(terms["anchor"].detach())
        return terms, render, numbers

    def timestep(self, step: int) -> int | None:
        return self.guidance.objective.timestep(step, self.context.max_steps())

    @property
    def pulled(self) -> bool:
        return self.generations is not None and self.part.anchor.form != "loss"

    def after_update(self) -> None:
        anchor_step(self.splats, self.generations, self.part.anchor)

    # --- what it is compared with

    @torch.no_grad()
    def references(self, index: int) -> dict[str, Tensor]:
        return self._references.get(index, lambda: self._make_references(index))

    def _make_references(self, index: int) -> dict[str, Tensor]:
        source = self.source.render(index)
        if self.truth is not None:
            return {"truth": self.truth.image(self.draw, self.camera(index)), "source": source}
        known = self.guidance.known_edit(source, index)
        if known is None:
            return {"source": source}
        rest = self.guidance.objective.expected(source, index)
        if rest is None or torch.allclose(rest, known, atol=1e-3):  # a balanced prior rests at its edit
            return {"edit": known, "source": source}
        return {"edit": known, "fixed_point": rest, "source": source}

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

    def describe(self, plan: PlanBuilder) -> None:
        plan.prior(self.guidance, self.context.data.cfg.batch_size)
        scene = self.source.scene
        plan.add("source", f"{len(scene):,} splats before the edit", scene_bytes(scene))
        plan.mask(self.part.mask.kind)
        plan.anchors(self.part.anchor, self.splats)
        plan.perceptual(self.part.loss.lambda_perceptual)

    def preview(self) -> list[Path]:
        """Write what the prior itself makes of one source render, over prompts and guidance scales."""
        self.prepare()
        config, data = self.part.preview, self.context.data
        capture = data.open(self.source.scene, self.cfg.gs_source)
        index = data.held_out[0] if config.view is None else config.view
        if not 0 <= index < len(capture):
            raise ConfigError(f"system.preview.view: got {index}, expected 0 to {len(capture) - 1}.")
        sheet = preview_sheet(self.guidance, self.source.render(index), index, config)
        return [write_png(self.context.save("preview.png"), sheet)]

    # --- checkpoints

    def state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = {"guidance": self.guidance.state_dict()}
        if self.generations is not None:
            state["generations"] = self.generations.state_dict()
        if self.source.region is not None:
            state["editable"] = self.source.region.editable
        return state

    def check_checkpoint(self, checkpoint: Mapping[str, Any]) -> None:
        if "guidance" not in checkpoint:
            raise SceneError(
                "resume: the checkpoint is of a run without guidance, such as a fit, and an edit cannot go on from it. "
                "Begin an edit of its splats: system.gs_source=<that run>/save/last.ply"
            )

    def load_state_dict(self, checkpoint: Mapping[str, Any]) -> None:
        self.guidance.load_state_dict(checkpoint["guidance"])
        if self.generations is not None:
            self.generations.load_state_dict(checkpoint.get("generations", {"weights": []}), self.splats)
        if "editable" in checkpoint:
            device = self.context.device
            self.begin_at(self.first_scene().to(device), checkpoint["editable"].to(device))
