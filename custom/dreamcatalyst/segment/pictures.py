"""Masks laid over renders, to be looked at."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..render.api import rasterize
from .api import Mask, MaskRequest

TINT = (1.0, 0.15, 0.1)  # of what may change


def overlay(image: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"], strength: float = 0.5) -> Float[Tensor, "H W 3"]:
    """`image` in [0,1], tinted red where `mask` in [0,1] is on and darkened by a third elsewhere."""
    weight = strength * mask[..., None].to(image)
    return image.clamp(0, 1) * (1 - weight) * (2 + mask[..., None].to(image)) / 3 + weight * image.new_tensor(TINT)


@torch.no_grad()
def rendered_mask(
    mask: Bool[Tensor, " N"] | Float[Tensor, " N"], request: MaskRequest, view: int
) -> Float[Tensor, "H W"]:
    """A mask of splats as one view sees it, in [0,1]."""
    seen = rasterize(
        request.scene,
        request.cameras[view],
        sh_degree=0,
        features=mask.to(request.scene.means)[:, None],
        antialiased=request.antialiased,
        backend=request.backend,
    )
    return seen.features[0, ..., 0]


def mask_panels(found: Mask, request: MaskRequest, view: int) -> list[tuple[str, Float[Tensor, "H W 3"]]]:
    """Labelled pictures of one view, for report/pictures.py: the source, the picture that the segmenter gave
    (where there is one of this view), and the splats that may change."""
    image = request.render(view)
    panels = [("source", image)]
    if view in found.images:
        panels.append(("2D mask", overlay(image, found.images[view])))
    return [*panels, ("splats in the mask", overlay(image, rendered_mask(found.mask, request, view)))]
