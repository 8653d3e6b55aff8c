"""Inpainting by Stable Diffusion: a U-Net that sees, beside the noisy latent, the hole and the picture around it.

Source: Rombach et al. 2022, section 4.5. Models of the layout of `stable-diffusion-v1-5/stable-diffusion-inpainting`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, cast

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..config import DdimSteps, NonNegative, Range, Seed
from ..diffusion.autoencoder import load_autoencoder
from ..diffusion.folder import check_memory, load_tokenizer, open_folder
from ..diffusion.hub import load
from ..diffusion.ip2p import DTYPES
from ..errors import choose
from .api import Inpainter

EXAMPLE = "stable-diffusion-v1-5/stable-diffusion-inpainting"


@dataclass(frozen=True)
class StableDiffusionInpainting(Inpainter):
    """Texture that a model invents. It wants a description of what is to be seen: the background, not the thing."""

    path: str = EXAMPLE  # a Hugging Face id, or a folder of that layout
    prompt: str = ""  # what is behind the thing, such as "a lawn with a path"
    guidance_scale: NonNegative = 7.5  # of the prompt; 1 and less: none
    steps: DdimSteps = 30
    size: Annotated[int, Range("[64, 4096]")] = 512  # pixels of the longer side at which the model sees a view
    dtype: str = "fp32"  # fp32 | fp16 | bf16
    seed: Seed = 0  # of the noise, the same for every view

    def __post_init__(self) -> None:
        choose("precision", self.dtype, DTYPES, "dtype")

    def load(self, device: torch.device) -> Any:
        """The pipeline of diffusers. Raises PriorError for a folder that is missing or of another kind."""
        from diffusers import DDIMScheduler, StableDiffusionInpaintPipeline, UNet2DConditionModel
        from transformers import CLIPTextModel

        folder, dtype = open_folder(self.path, conditioned=True, masked=True), DTYPES[self.dtype]
        check_memory(folder, dtype, device, offload=False, tiny=False)
        pipeline = StableDiffusionInpaintPipeline(
            vae=load_autoencoder(folder, None, dtype),
            text_encoder=load(CLIPTextModel, folder.path, "text_encoder", dtype),
            tokenizer=load_tokenizer(folder),
            unet=load(UNet2DConditionModel, folder.path, "unet", dtype),
            scheduler=cast(Any, DDIMScheduler.from_config(folder.scheduler, steps_offset=1, clip_sample=False)),
            safety_checker=cast(Any, None),
            feature_extractor=cast(Any, None),
            requires_safety_checker=False,
        )
        pipeline.set_progress_bar_config(disable=True)
        return pipeline.to(device)

    def fill(self, image: Tensor, hole: Tensor, loaded: Any = None) -> Tensor:
        height, width = hole.shape
        times, step = self.size / max(height, width), loaded.vae_scale_factor
        size = [max(step, round(side * times / step) * step) for side in (height, width)]
        picture = interpolate(image.permute(2, 0, 1)[None].float(), size, mode="bicubic", antialias=True).clamp(0, 1)
        mask = interpolate(hole[None, None].float(), size)
        with torch.no_grad():
            made = loaded(
                prompt=self.prompt,
                image=picture,
                mask_image=mask,
                height=size[0],
                width=size[1],
                num_inference_steps=self.steps,
                guidance_scale=self.guidance_scale,
                generator=torch.Generator().manual_seed(self.seed),
                output_type="pt",
            ).images
        return interpolate(made.float(), (height, width), mode="bicubic", antialias=True)[0].permute(1, 2, 0).to(image)
