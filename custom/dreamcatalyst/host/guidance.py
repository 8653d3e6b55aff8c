"""The rules inside threestudio's own systems: what takes its guidance's calls and gives what that gives.

Swapping is one line, `system.guidance_type=dreamcatalyst-edit-guidance` (or `dreamcatalyst-guidance`); the keys of the
guidance that stood there may stay in the YAML.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor

from .. import plugin
from ..config import check, corners, parse
from ..diffusion.noise import stable_diffusion_schedule
from ..errors import ConfigError
from ..guidance.config import GuidanceConfig, chosen_rule, chosen_schedule
from ..guidance.guidance import Guidance
from .config import WITHOUT_EFFECT, HostConfig, prior_options

LIMITS = ("min_step_percent", "max_step_percent")
PICTURES = (".png", ".jpg", ".jpeg")
WHICH = (
    "dreamcatalyst-edit-guidance gives edit_images, for systems that replace their pictures by edited ones "
    "(instructnerf2nerf-system, control4d-multiview-system); dreamcatalyst-guidance gives a loss, for systems that add "
    "one at every step (dreamfusion-system and its like)"
)


class Answer(dict):
    """What the host gets. Asked for what is not in it, it says which guidance gives that."""

    def __missing__(self, key: str) -> Any:
        name = key.removeprefix("loss_")
        ours = [given for given in self if given.startswith("loss_")]
        if ours and name != key:
            raise ConfigError(
                f"system.guidance.loss_name: this system asks for {key}, got {ours[0]}. Set it to {name}."
            )
        raise ConfigError(f"system.guidance_type: this system asks for {key}, got {', '.join(self)}. {WHICH}.")


class HostGuidance(plugin.BaseObject):
    """What the two guidances share: the calls, the text, the source images, and where the run stands.

    Calls: (rgb, cond_rgb, prompt_utils); (rgb, prompt_utils, **batch); (rgb, origin, target_utils, source_utils).
    Images are [B,H,W,3] in [0,1], of any size. The source image is the one that is passed, or `gt_rgb` of the batch, or
    the reference of the view's `index`. The prior is loaded when the host builds the guidance, so that one that will
    not do is found before any training. Everything that is drawn at random is a function of seed, step and source
    image; the step is the one that the host announced last.
    """

    Config = HostConfig
    cfg: HostConfig

    def __init__(self, cfg: Any = None, *args: Any, **kwargs: Any):
        # The host's own parser knows neither the nearest key nor ranges.
        check(type(self), cfg, "system.guidance")
        super().__init__(cfg or {}, *args, **kwargs)

    def configure(self) -> None:
        self._epoch = self._step = 0
        ours = {f.name: getattr(self.cfg, f.name) for f in fields(GuidanceConfig)} | {"prior": prior_options(self.cfg)}
        self._settings: GuidanceConfig = parse(GuidanceConfig, {**ours, **self._limits(0, 0)}, "system.guidance")
        self.rule = chosen_rule(self._settings)
        self.schedule = chosen_schedule(self._settings, self.rule)
        limits = [limit for name in LIMITS if (limit := getattr(self.cfg, name)) is not None]
        for time in {time for limit in limits for time in corners(limit)}:
            chosen_schedule(replace(self._settings, **self._limits(time, time)), self.rule)  # where they are extreme
        self._references = self._find_references()
        unused = [
            f"system.guidance.{name} ({why})"
            for name, why in WITHOUT_EFFECT.items()
            if getattr(self.cfg, name) is not None
        ]
        if unused:
            plugin.info(f"keys of another guidance, which have no effect on {type(self).__name__}: {', '.join(unused)}")
        self.check()
        self._guidance = Guidance(self._settings, self.cfg.prompt, self.cfg.source_prompt, self.device)

    def check(self) -> None:
        """What can be said of the settings before the prior is loaded. Raises ConfigError."""

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Told by the host before each batch, sometimes more than once."""
        self._epoch, self._step = epoch, global_step

    def set_min_max_steps(self, min_step_percent: float, max_step_percent: float) -> None:
        """The limits of the noise level from now on; some of the host's systems set them."""
        self.cfg.min_step_percent, self.cfg.max_step_percent = min_step_percent, max_step_percent

    def _limits(self, epoch: float, step: float) -> dict[str, float]:
        """The limits of the noise level that are set; they may follow a schedule."""
        limits = {name: getattr(self.cfg, name) for name in LIMITS}
        return {name: plugin.C(limit, epoch, step) for name, limit in limits.items() if limit is not None}

    def settings(self) -> GuidanceConfig:
        """The guidance's config at this moment."""
        return replace(self._settings, **self._limits(self._epoch, self._step))

    def __call__(self, rgb: Float[Tensor, "B H W 3"], *args: Any, **batch: Any) -> Answer:
        for flag in ("rgb_as_latents", "guidance_eval", "test_info"):
            if batch.get(flag):
                raise ConfigError(
                    f"{type(self).__name__}: {flag} is asked for by this system; only images can be guided"
                )
        guidance = self._guidance
        guidance.schedule = chosen_schedule(self.settings(), self.rule)  # its limits may follow the host's steps
        rgb = rgb.to(torch.promote_types(rgb.dtype, torch.float32))
        images = self._resized(rgb, self._encoded_size(rgb))
        sources = self._sources(args, batch, images)
        self._set_text(guidance, [a for a in (*args, *batch.values()) if hasattr(a, "get_text_embeddings")], batch)
        views = list(range(len(rgb))) if sources is None else [content_key(source) for source in sources]
        return Answer(self.answer(guidance, images, sources, views, rgb))

    def answer(
        self,
        guidance: Guidance,
        images: Float[Tensor, "B h w 3"],
        sources: Float[Tensor, "B h w 3"] | None,
        views: list[int],
        rgb: Float[Tensor, "B H W 3"],
    ) -> dict[str, Any]:
        """What the host gets. images, sources: at the size at which they are encoded; rgb as it was passed."""
        raise NotImplementedError

    # --- images

    def _encoded_size(self, rgb: Float[Tensor, "B H W 3"]) -> tuple[int, ...]:
        return (self.cfg.fixed_size, self.cfg.fixed_size) if self.cfg.fixed_size > 0 else tuple(rgb.shape[1:3])

    @staticmethod
    def _resized(images: Float[Tensor, "B H W 3"], size: Sequence[int]) -> Float[Tensor, "B h w 3"]:
        if tuple(images.shape[1:3]) == tuple(size):
            return images
        resized = F.interpolate(images.permute(0, 3, 1, 2), tuple(size), mode="bilinear", antialias=True)
        return resized.permute(0, 2, 3, 1)

    def _sources(
        self, args: Sequence[Any], batch: dict[str, Any], images: Float[Tensor, "B h w 3"]
    ) -> Float[Tensor, "_ h w 3"] | None:
        given = next((a for a in args if isinstance(a, Tensor)), batch.get("gt_rgb"))
        if given is None and self._references and "index" in batch:
            given = self._reference(batch["index"])
        if given is None and (self.rule.needs_source or self._guidance.prior.takes_image):
            raise ConfigError(
                f"system.guidance: rule '{self.rule.name}' on prior {self.cfg.prior_type} needs the image that is "
                "edited, and this system passes none. Use a data module that gives gt_rgb, such as "
                "multiview-camera-datamodule, or set system.guidance.references to a folder with one image for each "
                "view's index; without any image there is system.guidance.prior_type=sd system.guidance.rule=sds."
            )
        return None if given is None else self._resized(given.detach().to(images), images.shape[1:3])

    def _find_references(self) -> list[Path]:
        if not self.cfg.references:
            return []
        folder = Path(self.cfg.references).expanduser()
        found = sorted(p for p in folder.glob("*") if p.suffix.lower() in PICTURES)
        if not found:
            fault = "holds none" if folder.is_dir() else "is no folder"
            raise ConfigError(
                f"system.guidance.references: '{folder}' {fault}, expected images ({', '.join(PICTURES)})."
            )
        return found

    def _reference(self, index: int | Shaped[Tensor, ...]) -> Float[Tensor, "B H W 3"]:
        """The reference images of the views `index`."""
        from PIL import Image

        views = torch.as_tensor(index).reshape(-1).tolist()
        if max(views) >= len(self._references):
            raise ConfigError(
                f"system.guidance.references: '{self.cfg.references}' holds {len(self._references)} images, and that "
                f"of view {max(views)} is asked for (counted from 0)"
            )
        loaded = [np.asarray(Image.open(self._references[view]).convert("RGB"), np.float32) / 255 for view in views]
        return torch.from_numpy(np.stack(loaded))

    # --- text

    def _set_text(self, guidance: Guidance, processors: list[Any], batch: dict[str, Any]) -> None:
        """Text for this call, from the prompt processors' outputs: of the target and, if there is one, the source."""
        if self.cfg.prompt:
            return
        if not processors:
            raise ConfigError("system.guidance.prompt: is empty, and this system passes no prompt processor's output")
        asked = processors[: 2 if self.rule.reads_source_text and not self.cfg.source_prompt else 1]
        prior: Any = guidance.prior  # whose text has a width, and a null_text in place of the empty prompt's
        if prior.exact:
            texts = prior.embed([processor.prompt for processor in asked])
        else:
            pairs = [self._host_text(prior, processor, batch) for processor in asked]
            texts, prior.null_text = [text for text, _ in pairs], pairs[0][1]
        guidance.text = texts[0]
        if len(texts) > 1:
            guidance.source_text = texts[1]

    def _host_text(
        self, prior: Any, processor: Any, batch: dict[str, Any]
    ) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "B L D"]]:
        """Embeddings (of one row, or of B) of the prompt and of the negative prompt."""
        directed = self.cfg.view_dependent_prompting and "elevation" in batch
        angles = [batch[name] if directed else torch.zeros(1) for name in ("elevation", "azimuth", "camera_distances")]
        rows = processor.get_text_embeddings(*angles, view_dependent_prompting=directed)
        if rows.shape[-1] != prior.text_width:
            raise ConfigError(
                f"system.prompt_processor: gives text embeddings of width {rows.shape[-1]}, and the U-Net of "
                f"{prior.config.path} takes {prior.text_width}. Set system.prompt_processor_type="
                "stable-diffusion-prompt-processor, system.prompt_processor.pretrained_model_name_or_path to a model "
                "with that text encoder (768: Stable Diffusion 1.5), or system.guidance.prompt for the prior's own."
            )
        return rows.detach().chunk(2)  # the host's order: the rows with text, then those without


def content_key(image: Float[Tensor, "H W 3"]) -> int:
    """A number for an image, the same for the same pixels: a view's name where the host gives it none."""
    data = image.detach().float().cpu().contiguous().numpy().tobytes()
    return int.from_bytes(hashlib.blake2b(data, digest_size=7).digest(), "little")


@plugin.register("dreamcatalyst-guidance")
class LossGuidance(HostGuidance):
    """Gives a loss: for systems that call their guidance at every step, as DreamFusion's does.

    Returns loss_<loss_name> with a graph to rgb, grad_norm (of the rule's gradient on the latents), min_step, max_step.
    """

    def check(self) -> None:
        begin, end = (list(self.schedule.options(at, stable_diffusion_schedule())) for at in (0.0, 1.0))
        if begin != end and not (self.cfg.max_steps or self.cfg.max_iteration):
            raise ConfigError(
                f"system.guidance.max_steps: timesteps of policy '{self.schedule.policy}' go down over the run, and a "
                "guidance cannot see how long that is. Add 'system.guidance.max_steps=${trainer.max_steps}' (in these "
                f"quotes), or system.guidance.timesteps=uniform. Or is it the other guidance that is meant? {WHICH}."
            )

    def answer(
        self,
        guidance: Guidance,
        images: Float[Tensor, "B h w 3"],
        sources: Float[Tensor, "B h w 3"] | None,
        views: list[int],
        rgb: Float[Tensor, "B H W 3"],
    ) -> dict[str, Any]:
        length = self.cfg.max_steps or self.cfg.max_iteration or 1
        given = guidance.step(images, sources, views, self._step, length)
        total, (lowest, highest) = len(guidance.prior.alphas_cumprod), guidance.schedule.limits
        return {
            f"loss_{self.cfg.loss_name}": given.loss,
            "grad_norm": given.gradient.norm(),
            "min_step": int(total * lowest),
            "max_step": int(total * highest),
        }


@plugin.register("dreamcatalyst-edit-guidance")
class EditGuidance(HostGuidance):
    """Gives edited images: for systems that replace their pictures, as Instruct-NeRF2NeRF's does.

    The rule as a sampler on the source's latents, `diffusion_steps` steps long; in2n: the prior's edit of the render.
    Returns edit_images [B,H,W,3] in [0,1], of the size of rgb, without graph. Where the sampler is known to diverge, as
    on the closed-form prior at the scales of a neural one, the constructor raises ConfigError.
    """

    def configure(self) -> None:
        super().configure()
        self._guidance.objective.check_sampler()

    def __call__(self, rgb: Float[Tensor, "B H W 3"], *args: Any, **batch: Any) -> Answer:
        if "rgb_as_latents" in batch:  # only systems that want a loss say this, and would go on without any
            raise ConfigError(
                f"system.guidance_type: this system asks for a loss, got dreamcatalyst-edit-guidance. {WHICH}."
            )
        return super().__call__(rgb, *args, **batch)

    @torch.no_grad()
    def answer(
        self,
        guidance: Guidance,
        images: Float[Tensor, "B h w 3"],
        sources: Float[Tensor, "B h w 3"] | None,
        views: list[int],
        rgb: Float[Tensor, "B H W 3"],
    ) -> dict[str, Any]:
        if sources is None:
            raise ConfigError("system.guidance: an edit needs the image that is edited, and this system passes none")
        edits = [guidance.objective.picture(*each, self._step) for each in zip(images, sources, views, strict=True)]
        return {"edit_images": self._resized(torch.stack(edits), rgb.shape[1:3]).to(rgb)}
