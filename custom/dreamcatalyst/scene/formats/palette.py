"""Many vectors as few, and many numbers as few: k-means, so arranged that one core does a million vectors."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

ROUNDS = 6  # of Lloyd's iteration on each level
BLOCK = 8192  # vectors whose distances are held at once
LEAF, DEPTH = 256, 6  # entries of a leaf, and divisions one after another, at most
LOOK = 4  # leaves in which a vector's nearest entry is looked for


def palette(
    vectors: Float[Tensor, "N D"], size: int, seed: int = 0
) -> tuple[Float[Tensor, "P D"], Int64[Tensor, " N"]]:
    """At most `size` vectors, and which of them stands for each of `vectors`, with little squared error.

    k-means as a tree: about sqrt(size) cells, each with a share of the entries that goes with its vectors' number, and
    divided again until a share is LEAF at most. At last each vector takes the nearest entry of the LOOK leaves nearest
    to it, and the entries move to the middle of theirs. The cost grows with N sqrt(size), not with N size.
    """
    n = len(vectors)
    if n <= size:
        return vectors.clone(), torch.arange(n)
    leaves = _leaves(vectors, size, torch.Generator().manual_seed(seed), DEPTH)
    entries, middles = torch.cat(leaves), torch.stack([leaf.mean(dim=0) for leaf in leaves])
    ends = torch.tensor([0, *np.cumsum([len(leaf) for leaf in leaves])])
    labels = _nearest_of_leaves(vectors, middles, entries, ends)
    return _moved(vectors, labels, entries), labels


def _leaves(vectors: Tensor, size: int, generator: torch.Generator, depth: int) -> list[Tensor]:
    """`size` entries for the vectors, those that lie together in one tensor. depth: how often they may be divided; what
    many equal vectors are is found no finer."""
    if len(vectors) <= size:
        return [vectors]
    order = torch.randperm(len(vectors), generator=generator)
    if size <= LEAF or depth == 0:
        return [_lloyd(vectors, vectors[order[: min(size, LEAF)]], ROUNDS)]
    cells = min(LEAF, round(size**0.5))
    sample = vectors[order[: 64 * cells]]
    cell = nearest(vectors, _lloyd(sample, sample[:cells], ROUNDS))
    counts = torch.bincount(cell, minlength=cells)
    shares = torch.where(counts > 0, (counts * (size / len(vectors))).long().clamp_min(1), 0)
    while int(shares.sum()) > size:
        shares[shares.argmax()] -= 1
    rows = torch.argsort(cell, stable=True).split(counts.tolist())
    parts = zip(rows, shares.tolist(), strict=True)
    return [leaf for some, share in parts if share for leaf in _leaves(vectors[some], share, generator, depth - 1)]


def nearest(vectors: Float[Tensor, "N D"], entries: Float[Tensor, "P D"]) -> Int64[Tensor, " N"]:
    """The entry nearest to each vector."""
    half = entries.square().sum(dim=1) / 2
    return torch.cat([(half - block @ entries.T).argmin(dim=1) for block in vectors.split(BLOCK)])


def _lloyd(vectors: Tensor, entries: Tensor, rounds: int) -> Tensor:
    for _ in range(rounds):
        entries = _moved(vectors, nearest(vectors, entries), entries)
    return entries


def _moved(vectors: Tensor, labels: Tensor, entries: Tensor) -> Tensor:
    """The middles of what the entries stand for; those that stand for nothing stay."""
    counts = torch.bincount(labels, minlength=len(entries))
    sums = torch.zeros_like(entries).index_add_(0, labels, vectors)
    return torch.where(counts[:, None] > 0, sums / counts.clamp_min(1)[:, None], entries)


def _nearest_of_leaves(vectors: Tensor, middles: Tensor, entries: Tensor, ends: Tensor) -> Tensor:
    """The nearest entry of the LOOK nearest leaves; those of leaf c are entries[ends[c]:ends[c + 1]]."""
    look = min(LOOK, len(middles))
    half = middles.square().sum(dim=1) / 2
    near = torch.cat(
        [(half - block @ middles.T).topk(look, 1, largest=False).indices for block in vectors.split(BLOCK)]
    )
    best = vectors.new_full((len(vectors),), torch.inf)
    labels = torch.zeros(len(vectors), dtype=torch.long)
    order = torch.argsort(near.flatten(), stable=True)
    counts = torch.bincount(near.flatten(), minlength=len(middles)).tolist()
    for c, places in enumerate(order.split(counts)):
        begin, end = int(ends[c]), int(ends[c + 1])
        if begin == end or len(places) == 0:
            continue
        members, inside = places // look, entries[begin:end]
        half = inside.square().sum(dim=1) / 2
        for some in members.split(BLOCK):
            distance, which = (half - vectors[some] @ inside.T).min(dim=1)
            closer = distance < best[some]
            best[some[closer]] = distance[closer]
            labels[some[closer]] = which[closer] + begin
    return labels


def codebook(
    values: Float[np.ndarray, " M"], size: int = 256, rounds: int = 20
) -> tuple[Float[np.ndarray, " P"], UInt8[np.ndarray, " M"]]:
    """`size` numbers, rising, and which of them stands for each of `values`: k-means on a line, where cells are
    stretches of the sorted values.

    Half of what is fitted is spread evenly over the range: rare values, such as the scales of a scene's few large
    splats, count for more in a picture than in a mean of squares.
    """
    even = np.linspace(values.min(), values.max(), min(len(values), 1 << 16)).repeat(max(1, len(values) >> 16))
    ordered = np.sort(np.concatenate([values, even]).astype(np.float64))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    spread = np.linspace(ordered[0], ordered[-1], size)
    entries = (np.quantile(ordered, (np.arange(size) + 0.5) / size) + spread) / 2
    for _ in range(rounds):
        edges = np.searchsorted(ordered, (entries[1:] + entries[:-1]) / 2)
        ends = np.concatenate([[0], edges, [len(ordered)]])
        counts = np.diff(ends)
        entries = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), entries)
    entries = entries.astype(np.float32)
    return entries, np.searchsorted((entries[1:] + entries[:-1]) / 2, values).astype(np.uint8)
