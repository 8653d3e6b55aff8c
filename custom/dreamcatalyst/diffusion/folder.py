"""A folder of Stable Diffusion's layout (vae, unet, text_encoder, tokenizer, scheduler): found, checked, then loaded.

All that can be known without reading weights is checked first, so that a wrong folder is refused in a second and before
any scene is loaded.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from ..errors import PriorError
from ..memory import free_memory
from .hub import find_folder, first_line, load_processor, not_given

T = TypeVar("T")

CONFIGS = {
    "unet": "config.json",
    "vae": "config.json",
    "text_encoder": "config.json",
    "tokenizer": "tokenizer_config.json",
    "scheduler": "scheduler_config.json",
}
INSTRUCTIONS = "instructions.json"  # of a model that was taught a list of edits: name of the edit to its wordings
PREDICTIONS = ("epsilon", "v_prediction", "sample")


@dataclass(frozen=True)
class Folder:
    """A checked model folder. path: where it lies; unet, vae, text_encoder, scheduler: its configs as written."""

    path: Path
    unet: dict[str, Any]
    vae: dict[str, Any]
    text_encoder: dict[str, Any]
    scheduler: dict[str, Any]

    @property
    def latent_channels(self) -> int:
        return self.vae.get("latent_channels", 4)

    @property
    def factor(self) -> int:
        """Pixels per latent along each side: 8 for Stable Diffusion."""
        return 2 ** (len(self.vae["block_out_channels"]) - 1)

    @property
    def scaling_factor(self) -> float:
        return self.vae.get("scaling_factor", 0.18215)

    @property
    def shift_factor(self) -> float:
        return self.vae.get("shift_factor") or 0.0

    @property
    def prediction_type(self) -> str:
        return self.scheduler.get("prediction_type", "epsilon")

    def instructions(self) -> dict[str, list[str]] | None:
        """What the model was taught, wordings by edit; None where the folder does not say."""
        file = self.path / INSTRUCTIONS
        if not file.is_file():
            return None
        taught = _json(file)
        texts = [text for words in taught.values() for text in (words if isinstance(words, list) else [None])]
        if not all(isinstance(text, str) for text in texts):
            raise PriorError(f"{file}: expected a list of wordings for each edit. Download the folder again.")
        return taught

    def alphas_cumprod(self) -> Float64[Tensor, " T"]:
        """abar_t. The betas are the folder's (float32, as trained); their product is taken in float64,
        because rules that divide by 1 - abar_t / abar_{t-1} would see the rounding of a float32 product."""
        from diffusers import DDPMScheduler

        scheduler = _built(self.path / "scheduler", lambda: DDPMScheduler.from_config(self.scheduler))
        return torch.cumprod(1 - cast(DDPMScheduler, scheduler).betas.double(), dim=0)


def open_folder(path: str, conditioned: bool, masked: bool = False) -> Folder:
    """Find the model `path` (a local folder, or a Hugging Face id that is downloaded once) and check its configs.

    conditioned: whether the U-Net must take an image beside the noisy latents (InstructPix2Pix). masked: and a mask (an
    inpainting model). Raises PriorError.
    """
    root = _local(path)
    found = {name: _read(root, name, file) for name, file in CONFIGS.items()}
    folder = Folder(root, found["unet"], found["vae"], found["text_encoder"], found["scheduler"])
    _check_kind(folder)
    _check_channels(folder, conditioned, masked)
    width, wanted = folder.text_encoder.get("hidden_size"), folder.unet.get("cross_attention_dim")
    if width != wanted:
        raise PriorError(
            f"{root}: the text encoder gives embeddings of width {width}, but the U-Net's cross-attention takes "
            f"{wanted}. Use a folder whose text_encoder and unet come from the same model (768: SD 1.x and "
            f"InstructPix2Pix; 1024: SD 2.x)."
        )
    return folder


def _local(path: str) -> Path:
    """The local folder of `path`, downloaded where it is an id of the hub that is not there yet."""
    folder = find_folder(path, ", ".join(CONFIGS), "timbrooks/instruct-pix2pix")
    if folder is not None:
        return folder
    from diffusers import DiffusionPipeline

    try:
        return Path(DiffusionPipeline.download(path, safety_checker=None, feature_extractor=None))
    except Exception as error:  # what the hub raises depends on its version and on its HTTP library
        raise PriorError(not_given(path, error)) from error


def _read(root: Path, name: str, file: str) -> dict[str, Any]:
    target = root / name / file
    if not target.is_file():
        there = sorted(p.name for p in root.iterdir() if p.is_dir())
        raise PriorError(
            f"{root}: '{name}/{file}' is missing (folders found: {', '.join(there) or 'none'}). A model folder needs "
            f"{', '.join(CONFIGS)}; give the folder that holds model_index.json."
        )
    return _json(target)


def _json(file: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises PriorError."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise PriorError(f"{file}: not valid JSON ({first_line(error)}). Download the folder again.") from error
    if not isinstance(content, dict):
        raise PriorError(f"{file}: holds a {type(content).__name__}, expected an object. Download the folder again.")
    return content


def _built(where: Path, build: Callable[[], T]) -> T:
    """What `build` makes of a config. Raises PriorError."""
    try:
        return build()
    except Exception as error:  # diffusers and transformers have no error of their own for a config that cannot be
        raise PriorError(f"{where}: its config cannot be used ({first_line(error)}). Download it again.") from error


def _check_kind(folder: Folder) -> None:
    """Refuse models of other layouts, which would load and then fail in the middle of a run, or be wrong silently."""
    what = "Use an InstructPix2Pix or Stable Diffusion 1.x/2.x folder."
    for name, wanted in (("unet", "UNet2DConditionModel"), ("vae", "AutoencoderKL")):
        got = getattr(folder, name).get("_class_name")
        if got != wanted:
            raise PriorError(f"{folder.path / name}: is a {got}, expected {wanted}. {what}")
    kind = folder.text_encoder.get("model_type")
    if kind != "clip_text_model":
        raise PriorError(f"{folder.path / 'text_encoder'}: is a '{kind}', expected 'clip_text_model'. {what}")
    for key in ("addition_embed_type", "class_embed_type", "encoder_hid_dim_type", "time_cond_proj_dim"):
        if folder.unet.get(key) is not None:
            raise PriorError(
                f"{folder.path / 'unet'}: {key}={folder.unet[key]} asks for a condition beyond text and image "
                f"(is this an XL or a distilled model?). {what}"
            )
    if not {"beta_start", "trained_betas"} & folder.scheduler.keys():
        raise PriorError(f"{folder.path / 'scheduler'}: states no betas (is this a flow model?). {what}")
    if folder.prediction_type not in PREDICTIONS:
        raise PriorError(
            f"{folder.path / 'scheduler'}: prediction_type '{folder.prediction_type}', expected one of "
            f"{', '.join(PREDICTIONS)}. {what}"
        )


def _check_channels(folder: Folder, conditioned: bool, masked: bool) -> None:
    latent, got, out = folder.latent_channels, folder.unet.get("in_channels"), folder.unet.get("out_channels")
    wanted = latent * (2 if conditioned else 1) + masked
    if got == wanted and out == latent:
        return
    remedy = "Use an InstructPix2Pix or Stable Diffusion 1.x/2.x folder."
    beside = "noisy latents and image latents" if conditioned else "noisy latents"
    if masked:
        remedy = "Use a model for inpainting, such as stable-diffusion-v1-5/stable-diffusion-inpainting."
        beside = "noisy latents, a mask and image latents"
    elif got == 2 * latent + 1:
        remedy = "This is a model for inpainting, which configs/delete.yaml takes. " + remedy
    elif conditioned and got == latent:
        remedy = "This is a text-to-image model: use prior 'sd', or an InstructPix2Pix folder."
    elif not conditioned and got == 2 * latent:
        remedy = "This is an InstructPix2Pix model: use prior 'ip2p', or a text-to-image folder."
    raise PriorError(
        f"{folder.path / 'unet'}: takes {got} channels and gives {out}, expected {wanted} and {latent} "
        f"({beside}). {remedy}"
    )


def check_memory(folder: Folder, dtype: torch.dtype, device: torch.device, *, offload: bool, tiny: bool) -> None:
    """Raise PriorError where the weights alone do not fit into the free memory of `device`.

    offload: only the largest model has to fit beside the autoencoder. tiny: the folder's autoencoder is not loaded.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    with torch.device("meta"):  # shapes only
        visitors = [
            _built(folder.path / "unet", lambda: UNet2DConditionModel.from_config(folder.unet)),
            _built(
                folder.path / "text_encoder",
                lambda: CLIPTextModel(CLIPTextConfig.from_dict(folder.text_encoder)),
            ),
        ]
        vae = [] if tiny else [_built(folder.path / "vae", lambda: AutoencoderKL.from_config(folder.vae))]

    def size(module: nn.Module) -> int:
        return sum(p.numel() for p in module.parameters()) * dtype.itemsize

    need = sum(map(size, cast(list[nn.Module], vae))) + (max if offload else sum)(map(size, visitors))
    free = free_memory(device)
    if need > free:
        raise PriorError(
            f"{folder.path}: the weights need {need / 2**30:.2f} GiB in {dtype}, {device} has {free / 2**30:.2f} GiB "
            f"free. Set dtype=fp16 (half of fp32), offload=true (one model at a time), or "
            f"autoencoder=madebyollin/taesd; or free memory there."
        )


def load_tokenizer(folder: Folder) -> Any:
    """The folder's CLIPTokenizer. Raises PriorError."""
    from transformers import CLIPTokenizer

    where = folder.path / "tokenizer"
    for file in (where / "vocab.json", where / "merges.txt"):
        if file.is_file() and not file.stat().st_size:  # with no merges, words would be spelled letter by letter
            raise PriorError(f"{file}: is empty; download the folder again.")
    return load_processor(CLIPTokenizer, folder.path, "vocab.json and merges.txt", "tokenizer")
