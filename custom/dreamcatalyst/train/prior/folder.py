"""What training leaves: a folder of weights that diffusers loads as an InstructPix2Pix, with its card and licence."""

from __future__ import annotations

import copy
import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from .models import TIMESTEPS, Networks
from .vocabulary import write_tokenizer

PIPELINE = "StableDiffusionInstructPix2PixPipeline"
SCHEDULER = {  # the noise of Stable Diffusion; sampling goes from its last timestep (Lin et al. 2024) in equal strides
    "_class_name": "DDIMScheduler",
    "_diffusers_version": "0.30.0",
    "num_train_timesteps": TIMESTEPS,
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
    "timestep_spacing": "trailing",
    "clip_sample": False,
    "set_alpha_to_one": True,
    "steps_offset": 0,
}
INDEX = {
    "_class_name": PIPELINE,
    "_diffusers_version": "0.30.0",
    "feature_extractor": [None, None],
    "image_encoder": [None, None],
    "requires_safety_checker": False,
    "safety_checker": [None, None],
    "scheduler": ["diffusers", "DDIMScheduler"],
    "text_encoder": ["transformers", "CLIPTextModel"],
    "tokenizer": ["transformers", "CLIPTokenizer"],
    "unet": ["diffusers", "UNet2DConditionModel"],
    "vae": ["diffusers", "AutoencoderKL"],
}
CARD = """---
license: mit
library_name: diffusers
pipeline_tag: image-to-image
---
# A small InstructPix2Pix

{megabytes:.1f} MB: an AutoencoderKL, a CLIP text encoder and a U-Net on latents, for images of {size} x {size} pixels,
trained from nothing on {pairs:,} pairs by `python launch.py --config configs/prior.yaml`.
It knows pictures of the kind that its pairs show (below) and these edits of them, each in several wordings
(`instructions.json`):

{edits}.

Other things and other instructions are beyond it.

Trained: autoencoder {autoencoder:,} steps, text encoder and U-Net {unet:,} steps. Scheduler: {scheduler}.

## Where the pairs come from

{origin}

## Figures

`python benchmarks/prior.py --card` measures it on worlds that it never saw and writes the table here.
"""
LICENCE = """MIT License

Copyright (c) 2026 the authors of DreamCatalyst for Gaussian splats

Permission is hereby granted, free of charge, to any person obtaining a copy of these model weights and associated
documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit
persons to whom the Software is furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""


def write_prior(
    folder: Path,
    networks: Networks,
    merges: list[tuple[str, str]],
    latent_std: float,
    instructions: Mapping[str, Sequence[str]],
    card: Mapping[str, object],
) -> Path:
    """Write vae, text_encoder and unet in half precision, with tokenizer, scheduler, index, card and licence.

    latent_std: of the unscaled latents, whose inverse is the scaling factor. instructions: what it was taught, the
    wordings by edit. card: the facts of the model card that are not seen in the networks (pairs, steps, origin).
    """
    from transformers.utils import logging

    logging.disable_progress_bar()  # which it would draw into the run's own line
    folder.mkdir(parents=True, exist_ok=True)
    for name, network in networks.items():
        half = copy.deepcopy(network).to("cpu", memory_format=torch.contiguous_format).half()
        if name == "vae":
            half.register_to_config(scaling_factor=round(1 / latent_std, 5))
        half.save_pretrained(folder / name, safe_serialization=True)
    _say_float32(folder / "text_encoder/config.json")
    length = networks["text_encoder"].config.max_position_embeddings
    write_tokenizer(folder / "tokenizer", merges, length)
    facts = {
        "megabytes": sum(p.numel() for _, network in networks.items() for p in network.parameters()) * 2 / 1e6,
        "size": networks["vae"].config.sample_size,
        "edits": textwrap.fill(", ".join(sorted(instructions)), 118),
        "scheduler": f"{SCHEDULER['beta_schedule']}, {SCHEDULER['prediction_type']}",
    }
    texts = {
        "scheduler/scheduler_config.json": json.dumps(SCHEDULER, indent=2),
        "model_index.json": json.dumps(INDEX, indent=2),
        "instructions.json": json.dumps(instructions, indent=1),
        "README.md": CARD.format(**facts, **card),
        "LICENSE": LICENCE,
    }
    for name, text in texts.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def _say_float32(config: Path) -> None:
    """Newer versions of transformers load weights in the precision that the config names, and the pipeline would mix
    it with the float32 that diffusers loads by default."""
    values = json.loads(config.read_text(encoding="utf-8"))
    values = {key: "float32" if key in ("dtype", "torch_dtype") else value for key, value in values.items()}
    config.write_text(json.dumps(values, indent=2), encoding="utf-8")
