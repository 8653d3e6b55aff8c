"""How an edit looks to CLIP (Radford et al. 2021): whether it goes the way that the words go, how much of the source it
keeps, and how good it looks. Models and files are named by the user; nothing is downloaded unasked.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor

from ..diffusion.hub import find_folder, load, load_processor, model_config
from ..errors import ConfigError

EXAMPLE, HOLDS = "openai/clip-vit-large-patch14", "config.json, weights and tokenizer of a CLIP"
MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)  # of OpenAI's CLIP, RGB


def clip_direction(
    source: Float[Tensor, "B D"],
    edited: Float[Tensor, "B D"],
    source_text: Float[Tensor, "*#B D"],
    target_text: Float[Tensor, "*#B D"],
) -> Float[Tensor, " B"]:
    """CLIP directional similarity: the cosine between the way from source to edit and the way from text to text.

    source, edited: embeddings of images; source_text, target_text ([D] or [B,D]): of their descriptions; of any
    length, they are normalised here. In [-1,1] with its sign: an edit that goes the opposite way is
    negative, one that changes nothing 0. Source: Gal et al. 2022, StyleGAN-NADA, equation 2, without its 1 - cosine.
    """
    start, end, word, words = (F.normalize(each, dim=-1) for each in (source, edited, source_text, target_text))
    return F.cosine_similarity(end - start, (words - word).expand_as(start), dim=-1)


class Clip:
    """A CLIP of transformers: path is a folder (config.json, weights, tokenizer) or an id on Hugging Face.

    The constructor finds out all that can be wrong without reading weights; these are read when first used. Raises
    PriorError: no such folder, an id that cannot be had, another kind of model.
    """

    def __init__(self, path: str, device: torch.device | str = "cpu"):
        self.path, self.device = path, torch.device(device)
        config = model_config(path, HOLDS, {"clip": EXAMPLE})
        self.width, self.side = config.projection_dim, config.vision_config.image_size
        self.mean, self.std = _standard(find_folder(path, HOLDS, EXAMPLE))

    @cached_property
    def _model(self) -> Any:
        from transformers import CLIPModel

        return load(CLIPModel, self.path, None, torch.float32).to(self.device)

    @cached_property
    def _tokenizer(self) -> Any:
        from transformers import CLIPTokenizer

        return load_processor(CLIPTokenizer, self.path, "vocab.json and merges.txt")

    @torch.no_grad()
    def images(self, images: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B D"]:
        """Embeddings of unit length of images in [0,1] (clamped).

        Stretched to the model's square, bicubic, without a crop: as the metrics of Instruct-NeRF2NeRF, GaussianEditor
        and DreamCatalyst's code do, so that figures can be compared.
        """
        pixels = images.detach().clamp(0, 1).permute(0, 3, 1, 2).to(self.device, torch.float32)
        pixels = F.interpolate(pixels, (self.side, self.side), mode="bicubic", align_corners=False)
        shift, scale = (pixels.new_tensor(values).view(1, 3, 1, 1) for values in (self.mean, self.std))
        seen = self._model.vision_model(pixel_values=(pixels - shift) / scale).pooler_output
        return F.normalize(self._model.visual_projection(seen), dim=-1)

    @torch.no_grad()
    def texts(self, texts: Sequence[str]) -> Float[Tensor, "B D"]:
        """Embeddings of unit length of descriptions; no template is put around them."""
        given = self._tokenizer(list(texts), padding=True, truncation=True, return_tensors="pt").to(self.device)
        read = self._model.text_model(input_ids=given.input_ids, attention_mask=given.attention_mask).pooler_output
        return F.normalize(self._model.text_projection(read), dim=-1)


def _standard(folder: Path | None) -> tuple[Sequence[float], Sequence[float]]:
    """Mean and deviation of the images that the model was trained on: the folder's own, or OpenAI's."""
    file = None if folder is None else folder / "preprocessor_config.json"
    given = json.loads(file.read_text(encoding="utf-8")) if file is not None and file.is_file() else {}
    return given.get("image_mean", MEAN), given.get("image_std", STD)


class Aesthetic:
    """LAION's predictor of aesthetic scores, about 1 to 10 (Schuhmann et al. 2022): linear layers on the unit embedding
    of an image by the CLIP that it was trained with. For ViT-L/14: 768-1024-128-64-16-1, `layers.<n>.weight`.

    Raises ConfigError where the file is missing, holds no such chain of layers, or takes another width than `width`.
    """

    def __init__(self, path: str, width: int, where: str = "system.report.aesthetic"):
        file = Path(path).expanduser()
        if not file.is_file():
            raise ConfigError(
                f"{where}: there is no file '{path}'. Give LAION's improved aesthetic predictor, such as "
                "sac+logos+ava1-l14-linearMSE.pth."
            )
        weights = _read(file)
        numbers = sorted(int(name.split(".")[1]) for name in weights if name.startswith("layers.") and "weight" in name)
        self.layers = [(weights[f"layers.{n}.weight"].float(), weights[f"layers.{n}.bias"].float()) for n in numbers]
        widths = [layer.shape[1] for layer, _ in self.layers] + [layer.shape[0] for layer, _ in self.layers[-1:]]
        chain = all(layer.shape[0] == nxt for (layer, _), nxt in zip(self.layers, widths[1:], strict=True))
        if not self.layers or not chain or widths[-1] != 1:
            raise ConfigError(f"{where}: {path} holds layers of widths {widths}, expected a chain that ends in 1.")
        if widths[0] != width:
            raise ConfigError(
                f"{where}: {path} takes embeddings of width {widths[0]}, the CLIP gives {width}. Use the CLIP that it "
                "was trained with (768: ViT-L/14)."
            )

    @torch.no_grad()
    def __call__(self, embeddings: Float[Tensor, "B D"]) -> Float[Tensor, " B"]:
        """Scores of image embeddings."""
        x = F.normalize(embeddings.float(), dim=-1).cpu()
        for weight, bias in self.layers:
            x = F.linear(x, weight, bias)
        return x[:, 0]


def _read(file: Path) -> dict[str, Shaped[Tensor, ...]]:
    if file.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(file)
    return torch.load(file, map_location="cpu", weights_only=True)


class ClipJudge:
    """What a report asks of CLIP. source, target: descriptions of the scene before and after, for the direction; one
    of them alone is a ConfigError. aesthetic: LAION's file, or empty."""

    def __init__(self, path: str, source: str, target: str, aesthetic: str, device: torch.device | str = "cpu"):
        if bool(source.strip()) != bool(target.strip()):
            raise ConfigError(
                "system.report: clip_source and clip_target belong together: descriptions of the scene before and "
                'after the edit, such as "a photo of a bear statue" and "a photo of a panda".'
            )
        self.clip, self.words = Clip(path, device), (source, target) if source.strip() else None
        self.aesthetic = Aesthetic(aesthetic, self.clip.width) if aesthetic else None

    def __call__(self, source: Float[Tensor, "B H W 3"], edited: Float[Tensor, "B H W 3"]) -> list[dict[str, float]]:
        """The scores of every view: source, edited in [0,1]. clip_similarity: the cosine between both;
        clip_direction: `clip_direction`; aesthetic and aesthetic_source: LAION's scores of both."""
        before, after = self.clip.images(source), self.clip.images(edited)
        scores = {"clip_similarity": F.cosine_similarity(before, after, dim=-1)}
        if self.words is not None:
            scores["clip_direction"] = clip_direction(before, after, *self.clip.texts(self.words))
        if self.aesthetic is not None:
            scores |= {"aesthetic": self.aesthetic(after), "aesthetic_source": self.aesthetic(before)}
        return [{name: float(values[i]) for name, values in scores.items()} for i in range(len(source))]
