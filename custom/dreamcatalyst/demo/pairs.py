"""Training pairs: (source render, instruction, edited render) of random worlds, in shards that resume."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor

from ..data.camera import Cameras
from ..errors import DataError
from ..render.api import rasterize
from ..scene.gaussians import Gaussians
from .edits import Edit, apply_edit, possible
from .random_world import HELD_OUT, random_world
from .worlds import World

SHARD = 250  # pairs in one file
CAMERAS, EDITS_PER_WORLD = 3, 4  # each world gives their product in pairs
VISIBLE = 0.03  # a pixel belongs to the object where its splats make up more than this of it
Pair = dict[str, object]


def worded(edit: Edit, rng: Generator) -> str:
    """One of the edit's instructions, the first more often; at times in lower or upper case or with a full stop."""
    text = edit.phrases[0] if rng.random() < 0.3 else edit.phrases[rng.integers(len(edit.phrases))]
    style = rng.random()
    if style < 0.3:
        text = text.lower()
    elif style < 0.35:
        text = text.upper()
    return text + "." if text and rng.random() < 0.1 else text


def draw_edits(world: World, rng: Generator) -> list[Edit]:
    """EDITS_PER_WORLD different edits that make sense in `world`, drawn by their weights."""
    known = possible(world)
    weights = np.array([edit.weight for edit in known])
    chosen = rng.choice(len(known), EDITS_PER_WORLD, replace=False, p=weights / weights.sum())
    return [known[i] for i in chosen]


def _bytes(images: Tensor) -> ndarray:
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _drawn(scene: Gaussians, cameras: Cameras, rows: tuple[int, int] | None) -> tuple[ndarray, Tensor | None]:
    """Images uint8 [V,H,W,3], and how much of each pixel [V,H,W] is made up of the splats in `rows`."""
    features = None
    if rows is not None:
        features = scene.means.new_zeros(len(scene), 1)
        features[rows[0] : rows[1]] = 1
    with torch.no_grad():
        out = rasterize(scene, cameras, features=features)
    return _bytes(out.rgb), None if rows is None else out.features[..., 0]


def world_pairs(seed: int, size: int) -> Iterator[Pair]:
    """All pairs of the world of `seed`: each of its edits from each of its cameras."""
    world, rng = random_world(seed, CAMERAS, size), np.random.default_rng([seed, 3])
    source, _ = _drawn(world.scene, world.cameras, None)
    for edit in draw_edits(world, rng):
        rows = None if edit.target is None else world.thing(edit.target).rows
        edited, after = _drawn(apply_edit(world, edit.name), world.cameras, rows)
        mask = np.full(source.shape[:3], 255, np.uint8)
        if rows is not None:
            _, before = _drawn(world.scene, world.cameras, rows)
            mask = ((torch.maximum(before, after) > VISIBLE) * 255).to(torch.uint8).numpy()
        for i in range(CAMERAS):
            yield dict(
                source=source[i],
                edited=edited[i],
                mask=mask[i],
                instruction=worded(edit, rng),
                edit=edit.name,
                world=np.int64(seed),
            )


def _settings(folder: Path, settings: dict) -> None:
    """Keep what the shards are made of beside them. Raises DataError where other pairs are there already."""
    file = folder / "pairs.json"
    if file.exists():
        there = json.loads(file.read_text(encoding="utf-8"))
        if there != settings:
            raise DataError(
                f"{file}: the folder holds pairs made with {there}, asked for {settings}. Choose another folder"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(settings), encoding="utf-8")


def make_pairs(folder: Path, count: int, seed: int, size: int = 128) -> None:
    """Write `count` training pairs of `size` x `size` pixels into `folder`, in shards pairs-00000.npz, ...

    Each shard has source, edited uint8 [n,H,W,3]; mask uint8 [n,H,W] (255 where the edited object is, everywhere for
    global edits); instruction, edit [n] strings; world int64 [n] (seeds of HELD_OUT and above). Shard i depends on
    `seed` and i alone; a shard appears whole or not at all, and those that are there are kept, so that an interrupted
    call is continued by the same call, with the same bits in the end.
    Raises DataError where the folder holds pairs of other settings.
    """
    folder = Path(folder)
    _settings(folder, dict(seed=seed, size=size, shard=SHARD))
    for i in range(-(-count // SHARD)):
        wanted, file = min(SHARD, count - i * SHARD), folder / f"pairs-{i:05d}.npz"
        if file.exists() and len(np.load(file)["world"]) >= wanted:
            continue
        rng, pairs = np.random.default_rng([seed, i]), []
        while len(pairs) < wanted:
            pairs += world_pairs(int(rng.integers(HELD_OUT, 2**31)), size)
        arrays = {key: np.stack([np.asarray(pair[key]) for pair in pairs[:wanted]]) for key in pairs[0]}
        part = file.with_suffix(".part")
        with part.open("wb") as stream:
            np.savez(stream, **arrays)
        part.replace(file)


def read_pairs(folder: Path) -> dict[str, ndarray]:
    """All pairs of `folder` in the order of their shards, as the arrays that make_pairs describes, in memory
    (about 115 kB a pair at 128 x 128). Raises DataError where there is none."""
    files = sorted(Path(folder).glob("pairs-*.npz"))
    if not files:
        raise DataError(f"{folder}: no training pairs (pairs-*.npz) in it. Make some with make_pairs")
    shards = [np.load(file) for file in files]
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0].files}
