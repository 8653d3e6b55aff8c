"""Compiled spherical harmonics and their derivative; `sh.py` is the same in torch."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ...scene.gaussians import SH_C0
from ...scene.harmonics import C1, C2, C3
from .jit import kernel

f32 = np.float32
ZERO, HALF, TINY = f32(0), f32(0.5), f32(1e-12)
K0, K1 = f32(SH_C0), f32(C1)
A0, A1, A2 = (f32(c) for c in C2)
B0, B1, B2, B3, B4 = (f32(c) for c in C3)
TWO, THREE, FOUR, SIX, EIGHT = f32(2), f32(3), f32(4), f32(6), f32(8)
CHUNK = 512  # splats per task


@njit(error_model="numpy", fastmath={"contract"})
def _direction(means, centers, v, i):
    x, y, z = means[i, 0] - centers[v, 0], means[i, 1] - centers[v, 1], means[i, 2] - centers[v, 2]
    norm = max(math.sqrt(x * x + y * y + z * z), TINY)
    return x / norm, y / norm, z / norm, norm


@njit(error_model="numpy", fastmath={"contract"})
def _basis(x, y, z, degree, out):
    """The bases above the constant one: out[0] is the first of degree 1."""
    out[0], out[1], out[2] = -K1 * y, K1 * z, -K1 * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        out[3], out[4], out[5] = A0 * x * y, -A0 * y * z, A1 * (TWO * zz - xx - yy)
        out[6], out[7] = -A0 * x * z, A2 * (xx - yy)
        if degree > 2:
            out[8], out[9], out[10] = -B0 * y * (THREE * xx - yy), B1 * x * y * z, -B2 * y * (FOUR * zz - xx - yy)
            out[11], out[12] = B3 * z * (TWO * zz - THREE * xx - THREE * yy), -B2 * x * (FOUR * zz - xx - yy)
            out[13], out[14] = B4 * z * (xx - yy), -B0 * x * (xx - THREE * yy)


@njit(error_model="numpy", fastmath={"contract"})
def _slope(x, y, z, degree, s):
    """Derivative in the direction of sum_k s[k] basis_k, for s [15] as `_basis` orders it."""
    gx, gy, gz = -K1 * s[2], -K1 * s[0], K1 * s[1]
    if degree > 1:
        gx += A0 * (y * s[3] - z * s[6]) + TWO * x * (A2 * s[7] - A1 * s[5])
        gy += A0 * (x * s[3] - z * s[4]) - TWO * y * (A2 * s[7] + A1 * s[5])
        gz += FOUR * A1 * z * s[5] - A0 * (y * s[4] + x * s[6])
        if degree > 2:
            xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
            gx += -SIX * B0 * xy * s[8] + B1 * yz * s[9] + TWO * B2 * xy * s[10] - SIX * B3 * xz * s[11]
            gx += -B2 * (FOUR * zz - THREE * xx - yy) * s[12] + TWO * B4 * xz * s[13] - THREE * B0 * (xx - yy) * s[14]
            gy += -THREE * B0 * (xx - yy) * s[8] + B1 * xz * s[9] - B2 * (FOUR * zz - xx - THREE * yy) * s[10]
            gy += -SIX * B3 * yz * s[11] + TWO * B2 * xy * s[12] - TWO * B4 * yz * s[13] + SIX * B0 * xy * s[14]
            gz += B1 * xy * s[9] - EIGHT * B2 * (yz * s[10] + xz * s[12]) + B4 * (xx - yy) * s[13]
            gz += THREE * B3 * (TWO * zz - xx - yy) * s[11]
    return gx, gy, gz


@kernel(parallel=True, fastmath={"contract"})
def forward(means, centers, sh0, shN, degree, colors):
    """Fill colors [V,N,3] = max(0, 0.5 + sum). means [N,3], centers [V,3], sh0 [N,1,3], shN [N,K,3]."""
    n, count = means.shape[0], (degree + 1) ** 2 - 1
    for chunk in prange(-(-n // CHUNK)):
        y = np.empty(15, np.float32)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            for v in range(centers.shape[0]):
                r, g, b = HALF + K0 * sh0[i, 0, 0], HALF + K0 * sh0[i, 0, 1], HALF + K0 * sh0[i, 0, 2]
                if degree > 0:
                    dx, dy, dz, _ = _direction(means, centers, v, i)
                    _basis(dx, dy, dz, degree, y)
                    for k in range(count):
                        r += y[k] * shN[i, k, 0]
                        g += y[k] * shN[i, k, 1]
                        b += y[k] * shN[i, k, 2]
                colors[v, i, 0], colors[v, i, 1], colors[v, i, 2] = max(r, ZERO), max(g, ZERO), max(b, ZERO)


@kernel(parallel=True, fastmath={"contract"})
def backward(means, centers, shN, degree, colors, g_colors, g_means, g_sh0, g_shN):
    """Fill the derivatives, summed over the views. colors [V,N,3] are those of `forward`: a clamped one has no
    slope."""
    n, count = means.shape[0], (degree + 1) ** 2 - 1
    for chunk in prange(-(-n // CHUNK)):
        y, s = np.empty(15, np.float32), np.empty(15, np.float32)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            g_means[i], g_sh0[i], g_shN[i] = ZERO, ZERO, ZERO
            for v in range(centers.shape[0]):
                r = g_colors[v, i, 0] if colors[v, i, 0] > ZERO else ZERO
                g = g_colors[v, i, 1] if colors[v, i, 1] > ZERO else ZERO
                b = g_colors[v, i, 2] if colors[v, i, 2] > ZERO else ZERO
                if r == ZERO and g == ZERO and b == ZERO:
                    continue
                g_sh0[i, 0, 0] += K0 * r
                g_sh0[i, 0, 1] += K0 * g
                g_sh0[i, 0, 2] += K0 * b
                if degree > 0:
                    dx, dy, dz, norm = _direction(means, centers, v, i)
                    _basis(dx, dy, dz, degree, y)
                    for k in range(count):
                        g_shN[i, k, 0] += y[k] * r
                        g_shN[i, k, 1] += y[k] * g
                        g_shN[i, k, 2] += y[k] * b
                        s[k] = shN[i, k, 0] * r + shN[i, k, 1] * g + shN[i, k, 2] * b
                    gx, gy, gz = _slope(dx, dy, dz, degree, s)
                    along = gx * dx + gy * dy + gz * dz
                    g_means[i, 0] += (gx - along * dx) / norm
                    g_means[i, 1] += (gy - along * dy) / norm
                    g_means[i, 2] += (gz - along * dz) / norm
