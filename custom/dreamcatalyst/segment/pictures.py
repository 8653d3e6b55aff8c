"""Masks laid over renders, to be looked at."""

from __future__ import annotations

import torch
from torch import Tensor

from ..render.api import rasterize
from .api import Mask, MaskRequest

TINT = (1.0, 0.15, 0.1)  # of what may change


def overlay(image: Tensor, mask: Tensor, strength: float = 0.5) -> Tensor:
    """`image` [H,W,3] in [0,1], tinted red where `mask` [H,W] in [0,1] is on and darkened by a third elsewhere."""
    weight = strength * mask[..., None].to(image)
    return image.clamp(0, 1) * (1 - weight) * (2 + mask[..., None].to(image)) / 3 + weight * image.new_tensor(TINT)


@torch.no_grad()
def rendered_mask(mask: Tensor, request: MaskRequest, view: int) -> Tensor:
    """A mask of splats [N] as one view sees it, [H,W] in [0,1]."""
    seen = rasterize(
        request.scene,
        request.cameras[view],
        sh_degree=0,
        features=mask.to(request.scene.means)[:, None],
        antialiased=request.antialiased,
        backend=request.backend,
    )
    return seen.features[0, ..., 0]


def mask_panels(found: Mask, request: MaskRequest, view: int) -> list[tuple[str, Tensor]]:
    """Labelled pictures [H,W,3] of one view, for report/pictures.py: the source, the picture that the segmenter gave
    (where there is one of this view), and the splats that may change."""
    image = request.render(view)
    panels = [("source", image)]
    if view in found.images:
        panels.append(("2D mask", overlay(image, found.images[view])))
    return [*panels, ("splats in the mask", overlay(image, rendered_mask(found.mask, request, view)))]
