"""The three networks of a small InstructPix2Pix, and how each stage of their training goes.

Sources: Rombach et al. 2022 (latent diffusion), Brooks et al. 2023 (InstructPix2Pix). All are classes of diffusers and
transformers, so that what is trained here loads wherever the large model does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any, Protocol

import torch
from torch import nn

from ...config import AtLeastOne, BelowOne, Count, Fraction, NonNegative, Positive, Range
from ...errors import ConfigError

LATENTS = 4  # channels of a latent; the U-Net takes the noisy one and the image's
TIMESTEPS = 1000
MEGABYTES = 24  # of weights in half precision, at most: what a repository may carry


class Networks(Protocol):
    """vae, text_encoder and unet by name, of the classes of diffusers and transformers (an nn.ModuleDict of them)."""

    def __getitem__(self, key: str, /) -> Any: ...

    def items(self) -> Iterable[tuple[str, Any]]: ...


@dataclass(frozen=True)
class Stage:
    """How long and how one stage trains."""

    steps: AtLeastOne = 1000
    minutes: Positive | None = None  # ends the stage earlier, and the schedule with it; resumed bits depend on speed
    batch_size: AtLeastOne = 8
    learning_rate: NonNegative = 1e-3  # AdamW's; warmed up, then down a cosine to zero
    warm_up: Count = 100  # steps
    ema: BelowOne = 0.999  # of the weights that are kept, per step


@dataclass(frozen=True)
class AutoencoderConfig(Stage):
    """AutoencoderKL: an image to latents of four channels at 1/2^(levels - 1) of its sides, and back."""

    channels: tuple[AtLeastOne, ...] = (16, 32, 64)
    layers: AtLeastOne = 1  # residual blocks per level; the decoder has one more
    groups: AtLeastOne = 4  # of the group norms. Few: what is constant over an image survives a norm over many channels
    crop: AtLeastOne = 64  # pixels; most of the training is on crops of this side
    whole: Fraction = 0.3  # the last part of the stage, on whole images: a group norm sees other statistics on crops
    kl: NonNegative = 1e-3  # weight of the divergence from a unit Gaussian, per latent element
    gradients: NonNegative = 0.5  # weight of the error in the images' gradients, beside that of the images

    def __post_init__(self) -> None:
        _divisible(self.channels, self.groups, "channels")
        if self.crop % self.factor:
            raise ConfigError(f"crop: got {self.crop}, expected a multiple of {self.factor} (the latents' factor)")

    @property
    def factor(self) -> int:
        """Pixels per latent along a side."""
        return 2 ** (len(self.channels) - 1)


@dataclass(frozen=True)
class TextConfig:
    """CLIP's text encoder, trained from nothing together with the U-Net."""

    width: AtLeastOne = 128
    layers: AtLeastOne = 2
    heads: AtLeastOne = 4
    tokens: Annotated[int, Range("[3, inf)")] = 32  # longest instruction, marks of start and end included

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ConfigError(f"width: got {self.width}, expected a multiple of heads={self.heads}")


@dataclass(frozen=True)
class UnetConfig(Stage):
    """UNet2DConditionModel on noisy latents and the image's, with cross-attention to the text.

    The widest level and one of half its width are both there: FreeU acts on these two.
    """

    batch_size: AtLeastOne = 16
    channels: tuple[AtLeastOne, ...] = (48, 96, 192)
    attention: tuple[bool, ...] = (False, False, True)  # by level; the middle always attends
    layers: AtLeastOne = 1
    groups: AtLeastOne = 8
    heads: AtLeastOne = 4
    drop_text: Fraction = 0.05  # Brooks et al. 2023, as the next two
    drop_image: Fraction = 0.05
    drop_both: Fraction = 0.05

    def __post_init__(self) -> None:
        _divisible(self.channels, self.groups, "channels")
        if len(self.attention) != len(self.channels):
            raise ConfigError(f"attention: got {len(self.attention)} levels, expected {len(self.channels)} as channels")
        if max(self.channels) not in [2 * width for width in self.channels]:
            raise ConfigError(
                f"channels: got {self.channels}, expected the widest and one of half its width: FreeU acts on both"
            )
        if not 0 <= self.drop_text + self.drop_image + self.drop_both < 1:
            raise ConfigError("drop_text, drop_image, drop_both: expected a sum in [0, 1)")


def _divisible(channels: tuple[int, ...], groups: int, name: str) -> None:
    if not channels or any(width % groups for width in channels):
        raise ConfigError(f"{name}: got {channels}, expected multiples of groups={groups}")


def make_autoencoder(config: AutoencoderConfig, size: int) -> nn.Module:
    """AutoencoderKL for images of `size` pixels, new. No attention: it would look no further than a crop."""
    from diffusers import AutoencoderKL

    levels = len(config.channels)
    by_level: dict[str, Any] = dict(  # which diffusers annotates as tuples of one
        block_out_channels=config.channels,
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
    )
    vae = AutoencoderKL(
        **by_level,
        layers_per_block=config.layers,
        norm_num_groups=config.groups,
        latent_channels=LATENTS,
        sample_size=size,
        mid_block_add_attention=False,
    )
    begin_with_colours(vae)
    return vae


@torch.no_grad()
def begin_with_colours(vae: nn.Module) -> None:
    """Let the image's colours through from the start: the first three channels carry them from convolution to
    convolution, averaged where the image is halved, beside random features. From random weights alone thousands of
    steps go by before the autoencoder has more than brightness to tell."""
    centre, quarters = ((1, 1),), ((0, 0), (0, 1), (1, 0), (1, 1))
    for name, conv in vae.named_modules():
        if name.endswith("downsamplers.0.conv"):
            _pass_on(conv, quarters)
        elif name.endswith(("conv_shortcut", "quant_conv")):
            _pass_on(conv, ((0, 0),))
        elif name.endswith(("conv_in", "upsamplers.0.conv")):
            _pass_on(conv, centre)
        elif name.endswith("conv_out"):
            _pass_on(conv, centre, gain=2.0)  # after a SiLU, whose slope at zero is a half


def _pass_on(conv: Any, taps: tuple[tuple[int, int], ...], gain: float = 1.0) -> None:
    """Make the first three channels of an nn.Conv2d those of its input, as the mean over `taps` (row, column)."""
    conv.weight[:3] = 0
    conv.bias[:3] = 0
    for channel, (row, column) in product(range(3), taps):
        conv.weight[channel, channel, row, column] = gain / len(taps)


def make_text_encoder(config: TextConfig, vocabulary: int) -> nn.Module:
    """A random CLIPTextModel over so many tokens, the last two of which mark start and end."""
    from transformers import CLIPTextConfig, CLIPTextModel

    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=vocabulary,
            hidden_size=config.width,
            intermediate_size=4 * config.width,
            num_hidden_layers=config.layers,
            num_attention_heads=config.heads,
            max_position_embeddings=config.tokens,
            projection_dim=config.width,
            bos_token_id=vocabulary - 2,
            eos_token_id=vocabulary - 1,
            pad_token_id=vocabulary - 1,
        )
    )


def make_unet(config: UnetConfig, text: TextConfig, size: int) -> nn.Module:
    """A random UNet2DConditionModel for latents of `size`."""
    from diffusers import UNet2DConditionModel

    return UNet2DConditionModel(
        sample_size=size,
        in_channels=2 * LATENTS,
        out_channels=LATENTS,
        block_out_channels=config.channels,
        layers_per_block=config.layers,
        norm_num_groups=config.groups,
        attention_head_dim=config.heads,  # which diffusers takes for the number of heads
        cross_attention_dim=text.width,
        down_block_types=tuple("CrossAttnDownBlock2D" if a else "DownBlock2D" for a in config.attention),
        up_block_types=tuple("CrossAttnUpBlock2D" if a else "UpBlock2D" for a in reversed(config.attention)),
    )


def make_networks(
    autoencoder: AutoencoderConfig, text: TextConfig, unet: UnetConfig, size: int, vocabulary: int, seed: int
) -> Networks:
    """vae, text_encoder and unet with weights drawn from `seed`. Raises ConfigError where they would be too large."""
    if size % autoencoder.factor or size // autoencoder.factor % 2 ** (len(unet.channels) - 1):
        raise ConfigError(f"data.size: got {size}, which {len(unet.channels)} levels of the U-Net cannot halve evenly")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        networks = nn.ModuleDict(
            {
                "vae": make_autoencoder(autoencoder, size),
                "text_encoder": make_text_encoder(text, vocabulary),
                "unet": make_unet(unet, text, size // autoencoder.factor),
            }
        )
    megabytes = {name: sum(p.numel() for p in part.parameters()) * 2 / 1e6 for name, part in networks.items()}
    if sum(megabytes.values()) > MEGABYTES:
        sizes = ", ".join(f"{name} {size:.1f}" for name, size in megabytes.items())
        raise ConfigError(
            f"system: {sum(megabytes.values()):.1f} MB of weights in half precision ({sizes}), expected at most "
            f"{MEGABYTES}. Lower system.unet.channels."
        )
    return networks
