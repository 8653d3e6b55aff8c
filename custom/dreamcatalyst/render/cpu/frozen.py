"""What is kept of frozen splats in one view, and how the splats that are edited come between them.

The tiles that no edited splat touches are copied from an image of the frozen splats alone. In the others the two depth
orders are merged, and composited as everywhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numba import prange

from .composite import AFTER, BEGIN, BOTTOM, END, FIRST, TILE, TOP, forward, spans
from .jit import kernel
from .records import Images, State, Work
from .tiles import PY, RY, TILE_H, TILE_W, depth_order, first_pixel, last_pixel, tile_lists

f32 = np.float32
NEAREST, MANY = 3, 4096  # of so many edited splats, this part of them is drawn before the rest is listed
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
MARGIN = 2  # tiles by which more is kept than is touched: edited splats move, and what they leave is made anew


@dataclass(frozen=True)
class View:
    """Frozen splats in one view: rgb [H,W,3] over black and alpha [H,W,1] of their image; covered [tiles] bool, the
    tiles whose lists are kept: entries[starts[t]:starts[t+1]], numbers of packed [M,COLUMNS] front to back, empty in
    the others. depths [M] of the packed splats; reach [tiles], the depth behind which nothing shows, infinite where
    the frozen splats alone do not finish the tile."""

    rgb: np.ndarray
    alpha: np.ndarray
    covered: np.ndarray
    packed: np.ndarray
    depths: np.ndarray
    reach: np.ndarray
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
    order = depth_order(depths, radii)
    packed, starts, entries, _ = tile_lists(order, means2d, conics, opacities, colors, width, height)
    rgb, alpha, none = (np.empty((height, width, c), np.float32) for c in (3, 1, 0))
    work = spans(np.arange(len(starts) - 1), starts[1:], width, height)
    black, extras = np.zeros(3, np.float32), np.empty((len(order), 0), np.float32)
    drawn = Work(packed, extras, work, entries, width, height, black)
    forward(drawn, Images(rgb, alpha, none), State.empty(len(work), 0))

    covered = _grown(touched, -(-width // TILE_W), -(-height // TILE_H))
    if known is not None:
        covered |= known.covered
    # Where the frozen splats alone finish a tile, what lies behind stays hidden: more splats leave less transmittance.
    z, ends = depths[order], work[:, END]
    reach = np.full(len(work), np.inf, np.float32)
    finished = ends < starts[1:]
    reach[finished] = z[entries[ends[finished] - 1, 0]]
    lengths = np.where(covered, ends - work[:, BEGIN], 0)
    kept = np.repeat(work[:, BEGIN] - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
    seen, entries = np.unique(entries[kept, 0], return_inverse=True)
    starts = np.append(0, np.cumsum(lengths))
    return View(rgb, alpha, covered, packed[seen], z[seen], reach, starts, entries.astype(np.int32))


def _grown(touched: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """bool [rows * columns]: the tiles `touched` (numbers) and those at most MARGIN away."""
    covered = np.zeros((rows, columns), bool)
    for dy in range(-MARGIN, MARGIN + 1):
        for dx in range(-MARGIN, MARGIN + 1):
            y, x = touched // columns + dy, touched % columns + dx
            covered[y.clip(0, rows - 1), x.clip(0, columns - 1)] = True
    return covered.ravel()


@kernel(parallel=True)
def _paint(kept_rgb, kept_alpha, background, rgb, alpha):
    """Fill rgb [H,W,3] and alpha [H,W,1] with those of the frozen splats alone."""
    r, g, b = background[0], background[1], background[2]
    for y in prange(alpha.shape[0]):
        for x in range(alpha.shape[1]):
            alpha[y, x, 0] = kept_alpha[y, x, 0]
            t = f32(1) - kept_alpha[y, x, 0]
            rgb[y, x, 0] = kept_rgb[y, x, 0] + t * r
            rgb[y, x, 1] = kept_rgb[y, x, 1] + t * g
            rgb[y, x, 2] = kept_rgb[y, x, 2] + t * b


@kernel(parallel=True)
def _merge(spans, horizon, starts0, entries0, depths0, reach, starts1, entries1, depths1, packed1, entries):
    """Fill `entries` and finish `spans`, of which TILE, BEGIN, END and TOP:BOTTOM, all rows of the tile, are known.

    Lists 0 are the frozen splats, which come first where depths agree, up to the depth `horizon`; lists 1 those that
    are edited. The rows that none of these touches are left as the frozen splats alone paint them."""
    for i in prange(spans.shape[0]):
        tile, low, high = spans[i, TILE], spans[i, TOP], spans[i, BOTTOM]
        a, b, stop_a, stop_b = starts0[tile], starts1[tile], starts0[tile + 1], starts1[tile + 1]
        first, after, top, bottom = -1, 0, high, low
        for k in range(spans[i, BEGIN], spans[i, END]):
            if b == stop_b or (a < stop_a and depths0[entries0[a]] <= depths1[entries1[b, 0]]):
                if depths0[entries0[a]] > horizon:
                    spans[i, END] = k
                    break
                entries[k, 0], entries[k, 1] = entries0[a], -1
                a += 1
                continue
            j = entries1[b, 0]
            if depths1[j] >= reach[tile]:  # hidden, as is all that follows
                spans[i, END] = k
                break
            entries[k, 0], entries[k, 1] = depths0.size + j, entries1[b, 1]
            b += 1
            first, after = k if first < 0 else first, k + 1
            if top > low or bottom < high:
                top = min(top, first_pixel(packed1[j, PY] - packed1[j, RY], low, high - 1))
                bottom = max(bottom, last_pixel(packed1[j, PY] + packed1[j, RY], low, high - 1) + 1)
        spans[i, FIRST], spans[i, AFTER], spans[i, TOP], spans[i, BOTTOM] = first, after, top, bottom


def merge(kept: View, packed, depths, horizon: float, starts, entries) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(packed, spans, entries) of the tiles where edited splats can show, with the frozen splats first in `packed`.

    packed [M,COLUMNS], starts, entries: lists of the edited splats, as from `tile_lists`; depths [M] of the packed,
    none beyond `horizon`, from where on frozen splats are left out. All these tiles must be covered by `kept`."""
    height, width, _ = kept.alpha.shape
    tiles = np.flatnonzero(np.diff(starts))
    tiles = tiles[depths[entries[starts[tiles], 0]] < kept.reach[tiles]]
    ends = np.cumsum(np.diff(starts)[tiles] + np.diff(kept.starts)[tiles])
    work = spans(tiles, ends, width, height)
    merged = np.empty((int(ends[-1]) if len(ends) else 0, 2), np.int32)
    lists = kept.starts, kept.entries, kept.depths, kept.reach, starts, entries, depths, packed
    _merge(work, np.float32(horizon), *lists, merged)
    return np.concatenate([kept.packed, packed]), work, merged


@kernel(parallel=True)
def _reach(order, means2d, radii, width, height, before, found):
    """Fill found [M] bool: whether the box about splat order[j] meets an open tile. before [rows+1,columns+1]: number
    of the open tiles above and left of a tile."""
    for j in prange(order.size):
        x, y, r = means2d[order[j], 0], means2d[order[j], 1], f32(radii[order[j]])
        left, right = first_pixel(x - r, 0, width - 1) // TILE_W, last_pixel(x + r, 0, width - 1) // TILE_W
        top, bottom = first_pixel(y - r, 0, height - 1) // TILE_H, last_pixel(y + r, 0, height - 1) // TILE_H
        below, above = before[bottom + 1], before[top]
        found[j] = below[right + 1] - below[left] > above[right + 1] - above[left]


def draw(
    find: Callable[[np.ndarray], View], order, depths, radii, splats: Arrays, background, rgb, alpha
) -> list[tuple[np.ndarray, np.ndarray, Work, State]]:
    """Fill rgb [H,W,3] and alpha [H,W,1] with the frozen splats and the edited ones `order` [M] of depths [N].

    find: gives the view with the tiles (numbers) covered that it is given. radii [N]; splats: means2d, conics,
    opacities and colors as for `tile_lists`. Returns (order, first_slots, work, state) of each round: the nearest
    splats come first, and where these finish a tile, those behind are not even listed. The other tiles are drawn anew
    with all.
    """
    height, width, _ = alpha.shape
    tiles_x, tiles_y = -(-width // TILE_W), -(-height // TILE_H)
    open_tiles, rounds = np.ones(tiles_x * tiles_y, bool), []
    for nearest in (True, False) if len(order) >= MANY else (False,):
        chosen, horizon = order, np.inf
        if nearest:
            chosen = order[: len(order) // NEAREST]
            horizon = depths[chosen[-1]]
        elif rounds:
            before = np.zeros((tiles_y + 1, tiles_x + 1), np.int32)
            before[1:, 1:] = open_tiles.reshape(tiles_y, tiles_x).cumsum(axis=0).cumsum(axis=1)
            found = np.empty(len(order), bool)
            _reach(order, splats[0], radii, width, height, before, found)
            chosen = order[found]
        packed, starts, entries, first_slots = tile_lists(chosen, *splats, width, height, open_tiles)
        view = find(np.flatnonzero(np.diff(starts)))
        if not rounds:
            _paint(view.rgb, view.alpha, background, rgb, alpha)
        packed, work, entries = merge(view, packed, depths[chosen], horizon, starts, entries)
        extras, none = np.empty((len(packed), 0), np.float32), np.empty((height, width, 0), np.float32)
        drawn, state = Work(packed, extras, work, entries, width, height, background), State.empty(len(work), len(work))
        ends = work[:, END].copy()
        forward(drawn, Images(rgb, alpha, none), state)
        if nearest:
            closed = work[:, END] < ends
            open_tiles[work[closed, TILE]] = False
            work[~closed, FIRST] = work[~closed, END]  # no derivatives: these tiles are drawn again
        rounds.append((chosen, first_slots, drawn, state))
    return rounds
