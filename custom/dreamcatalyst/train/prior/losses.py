"""What the two stages minimise."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

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
