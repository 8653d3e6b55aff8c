"""The latents of all pairs: encoded once, kept on disk, drawn from memory."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ... import files, plugin
from ...errors import FileError
from ...meter import Meter
from .data import Pairs

BATCH = 32
KINDS = ("source", "edited")


@torch.no_grad()
def encode_pairs(vae: Any, pairs: Pairs, device: torch.device) -> dict[str, Tensor]:
    """The posterior's mode of all n pairs and of their mirror images, unscaled, as "source" and "edited": float16
    [2n,C,h,w] on the CPU, pair i at i and mirrored at n + i. vae: an AutoencoderKL."""
    n = len(pairs)
    meter = Meter("encode", 4 * n, "image", passing=True)
    made: dict[str, Tensor] = {}
    for done, kind in enumerate(KINDS):
        parts: tuple[list[Tensor], list[Tensor]] = ([], [])
        for start in range(0, n, BATCH):
            images = pairs.images(kind, slice(start, start + BATCH)).to(device) * 2 - 1
            for part, view in zip(parts, (images, images.flip(-1)), strict=True):
                view = view.contiguous(memory_format=torch.channels_last)
                part.append(vae.encode(view).latent_dist.mode().half().cpu())
            meter.update(2 * (done * n + start))
        made[kind] = torch.cat([*parts[0], *parts[1]])
    meter.close()
    return made


def cached_latents(file: Path, vae: Any, pairs: Pairs, device: torch.device) -> dict[str, Tensor]:
    """`encode_pairs`, or what it gave before for the same weights and the same pairs, from `file`."""
    key = _key(vae, pairs)
    if file.exists():
        try:
            kept, _ = files.load(file)
        except FileError as error:
            plugin.warn(f"{error}; the latents are made again")
        else:
            if kept["key"] == key:
                return kept
    made = {"key": key, **encode_pairs(vae, pairs, device)}
    files.save(file, made)
    return made


def _key(vae: Any, pairs: Pairs) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for value in vae.state_dict().values():
        digest.update(value.cpu().contiguous().numpy().tobytes())
    for kind in KINDS:
        digest.update(pairs.arrays[kind].tobytes())
    return digest.hexdigest()
