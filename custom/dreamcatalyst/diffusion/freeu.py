"""FreeU: stronger backbone features and weaker low frequencies of the skip features in the decoder of a U-Net.

Source: Si et al. 2023, "FreeU: Free Lunch in Diffusion U-Net", equations 3 to 5 (here with a constant backbone factor,
as in their code). Nothing is forked: the wrapper hooks into the residual blocks of a diffusers U-Net and comes off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..config import NonNegative
from ..errors import ConfigError, PriorError, choose

MODES = ("none", "paper", "diffusers")


@dataclass(frozen=True)
class FreeUConfig:
    """mode: none; paper, the sites of the paper's code, decided by the channels of the incoming backbone tensor;
    diffusers, `enable_freeu`, decided by block (up-block 0: b1, s1; up-block 1: b2, s2), which is another set of sites.

    b1, b2: factor of the first half of the backbone's channels, at the widest sites and at those half as wide.
    s1, s2: factor of the lowest frequencies of the skip tensor at the same sites. 1 leaves a site alone.
    The defaults are those of the code published with DreamCatalyst; its paper calls b = 1.3 over-editing.
    """

    mode: str = "none"
    b1: NonNegative = 1.1
    b2: NonNegative = 1.1
    s1: NonNegative = 0.9
    s2: NonNegative = 0.2

    def __post_init__(self) -> None:
        choose("FreeU mode", self.mode, MODES, "freeu.mode")
        for name in ("b1", "b2", "s1", "s2"):
            if self.mode == "diffusers" and getattr(self, name) == 0:
                raise ConfigError(f"freeu.{name}: diffusers takes a factor of 0 for 'off'; use 1e-6 or mode 'paper'")

    @property
    def factors(self) -> dict[int, tuple[float, float]]:
        """Stage (1 widest, 2 half as wide) to its (b, s)."""
        return {1: (self.b1, self.s1), 2: (self.b2, self.s2)}


class Site(NamedTuple):
    """A residual block of the decoder whose input is cat([backbone, skip]): its name in the U-Net, the block, how many
    of its input channels are the backbone's, and the stage (1: as many as the widest block, 2: half of that)."""

    name: str
    block: nn.Module
    backbone: int
    stage: int


def freeu_sites(unet: Any) -> list[Site]:
    """The sites of the paper's code, stated relatively to the U-Net's widest block: 7 of stage 1 and 3 of stage 2 on
    Stable Diffusion 1.5 (all blocks of up-blocks 0 and 1 and the first of 2; the last two of 2 and the first of 3)."""
    return [site for site in _decoder(unet) if site.stage]


def _decoder(unet: Any) -> Iterator[Site]:
    """Every residual block of the decoder in running order; stage 0 where FreeU has no business."""
    widest = max(unet.config.block_out_channels)
    stages = {widest: 1, widest / 2: 2}
    backbone = unet.config.block_out_channels[-1]  # the middle block keeps the width of the last down-block
    for i, up_block in enumerate(unet.up_blocks):
        for j, resnet in enumerate(up_block.resnets):
            yield Site(f"up_blocks.{i}.resnets.{j}", resnet, backbone, stages.get(backbone, 0))
            backbone = resnet.out_channels


def filter_low_frequencies(x: Float[Tensor, "B C h w"], scale: float) -> Float[Tensor, "B C h w"]:
    """Multiply the 2x2 block of lowest frequencies of x by `scale`.

    The block is the four coefficients around the centre of the shifted spectrum, frequencies {-1, 0} per axis, and the
    real part of the result is kept, as in the paper's code. Seven real basis functions span what these coefficients
    can change, so two thin matrix products replace two Fourier transforms; they run in float32 at least, for any size.
    """
    basis = _low_frequency_basis(x.shape[-2], x.shape[-1], x.device, torch.promote_types(x.dtype, torch.float32))
    flat = x.flatten(2).to(basis.dtype)
    low = (flat @ basis) @ basis.T
    return torch.add(flat, low, alpha=scale - 1).view(x.shape).to(x.dtype)


def _low_frequency_basis(h: int, w: int, device: torch.device, dtype: torch.dtype) -> Float[Tensor, "{h}*{w} n"]:
    """n vectors with x -> x @ basis @ basis.T the real part of the projection onto frequencies {-1, 0} x {-1, 0}."""

    def phases(n: int) -> list[Tensor]:
        angle = torch.arange(n, device=device, dtype=dtype) * (2 * math.pi / n)
        return [torch.zeros_like(angle)] if n == 1 else [torch.zeros_like(angle), angle]

    angles = torch.stack([(y[:, None] + x[None, :]).flatten() for y in phases(h) for x in phases(w)], dim=1)
    # cos(a - b) = cos a cos b + sin a sin b; the sine of the constant, the first column, is zero
    return torch.cat([angles.cos(), angles[:, 1:].sin()], dim=1) / math.sqrt(h * w)


class FreeU:
    """FreeU on one U-Net: `install` puts it on, `remove` takes it off without a trace.

    unet: a diffusers UNet2DConditionModel. Raises PriorError where a factor would find no site to act on.
    Where b = s = 1 nothing is hooked and the U-Net's output is the same to the bit.
    """

    def __init__(self, unet: Any, config: FreeUConfig):
        self.unet, self.config = unet, config
        self._handles: list = []
        self._active = {stage: bs for stage, bs in config.factors.items() if config.mode != "none" and bs != (1, 1)}
        self._sites = [site for site in freeu_sites(unet) if site.stage in self._active]
        self._require_sites()

    def _require_sites(self) -> None:
        if self.config.mode == "paper":
            missing = self._active.keys() - {site.stage for site in self._sites}
        else:  # diffusers acts on the up-blocks numbered 0 and 1
            missing = self._active.keys() - {getattr(b, "resolution_idx", -1) + 1 for b in self.unet.up_blocks}
        for stage in sorted(missing):
            widths = tuple(self.unet.config.block_out_channels)
            raise PriorError(
                f"freeu.mode={self.config.mode}: no decoder block of this U-Net (widths {widths}) takes b{stage} and "
                f"s{stage}. Set freeu.b{stage}=1 freeu.s{stage}=1 to leave that stage out, or freeu.mode=none."
            )

    def install(self) -> FreeU:
        """Put FreeU on; putting it on twice is putting it on once."""
        self.remove()
        if self.config.mode == "paper":
            for site in self._sites:
                self._handles.append(site.block.register_forward_pre_hook(_hook(site, *self._active[site.stage])))
        elif self._active:
            c = self.config
            self.unet.enable_freeu(s1=c.s1, s2=c.s2, b1=c.b1, b2=c.b2)
        return self

    def remove(self) -> None:
        """Take FreeU off."""
        for handle in self._handles:
            handle.remove()
        self._handles.clear()
        if self.config.mode == "diffusers":
            self.unet.disable_freeu()


def _hook(site: Site, b: float, s: float):
    """A forward pre-hook that edits the first argument, cat([backbone, skip]) along the channels."""

    def edit(_: nn.Module, args: tuple) -> tuple:
        backbone, skip = args[0].split([site.backbone, args[0].shape[1] - site.backbone], dim=1)
        strong, rest = backbone.tensor_split([site.backbone // 2], dim=1)
        if s != 1:
            skip = filter_low_frequencies(skip, s)
        return (torch.cat([strong * b, rest, skip], dim=1), *args[1:])

    return edit
