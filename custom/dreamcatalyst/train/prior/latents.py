"""The latents of all pairs: encoded once, kept on disk, drawn from memory."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..progress import Meter
from .data import Pairs

BATCH = 32
KINDS = ("source", "edited")


@torch.no_grad()
def encode_pairs(vae: nn.Module, pairs: Pairs, device: torch.device) -> dict[str, Tensor]:
    """The posterior's mode of every pair, unscaled, float16 [n,C,h,w] on the CPU, as "source" and "edited"."""
    n = len(pairs)
    meter = Meter("encode", 2 * n, "image", passing=True)
    made: dict[str, Any] = {}
    for done, kind in enumerate(KINDS):
        parts = []
        for start in range(0, n, BATCH):
            images = pairs.images(kind, slice(start, start + BATCH)).to(device)
            parts.append(vae.encode(images * 2 - 1).latent_dist.mode().half().cpu())
            meter.update(done * n + start)
        made[kind] = torch.cat(parts)
    meter.close()
    return made


def cached_latents(file: Path, vae: nn.Module, pairs: Pairs, device: torch.device) -> dict[str, Tensor]:
    """`encode_pairs`, or what it gave before for the same weights and the same pairs, from `file`."""
    key = _key(vae, pairs)
    if file.exists():
        kept = torch.load(file, weights_only=True)
        if kept["key"] == key:
            return kept
    made = {"key": key, **encode_pairs(vae, pairs, device)}
    part = file.with_suffix(".part")
    torch.save(made, part)
    part.replace(file)
    return made


def _key(vae: nn.Module, pairs: Pairs) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for value in vae.state_dict().values():
        digest.update(value.cpu().contiguous().numpy().tobytes())
    for kind in KINDS:
        digest.update(pairs.arrays[kind].tobytes())
    return digest.hexdigest()
