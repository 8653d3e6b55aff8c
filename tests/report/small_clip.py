"""A small CLIP with random weights and a predictor of its width, in the layouts of the hub and of LAION."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from tests.diffusion.small_model import _vocabulary, _write_tokenizer

SIDE, WIDTH = 16, 24
MEAN, STD = [0.4, 0.5, 0.6], [0.2, 0.3, 0.25]


def make_clip(path: Path) -> Path:
    """Write the folder: config, weights, tokenizer, preprocessor."""
    from transformers import CLIPConfig, CLIPModel, CLIPTextConfig, CLIPVisionConfig

    _write_tokenizer(path)
    marks = len(_vocabulary()[0])
    ends = dict(bos_token_id=marks - 2, eos_token_id=marks - 1, pad_token_id=marks - 1)
    size = dict(hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4)
    text = CLIPTextConfig(vocab_size=marks, max_position_embeddings=77, projection_dim=WIDTH, **size, **ends)
    vision = CLIPVisionConfig(image_size=SIDE, patch_size=4, projection_dim=WIDTH, **size)
    config = CLIPConfig(text_config=text.to_dict(), vision_config=vision.to_dict(), projection_dim=WIDTH)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        CLIPModel(config).save_pretrained(path)
    (path / "preprocessor_config.json").write_text(json.dumps({"image_mean": MEAN, "image_std": STD}))
    return path


def make_predictor(path: Path, widths: tuple[int, ...] = (WIDTH, 12, 6, 1)) -> Path:
    """Write linear layers under LAION's names, whose numbers leave room for the dropout between them."""
    generator, weights = torch.Generator().manual_seed(1), {}
    for number, (one, other) in enumerate(zip(widths, widths[1:], strict=False)):
        weights[f"layers.{2 * number}.weight"] = torch.randn(other, one, generator=generator)
        weights[f"layers.{2 * number}.bias"] = torch.randn(other, generator=generator)
    torch.save(weights, path)
    return path
