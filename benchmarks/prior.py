"""What a prior's own sampling reaches on synthetic scenes that it never saw, against the truth.

python benchmarks/prior.py --picture docs/prior.png     (a folder: --model outputs/prior/.../save/prior)

PSNR inside and outside of the object, for each edit, between leaving the image alone ("unedited") and what the
autoencoder makes of the truth ("bound"); the guidance scales swept on a few pairs; and the null instruction, which must
leave the image alone.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.demo.pairs import CAMERAS, world_pairs  # noqa: E402
from dreamcatalyst.demo.random_world import random_world  # noqa: E402
from dreamcatalyst.diffusion.ip2p import InstructPix2Pix, Ip2pConfig  # noqa: E402
from dreamcatalyst.report.pictures import write_png  # noqa: E402
from dreamcatalyst.train.prior.data import Pairs  # noqa: E402
from dreamcatalyst.train.prior.judge import (  # noqa: E402
    SamplesConfig,
    edit_rows,
    judge_pairs,
    reconstruction,
    sampled_edits,
    score_table,
    sheet,
)

BATCH = 16
FIGURES = "## Figures\n"


def judged_pairs(worlds: int, size: int) -> Pairs:
    """One camera of each edit of the worlds 0 .. worlds - 1, which training never draws."""
    found = []
    for seed in range(worlds):
        cameras: dict[str, list] = {}
        for pair in world_pairs(random_world(seed, CAMERAS, size), np.random.default_rng(seed)):
            cameras.setdefault(str(pair["edit"]), []).append(pair)
        found += [views[(seed + i) % len(views)] for i, views in enumerate(cameras.values())]
    return Pairs({key: np.stack([np.asarray(pair[key]) for pair in found]) for key in found[0]})


def judge(prior: InstructPix2Pix, pairs: Pairs, index: np.ndarray, config: SamplesConfig) -> list[dict]:
    """`judge_pairs` in batches."""
    parts = np.array_split(index, -(-len(index) // BATCH))
    return [judge_pairs(prior, pairs, part.tolist(), config, seed=i) for i, part in enumerate(parts)]


def mean(judged: list[dict], name: str) -> float:
    """Mean of a score over pairs, infinite and missing ones left out."""
    values = torch.cat([part[name] for part in judged])
    return float(values[values.isfinite()].mean())


def sweep(prior: InstructPix2Pix, pairs: Pairs, args: argparse.Namespace) -> SamplesConfig:
    """The pair of guidance scales with the highest PSNR inside, on some pairs that ask for something."""
    asked = np.flatnonzero(pairs.edit != "nothing")
    index = asked[np.linspace(0, len(asked) - 1, min(args.sweep_pairs, len(asked))).round().astype(int)]
    print(f"guidance scales, on {len(index)} pairs: PSNR inside / outside in dB", flush=True)
    best, config = -np.inf, SamplesConfig(steps=args.steps)
    for text, image in product(args.scales, args.image_scales):
        tried = replace(config, guidance_scale=text, image_guidance_scale=image)
        judged = judge(prior, pairs, index, tried)
        inside = mean(judged, "edit_inside")
        print(f"  {text:g} / {image:g}: {inside:.2f} / {mean(judged, 'edit_outside'):.2f}", flush=True)
        if inside > best:
            best, config = inside, tried
    return config


def null_table(prior: InstructPix2Pix, pairs: Pairs, config: SamplesConfig) -> str:
    """What is left of sources that are edited by the empty instruction."""
    index = np.unique(pairs.world, return_index=True)[1][:BATCH]
    source = pairs.images("source", index)
    made = sampled_edits(
        prior,
        source,
        [""] * len(index),
        steps=config.steps,
        guidance_scale=config.guidance_scale,
        image_guidance_scale=config.image_guidance_scale,
    )
    psnr = [
        float((-10 * (image - source).square().mean((1, 2, 3)).log10()).mean())
        for image in (made, reconstruction(prior, source))
    ]
    return f"null instruction on {len(index)} sources: {psnr[0]:.2f} dB to the source, bound {psnr[1]:.2f} dB"


def pick(judged: list[dict], count: int) -> list:
    """Rows of pictures, edits in turn."""
    rows = [(name, row) for part in judged for name, row in zip(part["edit"], edit_rows(part), strict=True)]
    turn: dict[str, int] = {}
    order = []
    for name, row in rows:
        turn[name] = turn.get(name, 0) + 1
        order.append((turn[name], row))
    return [row for _, row in sorted(order, key=lambda entry: entry[0])[:count]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default=str(ROOT / "custom/dreamcatalyst/demo/prior"), help="folder of the prior")
    parser.add_argument("--worlds", type=int, default=100, help="worlds that are judged, from seed 0")
    parser.add_argument("--steps", type=int, default=20, help="of DDIM")
    parser.add_argument("--scales", type=float, nargs="+", default=[1.5, 2.5, 4.0, 7.5], help="text guidance scales")
    parser.add_argument("--image-scales", type=float, nargs="+", default=[1.0, 1.5], help="image guidance scales")
    parser.add_argument("--sweep-pairs", type=int, default=48, help="pairs that the scales are swept on")
    parser.add_argument("--picture", type=Path, help="PNG of edits: source, truth, edit")
    parser.add_argument("--card", action="store_true", help="write the figures into the model's README.md")
    args = parser.parse_args()

    started = time.monotonic()
    prior = InstructPix2Pix(Ip2pConfig(path=args.model))
    pairs = judged_pairs(args.worlds, prior.autoencoder.vae.config.sample_size)
    config = sweep(prior, pairs, args)
    judged = judge(prior, pairs, np.arange(len(pairs)), config)
    report = (
        f"{len(pairs)} pairs of {args.worlds} worlds that it never saw, {config.steps} steps, guidance scales "
        f"{config.guidance_scale:g} (text) and {config.image_guidance_scale:g} (image), PSNR in dB:\n\n"
        f"{score_table(judged)}\n\n{null_table(prior, pairs, config)}"
    )
    print(f"{report}\n{time.monotonic() - started:.0f} s")
    if args.picture:
        write_png(args.picture, sheet(pick(judged, 36)))
    if args.card:
        card = Path(args.model) / "README.md"
        head = card.read_text(encoding="utf-8").partition(FIGURES)[0]
        card.write_text(f"{head}{FIGURES}\n```\n{report}\n```\n", encoding="utf-8")


if __name__ == "__main__":
    main()
