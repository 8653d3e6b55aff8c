"""How splats are edited: renders of the scene, what guidance makes of them, and the way back into the splats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import plugin
from ..data.truth import normalised
from ..errors import ConfigError, PriorError, SceneError, choose, nearest
from ..guidance.config import chosen_prior
from ..guidance.guidance import Guidance
from ..loss.anchor import anchor_loss, anchor_step
from ..loss.perceptual import Lpips
from ..render.api import Render
from ..report.clock import Clock
from ..report.pictures import write_png
from ..scene.formats.api import read_splats
from ..scene.gaussians import Gaussians
from ..scene.trainable import Splats
from ..segment.api import MaskRequest
from .edit_config import EditParts
from .finite import require_finite
from .plan import PlanBuilder, scene_bytes
from .preview import preview_sheet
from .region import dilate, restrict_to_mask
from .sourced import SourcedMethod


def warn_of_unknown(taught: Mapping[str, Sequence[str]] | None, prompt: str) -> None:
    """Say so where a prior that was taught a list of edits has not heard of this one."""
    if taught is None or normalised(prompt) in {normalised(text) for texts in taught.values() for text in texts}:
        return
    plugin.warn(
        f'"{prompt}" is nothing that this small model was taught, and what comes of it is chance. It knows, in several '
        f"wordings: {', '.join(taught)}. InstructPix2Pix is open to any instruction: configs/dc-ge-ip2p.yaml"
    )


class EditMethod(SourcedMethod):
    """Edits the splats of gs_source (or those that the capture carries) as the instruction says.

    guidance: the prior with its rule; `prepare` loads it and the scene before the edit. perceptual: LPIPS, where the
    loss has it.
    """

    part: EditParts
    guidance: Guidance

    def __init__(self, cfg: Any, part: EditParts, clock: Clock):
        super().__init__(cfg, part, clock)
        if cfg.mode:
            choose("mode", cfg.mode, cfg.steps, "system.mode")
        chosen_prior(part.guidance)  # what the kind of prior takes is looked at before any is made
        self.perceptual: Lpips | None = None
        self.generations = part.anchor.generations()
        self._loaded = self._prepared = False

    @property
    def title(self) -> str:
        return self.part.prompt_processor.prompt

    # --- a scene to begin with

    def load_prior(self) -> None:
        """Load the prior and what else knows nothing of the scene. Raises PriorError and ConfigError."""
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
        self._loaded = True

    def prepare(self) -> None:
        """Load the prior and then the source scene, so that a prior or a prompt that will not do is found first."""
        super().prepare()
        if self._prepared:
            return
        if not self._loaded:
            self.load_prior()
        self.load_source()
        self._find_truth()
        self._prepared = True

    def scene_before(self) -> Gaussians:
        return self.given_scene() if not self.cfg.original else read_splats(self.cfg.original, origin=self.origin)

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
        prompt = self.part.prompt_processor.prompt
        return replace(super().mask_request(scene), guidance=self.guidance, prompt=prompt)

    def begin_at(self, scene: Gaussians, editable: Tensor, is_source: bool = True) -> None:
        super().begin_at(scene, editable, is_source and not self.cfg.original)
        self.guidance.forget_sources()

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

    def make_references(self, index: int) -> dict[str, Tensor]:
        source = self.source.render(index)
        if self.truth is not None:
            return super().make_references(index)
        known = self.guidance.known_edit(source, index)
        if known is None:
            return {"source": source}
        rest = self.guidance.objective.expected(source, index)
        if rest is None or torch.allclose(rest, known, atol=1e-3):  # a balanced prior rests at its edit
            return {"edit": known, "source": source}
        return {"edit": known, "fixed_point": rest, "source": source}

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
