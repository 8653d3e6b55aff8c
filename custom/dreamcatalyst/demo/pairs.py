"""Training pairs: (source render, instruction, edited render) of random worlds, in shards that resume."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor

from ..data.camera import Cameras
from ..data.formats import read_json
from ..errors import DataError
from ..files import replacing, write_text
from ..render.api import rasterize
from ..scene.gaussians import Gaussians
from .edits import EDITS, NOTHING, WorldEdit, apply_edit, possible
from .photographs import Picture, crop, load_photographs
from .random_world import HELD_OUT, random_world
from .worlds import World

SHARD = 250  # pairs in one file
CAMERAS, EDITS_PER_SOURCE = 3, 4  # a world gives up to their product in pairs, a photograph one for each edit
PHOTOGRAPHED = 0.2  # how often a photograph is drawn in place of a world: about one pair in thirteen
VISIBLE = 0.03  # a pixel belongs to the object where its splats make up more than this of it
SEEN = 0.01  # an object that covers less of the picture than this is no target there

PAIRS = ("pairs", "height", "width", "channels")
ARRAYS = {  # of a shard: number type and shape
    "world": (np.integer, PAIRS[:1]),
    "source": (np.uint8, PAIRS),
    "edited": (np.uint8, PAIRS),
    "mask": (np.uint8, PAIRS[:3]),
    "instruction": (np.str_, PAIRS[:1]),
    "edit": (np.str_, PAIRS[:1]),
}

Images = Float[Tensor, "B 3 H W"]
Operators = Callable[[str], Callable[[Images], Images]]  # an edit's name -> RGB in [0,1] to the same


def worded(edit: WorldEdit, rng: Generator) -> str:
    """One of the edit's instructions, the first more often; at times in lower or upper case or with a full stop."""
    text = edit.phrases[0] if rng.random() < 0.3 else edit.phrases[rng.integers(len(edit.phrases))]
    style = rng.random()
    if style < 0.3:
        text = text.lower()
    elif style < 0.35:
        text = text.upper()
    return text + "." if text and rng.random() < 0.1 else text


def drawn(known: list[WorldEdit], rng: Generator) -> list[WorldEdit]:
    """EDITS_PER_SOURCE different ones of the `known` edits, drawn by their weights."""
    weights = np.array([edit.weight for edit in known])
    chosen = rng.choice(len(known), EDITS_PER_SOURCE, replace=False, p=weights / weights.sum())
    return [known[i] for i in chosen]


def _pair(
    source: Picture, edited: Picture, mask: UInt8[ndarray, "H W"], edit: WorldEdit, world: int, rng: Generator
) -> dict:
    return dict(source=source, edited=edited, mask=mask, instruction=worded(edit, rng), edit=edit.name, world=world)


def _bytes(images: Float[Tensor, "*shape"]) -> UInt8[ndarray, "*shape"]:
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _render(
    scene: Gaussians, cameras: Cameras, rows: tuple[int, int]
) -> tuple[UInt8[ndarray, "V H W 3"], Float[Tensor, "V H W"]]:
    """Images, and how much of each pixel is made up of the splats in `rows`."""
    share = scene.means.new_zeros(len(scene), 1)
    share[rows[0] : rows[1]] = 1
    with torch.no_grad():
        out = rasterize(scene, cameras, features=share)
    return _bytes(out.rgb), out.features[..., 0]


def world_pairs(world: World, rng: Generator) -> Iterator[dict]:
    """Some edits of `world` from each of its cameras, as pairs."""
    source, _ = _render(world.scene, world.cameras, (0, 0))
    for edit in drawn(possible(world), rng):
        rows = world.thing(edit.target).rows if edit.target else (0, len(world.scene))
        edited, after = _render(apply_edit(world, edit.name), world.cameras, rows)
        mask = np.full(source.shape[:3], 255, np.uint8)
        if edit.target:
            before = _render(world.scene, world.cameras, rows)[1]
            mask = _bytes((torch.maximum(before, after) > VISIBLE).float())
        for i in np.flatnonzero(mask.mean((1, 2)) > SEEN * 255):
            yield _pair(source[i], edited[i], mask[i], edit, world.seed, rng)


def photograph_pairs(images: list[Picture], operators: Operators, size: int, rng: Generator) -> Iterator[dict]:
    """Some global edits of a crop of one of `images`, as pairs; their world is -1."""
    source = crop(images, size, rng)
    tensor = torch.from_numpy(source).permute(2, 0, 1)[None].float() / 255
    for edit in drawn([edit for edit in EDITS.values() if edit.scope == "global"], rng):
        edited = source
        if edit.name != NOTHING:
            edited = _bytes(operators(edit.name)(tensor)[0].permute(1, 2, 0))
        yield _pair(source, edited, np.full((size, size), 255, np.uint8), edit, -1, rng)


def shard_pairs(seed: int, index: int, size: int, images: list[Picture], operators: Operators | None) -> Iterator[dict]:
    """The pairs of one shard, without end: the first n are the same whatever is taken."""
    rng = np.random.default_rng([seed, index])
    while True:
        if images and operators and rng.random() < PHOTOGRAPHED:
            yield from photograph_pairs(images, operators, size, rng)
        else:
            yield from world_pairs(random_world(int(rng.integers(HELD_OUT, 2**31)), CAMERAS, size), rng)


def _settings(folder: Path, settings: dict) -> None:
    """Keep what the shards are made of beside them. Raises DataError where other pairs are there already."""
    file = folder / "pairs.json"
    if not file.exists():
        write_text(file, json.dumps(settings))
    elif not isinstance(there := read_json(file), dict) or there | settings != there:
        raise DataError(f"{folder}: holds pairs made with {there}, asked for are {settings}. Choose another folder")


def _count(file: Path) -> int:
    """How many pairs a shard holds, 0 where there is none."""
    return len(_arrays(file, ["world"])["world"]) if file.exists() else 0


def _arrays(file: Path, names: Iterable[str]) -> dict[str, Shaped[ndarray, "pairs ..."]]:
    """These arrays of a shard. Raises DataError where the file is no archive of arrays, or lacks one."""
    try:
        with np.load(file) as shard:
            lacking = [name for name in names if name not in shard]
            if not lacking:
                return {name: shard[name] for name in names}
            found = ", ".join(shard)
    except Exception as error:  # numpy, zip and zlib raise their own kinds
        raise DataError(f"{file}: is no shard of pairs, or is damaged ({type(error).__name__}). Remove it") from error
    raise DataError(f"{file}: has no '{lacking[0]}', which a shard of pairs needs (found {found or 'nothing'})")


def _shard(file: Path, size: tuple[int, ...] | None) -> dict[str, Shaped[ndarray, "pairs ..."]]:
    """The arrays of a shard, each with the number type and the shape that `make_pairs` describes. size: height and
    width of the pairs before it. Raises DataError."""
    arrays = _arrays(file, ARRAYS)
    for name, (kind, shape) in ARRAYS.items():
        array = arrays[name]
        wanted = (len(arrays["world"]), *(size or arrays["source"].shape[1:3]), 3)[: len(shape)]
        if not np.issubdtype(array.dtype, kind) or array.shape != wanted or array.size == 0:
            held = f"{array.dtype} {list(array.shape)}"
            raise DataError(f"{file}: '{name}' is {held}, expected {kind.__name__} {list(wanted)}: {' x '.join(shape)}")
    return arrays


def make_pairs(folder: Path, count: int, seed: int, size: int = 128, photographs: Operators | None = None) -> None:
    """Write `count` training pairs of `size` x `size` pixels into `folder`, in shards pairs-00000.npz, ...

    Each shard has source, edited uint8 [n,H,W,3]; mask uint8 [n,H,W] (255 where the edited object is, at least on SEEN
    of the picture; everywhere for global edits); instruction, edit [n] strings; world int64 [n]: the world's seed,
    HELD_OUT or above, -1 for a photograph. Shard i depends on `seed` and i alone. It appears whole or not at all, and
    those that are there are kept: an interrupted call is continued by the same call, and more pairs are made by a
    larger `count`, with the same bits.
    photographs: also take the free photographs of `load_photographs`, edited by what this gives for an edit's name
    (sunset, autumn, snow, night), such as the closed form's operators. Not asked for where no pair is missing.
    Raises DataError where the folder holds pairs of other settings, ConfigError where photographs are not installed.
    """
    folder, wanted = Path(folder), {i: min(SHARD, count - i * SHARD) for i in range(-(-count // SHARD))}
    files = {i: folder / f"pairs-{i:05d}.npz" for i in wanted}
    missing = [i for i in wanted if _count(files[i]) < wanted[i]]
    images = load_photographs() if photographs and missing else []
    _settings(folder, dict(seed=seed, size=size, shard=SHARD) | (dict(photographs=len(images)) if missing else {}))
    for i in missing:
        stream = shard_pairs(seed, i, size, images, photographs)
        pairs = [pair for _, pair in zip(range(wanted[i]), stream, strict=False)]
        arrays: dict[str, Any] = {key: np.stack([np.asarray(pair[key]) for pair in pairs]) for key in pairs[0]}
        with replacing(files[i]) as part, part.open("wb") as out:
            np.savez(out, **arrays)


def read_pairs(folder: Path) -> dict[str, Shaped[ndarray, "pairs ..."]]:
    """All pairs of `folder` in the order of their shards, as the arrays that make_pairs describes, in memory
    (about 115 kB a pair at 128 x 128). Raises DataError where there is none, or a shard is damaged or holds anything
    else."""
    files = sorted(Path(folder).glob("pairs-*.npz"))
    if not files:
        raise DataError(f"{folder}: no training pairs (pairs-*.npz) in it. Make some with make_pairs")
    shards = []
    for file in files:
        shards.append(_shard(file, shards[0]["source"].shape[1:3] if shards else None))
    return {key: np.concatenate([shard.pop(key) for shard in shards]) for key in list(shards[0])}
