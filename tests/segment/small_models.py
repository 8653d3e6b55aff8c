"""Small models of the classes that segmenters load, in the folder layout of the hub, made on the spot."""

from __future__ import annotations

from pathlib import Path

import torch

from tests.diffusion.small_model import _vocabulary, _write_tokenizer

SIDE = 32  # pixels of the images that they look at
WORDS = ("green", "disc", "red", "wall", "fox", "head")


def make_clipseg(path: Path, learn=None) -> Path:
    """A CLIPSeg. learn: a function of (model, processor) that trains it before it is saved."""
    from transformers import (
        CLIPSegConfig,
        CLIPSegForImageSegmentation,
        CLIPSegProcessor,
        CLIPSegTextConfig,
        CLIPSegVisionConfig,
        CLIPTokenizer,
        ViTImageProcessor,
    )

    _write_tokenizer(path)
    marks = len(_vocabulary()[0])
    ends = dict(bos_token_id=marks - 2, eos_token_id=marks - 1, pad_token_id=marks - 1)
    size = dict(hidden_size=32, intermediate_size=64, num_hidden_layers=3, num_attention_heads=4)
    text = CLIPSegTextConfig(vocab_size=marks, max_position_embeddings=32, **size, **ends)
    vision = CLIPSegVisionConfig(image_size=SIDE, patch_size=4, **size)
    config = CLIPSegConfig(
        text_config=text.to_dict(),
        vision_config=vision.to_dict(),
        projection_dim=32,
        extract_layers=[1, 2],
        reduce_dim=16,
        decoder_num_attention_heads=4,
        decoder_intermediate_size=32,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = CLIPSegForImageSegmentation(config)
    images = ViTImageProcessor(size={"height": SIDE, "width": SIDE}, image_mean=[0.5] * 3, image_std=[0.5] * 3)
    processor = CLIPSegProcessor(images, CLIPTokenizer.from_pretrained(path))
    if learn is not None:
        learn(model, processor)
    model.save_pretrained(path)
    processor.save_pretrained(path)
    return path


def make_grounding_dino(path: Path) -> Path:
    """A Grounding DINO with random weights."""
    from transformers import (
        BertConfig,
        BertTokenizer,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessor,
        GroundingDinoProcessor,
        SwinConfig,
    )

    path.mkdir(parents=True)
    tokens = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "?", *WORDS]
    (path / "vocab.txt").write_text("\n".join(tokens) + "\n", encoding="utf-8")
    backbone = SwinConfig(
        image_size=64,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 2, 2, 2],
        window_size=4,
        out_features=["stage2", "stage3", "stage4"],
    )
    text = BertConfig(
        vocab_size=len(tokens), hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=32
    )
    config = GroundingDinoConfig(
        backbone_config=backbone,
        text_config=text,
        d_model=32,  # its group norms have 32 groups
        num_queries=6,
        encoder_layers=1,
        encoder_ffn_dim=16,
        encoder_attention_heads=2,
        decoder_layers=2,
        decoder_ffn_dim=16,
        decoder_attention_heads=2,
        max_text_len=16,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = GroundingDinoForObjectDetection(config)
    model.save_pretrained(path)
    images = GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96})
    GroundingDinoProcessor(images, BertTokenizer(str(path / "vocab.txt"))).save_pretrained(path)
    return path


def make_sam(path: Path) -> Path:
    """A SAM with random weights."""
    from transformers import (
        SamConfig,
        SamImageProcessor,
        SamMaskDecoderConfig,
        SamModel,
        SamProcessor,
        SamPromptEncoderConfig,
        SamVisionConfig,
    )

    vision = SamVisionConfig(
        hidden_size=16,
        output_channels=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        image_size=64,
        patch_size=8,
        window_size=4,
        num_pos_feats=8,
        mlp_dim=32,
        global_attn_indexes=[0],
    )
    prompt = SamPromptEncoderConfig(hidden_size=16, image_size=64, patch_size=8, mask_input_channels=4)
    decoder = SamMaskDecoderConfig(hidden_size=16, mlp_dim=32, num_hidden_layers=1, num_attention_heads=2)
    config = SamConfig(
        vision_config=vision.to_dict(),
        prompt_encoder_config=prompt.to_dict(),
        mask_decoder_config={**decoder.to_dict(), "iou_head_hidden_dim": 16},
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = SamModel(config)
    model.save_pretrained(path)
    sizes = dict(size={"longest_edge": 64}, pad_size={"height": 64, "width": 64}, mask_size={"longest_edge": 16})
    SamProcessor(SamImageProcessor(**sizes, mask_pad_size={"height": 16, "width": 16})).save_pretrained(path)
    return path
