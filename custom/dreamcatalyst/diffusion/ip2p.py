"""Latent diffusion models from diffusers as priors: InstructPix2Pix, and Stable Diffusion where only text conditions.

Sources: Brooks et al. 2023, "InstructPix2Pix" (conditions); Rombach et al. 2022 (latents); Salimans & Ho 2022 (v).
Both expect a folder of the layout of `timbrooks/instruct-pix2pix` and differ in what the U-Net takes beside the noisy
latent: InstructPix2Pix the image's latent in as many further channels, Stable Diffusion nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..config import AtLeastOne, Seed
from ..errors import ConfigError, PriorError, choose
from .api import Prior, Row
from .autoencoder import Autoencoder, load_autoencoder
from .folder import check_memory, load_tokenizer, open_folder
from .freeu import FreeU, FreeUConfig
from .hub import load

DTYPES = {"fp32": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}
OUT_OF_MEMORY = ("out of memory", "allocate memory", "not enough memory")  # no error class serves all devices


@dataclass(frozen=True)
class Ip2pConfig:
    """What to load and how to run it. The options that save memory bear the names that diffusers gives them. Effects
    are those of `benchmarks/guidance_step.py --size sd15 --pixels 256 --options channels_last slicing tiling` on two
    CPU cores in fp32, per step.

    path: a Hugging Face id, or a local folder of the same layout; demo:prior is the small one that comes along.
    dtype: precision of all weights and activations, fp32, fp16 or bf16. Latents and gradients stay the caller's; the
        gradient through a half-precision encoder is kept in range by itself, so no loss scaling is needed.
    autoencoder: null for the folder's, or folder or id of an AutoencoderTiny (madebyollin/taesd): cheaper, blurrier
        (measured: 0.7 of the time, 0.31 of the memory; encoding alone an eighth of its time).
    latents: mode of the posterior; sample: both branches, and every view of a size, with the same noise of `seed`; or
        independent: drawn anew at every step, source and edit apart, as all published codes do. The mode is the default
        because independent draws differ by sqrt(2) deviations where nothing was edited, which the identity term takes
        for an edit, and no draw says more of an image than the mode.
    condition_unit_range: the image condition is encoded from [0,1] for [-1,1], off the range that the autoencoder
        knows: what the published NeRF release does, for its figures.
    freeu: see FreeUConfig.
    slicing: the autoencoder takes a batch one image at a time. Same result; saves memory for batches only
        (measured with one view per step: none).
    tiling: the autoencoder works in blended tiles on images larger than its training size. An approximation: every
        tile is normalised by itself and sees no other, so latents and gradients differ from those without tiling. It
        saves memory where no gradient is asked for; with one, all tiles keep their graphs (measured with tiles of a
        quarter of the image's side: 2.2 times the time, 1.6 times the memory).
    channels_last: memory format of the convolutions. Same result up to rounding; faster where half precision runs on
        matrix units (measured on a CPU in fp32: no gain, 1.2 to 1.5 times the time).
    compile: torch.compile on the U-Net. Same result up to rounding; the first call of each shape takes minutes.
    offload: U-Net and text encoder wait in the host's memory and visit the device for their own calls only. Same
        result; every U-Net call pays for two copies of its weights. The autoencoder stays: a graph runs through it.
    checkpointing: the encoder's activations are computed again on the way back. Same gradient; one more encoder pass
        for a peak of one block (measured: 1.33 times the time, 0.53 of the memory).
    max_rows: images per U-Net call at most; null, as many as are asked for, and fewer if memory runs out
        (measured one at a time: 1.3 times the time, 0.96 of the memory, which is the encoder's).
    """

    path: str = "timbrooks/instruct-pix2pix"
    dtype: str = "fp32"
    autoencoder: str | None = None
    latents: str = "mode"
    condition_unit_range: bool = False
    seed: Seed = 0
    freeu: FreeUConfig = field(default_factory=FreeUConfig)
    slicing: bool = False
    tiling: bool = False
    channels_last: bool = False
    compile: bool = False
    offload: bool = False
    checkpointing: bool = False
    max_rows: AtLeastOne | None = None

    def __post_init__(self) -> None:
        choose("precision", self.dtype, DTYPES, "prior.dtype")
        choose("kind of latents", self.latents, ("mode", "sample", "independent"), "prior.latents")
        if self.latents != "mode" and self.autoencoder is not None:
            raise ConfigError(
                f"prior.latents={self.latents}: a tiny autoencoder has no posterior to sample; set latents=mode"
            )


class LatentDiffusion(Prior):
    """What InstructPix2Pix and Stable Diffusion share. `device` is where the models run.

    Everything is checked on construction; PriorError says what does not fit, and what to do.
    """

    Config = Ip2pConfig

    def __init__(self, config: Ip2pConfig, device: torch.device | str = "cpu"):
        from diffusers import UNet2DConditionModel
        from transformers import CLIPTextModel

        self.config, self.device, self.dtype = config, torch.device(device), DTYPES[config.dtype]
        folder = open_folder(config.path, conditioned=self.takes_image)
        check_memory(folder, self.dtype, self.device, offload=config.offload, tiny=config.autoencoder is not None)
        self.alphas_cumprod, self.prediction_type = folder.alphas_cumprod(), folder.prediction_type
        self.text_width, self.latent_channels = folder.unet["cross_attention_dim"], folder.latent_channels
        self.max_rows, self.instructions = config.max_rows, folder.instructions()

        self.tokenizer = load_tokenizer(folder)
        self.max_tokens = folder.text_encoder.get("max_position_embeddings", 77)
        home = torch.device("cpu") if config.offload else self.device
        self.text_encoder = load(CLIPTextModel, folder.path, "text_encoder", self.dtype).to(home)
        self.unet = load(UNet2DConditionModel, folder.path, "unet", self.dtype).to(home)
        vae = load_autoencoder(folder, config.autoencoder, self.dtype).to(self.device)
        self.autoencoder = Autoencoder(
            vae,
            folder,
            sample=config.latents == "sample",
            seed=config.seed,
            unit_condition=config.condition_unit_range,
        )
        self.draws_latents = config.latents == "independent"
        if config.checkpointing:
            self.autoencoder.enable_checkpointing()
        self.freeu = FreeU(self.unet, config.freeu).install()
        self._apply_options(vae)
        self._embeddings: dict[str, Tensor] = {}
        self.null_text: Tensor | None = None  # [L,D] in place of the empty prompt's, such as a negative prompt's

    @property
    def weight_bytes(self) -> int:
        models = self.unet, self.text_encoder, self.autoencoder.vae
        return sum(p.numel() * p.element_size() for model in models for p in model.parameters())

    def _apply_options(self, vae: Any) -> None:
        if self.config.slicing:
            vae.enable_slicing()
        if self.config.tiling:
            vae.enable_tiling()
        if self.config.channels_last:
            for model in (self.unet, vae):
                model.to(memory_format=torch.channels_last)
        if self.config.compile:
            self.unet.compile()

    # -- images and latents -------------------------------------------------------------------------------------------

    def encode(
        self, images: Float[Tensor, "B 3 H W"], noise: Float[Tensor, "B C h w"] | None = None
    ) -> Float[Tensor, "B C h w"]:
        """Images in [0,1] to scaled latents, differentiable in `images`; h = ceil(H/8), w = ceil(W/8).

        noise, standard normal: draw from the posterior with it, whatever `latents` says.
        """
        with self._own_precision():
            return self.autoencoder.encode(images, noise)

    def latent_shape(self, images: Float[Tensor, "B 3 H W"]) -> tuple[int, ...]:
        height, width = (-(-side // self.autoencoder.factor) for side in images.shape[-2:])
        return self.latent_channels, height, width

    def deviation(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        with self._own_precision():
            return self.autoencoder.deviation(images)

    def decode(
        self, latents: Float[Tensor, "B C h w"], size: tuple[int, int] | None = None
    ) -> Float[Tensor, "B 3 H W"]:
        """Scaled latents to images in [0,1], without graph; H = 8h, W = 8w. size (H, W): of the image that was
        encoded, where its sides are no multiple of 8; the surplus on the right and at the bottom is cut off."""
        with self._own_precision():
            return self.autoencoder.decode(latents, size)

    def condition(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"] | None:
        """The image condition of images in [0,1]: the posterior's mode, unscaled, without graph;
        None for a prior that takes no image."""
        if not self.takes_image:
            return None
        with self._own_precision():
            return self.autoencoder.condition(images)

    # -- text ---------------------------------------------------------------------------------------------------------

    def embed(self, prompts: Sequence[str]) -> list[Float[Tensor, "L D"]]:
        """One text embedding per prompt, without graph. The text encoder runs once for each distinct prompt.

        Warns with the words that are lost where a prompt is longer than the encoder takes (77 tokens).
        """
        for prompt in prompts:
            if not isinstance(prompt, str):
                raise PriorError(f"prompt {prompt!r} is of type {type(prompt).__name__}, expected text")
            if prompt not in self._embeddings:
                self._embeddings[prompt] = self._encode_text(prompt)
        return [self._embeddings[prompt] for prompt in prompts]

    def _encode_text(self, prompt: str) -> Float[Tensor, "L D"]:
        length = min(self.tokenizer.model_max_length, self.max_tokens)
        ids = self.tokenizer(prompt, verbose=False).input_ids
        if len(ids) > length:  # the first and the last token are the marks of start and end
            lost = self.tokenizer.decode(ids[length - 1 : -1]).strip()
            warnings.warn(f"prompt cut after {length - 2} tokens; these words are lost: '{lost}'", stacklevel=4)
        ids = self.tokenizer(prompt, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
        with torch.no_grad(), self._own_precision(), self._visiting(self.text_encoder):
            return self.text_encoder(ids.input_ids.to(self.device))[0][0]

    # -- noise --------------------------------------------------------------------------------------------------------

    def predict_noise(self, rows: Sequence[Row], timestep: int) -> list[Float[Tensor, "B C h w"]]:
        """The noise in each row's `noisy` at index `timestep` (0..T-1), without graph, in one U-Net call.

        Row.text: an embedding [L,D] (or [B,L,D] from elsewhere), None for the empty prompt. Row.image: [B,C,h,w] from
        `condition`, None for zeros, as InstructPix2Pix was trained without an image. Whatever the model predicts
        (noise, v or the clean latent) comes back as noise. Raises PriorError where shapes, width or timestep cannot be.
        """
        if not rows:
            return []
        self._check(rows, timestep)
        noisy = torch.cat([row.noisy for row in rows]).detach()
        with torch.no_grad(), self._own_precision():
            inputs = torch.cat([self._input(row) for row in rows])
            text = torch.cat([self._text(row) for row in rows])
            with self._visiting(self.unet):
                predicted = self._call_unet(inputs, text, timestep).to(noisy.dtype)
            return list(self._to_noise(predicted, noisy, timestep).split([len(row.noisy) for row in rows]))

    def _check(self, rows: Sequence[Row], timestep: int) -> None:
        if not 0 <= timestep < len(self.alphas_cumprod):
            raise PriorError(f"timestep {timestep} is outside this prior's 0..{len(self.alphas_cumprod) - 1}")
        size = rows[0].noisy.shape[1:]
        for i, row in enumerate(rows):
            if row.noisy.ndim != 4 or row.noisy.shape[1] != self.latent_channels or row.noisy.shape[1:] != size:
                raise PriorError(
                    f"row {i}: noisy latents of shape {tuple(row.noisy.shape)}, expected "
                    f"[B,{self.latent_channels},h,w] and one h,w for all rows"
                )
            if row.image is not None and (not self.takes_image or row.image.shape != row.noisy.shape):
                takes = tuple(row.noisy.shape) if self.takes_image else "none (a text-to-image model)"
                raise PriorError(f"row {i}: image condition {tuple(row.image.shape)}, this prior takes {takes}")
            if row.text is not None and row.text.shape[-1] != self.text_width:
                raise PriorError(
                    f"row {i}: text embedding of width {row.text.shape[-1]}, this U-Net takes {self.text_width}. Embed "
                    f"the prompt with this prior, or with a text encoder of that width."
                )

    def _input(self, row: Row) -> Float[Tensor, "B channels h w"]:
        """The U-Net's channels of one row in its precision."""
        noisy = row.noisy.to(self.device, self.dtype)
        if not self.takes_image:
            return noisy
        image = torch.zeros_like(noisy) if row.image is None else row.image.to(noisy)
        return torch.cat([noisy, image], dim=1)

    def _text(self, row: Row) -> Float[Tensor, "B L D"]:
        text = self.null_text if row.text is None else row.text
        text = self.embed([""])[0] if text is None else text.to(self.device, self.dtype)
        return text.expand(len(row.noisy), -1, -1)

    def _call_unet(
        self, inputs: Float[Tensor, "N channels h w"], text: Float[Tensor, "N L D"], timestep: int
    ) -> Float[Tensor, "N C h w"]:
        """The U-Net on N images, at most `max_rows` at a time; half as many from then on whenever memory runs out."""
        t = torch.tensor(timestep, device=self.device)
        done: list[Tensor] = []
        start = 0
        while start < len(inputs):
            part = slice(start, start + min(self.max_rows or len(inputs), len(inputs) - start))
            try:
                done.append(self.unet(inputs[part], t, encoder_hidden_states=text[part], return_dict=False)[0])
                start = part.stop
            except RuntimeError as error:
                if not any(phrase in str(error).lower() for phrase in OUT_OF_MEMORY):
                    raise
                self._shrink(part.stop - part.start, error)
        return torch.cat(done)

    def _shrink(self, rows: int, error: RuntimeError) -> None:
        if rows == 1:
            raise PriorError(
                f"{self.config.path}: {self.device} has not enough memory for one row of the U-Net. Set dtype=fp16, "
                f"offload=true or autoencoder=madebyollin/taesd, or use smaller images."
            ) from error
        if self.max_rows == self.config.max_rows:
            warnings.warn(
                f"memory ran out at {rows} rows in one U-Net call; fewer at a time from now on (slower, same result). "
                f"Set prior.max_rows below {rows}, or dtype=fp16.",
                stacklevel=4,
            )
        self.max_rows = (rows + 1) // 2

    def _to_noise(
        self, predicted: Float[Tensor, "N C h w"], noisy: Float[Tensor, "N C h w"], timestep: int
    ) -> Float[Tensor, "N C h w"]:
        """What the model predicts as the noise in x_t = sqrt(abar) x_0 + sqrt(1 - abar) eps."""
        signal, sigma = self.alphas_cumprod[timestep].sqrt().item(), (1 - self.alphas_cumprod[timestep]).sqrt().item()
        if self.prediction_type == "v_prediction":  # v = sqrt(abar) eps - sqrt(1 - abar) x_0
            return signal * predicted + sigma * noisy
        if self.prediction_type == "sample":
            return (noisy - signal * predicted) / sigma
        return predicted

    # -- where and how the models run ---------------------------------------------------------------------------------

    def _own_precision(self) -> AbstractContextManager:
        """Switches a caller's autocast off: the models run in the precision of the config, not in the trainer's."""
        return torch.autocast(self.device.type, enabled=False)

    @contextmanager
    def _visiting(self, model: nn.Module) -> Iterator[None]:
        """With `offload`, `model` is on the device inside this block only."""
        if not self.config.offload:
            yield
            return
        model.to(self.device)
        try:
            yield
        finally:
            model.to("cpu")


class InstructPix2Pix(LatentDiffusion):
    """Instruction-guided editing: the U-Net takes the noisy latent and the latent of the image to be edited."""

    takes_image = True


class StableDiffusion(LatentDiffusion):
    """Text-to-image: prompts are descriptions, there is no image condition, and image guidance means nothing."""

    takes_image = False
