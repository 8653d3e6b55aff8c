"""Compiled projection and its derivative; `projection.py` is the same in torch, with the sources of the formulas.

A projected splat is the conic (a, m, d) of sigma = a (dx - m dy)^2 + d dy^2, the exponent at an offset (dx, dy) pixels
from its mean: a = yy / (2 det), m = xy / yy, d = 1 / (2 yy) of the blurred 2D covariance (xx, xy, yy). Two squares do
not cancel for needles, where the usual three terms lose all digits in float32.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from ..thresholds import ALPHA_MIN, BLUR, FRUSTUM_MARGIN, NEAR
from .jit import kernel

f32, i32 = np.float32, np.int32


class Splats(NamedTuple):
    """Raw parameters of N splats, or the derivatives in them; float32."""

    means: np.ndarray  # [N,3] world units
    quats: np.ndarray  # [N,4] wxyz, any norm
    log_scales: np.ndarray  # [N,3] log of world units
    logits: np.ndarray  # [N] of the opacities


class Views(NamedTuple):
    """V cameras of one size."""

    viewmats: np.ndarray  # float32 [V,4,4] world to camera
    Ks: np.ndarray  # float32 [V,3,3] pixels
    width: int  # pixels
    height: int
    antialiased: bool  # whether opacities are compensated for the blur


class Projected(NamedTuple):
    """Splats in V views, or the derivatives in them; float32."""

    means2d: np.ndarray  # [V,N,2] pixels
    conics: np.ndarray  # [V,N,3]: a, m, d
    depths: np.ndarray  # [V,N] world units
    opacities: np.ndarray  # [V,N]


ALPHA_MIN, BLUR, MARGIN, NEAR = f32(ALPHA_MIN), f32(BLUR), f32(FRUSTUM_MARGIN), f32(NEAR)
ZERO, HALF, ONE, TWO, FOUR, TINY = f32(0), f32(0.5), f32(1), f32(2), f32(4), f32(1e-12)


@njit(error_model="numpy", fastmath={"contract"})
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(error_model="numpy", fastmath={"contract"})
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(error_model="numpy", fastmath={"contract"})
def _combine(a, x, b, y):
    """a x + b y of 3-vectors x, y."""
    return a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]


@njit(error_model="numpy", fastmath={"contract"})
def _unit(quats, i):
    """The unit quaternion and max(norm, 1e-12). The largest number is divided off first: squares would overflow."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    largest = max(max(abs(w), abs(x)), max(abs(y), abs(z)), TINY)
    w, x, y, z = w / largest, x / largest, y / largest, z / largest
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), TINY / largest)
    return w / norm, x / norm, y / norm, z / norm, norm * largest


@njit(error_model="numpy", fastmath={"contract"})
def _rotation(q):
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)),
        (TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)),
        (TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)),
    )


@njit(error_model="numpy", fastmath={"contract"})
def _scaled(rows, s):
    """The matrix of `rows` with its columns multiplied by s."""
    r0, r1, r2 = rows
    return (
        (r0[0] * s[0], r0[1] * s[1], r0[2] * s[2]),
        (r1[0] * s[0], r1[1] * s[1], r1[2] * s[2]),
        (r2[0] * s[0], r2[1] * s[1], r2[2] * s[2]),
    )


@njit(error_model="numpy", fastmath={"contract"})
def _row_times(view, row, m):
    """Row `row` of the view's rotation times the 3x3 matrix m."""
    a, b, c = view[row, 0], view[row, 1], view[row, 2]
    return (
        a * m[0][0] + b * m[1][0] + c * m[2][0],
        a * m[0][1] + b * m[1][1] + c * m[2][1],
        a * m[0][2] + b * m[1][2] + c * m[2][2],
    )


@njit(error_model="numpy", fastmath={"contract"})
def _coordinate(view, row, means, i):
    return view[row, 0] * means[i, 0] + view[row, 1] * means[i, 1] + view[row, 2] * means[i, 2] + view[row, 3]


@njit(error_model="numpy", fastmath={"contract"})
def _limits(focal, center, size):
    return (-MARGIN * size - center) / focal, ((ONE + MARGIN) * size - center) / focal


@njit(error_model="numpy", fastmath={"contract"})
def _axes(view, m, fx, fy, tx, ty, z):
    """The rows of J W R S, px, and the third row of W R S that both share."""
    b0, b1, b2 = _row_times(view, 0, m), _row_times(view, 1, m), _row_times(view, 2, m)
    return _combine(fx / z, b0, -tx * fx / z, b2), _combine(fy / z, b1, -ty * fy / z, b2), b2


@njit(error_model="numpy", fastmath={"contract"})
def _sizes(log_scales, i):
    return math.exp(log_scales[i, 0]), math.exp(log_scales[i, 1]), math.exp(log_scales[i, 2])


@njit(error_model="numpy", fastmath={"contract"})
def _sigmoid(x):
    return ONE / (ONE + math.exp(-x))


@njit(error_model="numpy", fastmath={"contract"})
def _radius(x, y, a, m, d, opacity, width, height):
    """Pixels, 0 where the splat cannot touch a pixel or is not finite: written so that a comparison with NaN culls."""
    if opacity >= ALPHA_MIN and a > ZERO and d > ZERO:
        limit = math.log(opacity / ALPHA_MIN)
        rx, ry = math.sqrt(limit * (ONE / a + m * m / d)), math.sqrt(limit / d)
        if x + rx > ZERO and x - rx < width and y + ry > ZERO and y - ry < height:
            return i32(max(ONE, math.ceil(min(max(rx, ry), f32(2**30)))))
    return i32(0)


@kernel(parallel=True, fastmath={"contract"})
def forward(splats, cameras, out, radii):
    """Fill the Projected `out` and radii [V,N], int32 pixels, from Splats and Views.

    Splats behind the near plane get their depth only; their other entries are zero.
    """
    means, quats, log_scales, logits = splats
    views, Ks, width, height, antialiased = cameras
    means2d, conics, depths, opacities = out
    for i in prange(means.shape[0]):
        m = _scaled(_rotation(_unit(quats, i)), _sizes(log_scales, i))
        for v in range(views.shape[0]):
            view, fx, fy, cx, cy = views[v], Ks[v, 0, 0], Ks[v, 1, 1], Ks[v, 0, 2], Ks[v, 1, 2]
            z = _coordinate(view, 2, means, i)
            depths[v, i], radii[v, i], opacities[v, i] = z, 0, ZERO
            if not z >= NEAR:
                means2d[v, i, 0] = means2d[v, i, 1] = ZERO
                conics[v, i, 0] = conics[v, i, 1] = conics[v, i, 2] = ZERO
                continue
            tx, ty = _coordinate(view, 0, means, i) / z, _coordinate(view, 1, means, i) / z
            px, py = fx * tx + cx, fy * ty + cy
            low, high = _limits(fx, cx, f32(width))
            tx = max(min(tx, high), low)
            low, high = _limits(fy, cy, f32(height))
            ty = max(min(ty, high), low)
            ax, ay, _ = _axes(view, m, fx, fy, tx, ty, z)
            xx, xy, yy, n = _dot(ax, ax), _dot(ax, ay), _dot(ay, ay), _cross(ax, ay)
            area2 = _dot(n, n)
            det = area2 + BLUR * (xx + yy) + BLUR * BLUR
            yy += BLUR
            conic = HALF * yy / det, xy / yy, HALF / yy
            opacity = _sigmoid(logits[i])
            if antialiased:
                opacity *= math.sqrt(area2 / det)
            means2d[v, i, 0], means2d[v, i, 1] = px, py
            conics[v, i, 0], conics[v, i, 1], conics[v, i, 2] = conic
            opacities[v, i] = opacity
            radii[v, i] = _radius(px, py, conic[0], conic[1], conic[2], opacity, f32(width), f32(height))


@njit(error_model="numpy", fastmath={"contract"})
def _to_quaternion(g, q):
    """Derivative in the raw quaternion, from g, that in the rotation matrix; q is the unit one and the norm."""
    w, x, y, z, norm = q
    gw = TWO * (x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1]))
    s01, s02, s12 = g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]
    gx = TWO * (y * s01 + z * s02 + w * (g[2][1] - g[1][2]) - TWO * x * (g[1][1] + g[2][2]))
    gy = TWO * (x * s01 + z * s12 + w * (g[0][2] - g[2][0]) - TWO * y * (g[0][0] + g[2][2]))
    gz = TWO * (x * s02 + y * s12 + w * (g[1][0] - g[0][1]) - TWO * z * (g[0][0] + g[1][1]))
    along = w * gw + x * gx + y * gy + z * gz
    return (gw - w * along) / norm, (gx - x * along) / norm, (gy - y * along) / norm, (gz - z * along) / norm


@njit(error_model="numpy", fastmath={"contract"})
def _covariance_gradient(ax, ay, conic, g, g_comp):
    """Derivatives in the two rows ax, ay from g = those in the conic (a, m, d), and from that in the compensation;
    and the compensation, 1 where nothing depends on it.

    With n = ax x ay and r = (ay x n + BLUR ax) / yy = ax - m ay:  1 / (2 a) = |r|^2 + BLUR (1 + m^2), and
    da = -4 a^2 r (dax - m day),  dm = 2 d (ay dax + (r - m ay) day),  dd = -4 d^2 ay day.  By way of the covariance
    (xx, xy, yy) these are differences of terms that grow with the square of a needle's length in pixels; r taken from
    the cross product keeps its digits.
    """
    a, m, d = conic
    n = _cross(ax, ay)
    to_x = _cross(ay, n)
    r = _combine(TWO * d, to_x, TWO * d * BLUR, ax)
    ga, gm = -FOUR * a * a * g[0], TWO * d * g[1]
    gax = _combine(ga, r, gm, ay)
    gay = _combine(gm - m * ga, r, -m * gm - FOUR * d * d * g[2], ay)
    if g_comp == ZERO:
        return gax, gay, ONE
    # compensation = |n| / sqrt(det), det = |n|^2 + rest
    area = math.sqrt(_dot(n, n))
    rest = BLUR * (_dot(ax, ax) + _dot(ay, ay)) + BLUR * BLUR
    det = area * area + rest
    root = math.sqrt(det)
    g_n = g_comp / area * (rest / (root * det)) if area > ZERO else ZERO
    g_rest = -g_comp * BLUR * area / (root * det)
    to_y = _cross(n, ax)
    gax, gay = _combine(ONE, gax, g_rest, ax), _combine(ONE, gay, g_rest, ay)
    return _combine(ONE, gax, g_n, to_x), _combine(ONE, gay, g_n, to_y), area / root


@kernel(parallel=True, fastmath={"contract"})
def backward(splats, cameras, conics, cotangents, out):
    """Fill `out`, the derivatives in the Splats, summed over the views. conics [V,N,3]: those of `forward`; cotangents:
    the derivatives in what it filled."""
    means, quats, log_scales, logits = splats
    views, Ks, width, height, antialiased = cameras
    g_means2d, g_conics, g_depths, g_opacities = cotangents
    g_means, g_quats, g_logs, g_logits = out
    for i in prange(means.shape[0]):
        q, s, opacity, g_logit = _unit(quats, i), _sizes(log_scales, i), _sigmoid(logits[i]), ZERO
        m = _scaled(_rotation(q), s)
        g_mean = (ZERO, ZERO, ZERO)
        gm0, gm1, gm2 = g_mean, g_mean, g_mean  # the derivative in R S, by rows
        for v in range(views.shape[0]):
            view, fx, fy, cx, cy = views[v], Ks[v, 0, 0], Ks[v, 1, 1], Ks[v, 0, 2], Ks[v, 1, 2]
            z = _coordinate(view, 2, means, i)
            gu, gv = g_means2d[v, i, 0], g_means2d[v, i, 1]
            g = (g_conics[v, i, 0], g_conics[v, i, 1], g_conics[v, i, 2])
            gz, g_opacity = g_depths[v, i], g_opacities[v, i]
            idle = gu == 0 and gv == 0 and g[0] == 0 and g[1] == 0 and g[2] == 0 and gz == 0 and g_opacity == 0
            if idle or not z >= NEAR:
                continue
            tx, ty = _coordinate(view, 0, means, i) / z, _coordinate(view, 1, means, i) / z
            gtx, gty = fx * gu, fy * gv
            low, high = _limits(fx, cx, f32(width))
            ux = max(min(tx, high), low)
            low, high = _limits(fy, cy, f32(height))
            uy = max(min(ty, high), low)
            ax, ay, b2 = _axes(view, m, fx, fy, ux, uy, z)
            conic = conics[v, i, 0], conics[v, i, 1], conics[v, i, 2]
            gax, gay, compensation = _covariance_gradient(
                ax, ay, conic, g, g_opacity * opacity if antialiased else ZERO
            )
            g_logit += g_opacity * compensation * opacity * (ONE - opacity)
            kx, ky = fx / z, fy / z
            gtx -= kx * _dot(gax, b2) if ux == tx else ZERO
            gty -= ky * _dot(gay, b2) if uy == ty else ZERO
            gz -= (_dot(gax, ax) + _dot(gay, ay) + gtx * tx + gty * ty) / z
            gx, gy = gtx / z, gty / z
            gb2 = _combine(-ux * kx, gax, -uy * ky, gay)
            gb0, gb1 = (kx * gax[0], kx * gax[1], kx * gax[2]), (ky * gay[0], ky * gay[1], ky * gay[2])
            r0, r1, r2 = (view[0, 0], view[0, 1], view[0, 2]), (view[1, 0], view[1, 1], view[1, 2]), view[2]
            g_mean = _combine(ONE, g_mean, gx, r0)
            g_mean = _combine(ONE, g_mean, gy, r1)
            g_mean = _combine(ONE, g_mean, gz, r2)
            gm0 = _combine(ONE, gm0, ONE, _combine(r0[0], gb0, r1[0], gb1))
            gm1 = _combine(ONE, gm1, ONE, _combine(r0[1], gb0, r1[1], gb1))
            gm2 = _combine(ONE, gm2, ONE, _combine(r0[2], gb0, r1[2], gb1))
            gm0, gm1, gm2 = (
                _combine(ONE, gm0, r2[0], gb2),
                _combine(ONE, gm1, r2[1], gb2),
                _combine(ONE, gm2, r2[2], gb2),
            )
        g_means[i, 0], g_means[i, 1], g_means[i, 2] = g_mean
        g_logits[i] = g_logit
        for k in range(3):
            g_logs[i, k] = gm0[k] * m[0][k] + gm1[k] * m[1][k] + gm2[k] * m[2][k]
        g_quats[i, 0], g_quats[i, 1], g_quats[i, 2], g_quats[i, 3] = _to_quaternion(_scaled((gm0, gm1, gm2), s), q)
