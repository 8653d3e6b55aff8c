"""The autoencoder's side of a latent prior: pixels in [0,1] to scaled latents and back, at any image size."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..errors import PriorError
from .folder import Folder
from .hub import load


class Autoencoder:
    """AutoencoderKL of the folder, or an AutoencoderTiny (TAESD) in its place.

    vae: the diffusers model, frozen. factor: pixels per latent along a side. Scaled latents, which the U-Net denoises,
    are (z - shift) * scale of the posterior's z; the image condition of InstructPix2Pix is z itself. A tiny autoencoder
    has no posterior and gives scaled latents directly, so that its condition is divided by the folder's scale.

    Sides that are no multiple of `factor` are padded on the right and at the bottom by repeating the last pixel, and
    `decode` crops there: no pixel ever moves.
    """

    def __init__(self, vae: Any, folder: Folder, *, sample: bool = False, seed: int = 0, unit_condition: bool = False):
        self.vae, self.factor, self.sample, self.seed = vae, folder.factor, sample, seed
        self.unit_condition = unit_condition
        self.scale, self.shift = folder.scaling_factor, folder.shift_factor
        self.tiny = type(vae).__name__ == "AutoencoderTiny"
        self._encoder = vae.encode

    def enable_checkpointing(self) -> None:
        """Keep no activations of the encoder for the way back, only the inputs of its blocks; compute them again."""
        if self.tiny:  # as one block: diffusers' own checkpointing of it (0.42) leaves out [-1,1] -> [0,1]
            self._encoder = partial(checkpoint, self.vae.encode, use_reentrant=False)
            return
        self.vae.enable_gradient_checkpointing()
        self.vae.encoder.train()  # older diffusers checkpoint in training mode only; it changes nothing else here

    def encode(
        self, images: Float[Tensor, "B 3 H W"], noise: Float[Tensor, "#B C h w"] | None = None
    ) -> Float[Tensor, "B C h w"]:
        """Images in [0,1] to scaled latents, differentiable; h = ceil(H/factor), w = ceil(W/factor).

        The posterior's mode; or, where `sample` is set, mean + std * noise. noise, standard normal: where it is not
        given, one draw from `seed` is used for every image of that size, so that the latents of a source and of its
        edit share it, however often they are encoded.
        """
        pixels = self._pixels(images)
        half = pixels.requires_grad and self.vae.dtype.itemsize == 2
        scaled = self._scaled(pixels, noise).to(images.dtype)
        if half:
            _keep_gradient_in_range(pixels, scaled)
        return scaled

    @torch.no_grad()
    def condition(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """The posterior's mode of images in [0,1], unscaled, in the model's precision, without graph.
        unit_condition: of these numbers as they are, not brought to [-1,1]."""
        pixels = self._pixels(images)
        encoded = self.vae.encode((pixels / 2 + 0.5 if self.unit_condition else pixels).to(self.vae.dtype))
        return encoded.latents / self.scale + self.shift if self.tiny else encoded.latent_dist.mode()

    @torch.no_grad()
    def deviation(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """The posterior's standard deviation of images in [0,1], in units of scaled latents, without graph;
        not for a tiny autoencoder."""
        posterior = self.vae.encode(self._pixels(images).to(self.vae.dtype)).latent_dist
        return (posterior.std * self.scale).to(images.dtype)

    @torch.no_grad()
    def decode(
        self, latents: Float[Tensor, "B C h w"], size: tuple[int, int] | None = None
    ) -> Float[Tensor, "B 3 H W"]:
        """Scaled latents to images in [0,1], H = h*factor and W = w*factor; or their upper left `size` (H, W)."""
        z = latents if self.tiny else latents / self.scale + self.shift
        images = self.vae.decode(z.to(self.vae.dtype)).sample.to(latents.dtype)
        height, width = size or images.shape[-2:]
        return (images[..., :height, :width] / 2 + 0.5).clamp(0, 1)

    def _pixels(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 padded_H padded_W"]:
        """[0,1] to [-1,1], padded to whole latents."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise PriorError(f"images of shape {tuple(images.shape)} cannot be encoded; expected [B,3,H,W] in [0,1]")
        height, width = images.shape[-2:]
        return F.pad(images * 2 - 1, (0, -width % self.factor, 0, -height % self.factor), mode="replicate")

    def _scaled(
        self, pixels: Float[Tensor, "B 3 H W"], noise: Float[Tensor, "#B C h w"] | None
    ) -> Float[Tensor, "B C h w"]:
        encoded = self._encoder(pixels.to(self.vae.dtype))
        if self.tiny:
            return encoded.latents
        posterior = encoded.latent_dist
        z = posterior.mode()
        if self.sample or noise is not None:
            z = z + posterior.std * (self._shared_noise(z) if noise is None else noise).to(z)
        return (z - self.shift) * self.scale

    def _shared_noise(self, z: Float[Tensor, "B C h w"]) -> Float[Tensor, "1 C h w"]:
        generator = torch.Generator().manual_seed(self.seed)
        return torch.randn((1, *z.shape[1:]), generator=generator)


def _keep_gradient_in_range(inside: Float[Tensor, "B 3 H W"], outside: Float[Tensor, "B C h w"]) -> None:
    """Carry a gradient through a half-precision encoder at full range, whatever the loss's reduction.

    What arrives at `outside` is divided by the power of two below its largest element, and what comes back at `inside`
    is multiplied by it again, both exactly: a mean over many elements does not underflow, a sum does not overflow.
    """
    magnitude: list[Tensor] = []

    def normalize(grad: Tensor) -> Tensor:
        largest = grad.abs().amax().float()
        magnitude[:] = [torch.where(largest > 0, torch.exp2(torch.log2(largest).floor()), torch.ones_like(largest))]
        return grad / magnitude[0]

    outside.register_hook(normalize)
    inside.register_hook(lambda grad: grad * magnitude[0])


def load_autoencoder(folder: Folder, tiny: str | None, dtype: torch.dtype) -> Any:
    """The folder's AutoencoderKL, or the AutoencoderTiny at `tiny` (a folder or a Hugging Face id), which must have as
    many latent channels and the same factor. Raises PriorError."""
    from diffusers import AutoencoderKL, AutoencoderTiny

    if tiny is None:
        return load(AutoencoderKL, folder.path, "vae", dtype)
    vae = load(AutoencoderTiny, Path(tiny).expanduser() if Path(tiny).expanduser().is_dir() else tiny, None, dtype)
    got = (vae.config.latent_channels, 2 ** (len(vae.config.encoder_block_out_channels) - 1))
    if got != (folder.latent_channels, folder.factor):
        raise PriorError(
            f"autoencoder={tiny}: {got[0]} latent channels at 1/{got[1]} of the image's sides, but the U-Net of "
            f"{folder.path} takes {folder.latent_channels} at 1/{folder.factor}. Use the tiny autoencoder made for it "
            f"(madebyollin/taesd for SD 1.x and 2.x), or autoencoder=null."
        )
    return vae
