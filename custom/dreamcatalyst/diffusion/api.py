"""The prior: what an image-editing diffusion model offers to every rule that distils it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from ..errors import PriorError
from ..registry import Registry

PRIORS = Registry("diffusion prior", __package__)
PRIORS.add("closed-form", ".closed_form:ClosedForm")
PRIORS.add("ip2p", ".ip2p:InstructPix2Pix")
PRIORS.add("sd", ".ip2p:StableDiffusion")
PRIORS.add("world-truth", ".world_truth:WorldTruth")


@dataclass(frozen=True)
class Row:
    """One row of a noise prediction: a noisy latent and what it is conditioned on.

    text: what `Prior.embed` returned for one prompt, None for the null instruction;
    image: what `Prior.condition` returned for B images, None for no image.
    """

    noisy: Float[Tensor, "B C h w"]
    text: Any = None
    image: Any = None


class Prior(ABC):
    """A conditional denoiser on latents. Images are [B,3,H,W] in [0,1]; latents [B,C,h,w].

    config: the options that it was built with; a relevance mask that was kept is found again by them.
    alphas_cumprod: on the CPU, abar_t of timestep index t = 0..T-1 (Ho et al. 2020).
    takes_image: whether the image condition means anything (False for text-to-image models).
    exact: whether the edit of an image is known in closed form (`known_edit`).
    draws_latents: whether latents are drawn from a posterior at every use, with noise that the caller gives.
    takes_truth: whether it must be told what each view becomes (diffusion/world_truth.py).
    instructions: all that the prior was taught, wordings by edit; None where it is open to any.
    """

    config: Any
    alphas_cumprod: Float64[Tensor, " T"]
    takes_image: bool = True
    exact: bool = False
    draws_latents: bool = False
    takes_truth: bool = False
    instructions: Mapping[str, Sequence[str]] | None = None

    @property
    def weight_bytes(self) -> int:
        """Memory of the weights; 0 for a prior without any."""
        return 0

    @abstractmethod
    def encode(
        self, images: Float[Tensor, "B 3 H W"], noise: Float[Tensor, "B C h w"] | None = None
    ) -> Float[Tensor, "B C h w"]:
        """Images to scaled latents, differentiable in `images`: the mode of their posterior; with
        noise, standard normal, a draw of it. A prior without a posterior takes no notice of the noise."""

    def latent_shape(self, images: Float[Tensor, "B 3 H W"]) -> tuple[int, ...]:
        """[C,h,w] of the latents of images."""
        return tuple(images.shape[1:])

    def deviation(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """The standard deviation of the posterior of images, in units of latents, without graph."""
        return torch.zeros(len(images), *self.latent_shape(images), dtype=images.dtype, device=images.device)

    @abstractmethod
    def decode(self, latents: Float[Tensor, "B C h w"]) -> Float[Tensor, "B 3 H W"]:
        """Scaled latents to images, clamped to [0,1], without graph."""

    @abstractmethod
    def condition(self, images: Float[Tensor, "B 3 H W"]) -> Any:
        """The image condition of images, without graph."""

    def condition_of(self, images: Float[Tensor, "B 3 H W"], view: int) -> Any:
        """The image condition of one view's source render; `view` is its number, for a prior that knows views."""
        return self.condition(images)

    @abstractmethod
    def embed(self, prompts: Sequence[str]) -> list[Any]:
        """One text condition per prompt, without graph. Raises PriorError for a prompt that the prior cannot take."""

    @abstractmethod
    def predict_noise(self, rows: Sequence[Row], timestep: int) -> list[Float[Tensor, "B C h w"]]:
        """The noise prediction of every row at index `timestep` (0..T-1), without graph, in one call."""

    def tell_truth(self, image: Callable[[int], Float[Tensor, "H W 3"]]) -> None:
        """Of a prior that `takes_truth`: number of a view to the edited scene there, in [0,1]."""
        raise PriorError(f"{type(self).__name__} takes no truth")

    def stack(self, conditions: Sequence[Any]) -> Any:
        """The conditions of single images as one condition of a batch, in that order."""
        return None if conditions[0] is None else torch.cat(list(conditions))

    def known_edit(self, condition: Any, text: Any) -> Float[Tensor, "B 3 H W"]:
        """The edit itself, in [0,1]. Raises PriorError for a prior that is not exact."""
        raise PriorError(f"{type(self).__name__} is no exact prior: what its edit should be is not known")
