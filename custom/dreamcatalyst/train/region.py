"""Where an edit may take place: the mask of a run, its pictures, and what it means for the splats."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .. import plugin
from ..report.pictures import picture_row, write_png
from ..scene.gaussians import Gaussians
from ..scene.trainable import UPDATE
from ..segment.api import EXTRA, Mask, MaskConfig, MaskRequest, make_mask
from ..segment.pictures import mask_panels

PICTURES = 4  # views that show the mask


@dataclass(frozen=True)
class EditRegion:
    """What a masked edit begins with. scene: N splats; editable: bool [N]; is_source: whether it is the source, too,
    and not an edit of it."""

    scene: Gaussians
    editable: Tensor
    is_source: bool

    @cached_property
    def edited(self) -> Gaussians:
        """The editable splats as they were."""
        return self.scene[self.editable]

    @cached_property
    def share(self) -> Tensor:
        """[N,1]: 1 where a splat may change. Drawn as a feature, it says how much of a pixel may."""
        return self.editable[:, None].to(self.scene.means)


def restrict_to_mask(
    config: MaskConfig, request: MaskRequest, folder: Path, picture: Path
) -> tuple[Gaussians, dict[str, Tensor], Tensor | None]:
    """Find the mask of a scene. Returns the scene with the soft weights [N] as its extra "mask", the state of the
    editable splats, and which ones these are, bool [N]; None where all are, and the edit goes on as without a mask.

    folder: where masks are kept for other runs. picture: the PNG that shows the mask in a few views.
    """
    scene, result = request.scene, make_mask(config, request, folder)
    if result is None:  # of kind none
        return scene, {}, None
    count = int(result.mask.sum())
    whole = count == len(scene)
    plugin.info(f"mask: {count} of {len(scene)} splats may change{', as without a mask' if whole else ''}")
    write_mask_pictures(result, request, picture)
    state = {} if bool((result.update[result.mask] == 1).all()) else {UPDATE: result.update[result.mask]}
    scene = scene.with_extra(**{EXTRA: weights_to_keep(result, config.threshold)})
    return scene, state, None if whole else result.mask


def weights_to_keep(result: Mask, threshold: float) -> Tensor:
    """Soft weights [N] that give the same mask again at the same threshold, after grow and invert, too."""
    below = torch.nextafter(result.weights.new_tensor(threshold), result.weights.new_tensor(0.0))
    inside, outside = result.weights.clamp(min=threshold), result.weights.minimum(below)
    return torch.where(result.mask, inside, outside)


def write_mask_pictures(result: Mask, request: MaskRequest, path: Path) -> Path:
    """One row per view: source, the segmenter's picture of it, and the splats that may change."""
    shown = sorted(result.images) or list(request.views)
    shown = shown[:: max(1, len(shown) // PICTURES)][:PICTURES]
    return write_png(path, np.vstack([picture_row(mask_panels(result, request, view)) for view in shown]))


def dilate(share: Tensor, reach: float) -> Tensor:
    """share [B,H,W,1] to the largest value within `reach` (a fraction of the longer side) of each pixel."""
    return widened(share, round(reach * max(share.shape[1:3])))


def widened(share: Tensor, pixels: int) -> Tensor:
    """share [B,H,W,1] to the largest value at most so many pixels away along both axes."""
    grown = torch.nn.functional.max_pool2d(share.permute(0, 3, 1, 2), 2 * pixels + 1, stride=1, padding=pixels)
    return grown.permute(0, 2, 3, 1)
