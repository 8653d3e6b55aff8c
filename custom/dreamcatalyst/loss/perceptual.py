"""LPIPS (Zhang et al. 2018) with the VGG-16 features, from weights that the user has.

The image goes through 13 convolutions; after each of five blocks the features of both images are normalised over their
channels, and their squared differences weighted, channel by channel, by weights that were fitted to human judgement.
Two files hold all of it: torchvision's VGG-16 (`features.*`) and LPIPS's linear weights (`lin0.model.1.weight` ...).
"""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..errors import ConfigError

BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))  # output channels, Simonyan 2015
WEIGHT_BYTES = 4 * sum(9 * i * o + o for i, o in zip((3, *sum(BLOCKS, ())), sum(BLOCKS, ()), strict=False))
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # ImageNet's mean and deviation on [-1,1]
SMALLEST = 16  # pixels a side: four poolings
VGG_FILES = ("vgg16*.pth", "vgg16*.pt", "vgg16*.safetensors")
LINEAR_FILES = ("vgg.pth", "lpips*.pth", "lpips*.safetensors")


def _find(folder: Path, patterns: tuple[str, ...], what: str, where: str) -> dict[str, Tensor]:
    found = [path for pattern in patterns for path in sorted(folder.glob(pattern))]
    if not found:
        have = ", ".join(sorted(p.name for p in folder.iterdir())) if folder.is_dir() else "no such folder"
        raise ConfigError(f"{where}: {folder} has no {what} ({' or '.join(patterns)}; found: {have or 'nothing'}).")
    if found[0].suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(found[0])
    return torch.load(found[0], map_location="cpu", weights_only=True)


def standardised(images: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B 3 H W"]:
    """Images [B,H,W,3] in [0,1] as the network saw those of ImageNet: [B,3,H,W] of mean 0 and deviation 1."""
    shift, scale = (images.new_tensor(values).view(1, 3, 1, 1) for values in (SHIFT, SCALE))
    return (2 * images.permute(0, 3, 1, 2) - 1 - shift) / scale


class Lpips:
    """The distance as a function. folder: holds both weight files. Raises ConfigError where one is missing or does not
    have the layers of VGG-16."""

    def __init__(self, folder: str | Path, device: torch.device | str = "cpu", where: str = "loss.perceptual_weights"):
        folder = Path(folder)
        vgg = _find(folder, VGG_FILES, "VGG-16 weights", where)
        linear = _find(folder, LINEAR_FILES, "LPIPS weights", where)
        self.blocks: list[list[tuple[Tensor, Tensor]]] = []
        self.linear: list[Tensor] = []
        place, channels = 0, 3  # torchvision numbers convolutions, activations and poolings alike
        for number, widths in enumerate(BLOCKS):
            self.blocks.append([])
            width = widths[-1]
            for width in widths:
                weight = self._take(vgg, f"features.{place}.weight", (width, channels, 3, 3), where)
                bias = self._take(vgg, f"features.{place}.bias", (width,), where)
                self.blocks[-1].append((weight.to(device), bias.to(device)))
                place, channels = place + 2, width
            place += 1
            lin = self._take(linear, f"lin{number}.model.1.weight", (1, width, 1, 1), where)
            self.linear.append(lin.to(device))

    @staticmethod
    def _take(weights: dict[str, Tensor], name: str, shape: tuple[int, ...], where: str) -> Tensor:
        if name not in weights or tuple(weights[name].shape) != shape:
            got = "nothing" if name not in weights else tuple(weights[name].shape)
            raise ConfigError(
                f"{where}: weight '{name}' is {got}, expected {shape}. Are these files VGG-16's and LPIPS's?"
            )
        return weights[name].float()

    def _features(self, images: Float[Tensor, "B H W 3"]) -> list[Float[Tensor, "B _ _ _"]]:
        x, features = standardised(images), []
        for number, block in enumerate(self.blocks):
            x = F.max_pool2d(x, 2) if number else x
            for weight, bias in block:
                x = F.relu(F.conv2d(x, weight, bias, padding=1))
            features.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return features

    def __call__(self, a: Float[Tensor, "B H W 3"], b: Float[Tensor, "B H W 3"]) -> Float[Tensor, ""]:
        """Mean distance of images a, b [B,H,W,3] in [0,1], a scalar >= 0, differentiable in both; sides of 16 pixels
        and more (smaller ones are enlarged)."""
        if min(a.shape[1:3]) < SMALLEST:
            size = [max(SMALLEST, side) for side in a.shape[1:3]]
            a, b = (F.interpolate(x.permute(0, 3, 1, 2), size, mode="bilinear").permute(0, 2, 3, 1) for x in (a, b))
        pairs = zip(self._features(a), self._features(b), self.linear, strict=True)
        return reduce(torch.add, (F.conv2d((x - y).square(), lin).mean() for x, y, lin in pairs))
