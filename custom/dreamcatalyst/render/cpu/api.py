"""Three differentiable nodes (project, shade, composite) around the numba kernels of this folder.

float32 only. Every sum has a fixed order, so that the same bits come out whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...data.camera import Cameras
from ...scene.gaussians import Gaussians
from ..api import Backend, Frozen, Render, RenderOptions
from . import composite, project, records, sh, tiles
from .frozen import View, draw, view


def rasterize(scene: Gaussians, cameras: Cameras, options: RenderOptions, frozen: Frozen | None = None) -> Render:
    """Draw `scene`; arguments and result as in `api.rasterize`, but `frozen` excludes features and depth."""
    means2d, conics, colors, opacities, depths, radii = _splats(scene, cameras, options)
    features = options.features
    extras = [] if features is None else [features.expand(len(cameras), -1, -1)]
    extras += [depths[..., None]] if options.depth else []
    extras = torch.cat(extras, dim=-1) if extras else None

    behind = None if frozen is None else partial(_frozen_view, frozen, cameras, options)
    size = cameras.width, cameras.height
    rgb, alpha, image = Composite.apply(
        means2d, conics, colors, opacities, extras, options.background, depths.detach(), radii, *size, behind
    )
    return Render(
        rgb=rgb,
        alpha=alpha,
        depth=image[..., -1:] / torch.where(alpha > 0, alpha, 1.0) if options.depth else None,
        features=None if features is None else image[..., : features.shape[1]],
        means2d=means2d,
        radii=radii,
    )


def _splats(scene: Gaussians, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, ...]:
    """means2d [V,N,2], conics [V,N,3], colors [V,N,3], opacities [V,N], depths [V,N], radii [V,N]."""
    parameters = scene.means, scene.quats, scene.log_scales, scene.logit_opacities
    means2d, conics, depths, opacities, radii = Project.apply(*parameters, cameras, options.antialiased)
    colors = Shade.apply(scene.means, scene.sh0, scene.shN, cameras.centers, options.sh_degree)
    return means2d, conics, colors, opacities, depths, radii


def _frozen_view(frozen: Frozen, cameras: Cameras, options: RenderOptions, v: int, touched: np.ndarray) -> View:
    """What is kept of the frozen splats in view v, made anew where there is nothing or `touched`, the numbers of the
    tiles that edited splats touch, goes beyond it."""
    camera = cameras[v]
    size = camera.width, camera.height
    numbers = (tensor.numpy().tobytes() for tensor in (camera.viewmats, camera.Ks))
    key = "cpu", *numbers, *size, options.sh_degree, options.antialiased
    kept = frozen.kept.find(key)
    if kept is None or not kept.covered[touched].all():
        *splats, radii = _splats(frozen.scene, camera, options)
        means2d, conics, colors, opacities, depths = (array[0] for array in _arrays(*splats))
        kept = view(means2d, conics, colors, opacities, depths, radii[0].numpy(), *size, touched, kept)
        frozen.kept.put(key, kept)
    return kept


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    """C-contiguous float32 views (copies where they must be) for the kernels."""
    return [t.detach().float().contiguous().numpy() for t in tensors]


def _given(inputs: Sequence[Tensor], options: tuple[int, int, bool]) -> tuple[project.Splats, project.Views]:
    """Four raw parameters, viewmats and Ks, with (width, height, antialiased), for the kernels of project.py."""
    *splats, viewmats, Ks = _arrays(*inputs)
    return project.Splats(*splats), project.Views(viewmats, Ks, *options)


class Project(torch.autograd.Function):
    """means [N,3], quats [N,4], log_scales [N,3], logit_opacities [N] -> means2d [V,N,2], conics [V,N,3], depths [V,N],
    opacities [V,N] (compensated if antialiased), radii [V,N] int32."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, cameras: Cameras, antialiased: bool):
        shape = len(cameras), len(means)
        outputs = [means.new_empty(*shape, *rest) for rest in ((2,), (3,), (), ())]
        radii = torch.empty(shape, dtype=torch.int32)
        inputs = means, quats, log_scales, logits, cameras.viewmats, cameras.Ks
        ctx.options = cameras.width, cameras.height, antialiased
        out = project.Projected(*_arrays(*outputs))
        project.forward(*_given(inputs, ctx.options), out, radii.numpy())
        ctx.save_for_backward(*inputs, outputs[1])
        ctx.mark_non_differentiable(radii)
        return *outputs, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor):
        *inputs, conics = ctx.saved_tensors
        out = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs[:4]]
        cotangents, targets = project.Projected(*_arrays(*grads[:4])), project.Splats(*_arrays(*out))
        project.backward(*_given(inputs, ctx.options), *_arrays(conics), cotangents, targets)
        return *out, None, None


class Shade(torch.autograd.Function):
    """means [N,3], sh0 [N,1,3], shN [N,K,3], camera centres [V,3] -> colours [V,N,3] >= 0."""

    @staticmethod
    def forward(ctx, means: Tensor, sh0: Tensor, shN: Tensor, centers: Tensor, degree: int):
        colors = means.new_empty(len(centers), len(means), 3)
        sh.forward(*_arrays(means, centers, sh0, shN), degree, *_arrays(colors))
        ctx.save_for_backward(means, centers, sh0, shN, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor):
        means, centers, sh0, shN, colors = ctx.saved_tensors
        out = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in (means, sh0, shN)]
        sh.backward(*_arrays(means, centers, shN), ctx.degree, *_arrays(colors, grad), *_arrays(*out))
        return *out, None, None


class Composite(torch.autograd.Function):
    """means2d [V,N,2], conics [V,N,3], colors [V,N,3], opacities [V,N], extras [V,N,E] or None, background [3] ->
    rgb [V,H,W,3], alpha [V,H,W,1], the extra channels [V,H,W,E] over zero. Splats are drawn in the order of depths
    [V,N] where radii [V,N] are not 0; where `behind` is given, together with the splats of behind(v, touched tiles)."""

    @staticmethod
    def forward(
        ctx, means2d, conics, colors, opacities, extras, background, depths, radii, width: int, height: int,
        behind: Callable[[int, np.ndarray], View] | None,
    ):  # fmt: skip
        views, n = depths.shape
        channels = 0 if extras is None else extras.shape[-1]
        rgb, alpha = np.empty((views, height, width, 3), np.float32), np.empty((views, height, width, 1), np.float32)
        image = np.empty((views, height, width, channels), np.float32)
        ctx.lists = []
        (shade_behind,) = _arrays(background)
        for v in range(views):
            xy, conic, color, opacity, z = _arrays(means2d[v], conics[v], colors[v], opacities[v], depths[v])
            order = tiles.depth_order(z, radii[v].numpy())
            splats = xy, conic, opacity, color
            if behind is None:
                extra = np.empty((len(order), 0), np.float32) if extras is None else _arrays(extras[v])[0][order]
                packed, starts, entries, first_slots = tiles.tile_lists(order, *splats, width, height)
                spans = composite.spans(np.arange(len(starts) - 1), starts[1:], width, height)
                work = records.Work(packed, extra, spans, entries, width, height, shade_behind)
                state = records.State.empty(len(spans), 0)
                composite.forward(work, records.Images(rgb[v], alpha[v], image[v]), state)
                rounds = [(order, first_slots, work, state)]
            else:
                find = partial(behind, v)
                rounds = draw(find, order, z, radii[v].numpy(), splats, shade_behind, rgb[v], alpha[v])
            ctx.lists += [(v, *lists) for lists in rounds]
        ctx.shapes = n, channels
        alpha = torch.from_numpy(alpha)
        ctx.save_for_backward(alpha)
        return torch.from_numpy(rgb), alpha, torch.from_numpy(image)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_rgb: Tensor, g_alpha: Tensor, g_image: Tensor):
        (n, channels), (alpha,) = ctx.shapes, ctx.saved_tensors
        views = len(alpha)
        sizes = (views, n, 2), (views, n, 3), (views, n), (views, n, 3), (views, n, channels)
        grads = records.Gradients(*(np.zeros(size, np.float32) for size in sizes))
        g_background = np.zeros(3, np.float32) if ctx.needs_input_grad[5] else None
        cotangents = [records.Images(*_arrays(g_rgb[v], g_alpha[v], g_image[v])) for v in range(views)]
        for v, order, first_slots, work, state in ctx.lists:
            pairs = int(first_slots[-1])
            slots = records.Slots(np.empty((pairs, 9 + channels), np.float32), np.zeros(pairs, np.uint8))
            composite.backward(work, state, cotangents[v], slots)
            composite.gather(order, first_slots, slots, records.Gradients(*(grad[v] for grad in grads)))
        if g_background is not None:
            rows = np.empty((views, alpha.shape[1], 3), np.float32)
            for v in range(views):
                composite.background_rows(alpha[v].numpy(), cotangents[v].rgb, rows[v])
            g_background += rows.sum(axis=(0, 1))
        means2d, conics, opacities, colors, extras = (torch.from_numpy(grad) for grad in grads)
        g_background = None if g_background is None else torch.from_numpy(g_background)
        return means2d, conics, colors, opacities, extras if channels else None, g_background, *[None] * 5


BACKEND = Backend("cpu", rasterize, devices=("cpu",), dtypes=(torch.float32,), keeps_frozen=True)
