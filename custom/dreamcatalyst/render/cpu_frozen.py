"""What is kept of frozen splats in one view, and how the splats that are edited come between them.

The tiles that no edited splat touches are copied from an image of the frozen splats alone. In the others the two depth
orders are merged, and composited as everywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import prange

from . import cpu_tiles
from .cpu_composite import AFTER, BEGIN, END, FIRST, PIXELS, TILE, forward, spans
from .cpu_jit import kernel
from .cpu_tiles import TILE_H, TILE_W

f32 = np.float32
MARGIN = 2  # tiles by which more is kept than is touched: edited splats move, and what they leave is made anew


@dataclass(frozen=True)
class View:
    """Frozen splats in one view: image [H,W,4] of colour over black and transmittance; covered [tiles] bool, the tiles
    whose lists are kept: entries[starts[t]:starts[t+1]], numbers of packed [M,COLUMNS] front to back, empty in the
    others. depths [M] of the packed splats."""

    image: np.ndarray
    covered: np.ndarray
    packed: np.ndarray
    depths: np.ndarray
    starts: np.ndarray
    entries: np.ndarray

    @property
    def nbytes(self) -> int:
        return sum(getattr(self, field.name).nbytes for field in fields(self))


def view(
    means2d, conics, colors, opacities, depths, radii, width: int, height: int, touched: np.ndarray, known: View | None
) -> View:
    """Draw the frozen splats, and keep what can be seen of the tiles `touched` (numbers), of their neighbours and of
    those that `known` covers. The splats [N,...] are as `cpu.Project` and `cpu.Shade` give them for one view."""
    order = cpu_tiles.depth_order(depths, radii)
    packed, starts, entries, _ = cpu_tiles.tile_lists(order, means2d, conics, opacities, colors, width, height)
    image = np.empty((height, width, 4), np.float32)
    rgb, alpha, none = (np.empty((height, width, c), np.float32) for c in (3, 1, 0))
    state = [np.empty((len(starts) - 1, PIXELS), np.float32) for _ in range(2)]
    work = spans(starts)
    drawn = packed, np.empty((len(order), 0), np.float32), work, entries, width, height
    forward(*drawn, np.zeros(3, np.float32), rgb, alpha, none, *state, np.empty((0, 4, PIXELS), np.float32))
    image[..., :3], image[..., 3:] = rgb, 1 - alpha

    covered = _grown(touched, -(-width // TILE_W), -(-height // TILE_H))
    if known is not None:
        covered |= known.covered
    # Where the frozen splats alone finish a tile, what lies behind stays hidden: more splats leave less transmittance.
    lengths = np.where(covered, work[:, END] - work[:, BEGIN], 0)
    kept = np.repeat(work[:, BEGIN] - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
    drawn, entries = np.unique(entries[kept, 0], return_inverse=True)
    starts = np.append(0, np.cumsum(lengths))
    return View(image, covered, packed[drawn], depths[order[drawn]], starts, entries.astype(np.int32))


def _grown(touched: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """bool [rows * columns]: the tiles `touched` (numbers) and those at most MARGIN away."""
    covered = np.zeros((rows, columns), bool)
    for dy in range(-MARGIN, MARGIN + 1):
        for dx in range(-MARGIN, MARGIN + 1):
            y, x = touched // columns + dy, touched % columns + dx
            covered[y.clip(0, rows - 1), x.clip(0, columns - 1)] = True
    return covered.ravel()


@kernel(parallel=True)
def paint(image, background, rgb, alpha):
    """Fill rgb [H,W,3] and alpha [H,W,1] from the frozen image [H,W,4]."""
    for y in prange(image.shape[0]):
        for x in range(image.shape[1]):
            t = image[y, x, 3]
            alpha[y, x, 0] = f32(1) - t
            for c in range(3):
                rgb[y, x, c] = image[y, x, c] + t * background[c]


@kernel(parallel=True)
def _merge(spans, starts0, entries0, depths0, starts1, entries1, depths1, entries):
    """Fill `entries` and FIRST and AFTER of `spans`, whose other columns are known. Lists 0 are the frozen splats,
    which come first where depths agree; lists 1 those that are edited."""
    shift = depths0.size
    for i in prange(spans.shape[0]):
        tile = spans[i, TILE]
        a, b, stop_a, stop_b = starts0[tile], starts1[tile], starts0[tile + 1], starts1[tile + 1]
        spans[i, FIRST] = -1
        for k in range(spans[i, BEGIN], spans[i, END]):
            if b == stop_b or (a < stop_a and depths0[entries0[a]] <= depths1[entries1[b, 0]]):
                entries[k, 0], entries[k, 1] = entries0[a], -1
                a += 1
            else:
                entries[k, 0], entries[k, 1] = shift + entries1[b, 0], entries1[b, 1]
                b += 1
                spans[i, AFTER] = k + 1
                if spans[i, FIRST] < 0:
                    spans[i, FIRST] = k


def merge(kept: View, packed, depths, starts, entries) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(packed, spans, entries) of the tiles that edited splats touch, with the frozen splats first in `packed`.

    packed [M,COLUMNS], starts, entries: lists of the edited splats, as from `tile_lists`; depths [M] of the packed.
    All these tiles must be covered by `kept`."""
    lengths = np.diff(starts)
    tiles = np.flatnonzero(lengths)
    ends = np.cumsum(lengths[tiles] + np.diff(kept.starts)[tiles])
    work = np.zeros((len(tiles), 5), np.int64)
    work[:, TILE], work[1:, BEGIN], work[:, END] = tiles, ends[:-1], ends
    merged = np.empty((int(ends[-1]) if len(ends) else 0, 2), np.int32)
    _merge(work, kept.starts, kept.entries, kept.depths, starts, entries, depths, merged)
    return np.concatenate([kept.packed, packed]), work, merged
