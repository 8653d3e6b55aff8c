"""GaussianEditor's unweighted count over the tile lists: for each splat the pixels to which it contributes."""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ...data.camera import Cameras
from ...scene.gaussians import Gaussians
from . import composite, project, tiles
from .composite import LAST, ONE, PIXELS, ROWS, STRIDES, ZERO, T, W, f32, u64
from .jit import kernel
from .tiles import TILE_H, TILE_W

_draw, _place, _rows = composite._draw, composite._place, composite._rows


@kernel(parallel=True, fastmath=True)
def _count(packed, starts, entries, width, height, mask, slots):
    """Fill slots [I,2] of each pair of splat and tile: the sum of mask [H,W] over the pixels to which the splat
    contributes, and their number."""
    tiles_x = -(-width // TILE_W)
    for task in prange(STRIDES):
        s, inside = np.zeros(ROWS * PIXELS, np.float32), np.zeros(PIXELS, np.float32)
        for tile in range(task, tiles_x * -(-height // TILE_H), STRIDES):
            x0, y0 = _place(tile, tiles_x, s)
            for y in range(TILE_H):
                for x in range(TILE_W):  # pixels outside of the image count as finished
                    p, there = u64(y * TILE_W + x), x0 + x < width and y0 + y < height
                    s[T + p], s[LAST + p] = (ONE if there else -ONE), ZERO
                    inside[p] = mask[y0 + y, x0 + x] if there else ZERO
            for k in range(starts[tile], starts[tile + 1]):
                j, slot = entries[k, 0], entries[k, 1]
                start, stop = _rows(packed, j, y0, y0, y0 + TILE_H)
                _draw(s, start, stop, packed, j, f32(1))
                votes, pixels = ZERO, ZERO
                for p in range(start, stop):
                    seen = ONE if s[W + p] > ZERO else ZERO
                    votes += seen * inside[p]
                    pixels += seen
                slots[slot, 0], slots[slot, 1] = votes, pixels


def count(scene: Gaussians, camera: Cameras, mask: Tensor, antialiased: bool) -> Tensor:
    """[N,2] for one view: the sum of `mask` [H,W] over the pixels to which each splat contributes, and their number.

    scene, camera, mask: float32 on the CPU, without graph.
    """
    n, size = len(scene), (camera.width, camera.height)
    means2d, conics, depths, opacities = (np.empty((1, n, *rest), np.float32) for rest in ((2,), (3,), (), ()))
    radii = np.empty((1, n), np.int32)
    inputs = scene.means, scene.quats, scene.log_scales, scene.logit_opacities, camera.viewmats, camera.Ks
    *splats, viewmats, Ks = (tensor.contiguous().numpy() for tensor in inputs)
    views, out = project.Views(viewmats, Ks, *size, antialiased), project.Projected(means2d, conics, depths, opacities)
    project.forward(project.Splats(*splats), views, out, radii)
    order = tiles.depth_order(depths[0], radii[0])
    colors = np.zeros((n, 3), np.float32)
    packed, starts, entries, first = tiles.tile_lists(order, means2d[0], conics[0], opacities[0], colors, *size)
    slots = np.zeros((len(entries), 2), np.float32)
    _count(packed, starts, entries, *size, mask.contiguous().numpy(), slots)
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(slots, axis=0, dtype=np.float64)])[first]
    found = np.zeros((n, 2), np.float32)
    found[order] = sums[1:] - sums[:-1]
    return torch.from_numpy(found)
