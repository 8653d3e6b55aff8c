"""What a prior makes of images by its own sampling, against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...config import AtLeastOne, Count, DdimSteps, Number
from ...diffusion.api import Prior
from ...diffusion.ip2p import InstructPix2Pix
from ...diffusion.noise import keyed_noise
from ...guidance.ddim import edit_image
from ...report.metrics import METRICS
from ...report.pictures import picture_row
from .data import Pairs

Row = list[tuple[str, Tensor]]  # labelled pictures [H,W,3], side by side


@dataclass(frozen=True)
class SamplesConfig:
    """How held-out pairs are looked at along the way."""

    every: Count = 500  # steps; 0: never
    pictures: AtLeastOne = 12
    steps: DdimSteps = 20  # of DDIM
    guidance_scale: Number = 4.0
    image_guidance_scale: Number = 1.5


@torch.no_grad()
def sampled_edits(
    prior: Prior,
    sources: Tensor,
    instructions: Sequence[str],
    *,
    seed: int = 0,
    steps: DdimSteps = 20,
    guidance_scale: Number = 4.0,
    image_guidance_scale: Number = 1.5,
) -> Tensor:
    """The prior's edit of each image from noise alone, [B,3,H,W] in [0,1]. sources [B,3,H,W] in [0,1]; instructions: B
    of them. The noise of image i is a function of (seed, i)."""
    condition = prior.condition(sources)
    latents = edit_image(
        prior,
        None,
        torch.stack([keyed_noise(seed, 0, i, condition.shape[1:]) for i in range(len(sources))]).to(sources.device),
        image=condition,
        text=torch.stack(prior.embed(list(instructions))),
        steps=steps,
        guidance_scale=guidance_scale,
        image_guidance_scale=image_guidance_scale,
    )
    return prior.decode(latents)


@torch.no_grad()
def reconstruction(prior: Prior, images: Tensor) -> Tensor:
    """What the autoencoder makes of images [B,3,H,W] in [0,1]: the bound of any edit through it."""
    return prior.decode(prior.encode(images))


def scores(candidates: Mapping[str, Tensor], truth: Tensor, mask: Tensor) -> dict[str, Tensor]:
    """PSNR of each candidate [B,3,H,W] against the truth inside and outside of `mask` [B,1,H,W], as
    "<candidate>_inside" and "<candidate>_outside", [B] each; NaN where there is no such pixel."""
    psnr = METRICS.get("psnr")
    rows, inside = truth.permute(0, 2, 3, 1), mask.permute(0, 2, 3, 1)
    out = {}
    for name, images in candidates.items():
        made = images.permute(0, 2, 3, 1)
        out[f"{name}_inside"] = psnr(made, rows, inside)
        out[f"{name}_outside"] = psnr(made, rows, 1 - inside)
    return out


def judge_pairs(
    prior: InstructPix2Pix, pairs: Pairs, index: np.ndarray | list[int], config: SamplesConfig, seed: int = 0
) -> dict[str, Any]:
    """Some of `pairs` and what `prior` makes of them: edit [B] names, instruction [B], source, truth, made
    [B,3,H,W], and the `scores` of leaving the source alone ("unedited"), of the edit, and of the "bound"."""
    device = prior.device
    source, truth = (pairs.images(kind, index).to(device) for kind in ("source", "edited"))
    instructions = [str(text) for text in pairs.instruction[index]]
    made = sampled_edits(
        prior,
        source,
        instructions,
        seed=seed,
        steps=config.steps,
        guidance_scale=config.guidance_scale,
        image_guidance_scale=config.image_guidance_scale,
    )
    candidates = {"unedited": source, "edit": made, "bound": reconstruction(prior, truth)}
    found = scores(candidates, truth, pairs.masks(index).to(device))
    names = pairs.edit[index].tolist()
    return {"edit": names, "instruction": instructions, "source": source, "truth": truth, "made": made, **found}


def score_table(judged: Sequence[Mapping[str, Any]]) -> str:
    """The mean scores of each edit and of all, as text. Infinite ones (an unedited image where it is the truth) and
    those without a pixel are left out of the means."""
    columns = [name for name in judged[0] if name.endswith(("_inside", "_outside"))]
    names = np.array([name for part in judged for name in part["edit"]])
    values = {name: torch.cat([part[name] for part in judged]).cpu().numpy() for name in columns}
    width = max(len(name) for name in [*names, "all"])
    lines = [" ".join([" " * width, "pairs", *(f"{name:>16}" for name in columns)])]
    for name in [*sorted(set(names)), "all"]:
        chosen = (names == name) | (name == "all")
        means = [value[chosen & np.isfinite(value)] for value in values.values()]
        shown = [f"{mean.mean():16.2f}" if len(mean) else " " * 15 + "-" for mean in means]
        lines.append(" ".join([f"{name:<{width}} {chosen.sum():5d}", *shown]))
    return "\n".join(lines)


def edit_rows(judged: Mapping[str, Any]) -> list[Row]:
    """Source, truth and edit of each pair of `judge_pairs`."""
    return [
        [
            (judged["instruction"][i] or "(nothing)", _picture(judged["source"][i])),
            ("truth", _picture(judged["truth"][i])),
            (f"edit, {float(judged['edit_inside'][i]):.1f} dB", _picture(judged["made"][i])),
        ]
        for i in range(len(judged["instruction"]))
    ]


@torch.no_grad()
def reconstruction_rows(
    vae: Any, pairs: Pairs, index: np.ndarray | list[int], device: torch.device
) -> tuple[list[Row], float]:
    """Sources and edited images of pairs, each beside what `vae`, an AutoencoderKL, makes of it; mean PSNR in dB."""
    rows, psnr = [], []
    for i in index:
        images = torch.cat([pairs.images(kind, [i]) for kind in ("source", "edited")]).to(device)
        made = (vae.decode(vae.encode(images * 2 - 1).latent_dist.mode()).sample / 2 + 0.5).clamp(0, 1)
        psnr += (-10 * (made - images).square().mean((1, 2, 3)).log10()).tolist()
        row = [("source", images[0]), (f"{psnr[-2]:.1f} dB", made[0])]
        row += [("edited", images[1]), (f"{psnr[-1]:.1f} dB", made[1])]
        rows.append([(label, _picture(image)) for label, image in row])
    return rows, float(np.mean(psnr))


def sheet(rows: Sequence[Row], columns: int = 3) -> np.ndarray:
    """Rows of pictures of one size as one picture, `columns` of them side by side, the last one filled up white."""
    made = [picture_row(row) for row in rows]
    made += [np.full_like(made[0], 255)] * (-len(made) % columns)
    return np.vstack([np.hstack(made[i : i + columns]) for i in range(0, len(made), columns)])


def _picture(image: Tensor) -> Tensor:
    return image.permute(1, 2, 0)
