"""Where a picture shows what a text names: CLIPSeg (Lüddecke & Ecker 2022), or Grounding DINO (Liu et al. 2023), whose
boxes SAM (Kirillov et al. 2023) cuts out. The models are those of transformers, imported when they are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from ..config import Between
from ..diffusion.hub import load, load_processor, model_config
from ..errors import ConfigError, SceneError
from ..kept import stamp
from .api import MaskRequest, Segmenter

CLIPSEG, DINO, SAM = "clipseg", "grounding-dino", "sam"  # as the models' config.json calls them
EXAMPLES = {
    CLIPSEG: "CIDAS/clipseg-rd64-refined",
    DINO: "IDEA-Research/grounding-dino-tiny",
    SAM: "facebook/sam-vit-base",
}


HOLDS, PROCESSOR = "config.json, weights and preprocessor", "tokenizer and preprocessor_config.json"


@dataclass(frozen=True)
class Text(Segmenter):
    """Several things are named with full stops between them: "fox head. flowers". All instances of all are merged."""

    text: str = ""  # what to look for: things ("fox head"), not an instruction
    path: str = EXAMPLES[CLIPSEG]  # CLIPSeg or Grounding DINO: folder, or id on Hugging Face
    sam: str = EXAMPLES[SAM]  # cuts out what Grounding DINO finds; CLIPSeg needs none
    threshold: Between | None = None  # of a pixel (CLIPSeg: 0.4) or of a box (Grounding DINO: 0.35), in (0,1)

    def __post_init__(self) -> None:
        if not self.phrases:
            raise ConfigError('text: is empty. Say what to look for, such as text="fox head".')

    @property
    def phrases(self) -> list[str]:
        """The things that are named, each for itself."""
        return [phrase.strip() for phrase in self.text.lower().split(".") if phrase.strip()]

    def identity(self, request: MaskRequest) -> Any:
        return stamp(self.path), stamp(self.sam)

    def __call__(self, request: MaskRequest, views: Sequence[int]) -> dict[int, Float[Tensor, "H W"]]:
        finder = MODELS[model_type(self.path, *MODELS)](self, request.scene.means.device)
        masks = {view: finder(request.render(view).detach().clamp(0, 1)) for view in views}
        if not any(bool(mask.any()) for mask in masks.values()):
            raise SceneError(
                f"mask: '{self.text}' was found in none of {len(masks)} views (best score {finder.best:.2f}, threshold "
                f"{finder.threshold:g}). Name it otherwise, or lower mask.options.threshold"
            )
        return masks


class ClipSeg:
    """A picture in [0,1] to a mask of 0 and 1: pixels whose probability for any phrase is over the threshold."""

    def __init__(self, options: Text, device: torch.device):
        from transformers import AutoProcessor, CLIPSegForImageSegmentation

        self.phrases, self.threshold, self.best = options.phrases, options.threshold or 0.4, 0.0
        self.processor = load_processor(AutoProcessor, options.path, PROCESSOR)
        self.model = load(CLIPSegForImageSegmentation, options.path, None, torch.float32).to(device)

    @torch.no_grad()
    def __call__(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        inputs = self.processor(
            text=self.phrases, images=[_pixels(image)] * len(self.phrases), padding=True, return_tensors="pt"
        ).to(self.model.device)
        logits = self.model(**inputs).logits.reshape(len(self.phrases), 1, *inputs["pixel_values"].shape[-2:])
        logits = F.interpolate(logits, image.shape[:2], mode="bilinear", align_corners=False)
        probability = logits.sigmoid().amax(dim=(0, 1))
        self.best = max(self.best, float(probability.max()))
        return (probability > self.threshold).float()


class GroundedSam:
    """A picture in [0,1] to a mask of 0 and 1: Grounding DINO's boxes over the threshold, each cut out by SAM."""

    def __init__(self, options: Text, device: torch.device):
        from transformers import AutoProcessor, GroundingDinoForObjectDetection, SamModel

        self.words = " ".join(f"{phrase}." for phrase in options.phrases)  # as the model was trained to read them
        self.threshold, self.best = options.threshold or 0.35, 0.0
        model_type(options.sam, SAM)
        self.processor, self.sam_processor = (
            load_processor(AutoProcessor, path, PROCESSOR) for path in (options.path, options.sam)
        )
        self.detector = load(GroundingDinoForObjectDetection, options.path, None, torch.float32).to(device)
        self.sam = load(SamModel, options.sam, None, torch.float32).to(device)

    def __call__(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        pixels = _pixels(image)
        boxes = self.boxes(pixels)
        return self.cut_out(pixels, boxes) if len(boxes) else torch.zeros(image.shape[:2])

    @torch.no_grad()
    def boxes(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Float[Tensor, "B 4"]:
        """Left, top, right, bottom in pixels of everything that is found."""
        inputs = self.processor(images=pixels, text=self.words, return_tensors="pt").to(self.detector.device)
        found = self.detector(**inputs)
        self.best = max(self.best, float(found.logits.sigmoid().max()))  # of the words that a box answers to best
        # By position: the first threshold has had two names. The second is of the words that label a box.
        find, words = self.processor.post_process_grounded_object_detection, inputs["input_ids"]
        (kept,) = find(found, words, self.threshold, self.threshold, [pixels.shape[:2]])
        return kept["boxes"]

    @torch.no_grad()
    def cut_out(self, pixels: UInt8[np.ndarray, "H W 3"], boxes: Float[Tensor, "B 4"]) -> Float[Tensor, "H W"]:
        """The union of what the boxes hold."""
        inputs = self.sam_processor(images=pixels, input_boxes=[boxes.tolist()], return_tensors="pt")
        sizes = inputs.pop("original_sizes"), inputs.pop("reshaped_input_sizes")
        inputs = {name: value.to(self.sam.device, torch.float32) for name, value in inputs.items()}
        predicted = self.sam(**inputs, multimask_output=False).pred_masks.cpu()
        (masks,) = self.sam_processor.image_processor.post_process_masks(predicted, *sizes)  # [B,1,H,W] bool
        return masks.flatten(0, 1).any(dim=0).float()


MODELS = {CLIPSEG: ClipSeg, DINO: GroundedSam}


def model_type(path: str, *wanted: str) -> str:
    """What kind of model `path` holds, one of `wanted`. Raises PriorError as `model_config`."""
    return model_config(path, HOLDS, {name: EXAMPLES[name] for name in wanted}).model_type


def _pixels(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """A picture in [0,1] in 8 bits."""
    return (image * 255).round().to(torch.uint8).cpu().numpy()
