"""Depth inside of a hole: the surfaces around it go on.

All of it works on inverse depth, which is an affine function of the pixel's place on every plane of the world, so that
a plane that goes on under a hole is continued exactly, whatever the camera.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve
from torch import Tensor

SAME_PLANE = 0.02  # of the inverse depth: what differs less from a plane lies on it
ENOUGH = 0.5  # of the ring that must lie on one plane for the rest, another surface behind it, to be left out
TRIALS = 200  # planes through three pixels that are tried (RANSAC, Fischler & Bolles 1981)
LEAST = 8  # pixels of a ring that say something
NEAREST = 1e-6  # inverse depth of what has none


def continue_depth(depth: Float[Tensor, "H W"], hole: Bool[Tensor, "H W"], ring: int) -> Float[Tensor, "H W"]:
    """`depth` (z, world units) with every part of the hole filled from `ring` pixels around it.

    Where most of the ring lies on one plane, that plane, bent so that it meets what lies on it; else a membrane (the
    solution of Laplace's equation) that is held by all of the ring. Outside of the hole nothing changes.
    """
    inverse = 1 / np.maximum(depth.detach().cpu().double().numpy(), NEAREST)
    inside = hole.cpu().numpy()
    filled, (parts, count) = inverse.copy(), cast(tuple[np.ndarray, int], ndimage.label(inside))
    for number in range(1, count + 1):
        part = parts == number
        around = ndimage.binary_dilation(part, iterations=ring) & ~inside
        if around.sum() >= LEAST:
            filled[part] = _continued(inverse, part, around)[part]
    return torch.where(hole, torch.from_numpy(1 / np.maximum(filled, NEAREST)).to(depth), depth)


def _continued(
    values: Float[np.ndarray, "H W"], part: Bool[np.ndarray, "H W"], around: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    v, u = np.nonzero(around)
    plane, near = _plane(u, v, values[v, u])
    if near.mean() < ENOUGH:
        return membrane(values, part, around)
    known = np.zeros_like(part)
    known[v[near], u[near]] = True
    y, x = np.indices(part.shape)
    flat = plane[0] * x + plane[1] * y + plane[2]
    return flat + membrane(values - flat, part | (around & ~known), known)


def _plane(u: np.ndarray, v: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The affine function [3] of pixels that most of `values` [P] agree with, and which do, bool [P]."""
    rows, rng = np.stack([u, v, np.ones_like(u)], axis=1).astype(float), np.random.default_rng(0)
    best = np.zeros(len(u), bool)
    for _ in range(TRIALS):
        three = rng.choice(len(u), 3, replace=False)
        if abs(np.linalg.det(rows[three])) < 1e-9:  # on one line
            continue
        near = np.abs(rows @ np.linalg.solve(rows[three], values[three]) - values) < SAME_PLANE * values
        best = near if near.sum() > best.sum() else best
    if best.sum() < 3:
        return np.array([0.0, 0.0, np.median(values)]), best
    plane = np.linalg.lstsq(rows[best], values[best], rcond=None)[0]
    return plane, np.abs(rows @ plane - values) < SAME_PLANE * values


def membrane(
    values: Float[np.ndarray, "H W"], unknown: Bool[np.ndarray, "H W"], known: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    """`values` with the unknown pixels such that each is the mean of those of its four neighbours that are known or
    unknown: others are not looked at. Parts that touch nothing known become 0."""
    number = np.full(unknown.shape, -1)
    ys, xs = np.nonzero(unknown)
    number[ys, xs] = np.arange(len(ys))
    degree, held, links = np.zeros(len(ys)), np.zeros(len(ys)), []
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        y, x = ys + dy, xs + dx
        there = (y >= 0) & (y < unknown.shape[0]) & (x >= 0) & (x < unknown.shape[1])
        y, x = y.clip(0, unknown.shape[0] - 1), x.clip(0, unknown.shape[1] - 1)
        free, fixed = there & unknown[y, x], there & known[y, x] & ~unknown[y, x]
        links.append((np.nonzero(free)[0], number[y[free], x[free]]))
        held[fixed] += values[y[fixed], x[fixed]]
        degree += free
        degree += fixed
    rows, columns = (np.concatenate(side) for side in zip(*links, strict=True))
    laplace = sparse.diags(degree + 1e-9) - sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (len(ys), len(ys)))
    out = values.copy()
    out[ys, xs] = spsolve(laplace.tocsc(), held)
    return out
