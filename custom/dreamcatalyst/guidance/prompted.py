"""A prior with its instruction: text, source views and noise, each computed once or drawn by a key."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from ..cache import ByteCache
from ..diffusion.api import Prior
from ..diffusion.closed_form import ClosedForm
from ..diffusion.noise import keyed_generator, keyed_noise
from .config import GuidanceConfig
from .ddim import edit_image
from .timesteps import Schedule

VIEW_BYTES = 2**30  # of latents and conditions of source views that are kept at most


class PromptedPrior:
    """What rules ask of a prior. text, source_text: from `Prior.embed`, None for the null instruction. schedule: of the
    timesteps. stage(name): a context manager around "encode" and "unet", for a clock."""

    def __init__(self, config: GuidanceConfig, prior: Prior, schedule: Schedule, prompt: str):
        self.config, self.prior, self.schedule, self.prompt = config, prior, schedule, prompt
        self.text = self.source_text = None
        self.stage: Callable[[str], AbstractContextManager] = nullcontext
        self._views, self._deviations = ByteCache(VIEW_BYTES), ByteCache(VIEW_BYTES)

    @property
    def scales(self) -> tuple[float, float]:
        """(w_y, w_I)."""
        return self.config.guidance_scale, self.config.condition_scale

    @property
    def closed_form(self) -> ClosedForm:
        """The prior, to be asked for where it is `exact`: then it has spreads, a mean and known edits."""
        return cast(ClosedForm, self.prior)

    # --- source views

    @torch.no_grad()
    def encode_source(self, source: Float[Tensor, "H W 3"], index: int) -> tuple[Float[Tensor, "1 C h w"], Any]:
        """Latents (the posterior's mode, where the prior draws them at every use) and condition of the source
        render of view `index`; computed once for each, as long as there is room (1 GiB)."""
        image = source.permute(2, 0, 1)[None]
        return self._views.get(index, lambda: (self.prior.encode(image), self.prior.condition_of(image, index)))

    def forget_sources(self) -> None:
        """Encode source views anew: the source is drawn otherwise from here on."""
        self._views.clear()
        self._deviations.clear()

    @torch.no_grad()
    def source_latents(self, source: Float[Tensor, "H W 3"], index: int, step: int) -> Float[Tensor, "1 C h w"]:
        """Latents of a view's source render, of its posterior where the prior draws them."""
        mode = self.encode_source(source, index)[0]
        if not self.prior.draws_latents:
            return mode
        deviation = self._deviations.get(index, lambda: self.prior.deviation(source.permute(2, 0, 1)[None]))
        return mode + deviation * self._posterior_noise("source", index, step, mode.shape[1:]).to(mode)

    def encode_sources(
        self, sources: Float[Tensor, "B H W 3"] | None, index: Sequence[int], step: int
    ) -> tuple[Float[Tensor, "B C h w"] | None, Any]:
        """Latents and condition of source renders; (None, None) where there are none."""
        if sources is None:
            return None, None
        views = list(zip(sources, index, strict=True))
        latents = [self.source_latents(source, i, step) for source, i in views]
        conditions = [self.encode_source(source, i)[1] for source, i in views]
        return (latents[0], conditions[0]) if len(views) == 1 else (torch.cat(latents), self.prior.stack(conditions))

    # --- renders

    def encode(self, images: Float[Tensor, "B H W 3"], index: Sequence[int], step: int) -> Float[Tensor, "B C h w"]:
        """Latents of renders, with a graph."""
        images = images.permute(0, 3, 1, 2)
        if not self.prior.draws_latents:
            return self.prior.encode(images)
        noise = [self._posterior_noise("edited", i, step, self.prior.latent_shape(images)) for i in index]
        return self.prior.encode(images, torch.stack(noise).to(images.device))

    def decode(self, latents: Float[Tensor, "1 C h w"], source: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Latents as an image of the size of `source`."""
        return self.prior.decode(latents)[0].permute(1, 2, 0)[: source.shape[0], : source.shape[1]]

    def edit_image(
        self,
        source: Float[Tensor, "H W 3"],
        index: int,
        latents: Float[Tensor, "1 C h w"] | None,
        noise: Float[Tensor, "1 C h w"],
        **options: Any,
    ) -> Float[Tensor, "H W 3"]:
        """The prior's edit in [0,1] of latents (None: of noise alone), conditioned on the source
        render of a view. options: of ddim.edit_image; text and guidance_scale are the run's where not given."""
        edited = edit_image(
            self.prior,
            latents,
            noise,
            image=self.encode_source(source, index)[1],
            image_guidance_scale=self.config.condition_scale,
            set_alpha_to_one=self.config.set_alpha_to_one,
            **{"text": self.text, "guidance_scale": self.config.guidance_scale, **options},
        )
        return self.decode(edited, source)

    def sample(
        self, source: Float[Tensor, "H W 3"], index: int, prompt: str, guidance_scale: float, steps: int
    ) -> Float[Tensor, "H W 3"]:
        """The prior's own edit of a source render, without any rule, in [0,1]."""
        text = self.text if prompt == self.prompt else self.prior.embed([prompt])[0]
        noise = self.noise(self.encode_source(source, index)[0], [index], 0)
        return self.edit_image(source, index, None, noise, text=text, guidance_scale=guidance_scale, steps=steps)

    # --- noise

    def noise(self, latents: Float[Tensor, "_ C h w"], index: Sequence[int], step: int) -> Float[Tensor, "B C h w"]:
        """Standard normal noise for latents of the views `index`, a function of seed, step and view."""
        shape, dtype, device = latents.shape[1:], latents.dtype, latents.device
        return torch.stack([keyed_noise(self.config.seed, step, i, shape, dtype, device) for i in index])

    def _posterior_noise(self, branch: str, index: int, step: int, shape: Sequence[int]) -> Float[Tensor, "C h w"]:
        generator = keyed_generator(self.config.seed, "posterior", branch, step, index)
        return torch.randn(tuple(shape), generator=generator)
