"""Splats edited by one sentence: renders of the scene, a prior's opinion of them, and the way back into the splats."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import plugin
from ..cache import ByteCache
from ..config import Count, Fraction, NonNegative
from ..data.camera import Cameras
from ..demo.edits import normalised
from ..errors import ConfigError, SceneError, choose
from ..guidance.guidance import Guidance, GuidanceConfig, chosen_prior
from ..loss.anchor import AnchorConfig, anchor_loss, anchor_step
from ..loss.perceptual import Lpips
from ..render.api import Render
from ..report.metrics import psnr
from ..report.pictures import write_png
from ..scene.edit import Splats
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from ..scene.ply import read_splats, write_ply
from ..segment.api import MaskConfig
from .confine import Start, confine
from .densify import DensifyConfig
from .finite import require_finite
from .plan import Draft, describe_edit
from .preview import PreviewConfig, preview_sheet
from .system import SplatSystem
from .truth import Truth, find_truth

REGIONS = ("current", "start", "everywhere")
PHOTO_WARNING_DB = 15.0  # below it a source render and its photograph have hardly anything in common


@dataclass(frozen=True)
class PromptConfig:
    """What is wanted, in words."""

    prompt: str = ""  # the instruction (a description where the prior is a text-to-image model)
    source_prompt: str = ""  # a description of the source, for rules that compare with it (dds, pds)

    def __post_init__(self) -> None:
        if not self.prompt.strip():
            raise ConfigError('prompt: is empty. Say what is wanted, e.g. prompt="Make it sunset".')


@dataclass(frozen=True)
class LossConfig:
    """What is minimised, as a sum of terms; the anchors' weights stand in `anchor`."""

    lambda_guidance: NonNegative = 1.0  # of the rule's loss (GaussianEditor's lambda_l1 = 10 for pictures)
    region: str = "current"  # what a mask lets change of an image: current | start | everywhere (as published)
    reach: Fraction = 0.06  # so far beyond the editable splats of the moment, a fraction of the longer side
    lambda_outside: NonNegative = 3.0  # of L1 to the source where no editable splat is seen
    lambda_perceptual: NonNegative = 0.0  # of LPIPS, for rules that deliver a picture (GaussianEditor's lambda_p = 10)
    perceptual_weights: str = ""  # a folder with VGG-16's and LPIPS's weight files (loss/perceptual.py)

    def __post_init__(self) -> None:
        choose("region", self.region, REGIONS, "region")
        if self.lambda_perceptual and not self.perceptual_weights:
            raise ConfigError(
                "perceptual_weights: is empty. LPIPS needs the folder that holds its two weight files; or set "
                "lambda_perceptual=0"
            )


def warn_of_unknown(taught: Mapping[str, Sequence[str]] | None, prompt: str) -> None:
    """Say so where a prior that was taught a list of edits has not heard of this one."""
    if taught is None or normalised(prompt) in {normalised(text) for texts in taught.values() for text in texts}:
        return
    plugin.warn(
        f'"{prompt}" is nothing that this small model was taught, and what comes of it is chance. It knows, in several '
        f"wordings: {', '.join(taught)}. InstructPix2Pix is open to any instruction: configs/dc-ge-ip2p.yaml"
    )


def widened(share: Tensor, reach: float) -> Tensor:
    """[B,H,W,1]: the largest value within `reach` (a fraction of the longer side) of each pixel."""
    pixels = round(reach * max(share.shape[1:3]))
    grown = torch.nn.functional.max_pool2d(share.permute(0, 3, 1, 2), 2 * pixels + 1, stride=1, padding=pixels)
    return grown.permute(0, 2, 3, 1)


@dataclass(frozen=True)
class EditDensifyConfig(DensifyConfig):
    """Density control of an edit: the source has large splats of its own, a sky for one, which are no mistake."""

    max_size: NonNegative = 0.0
    max_splats: Count = 5_000_000  # a scene of one's own may have millions to begin with; an edit adds few to them


@plugin.register("dreamcatalyst-edit-system")
class EditSystem(SplatSystem):
    """Edits the splats of gs_source (or of a made world) as the instruction says."""

    parts = {
        **SplatSystem.parts,
        "guidance": GuidanceConfig,
        "prompt_processor": PromptConfig,
        "preview": PreviewConfig,
        "mask": MaskConfig,
        "densify": EditDensifyConfig,
        "anchor": AnchorConfig,
        "loss": LossConfig,
    }

    @dataclass
    class Config(SplatSystem.Config):
        mode: str = ""  # which entry of `steps` the YAML's trainer.max_steps takes: ${system.steps.${system.mode}}
        steps: dict = field(default_factory=dict)  # length of the run in each mode, such as fast and high-quality
        guidance: dict = field(default_factory=dict)
        prompt_processor: dict = field(default_factory=dict)
        preview: dict = field(default_factory=dict)
        original: str = ""  # a PLY of the scene before any edit, where gs_source is an edited one; empty: gs_source
        allow_coarse_fit: bool = False  # edit splats that were fitted to smaller pictures than those of this run
        mask: dict = field(default_factory=dict)  # where the edit may take place
        anchor: dict = field(default_factory=dict)  # what splats are held to, by generation
        source_cache_mib: Count = 1024  # what is kept of renders of the source

    def configure(self) -> None:
        super().configure()
        if self.cfg.mode:
            choose("mode", self.cfg.mode, self.cfg.steps, "system.mode")
        chosen_prior(self.part["guidance"])  # what the kinds of prior and mask take is looked at before any is made
        self.part["mask"].segmenter()
        self.guidance: Guidance | None = None
        self.source: Gaussians | None = None
        self.truth: Truth | None = None
        self.perceptual: Lpips | None = None
        self.generations = self.part["anchor"].generations()
        self.start: Start | None = None
        self._source_views = ByteCache(self.cfg.source_cache_mib * 2**20)
        self._references = ByteCache(self.cfg.source_cache_mib * 2**20)
        self._regions: dict[int, Tensor | None] = {}

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if stage == "fit":
            comments = [] if self.fitted is None else [self.fitted.comment]
            write_ply(self.save_path("source.ply"), self.source.to("cpu"), origin=self.origin, comments=comments)
            self.compare_with_photos()

    def describe(self, draft: Draft) -> None:
        describe_edit(self, draft)

    def prepare(self) -> None:
        """Load the prior and then the source scene, so that a prior or a prompt that will not do is found first."""
        super().prepare()
        if self.guidance is None:
            words: PromptConfig = self.part["prompt_processor"]
            self.guidance = Guidance(self.part["guidance"], words.prompt, words.source_prompt, device=self.root_device)
            self.guidance.stage = self.clock.stage
            warn_of_unknown(self.guidance.prior.instructions, words.prompt)
        losses: LossConfig = self.part["loss"]
        if losses.lambda_perceptual and self.perceptual is None:
            if self.guidance.rule.delivers == "gradient":
                raise ConfigError(
                    f"system.loss.lambda_perceptual: rule '{self.guidance.rule.name}' delivers no picture to compare "
                    "with. Set it to 0, or use the rule in2n."
                )
            self.perceptual = Lpips(losses.perceptual_weights, self.root_device, "system.loss.perceptual_weights")
        if self.source is None:
            self.check_detail()
            given = self.given_scene() if not self.cfg.original else read_splats(self.cfg.original, origin=self.origin)
            self.source = given.to(self.root_device)
            # Splats of one's own are another scene, and a prior that is exact has a truth of its own.
            whole = not (self.cfg.gs_source or self.cfg.original or self.guidance.prior.exact)
            words: PromptConfig = self.part["prompt_processor"]
            told = self.guidance.prior.takes_truth
            self.truth = find_truth(self.data.world if whole or told else None, words.prompt, self.root_device)
            if told and self.truth is not None:
                self.guidance.prior.truth.image = lambda index: self.truth.image(self.draw, self.camera(index))

    @cached_property
    def fitted(self) -> Fitted | None:
        return Fitted.of(self.cfg.gs_source) if self.cfg.gs_source else None

    def check_detail(self) -> None:
        """Refuse splats that were fitted to smaller pictures than the prior is to see: it would judge a blur."""
        if self.fitted is None or not self.data.cfg.source or self.cfg.allow_coarse_fit:
            return
        capture = self.data.open(None, self.cfg.gs_source)
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
        return self.given_scene() if self.cfg.original else self.source

    def make_splats(self, scene: Gaussians) -> Splats:
        state, editable = {}, None
        if self.part["mask"].kind != "none" and not self.resumed:  # a checkpoint knows what is editable
            scene, state, editable = confine(self, scene)
            if editable is None:
                self.guidance.forget_views()  # a mask is sought in clamped renders
            else:
                self.begin_at(scene, editable)
        splats = Splats(scene, state, editable)
        if self.generations is not None:
            self.generations.begin(splats)
        return splats

    def after_update(self) -> None:
        anchor_step(self.splats, self.generations, self.part["anchor"])

    def begin_at(self, scene: Gaussians, editable: Tensor) -> None:
        """Remember what a confined edit began with: bool [N], which splats of `scene` may change."""
        self.start = Start(scene, editable, is_source=not self.cfg.original)
        self._source_views.clear()  # drawn otherwise from here on
        self.guidance.forget_views()

    @torch.no_grad()
    def source_view(self, index: int) -> tuple[Tensor, Tensor | None]:
        """The source at one view, [H,W,3], drawn once, and where it may change, [H,W,1] in [0,1] (None: everywhere).

        As renders of the edit it is not clamped, and it is drawn in the same way: where nothing was edited, the two
        must be equal to the bit.
        """
        return self._source_views.get(index, lambda: self._draw_source(self.camera(index)))

    def _draw_source(self, camera: Cameras) -> tuple[Tensor, Tensor | None]:
        if self.start is None:
            return self.draw(self.source, camera).rgb[0], None
        begun = self.draw(self.start.scene, camera, features=self.start.share)
        if not self.start.is_source:
            return self.draw(self.source, camera).rgb[0], begun.features[0]
        if self.splats is None:
            return begun.rgb[0], begun.features[0]
        return self.draw(self.start.edited, camera, frozen=self.frozen).rgb[0], begun.features[0]

    @torch.no_grad()
    def editable_share(self, index: list[int]) -> Tensor | None:
        """How much of each pixel of these views is of editable splats, [B,H,W,1] in [0,1]: of those of the moment, or
        with loss.region=start of those that the run began with. None where all of all may change."""
        losses: LossConfig = self.part["loss"]
        if self.start is None or losses.region == "everywhere":
            return None
        if losses.region == "start":
            return torch.stack([self.source_view(i)[1] for i in index])
        scene, camera = self.splats.scene.detach(), self.camera(index)
        share = scene.means.new_ones(len(scene), 1)
        share[: len(scene) - len(self.splats)] = 0
        return self.draw(scene, camera, features=share).features

    def source_render(self, index: int) -> Tensor:
        """The source at one view, [H,W,3], not clamped."""
        return self.source_view(index)[0]

    def compare_with_photos(self) -> None:
        """Warn where renders of the source have nothing to do with the photographs of the same cameras; a made world's
        are its own renders."""
        world = self.data.world
        if not self.capture.has_photos and (world is None or not self.cfg.gs_source):
            return
        some = self.capture.train[:: max(1, len(self.capture.train) // 4)][:4]
        if world is None:
            photos = [self.capture.image(i) for i in some]
        else:
            photos = [self.draw(world.scene.to(self.root_device), self.camera(i)).rgb[0].cpu() for i in some]
        values = [psnr(self.source_render(i)[None].cpu(), photo[None]) for i, photo in zip(some, photos, strict=True)]
        mean = float(torch.cat(values).mean())
        if mean < PHOTO_WARNING_DB:
            plugin.warn(
                f"the splats' renders and the photographs of {self.capture.source} differ by {mean:.1f} dB PSNR "
                f"(under {PHOTO_WARNING_DB:.0f}): do these cameras and these splats belong together? "
                "data.source= left empty puts cameras around the splats"
            )

    def step_loss(self, batch: Mapping[str, Any], step: int) -> tuple[dict[str, Tensor], Render, dict[str, float]]:
        index, losses = batch["index"], self.part["loss"]
        render = self.draw_now(self.camera(index))
        require_finite("render", colours=render.rgb)
        views = [self.source_view(i) for i in index]
        sources, shown = torch.stack([source for source, _ in views]), render.rgb
        share = self.editable_share(index)
        if share is not None:  # elsewhere the prior sees the source, and asks for nothing
            shown = torch.lerp(sources, shown, widened(share, losses.reach if losses.region == "current" else 0.0))
        given = self.guidance.step(shown, sources, index, step, self.max_steps, batch.get("visit"))
        numbers = {"t": given.timestep, "residual": given.gradient_rms}
        terms = {"guidance": losses.lambda_guidance * given.loss}
        if share is not None and losses.lambda_outside:
            leak = self.guidance.in_balance(((1 - share) * (render.rgb - sources)).abs().mean(), given)
            terms["outside"], numbers["outside"] = losses.lambda_outside * leak, float(leak.detach())
        if self.perceptual is not None:
            distance = self.perceptual(shown, given.target)
            terms["perceptual"] = losses.lambda_perceptual * distance
            numbers["perceptual"] = float(distance.detach())
        if self.generations is not None and self.part["anchor"].form == "loss":
            terms["anchor"] = anchor_loss(self.splats, self.generations, self.part["anchor"])
            numbers["anchor"] = float(terms["anchor"].detach())
        return terms, render, numbers

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint["guidance"] = self.guidance.state_dict()
        if self.generations is not None:
            checkpoint["generations"] = self.generations.state_dict()
        if self.start is not None:
            checkpoint["editable"] = self.start.editable

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "guidance" not in checkpoint:
            raise SceneError(
                "resume: the checkpoint is of a run without guidance, such as a fit, and an edit cannot go on from it. "
                "Begin an edit of its splats: system.gs_source=<that run>/save/last.ply"
            )
        super().on_load_checkpoint(checkpoint)
        self.guidance.load_state_dict(checkpoint["guidance"])
        if self.generations is not None:
            self.generations.load_state_dict(checkpoint.get("generations", {"weights": []}), self.splats)
        if "editable" in checkpoint:
            self.begin_at(self.first_scene().to(self.root_device), checkpoint["editable"].to(self.root_device))

    @property
    def title(self) -> str:
        return self.part["prompt_processor"].prompt

    def timestep(self, step: int) -> int | None:
        if self.guidance.rule.delivers != "gradient":
            return None
        return self.guidance.schedule.timestep(step, self.max_steps, self.guidance.prior.alphas_cumprod)

    @torch.no_grad()
    def references(self, index: int) -> dict[str, Tensor]:
        return self._references.get(index, lambda: self._make_references(index))

    def _make_references(self, index: int) -> dict[str, Tensor]:
        source = self.source_render(index)
        if self.truth is not None:
            return {"truth": self.truth.image(self.draw, self.camera(index)), "source": source}
        known = self.guidance.known_edit(source, index)
        if known is None:
            return {"source": source}
        rest = self.guidance.expected(source, index)
        apart = rest is not None and not torch.allclose(rest, known, atol=1e-3)  # a balanced prior rests at its edit
        return {"edit": known, **({"fixed_point": rest} if apart else {}), "source": source}

    def region(self, index: int) -> Tensor | None:
        """The thing itself where the truth is known, else what the mask lets change; None for an edit of everything."""
        if self.truth is not None:
            if index not in self._regions:
                self._regions[index] = self.truth.region(self.draw, self.camera(index))
            return self._regions[index]
        return None if self.start is None else self.source_view(index)[1].round()

    def known_scenes(self) -> dict[str, Gaussians]:
        return {"source": self.source, **({} if self.truth is None else {"truth": self.truth.scene})}

    def panels(self, index: int) -> list[tuple[str, Tensor]]:
        source, references = self.source_render(index), self.references(index)
        shown = [("source", source), (f"edited, step {self.true_global_step}", self.picture(index))]
        names = {"truth": "the truth", "edit": "the prior's edit"}
        return [*shown, *((label, references[name]) for name, label in names.items() if name in references)]

    def video_frame(self, cameras: Cameras) -> list[tuple[str, Tensor]]:
        edited = self.draw_now(cameras).rgb[0]
        return [("source", self.draw(self.source, cameras).rgb[0]), ("edited", edited)]

    def preview(self, data: Any) -> list[Path]:
        """Write what the prior itself makes of one source render, over prompts and guidance scales, without a run."""
        self._data = data
        self.prepare()
        config: PreviewConfig = self.part["preview"]
        capture = data.open(self.source, self.cfg.gs_source)
        index = data.held_out[0] if config.view is None else config.view
        if not 0 <= index < len(capture):
            raise ConfigError(f"system.preview.view: got {index}, expected 0 to {len(capture) - 1}.")
        sheet = preview_sheet(self.guidance, self.source_render(index), index, config)
        return [write_png(self.save_path("preview.png"), sheet)]
