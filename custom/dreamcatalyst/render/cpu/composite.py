"""Compiled alpha compositing of the tile lists of one view, and its derivative.

The inner loops run over whole rows of a tile without branches, so that they compile to vector instructions: a
condition is a factor or a choice between two values. All that a loop touches lies in one scratch array at constant
distances, which is how the compiler knows that nothing overlaps.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ..thresholds import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .jit import kernel
from .tiles import BLUE, GREEN, OPACITY, PIXELS, PX, PY, RED, RY, TILE_H, TILE_W, A, D, M, first_pixel, last_pixel

f32, u64 = np.float32, np.uint64
STRIDES = 64  # tasks: each takes every 64th tile, which evens out their work
# Columns of a span, the work of one tile: its number; its rows of pixels that are drawn, top:bottom; its entries
# begin:end; among them, first:after, outside of which no splat takes derivatives. An entry is a packed splat and its
# slot, which is negative if it takes no derivatives.
TILE, TOP, BOTTOM, BEGIN, FIRST, AFTER, END = range(7)
LOOK = 8  # splats between two looks at whether a tile is finished
ZERO, ONE, CUT, CAP, STOP = f32(0), f32(1), f32(ALPHA_MIN), f32(ALPHA_MAX), f32(TRANSMITTANCE_MIN)

# Rows of the scratch array: pixel centres, transmittance (negative once the pixel is finished), number of the last
# splat that contributed (as float), the weight of the present splat, and colours.
X, Y, T, LAST, W, C0, C1, C2 = (u64(k * PIXELS) for k in range(8))
# In the backward pass: the image's derivatives (red, green, blue, extra channels) and the light from behind times them.
V0, V1, V2, VE, BEHIND = C0, C1, C2, u64(8 * PIXELS), u64(9 * PIXELS)
ROWS = 10
# Without "arcp": a reciprocal by estimate is 6e-8 short of 1 even where alpha is 0, which adds up over deep lists.
EXACT_DIVISION = {"nnan", "ninf", "nsz", "contract", "afn", "reassoc"}

# exp(-s) = p(s / 8)^8, p fitted to the 0 <= s <= 6 beyond which alpha is below ALPHA_MIN anyway; relative error about
# 5e-7.
SIGMA_MAX, EIGHTH = f32(6), f32(0.125)
_nodes = 0.375 + 0.375 * np.cos(np.pi * (np.arange(64) + 0.5) / 64)
P5, P4, P3, P2, P1, P0 = (f32(c) for c in np.polyfit(_nodes, np.exp(-_nodes), 5, w=np.exp(_nodes)))


def spans(tiles: np.ndarray, ends: np.ndarray, width: int, height: int) -> np.ndarray:
    """Spans [S,7] of the tiles numbered `tiles` [S], whose lists follow one another and end at `ends` [S]; all splats
    take derivatives."""
    out = np.zeros((len(tiles), 7), np.int64)
    out[:, TILE], out[:, TOP] = tiles, tiles // -(-width // TILE_W) * TILE_H
    out[:, BOTTOM] = np.minimum(out[:, TOP] + TILE_H, height)
    out[1:, BEGIN], out[:, END] = ends[:-1], ends
    out[:, FIRST], out[:, AFTER] = out[:, BEGIN], ends
    return out


@njit(fastmath=True, error_model="numpy")
def _exp_minus(s):
    t = s * EIGHTH
    e = P0 + t * (P1 + t * (P2 + t * (P3 + t * (P4 + t * P5))))
    e = e * e
    e = e * e
    return e * e


@njit(fastmath=True, error_model="numpy")
def _rows(packed, j, y0, top, bottom):
    """Range of scratch indices of the rows top:bottom of the tile at y0 that packed splat j can touch."""
    first = first_pixel(packed[j, PY] - packed[j, RY], top, bottom - 1)
    last = last_pixel(packed[j, PY] + packed[j, RY], top, bottom - 1)
    return u64((first - y0) * TILE_W), u64(max(last + 1 - y0, 0) * TILE_W)


@njit(fastmath=True, error_model="numpy")
def _place(tile, tiles_x, scratch):
    """Write the pixel centres of a tile into the scratch array and return its corner."""
    y0 = tile // tiles_x * TILE_H
    x0 = tile % tiles_x * TILE_W
    for y in range(TILE_H):
        for x in range(TILE_W):
            p = u64(y * TILE_W + x)
            scratch[X + p], scratch[Y + p] = f32(x0 + x) + f32(0.5), f32(y0 + y) + f32(0.5)
    return x0, y0


@njit(fastmath=True, error_model="numpy")
def _shape(packed, j):
    """What `_alpha` needs of packed splat j, read once, before the loop over its pixels."""
    return packed[j, PX], packed[j, PY], packed[j, A], packed[j, M], packed[j, D], packed[j, OPACITY]


@njit(fastmath=True, error_model="numpy")
def _alpha(s, p, shape):
    """Offsets of a pixel from a splat's mean, u along its conic and dy, and the splat's alpha there."""
    px, py, a, m, d, opacity = shape
    dy = s[Y + p] - py
    u = s[X + p] - px - m * dy
    alpha = min(CAP, opacity * _exp_minus(min(a * u * u + d * dy * dy, SIGMA_MAX)))
    return u, dy, alpha if alpha >= CUT else ZERO


@njit(fastmath=True, error_model="numpy")
def _draw(s, start, stop, packed, j, number):
    """Blend one packed splat into the pixels start:stop of the scratch array `s`."""
    shape, red, green, blue = _shape(packed, j), packed[j, RED], packed[j, GREEN], packed[j, BLUE]
    for p in range(start, stop):
        _, _, alpha = _alpha(s, p, shape)
        t = s[T + p]
        w = t * alpha
        goes_on = t - w > STOP  # false too where the pixel is finished and t negative
        w = w if goes_on else ZERO
        sign = ONE if goes_on else -ONE
        last = s[LAST + p]
        last = number if w > ZERO else last
        s[T + p] = abs(t - w) * sign
        s[LAST + p] = last
        s[W + p] = w
        s[C0 + p] += w * red
        s[C1 + p] += w * green
        s[C2 + p] += w * blue


@njit(fastmath=EXACT_DIVISION, error_model="numpy")
def _pass(s, start, stop, packed, j, number):
    """Take one packed splat that takes no derivatives off the pixels start:stop again, the last drawn first."""
    shape, red, green, blue = _shape(packed, j), packed[j, RED], packed[j, GREEN], packed[j, BLUE]
    for p in range(start, stop):
        _, _, alpha = _alpha(s, p, shape)
        alpha = alpha if number <= s[LAST + p] else ZERO
        t = s[T + p] / (ONE - alpha)
        s[T + p] = t
        s[BEHIND + p] += alpha * t * (red * s[V0 + p] + green * s[V1 + p] + blue * s[V2 + p])


@njit(fastmath=EXACT_DIVISION, error_model="numpy")
def _undraw(s, start, stop, packed, j, number, slots, slot):
    """Take one packed splat off the pixels start:stop again, the last drawn first, and write to slots[slot] the
    derivatives in its mean (2), conic (3), opacity and colour (3)."""
    shape = _, _, a, m, d, opacity = _shape(packed, j)
    red, green, blue = packed[j, RED], packed[j, GREEN], packed[j, BLUE]
    g_red, g_green, g_blue, g, gu, guu, gy, guy, gyy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    for p in range(start, stop):
        u, dy, alpha = _alpha(s, p, shape)
        alpha = alpha if number <= s[LAST + p] else ZERO
        v0, v1, v2, behind = s[V0 + p], s[V1 + p], s[V2 + p], s[BEHIND + p]
        inverse = ONE / (ONE - alpha)
        t = s[T + p] * inverse
        w = alpha * t
        dot = red * v0 + green * v1 + blue * v2 + s[VE + p]
        s[T + p] = t
        s[W + p] = w
        s[BEHIND + p] = behind + w * dot
        slope = alpha * (behind * inverse - t * dot)  # dL/dsigma
        slope = slope if alpha < CAP else ZERO
        g_red += w * v0
        g_green += w * v1
        g_blue += w * v2
        su, sy = slope * u, slope * dy
        g += slope
        gu += su
        gy += sy
        guu += su * u
        guy += su * dy
        gyy += sy * dy
    slots[slot, 0] = -f32(2) * a * gu
    slots[slot, 1] = f32(2) * (a * m * gu - d * gy)
    slots[slot, 2] = guu
    slots[slot, 3] = -f32(2) * a * guy
    slots[slot, 4] = gyy
    slots[slot, 5] = -g / opacity
    slots[slot, 6], slots[slot, 7], slots[slot, 8] = g_red, g_green, g_blue


@njit(fastmath=True, error_model="numpy")
def _walk(s, more, packed, extras, entries, begin, here, there, y0, top, bottom):
    """Blend the entries here:there of a tile whose list begins at `begin`. Returns where all of its pixels were
    finished, which none of the later entries can change, else `there`."""
    for k in range(here, there):
        if (k - begin) % LOOK == 0:
            brightest = -ONE
            for p in range(u64(0), u64(PIXELS)):
                brightest = max(brightest, s[T + p])
            if brightest < ZERO:
                return k
        j = entries[k, 0]
        start, stop = _rows(packed, j, y0, top, bottom)
        _draw(s, start, stop, packed, j, f32(k - begin + 1))
        for c in range(extras.shape[1]):
            value = extras[j, c]
            for p in range(start, stop):
                more[c, p] += s[W + p] * value
    return there


@kernel(parallel=True, fastmath=True)
def forward(work, images, state):
    """Fill the tiles of the Work's spans in the Images and the State, and move each END to where the tile was
    finished."""
    packed, extras, spans, entries, width, height, background = work
    rgb, alpha, image = images
    final, last, rest = state
    tiles_x, channels = -(-width // TILE_W), extras.shape[1]
    for task in prange(STRIDES):
        s, more = np.empty(ROWS * PIXELS, np.float32), np.empty((channels, PIXELS), np.float32)
        for i in range(task, spans.shape[0], STRIDES):
            x0, y0 = _place(spans[i, TILE], tiles_x, s)
            top, bottom = spans[i, TOP], spans[i, BOTTOM]
            s[T:] = ZERO
            more[:] = ZERO
            for y in range(TILE_H):
                for x in range(TILE_W):  # pixels that are not drawn count as finished
                    s[T + u64(y * TILE_W + x)] = ONE if x0 + x < width and top <= y0 + y < bottom else -ONE
            # up to AFTER: what the backward pass has to undo starts from the state behind these entries
            begin, after, end = spans[i, BEGIN], spans[i, AFTER], spans[i, END]
            spans[i, END] = _walk(s, more, packed, extras, entries, begin, begin, after, y0, top, bottom)
            for p in range(PIXELS):
                q = u64(p)
                final[i, p], last[i, p] = abs(s[T + q]), s[LAST + q]
            # from AFTER on: nothing takes derivatives, so that only their sum is kept, with the background's
            if spans[i, END] == after and after < end:
                for p in range(PIXELS):
                    q = u64(p)
                    rest[i, 0, p], rest[i, 1, p], rest[i, 2, p] = s[C0 + q], s[C1 + q], s[C2 + q]
                spans[i, END] = _walk(s, more, packed, extras, entries, begin, after, end, y0, top, bottom)
                for p in range(PIXELS):
                    q = u64(p)
                    t = abs(s[T + q])
                    rest[i, 0, p] = s[C0 + q] - rest[i, 0, p] + t * background[0]
                    rest[i, 1, p] = s[C1 + q] - rest[i, 1, p] + t * background[1]
                    rest[i, 2, p] = s[C2 + q] - rest[i, 2, p] + t * background[2]
                    rest[i, 3, p] = t
            # the tile is finished: out of the scratch array into the images
            for p in range(PIXELS):
                q = u64(p)
                y, x = y0 + p // TILE_W, x0 + p % TILE_W
                if x < width and top <= y < bottom:
                    t = abs(s[T + q])
                    alpha[y, x, 0] = ONE - t
                    rgb[y, x, 0] = s[C0 + q] + t * background[0]
                    rgb[y, x, 1] = s[C1 + q] + t * background[1]
                    rgb[y, x, 2] = s[C2 + q] + t * background[2]
                    for c in range(channels):
                        image[y, x, c] = more[c, p]


@kernel(parallel=True, fastmath=True)
def backward(work, state, cotangents, out):
    """Fill the Slots `out` from the cotangents, the derivatives in the Images of `forward`."""
    packed, extras, spans, entries, width, height, background = work
    final, last, rest = state
    v_rgb, v_alpha, v_image = cotangents
    slots, used = out
    tiles_x, channels = -(-width // TILE_W), extras.shape[1]
    for task in prange(STRIDES):
        s, more = np.zeros(ROWS * PIXELS, np.float32), np.zeros((channels, PIXELS), np.float32)
        for i in range(task, spans.shape[0], STRIDES):
            x0, y0 = _place(spans[i, TILE], tiles_x, s)
            top, bottom = spans[i, TOP], spans[i, BOTTOM]
            s[T:] = ZERO
            more[:] = ZERO
            # the state in which the forward pass left the pixels, and the images' derivatives there
            deepest, rested = ZERO, spans[i, AFTER] < spans[i, END]
            for p in range(PIXELS):
                q = u64(p)
                y, x = y0 + p // TILE_W, x0 + p % TILE_W
                if x < width and top <= y < bottom:
                    t, v0, v1, v2 = final[i, p], v_rgb[y, x, 0], v_rgb[y, x, 1], v_rgb[y, x, 2]
                    s[T + q], s[LAST + q] = t, last[i, p]
                    s[V0 + q], s[V1 + q], s[V2 + q] = v0, v1, v2
                    if rested:
                        behind = rest[i, 0, p] * v0 + rest[i, 1, p] * v1 + rest[i, 2, p] * v2
                        s[BEHIND + q] = behind - rest[i, 3, p] * v_alpha[y, x, 0]
                    else:
                        through = background[0] * v0 + background[1] * v1 + background[2] * v2 - v_alpha[y, x, 0]
                        s[BEHIND + q] = t * through
                    deepest = max(deepest, last[i, p])
                    for c in range(channels):
                        more[c, p] = v_image[y, x, c]
            # back to front, from the deepest splat that any pixel saw
            begin = spans[i, BEGIN]
            for k in range(begin + int(deepest) - 1, spans[i, FIRST] - 1, -1):
                j, slot = entries[k, 0], entries[k, 1]
                start, stop = _rows(packed, j, y0, top, bottom)
                if slot < 0:
                    _pass(s, start, stop, packed, j, f32(k - begin + 1))
                    continue
                # extra channels count as further colours: their share of dL/dw before, their own derivative after
                if channels > 0:
                    for p in range(start, stop):
                        s[VE + p] = ZERO
                    for c in range(channels):
                        value = extras[j, c]
                        for p in range(start, stop):
                            s[VE + p] += more[c, p] * value
                _undraw(s, start, stop, packed, j, f32(k - begin + 1), slots, slot)
                for c in range(channels):
                    total = ZERO
                    for p in range(start, stop):
                        total += s[W + p] * more[c, p]
                    slots[slot, 9 + c] = total
                used[slot] = 1


@kernel(parallel=True)
def background_rows(alpha, v_rgb, rows):
    """Fill rows [H,3], to be summed: the derivative in the background of alpha [H,W,1] and the image's."""
    for y in prange(alpha.shape[0]):
        r, g, b = ZERO, ZERO, ZERO
        for x in range(alpha.shape[1]):
            t = ONE - alpha[y, x, 0]
            r, g, b = r + t * v_rgb[y, x, 0], g + t * v_rgb[y, x, 1], b + t * v_rgb[y, x, 2]
        rows[y, 0], rows[y, 1], rows[y, 2] = r, g, b


@kernel(parallel=True)
def gather(order, first_slots, found, gradients):
    """Sum the Slots of each drawn splat, always in the same order, into the Gradients of splat order[j]."""
    slots, used = found
    g_means2d, g_conics, g_opacities, g_colors, g_extras = gradients
    for j in prange(order.size):
        i = order[j]
        for k in range(first_slots[j], first_slots[j + 1]):
            if used[k]:
                g_means2d[i, 0] += slots[k, 0]
                g_means2d[i, 1] += slots[k, 1]
                g_conics[i, 0] += slots[k, 2]
                g_conics[i, 1] += slots[k, 3]
                g_conics[i, 2] += slots[k, 4]
                g_opacities[i] += slots[k, 5]
                g_colors[i, 0] += slots[k, 6]
                g_colors[i, 1] += slots[k, 7]
                g_colors[i, 2] += slots[k, 8]
                for c in range(g_extras.shape[1]):
                    g_extras[i, c] += slots[k, 9 + c]
