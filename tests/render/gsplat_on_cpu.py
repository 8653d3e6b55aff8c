"""The package gsplat on a machine without a GPU: its own `rasterization` and wrappers, with what they call of its
compiled extension written in torch.

Projection is gsplat's own twin of its kernel; culling, tile lists and compositing are written here after what its
documentation and the image model say, as plain differentiable torch. Where the kernels are less kind than torch, so is
this: a quaternion is divided by its norm, whatever it is; no splats at all is a division by zero; what the kernels
leave unwritten for culled splats is NaN; tensors must be contiguous.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from dreamcatalyst.render.api import BACKENDS
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, STOP, EXTENT = 1 / 255, 0.999, 1e-4, 3.33


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let backend "gsplat" draw on any device and in any precision, for the length of a test."""
    wrapper = pytest.importorskip("gsplat.cuda._wrapper")
    kernels = {"intersect_tile": intersect_tiles, "intersect_offset": offsets}
    monkeypatch.setattr(wrapper, "_make_lazy_cuda_func", kernels.__getitem__)
    monkeypatch.setattr(wrapper, "_FullyFusedProjection", SimpleNamespace(apply=project))
    monkeypatch.setattr(wrapper, "_RasterizeToPixels", SimpleNamespace(apply=composite))
    anywhere = replace(BACKENDS.get("gsplat"), devices=(), dtypes=(), prepare=None)
    monkeypatch.setitem(BACKENDS._targets, "gsplat", anywhere)


def check(*tensors: Tensor) -> None:
    """As the kernels do."""
    device = tensors[0].device
    for tensor in tensors:
        assert tensor.device == device and tensor.is_contiguous(), (tensor.device, tensor.shape, tensor.stride())


def project(means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near, far, clip, compensated, model,
            opacities):  # fmt: skip
    """radii [V,N,2] int32, means2d [V,N,2], depths [V,N], conics [V,N,3], compensations [V,N] or None."""
    from gsplat.cuda import _torch_impl as twin

    assert covars is None and model == "pinhole" and clip == 0
    check(means, quats, scales, viewmats, Ks, opacities)
    if len(means) == 0:
        raise ZeroDivisionError("the number of batches is a quotient by the number of splats")
    quats = quats * quats.square().sum(-1, keepdim=True).rsqrt()
    covars, _ = twin._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    centers, covars = twin._world_to_cam(means, covars, viewmats)
    depths = centers[..., 2]
    there = (depths >= near) & (depths <= far)
    safe = torch.where(there[..., None], centers, torch.ones_like(centers))
    means2d, covars = twin._persp_proj(safe, covars, Ks, width, height)
    xx, xy, yy = covars[..., 0, 0], covars[..., 0, 1], covars[..., 1, 1]
    sharp, xx, yy = xx * yy - xy * xy, xx + eps2d, yy + eps2d
    det = xx * yy - xy * xy
    ratio = sharp / det
    compensation = torch.where(ratio > 0, ratio, 1).sqrt() * (ratio > 0)
    conics = torch.stack([yy, -xy, xx], dim=-1) / det[..., None]
    with torch.no_grad():
        opaque = opacities * compensation if compensated else opacities.expand_as(depths)
        extent = (2 * (opaque / ALPHA_MIN).clamp_min(1).log()).sqrt().clamp_max(EXTENT)
        radii = (extent[..., None] * torch.stack([xx, yy], dim=-1).sqrt()).ceil()
        size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
        there = there & (det > 0) & (opaque >= ALPHA_MIN) & (radii > 0).any(-1)
        there = there & ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
        radii = torch.where(there[..., None], radii, 0).int()
    means2d, conics = (torch.where(there[..., None], value, torch.nan) for value in (means2d, conics))
    depths, compensation = torch.where(there, depths, torch.nan), torch.where(there, compensation, 0)
    return radii, means2d, depths, conics, compensation if compensated else None


def intersect_tiles(means2d, radii, depths, image_ids, splat_ids, images, tile, columns, rows, sort, segmented):
    """tiles_per_splat [V,N], and for each pair of a tile and a splat in it, by tile and from front to back: the number
    of the tile among those of all images, and of the splat among those of all images."""
    assert image_ids is None and splat_ids is None and sort and not segmented
    check(means2d, radii, depths)
    most = torch.tensor([columns, rows], device=means2d.device)
    drawn = (radii > 0).all(-1)
    center = torch.where(drawn[..., None], means2d, 0)
    low = ((center - radii) / tile).floor().long().clamp_min(0).minimum(most)
    high = ((center + radii) / tile).ceil().long().clamp_min(0).minimum(most)
    wide = (high - low) * drawn[..., None]
    count = wide.prod(-1)
    ids = torch.arange(count.numel(), device=count.device).repeat_interleave(count.flatten())
    nth = torch.arange(len(ids), device=count.device) - (count.flatten().cumsum(0) - count.flatten())[ids]
    across, (left, top) = wide.flatten(0, -2)[ids, 0], low.flatten(0, -2)[ids].unbind(-1)
    place = (top + nth // across.clamp_min(1)) * columns + left + nth % across.clamp_min(1)
    tiles = ids // means2d.shape[-2] * (columns * rows) + place
    order = depths.flatten()[ids].argsort(stable=True)
    order = order[tiles[order].argsort(stable=True)]
    return count.int(), tiles[order], ids[order].int()


def offsets(tiles: Tensor, images: int, columns: int, rows: int) -> Tensor:
    """[images, rows, columns]: where each tile's list begins."""
    numbers = torch.arange(images * rows * columns, device=tiles.device)
    return torch.searchsorted(tiles, numbers).view(images, rows, columns).int()


def composite(means2d, conics, colors, opacities, backgrounds, masks, width, height, tile, starts, ids, absgrad):
    """Images [V,H,W,D] and alphas [V,H,W,1]."""
    assert masks is None and not absgrad
    check(means2d, conics, colors, opacities, backgrounds, starts, ids)
    views, rows, columns = starts.shape
    ids, bounds = ids.long(), [*starts.flatten().tolist(), len(ids)]
    flat = [value.flatten(0, 1) for value in (means2d, conics, colors, opacities)]
    images, alphas = [], []
    for view in range(views):
        strips = []
        for row in range(rows):
            blocks = []
            for column in range(columns):
                number = (view * rows + row) * columns + column
                xy, conic, color, opacity = (value[ids[bounds[number] : bounds[number + 1]]] for value in flat)
                x = torch.arange(column * tile, min((column + 1) * tile, width)).to(xy) + 0.5
                y = torch.arange(row * tile, min((row + 1) * tile, height)).to(xy) + 0.5
                dx, dy = x[None, :, None] - xy[:, 0], y[:, None, None] - xy[:, 1]
                sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
                alpha = (opacity * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
                alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0)
                alpha = torch.where((1 - alpha).cumprod(-1) > STOP, alpha, 0)
                left = torch.cat([alpha.new_ones(*alpha.shape[:2], 1), (1 - alpha).cumprod(-1)], dim=-1)
                through = left[..., -1:]
                shown = (alpha * left[..., :-1]) @ color + through * backgrounds[view]
                blocks.append(torch.cat([shown, 1 - through], dim=-1))
            strips.append(torch.cat(blocks, dim=1))
        whole = torch.cat(strips)
        images.append(whole[..., :-1])
        alphas.append(whole[..., -1:])
    return torch.stack(images), torch.stack(alphas)
