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
from torch import Tensor

from ..config import Between
from ..diffusion.folder import find_folder, load, not_given
from ..errors import ConfigError, PriorError, SceneError
from ..kept import stamp
from .api import MaskRequest, Segmenter

CLIPSEG, DINO, SAM = "clipseg", "grounding-dino", "sam"  # as the models' config.json calls them
EXAMPLES = {
    CLIPSEG: "CIDAS/clipseg-rd64-refined",
    DINO: "IDEA-Research/grounding-dino-tiny",
    SAM: "facebook/sam-vit-base",
}


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

    def __call__(self, request: MaskRequest, views: Sequence[int]) -> dict[int, Tensor]:
        finder = MODELS[model_type(self.path, *MODELS)](self, request.scene.means.device)
        masks = {view: finder(request.render(view).detach().clamp(0, 1)) for view in views}
        if not any(bool(mask.any()) for mask in masks.values()):
            raise SceneError(
                f"mask: '{self.text}' was found in none of {len(masks)} views (best score {finder.best:.2f}, threshold "
                f"{finder.threshold:g}). Name it otherwise, or lower mask.options.threshold"
            )
        return masks


class ClipSeg:
    """[H,W,3] in [0,1] to a mask [H,W] of 0 and 1: pixels whose probability for any phrase is over the threshold."""

    def __init__(self, options: Text, device: torch.device):
        from transformers import AutoProcessor, CLIPSegForImageSegmentation

        self.phrases, self.threshold, self.best = options.phrases, options.threshold or 0.4, 0.0
        self.processor = _processor(AutoProcessor, options.path)
        self.model = load(CLIPSegForImageSegmentation, options.path, None, torch.float32).to(device)

    @torch.no_grad()
    def __call__(self, image: Tensor) -> Tensor:
        inputs = self.processor(
            text=self.phrases, images=[_pixels(image)] * len(self.phrases), padding=True, return_tensors="pt"
        ).to(self.model.device)
        logits = self.model(**inputs).logits.reshape(len(self.phrases), 1, *inputs["pixel_values"].shape[-2:])
        logits = F.interpolate(logits, image.shape[:2], mode="bilinear", align_corners=False)
        probability = logits.sigmoid().amax(dim=(0, 1))
        self.best = max(self.best, float(probability.max()))
        return (probability > self.threshold).float()


class GroundedSam:
    """[H,W,3] in [0,1] to a mask [H,W] of 0 and 1: Grounding DINO's boxes over the threshold, each cut out by SAM."""

    def __init__(self, options: Text, device: torch.device):
        from transformers import AutoProcessor, GroundingDinoForObjectDetection, SamModel

        self.words = " ".join(f"{phrase}." for phrase in options.phrases)  # as the model was trained to read them
        self.threshold, self.best = options.threshold or 0.35, 0.0
        model_type(options.sam, SAM)
        self.processor, self.sam_processor = (_processor(AutoProcessor, path) for path in (options.path, options.sam))
        self.detector = load(GroundingDinoForObjectDetection, options.path, None, torch.float32).to(device)
        self.sam = load(SamModel, options.sam, None, torch.float32).to(device)

    def __call__(self, image: Tensor) -> Tensor:
        pixels = _pixels(image)
        boxes = self.boxes(pixels)
        return self.cut_out(pixels, boxes) if len(boxes) else torch.zeros(image.shape[:2])

    @torch.no_grad()
    def boxes(self, pixels: np.ndarray) -> Tensor:
        """Left, top, right, bottom in pixels, [B,4], of everything that is found."""
        inputs = self.processor(images=pixels, text=self.words, return_tensors="pt").to(self.detector.device)
        found = self.detector(**inputs)
        scores = found.logits[0].sigmoid().amax(dim=-1)  # of the words that a box answers to best
        self.best = max(self.best, float(scores.max()))
        x, y, w, h = found.pred_boxes[0][scores > self.threshold].unbind(dim=-1)
        height, width = pixels.shape[:2]
        corners = torch.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], dim=-1)
        return corners.clamp(0, 1) * corners.new_tensor([width, height, width, height])

    @torch.no_grad()
    def cut_out(self, pixels: np.ndarray, boxes: Tensor) -> Tensor:
        """The union [H,W] of what the boxes [B,4] hold."""
        inputs = self.sam_processor(images=pixels, input_boxes=[boxes.tolist()], return_tensors="pt")
        sizes = inputs.pop("original_sizes"), inputs.pop("reshaped_input_sizes")
        inputs = {name: value.to(self.sam.device, torch.float32) for name, value in inputs.items()}
        predicted = self.sam(**inputs, multimask_output=False).pred_masks.cpu()
        (masks,) = self.sam_processor.image_processor.post_process_masks(predicted, *sizes)  # [B,1,H,W] bool
        return masks.flatten(0, 1).any(dim=0).float()


MODELS = {CLIPSEG: ClipSeg, DINO: GroundedSam}


def model_type(path: str, *wanted: str) -> str:
    """What kind of model `path` holds (a local folder, or a Hugging Face id that is downloaded once), one of `wanted`.

    Raises PriorError: no such folder, an id that cannot be had, another kind of model.
    """
    from transformers import AutoConfig

    folder = find_folder(path, "config.json, weights and preprocessor", EXAMPLES[wanted[0]])
    try:
        kind = AutoConfig.from_pretrained(path).model_type
    except (OSError, ValueError, KeyError) as error:
        fault = not_given(path, error) if folder is None else f"{path}: has no config.json of a model that is known."
        raise PriorError(fault) from error
    if kind not in wanted:
        good = " or ".join(f"{name} (such as {EXAMPLES[name]})" for name in wanted)
        raise PriorError(f"{path}: is a '{kind}', expected {good}.")
    return kind


def _processor(kind: type, path: str) -> Any:
    try:
        return kind.from_pretrained(path)
    except (OSError, ValueError, TypeError) as error:
        raise PriorError(
            f"{path}: its tokenizer or image processor cannot be loaded: {str(error).splitlines()[0]} "
            "Download the folder again, complete."
        ) from error


def _pixels(image: Tensor) -> np.ndarray:
    """uint8 [H,W,3] of [H,W,3] in [0,1]."""
    return (image * 255).round().to(torch.uint8).cpu().numpy()
