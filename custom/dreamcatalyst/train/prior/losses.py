"""What the two stages minimise."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from .models import Networks

SCALES = 4  # halvings of an image, at most, at which its error is seen again


def reconstruction_loss(image: Tensor, target: Tensor, gradients: float) -> Tensor:
    """Mean L1 of the error at each of several scales, and `gradients` times that of the error's finite differences.

    image, target [B,3,H,W]. At a coarse scale only what is wrong over an area is left, so that the colour of a sky or
    a floor weighs as much as its grain; the differences keep edges sharp. No network is asked what looks alike.
    """
    error = image - target
    loss = error.abs().mean()
    loss = loss + gradients * (error.diff(dim=-1).abs().mean() + error.diff(dim=-2).abs().mean())
    for _ in range(SCALES):
        if min(error.shape[-2:]) < 2:
            break
        error = F.avg_pool2d(error, 2)
        loss = loss + error.abs().mean()
    return loss


def noised(clean: Tensor, noise: Tensor, abar: Tensor) -> tuple[Tensor, Tensor]:
    """x_t and v of clean latents [B,C,h,w] at abar [B] (Salimans & Ho 2022: v = sqrt(abar) eps - sqrt(1-abar) x_0)."""
    signal, sigma = abar.sqrt()[:, None, None, None], (1 - abar).sqrt()[:, None, None, None]
    return signal * clean + sigma * noise, signal * noise - sigma * clean


def unet_loss(networks: Networks, abar: Tensor, inputs: Sequence[Tensor], rows: slice) -> Tensor:
    """What `rows` of a batch add to its mean squared error in v (Salimans & Ho 2022), unweighted: what an instruction
    asks for is decided at high noise, where weights by the signal-to-noise ratio all but vanish.

    networks: "unet" and "text_encoder". abar [T]. inputs: of `stages.unet_inputs`.
    """
    clean, image, ids, noise, t = (tensor[rows] for tensor in inputs)
    noisy, v = noised(clean, noise, abar.to(clean.device)[t])
    joined = torch.cat([noisy, image], 1).to(memory_format=torch.channels_last)
    text = networks["text_encoder"](ids)[0]
    predicted = networks["unet"](joined, t, encoder_hidden_states=text, return_dict=False)[0]
    return F.mse_loss(predicted.float(), v, reduction="sum") / inputs[0].numel()
