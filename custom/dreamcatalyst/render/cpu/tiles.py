"""Which splats touch which tile, front to back: culling, depth order and the lists of the tiles of one view."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ..thresholds import ALPHA_MIN
from .jit import kernel

f32 = np.float32
TILE_W, TILE_H = 8, 16  # pixels; a row is one vector of eight floats
PIXELS = TILE_W * TILE_H
CHUNKS = 32  # pieces into which the splats are cut for parallel counting, whatever the number of threads
ALPHA_MIN = f32(ALPHA_MIN)
ZERO, HALF, ONE = f32(0), f32(0.5), f32(1)
SLACK = f32(0.01)  # pixels by which extents are widened against rounding: what they admit is tested again per pixel
RADIX = 11  # bits per pass of the depth sort

# Columns of a packed splat: mean, conic (a, m, d), opacity, half height of its ellipse sigma <= limit, that limit
# ln(opacity / ALPHA_MIN), colour, 1 / a, and TIP: dy of the ellipse's rightmost point, which is -dy of the leftmost.
PX, PY, A, M, D, OPACITY, RY, LIMIT, RED, GREEN, BLUE, INVERSE_A, TIP = range(13)
COLUMNS = 16  # one cache line


@kernel()
def depth_order(depths, radii):
    """Indices [M] int32 of the drawn splats by depth, ties by index: a stable radix sort of the bits, since positive
    floats order as their bits do."""
    bits = depths.view(np.uint32)
    order = np.empty(radii.size, np.int32)
    count = 0
    for i in range(radii.size):
        if radii[i] > 0:
            order[count] = i
            count += 1
    order = order[:count]
    keys = np.empty(count, np.uint32)
    for j in range(count):
        keys[j] = bits[order[j]]
    other_keys, other = np.empty_like(keys), np.empty_like(order)
    mask = np.uint32((1 << RADIX) - 1)
    for shift in range(0, 32, RADIX):
        starts = np.zeros((1 << RADIX) + 1, np.int64)
        for j in range(count):
            starts[((keys[j] >> np.uint32(shift)) & mask) + 1] += 1
        starts = np.cumsum(starts)
        for j in range(count):
            digit = (keys[j] >> np.uint32(shift)) & mask
            at = starts[digit]
            starts[digit] += 1
            other_keys[at], other[at] = keys[j], order[j]
        keys, other_keys, order, other = other_keys, keys, other, order
    return order


@njit(error_model="numpy")
def first_pixel(edge, lowest, highest):
    """Index of the first pixel centre at or after `edge`, within [lowest, highest + 1]."""
    return int(min(max(np.ceil(edge - HALF - SLACK), f32(lowest)), f32(highest + 1)))


@njit(error_model="numpy")
def last_pixel(edge, lowest, highest):
    """Index of the last pixel centre at or before `edge`, within [lowest - 1, highest]."""
    return int(max(min(np.floor(edge - HALF + SLACK), f32(highest)), f32(lowest - 1)))


@njit(error_model="numpy")
def _columns(packed, j, row, width, height):
    """First and last tile of the row of tiles `row` that the ellipse sigma <= limit of packed splat j touches."""
    m, d, limit, tip, inverse_a = packed[j, M], packed[j, D], packed[j, LIMIT], packed[j, TIP], packed[j, INVERSE_A]
    low = max(f32(row * TILE_H) + HALF - packed[j, PY], -packed[j, RY])
    high = min(f32(min(height, (row + 1) * TILE_H)) - HALF - packed[j, PY], packed[j, RY])
    right, left = min(max(tip, low), high), min(max(-tip, low), high)
    xr = packed[j, PX] + m * right + math.sqrt(max(limit - d * right * right, ZERO) * inverse_a)
    xl = packed[j, PX] + m * left - math.sqrt(max(limit - d * left * left, ZERO) * inverse_a)
    first, last = first_pixel(xl, 0, width - 1), last_pixel(xr, 0, width - 1)
    if last < first:
        return 1, 0
    return first // TILE_W, last // TILE_W


@njit(error_model="numpy")
def _tile_rows(packed, j, height):
    """First and last row of tiles that packed splat j touches."""
    top = first_pixel(packed[j, PY] - packed[j, RY], 0, height - 1) // TILE_H
    return top, last_pixel(packed[j, PY] + packed[j, RY], 0, height - 1) // TILE_H


@kernel(parallel=True)
def _pack(order, means2d, conics, opacities, colors, width, height, open_tiles, packed, counts, pairs):
    """Copy the drawn splats next to each other in the order in which they are drawn, to packed [M,COLUMNS]; count the
    splats of each open tile per chunk, counts [CHUNKS,tiles], and the open tiles of each splat, pairs [M]."""
    n, tiles_x, size = order.size, -(-width // TILE_W), -(-order.size // CHUNKS)
    for chunk in prange(CHUNKS):
        for j in range(chunk * size, min(n, (chunk + 1) * size)):
            i = order[j]
            a, m, d = conics[i, 0], conics[i, 1], conics[i, 2]
            limit = math.log(opacities[i] / ALPHA_MIN)
            spread = ONE / a + m * m / d  # rx^2 = limit * spread
            packed[j, PX], packed[j, PY] = means2d[i, 0], means2d[i, 1]
            packed[j, A], packed[j, M], packed[j, D] = a, m, d
            packed[j, OPACITY], packed[j, LIMIT], packed[j, RY] = opacities[i], limit, math.sqrt(limit / d)
            packed[j, INVERSE_A], packed[j, TIP] = ONE / a, math.sqrt(limit / spread) * m / d
            packed[j, RED], packed[j, GREEN], packed[j, BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]
            top, bottom = _tile_rows(packed, j, height)
            for row in range(top, bottom + 1):
                left, right = _columns(packed, j, row, width, height)
                for t in range(row * tiles_x + left, row * tiles_x + right + 1):
                    counts[chunk, t] += open_tiles[t]
                    pairs[j] += open_tiles[t]


@kernel()
def _offsets(counts, starts, first_slots):
    """Turn counts into places, in place: starts [tiles+1] of the lists, counts [CHUNKS,tiles] the place where each
    chunk writes into them, first_slots [M+1] from the number of tiles of splat j at j+1."""
    for j in range(first_slots.size - 1):
        first_slots[j + 1] += first_slots[j]
    at = 0
    for t in range(counts.shape[1]):
        for chunk in range(CHUNKS):
            here = counts[chunk, t]
            counts[chunk, t] = at
            at += here
        starts[t + 1] = at


@kernel(parallel=True)
def _fill(packed, width, height, open_tiles, counts, first_slots, entries):
    n, tiles_x, size = packed.shape[0], -(-width // TILE_W), -(-packed.shape[0] // CHUNKS)
    for chunk in prange(CHUNKS):
        for j in range(chunk * size, min(n, (chunk + 1) * size)):
            slot = first_slots[j]
            top, bottom = _tile_rows(packed, j, height)
            for row in range(top, bottom + 1):
                left, right = _columns(packed, j, row, width, height)
                for t in range(row * tiles_x + left, row * tiles_x + right + 1):
                    if not open_tiles[t]:
                        continue
                    entry = counts[chunk, t]
                    counts[chunk, t] = entry + 1
                    entries[entry, 0], entries[entry, 1] = j, slot
                    slot += 1


def tile_lists(
    order, means2d, conics, opacities, colors, width: int, height: int, open_tiles: np.ndarray | None = None
):
    """Return (packed [M,COLUMNS], starts [tiles+1], entries [I,2], first_slots [M+1]) of the drawn splats `order` [M].

    entries[starts[t]:starts[t+1]] are the splats of tile t front to back, each with its slot: the number of the pair
    (splat, tile) where pairs are counted splat by splat. Splat j has the slots first_slots[j]:first_slots[j+1].
    open_tiles [tiles] bool: the lists of the others stay empty (default: all are open).
    """
    tiles = -(-width // TILE_W) * -(-height // TILE_H)
    if open_tiles is None:
        open_tiles = np.ones(tiles, bool)
    packed = np.empty((len(order), COLUMNS), np.float32)
    counts, first_slots = np.zeros((CHUNKS, tiles), np.int32), np.zeros(len(order) + 1, np.int64)
    starts = np.zeros(tiles + 1, np.int64)
    _pack(order, means2d, conics, opacities, colors, width, height, open_tiles, packed, counts, first_slots[1:])
    _offsets(counts, starts, first_slots)
    entries = np.empty((int(starts[-1]), 2), np.int32)
    _fill(packed, width, height, open_tiles, counts, first_slots, entries)
    return packed, starts, entries, first_slots
