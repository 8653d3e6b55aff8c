"""Where an edit may take place: the mask of a run, its pictures, and what it means for scores."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from .. import plugin
from ..report.pictures import picture_row, write_png
from ..scene.edit import UPDATE
from ..scene.gaussians import Gaussians
from ..segment.api import EXTRA, Mask, MaskRequest, make_mask
from ..segment.pictures import mask_panels

if TYPE_CHECKING:
    from .edit import EditSystem


@dataclass(frozen=True)
class Start:
    """What a confined edit begins with. scene: N splats; editable: bool [N]; is_source: whether it is the source, too,
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


PICTURES = 4  # views that show the mask


def confine(system: EditSystem, scene: Gaussians) -> tuple[Gaussians, dict[str, Tensor], Tensor | None]:
    """Find the mask of `scene`. Returns the scene with the soft weights [N] as its extra "mask", the state of the
    editable splats, and which ones these are, bool [N]; None where all are, and the edit goes on as without a mask.
    Writes pictures of the mask beside the run's results."""
    request = mask_request(system, scene)
    folder = Path(system.get_save_dir()).parent.parent / "masks"  # of all runs of this name
    found = make_mask(system.part["mask"], request, folder)
    count = int(found.mask.sum())
    whole = count == len(scene)
    plugin.info(f"mask: {count} of {len(scene)} splats may change{', as without a mask' if whole else ''}")
    write_mask_pictures(system, found, request)
    state = {} if bool((found.update[found.mask] == 1).all()) else {UPDATE: found.update[found.mask]}
    kept = scene.with_extra(**{EXTRA: weights_to_keep(found, system.part["mask"].threshold)})
    return kept, state, None if whole else found.mask


def weights_to_keep(found: Mask, threshold: float) -> Tensor:
    """Soft weights [N] that give the same mask again at the same threshold, after grow and invert, too."""
    below = torch.nextafter(found.weights.new_tensor(threshold), found.weights.new_tensor(0.0))
    inside, outside = found.weights.clamp(min=threshold), found.weights.minimum(below)
    return torch.where(found.mask, inside, outside)


def mask_request(system: EditSystem, scene: Gaussians) -> MaskRequest:
    """What a segmenter may know of the run."""
    capture, renderer = system.data.open(scene, system.cfg.gs_source), system.part["renderer"]
    return MaskRequest(
        scene=scene,
        cameras=[capture.cameras([i]) for i in range(len(capture.views))],
        names=[view.name for view in capture.views],
        views=capture.train,
        extent=capture.extent,
        render=lambda index: system.source_render(index).clamp(0, 1),
        guidance=system.guidance,
        prompt=system.part["prompt_processor"].prompt,
        backend=renderer.backend,
        antialiased=renderer.antialiased,
        background=renderer.background,
        origin=system.origin,
    )


def write_mask_pictures(system: EditSystem, found: Mask, request: MaskRequest) -> Path:
    """One row per view: source, the segmenter's picture of it, and the splats that may change."""
    shown = sorted(found.images) or list(request.views)
    shown = shown[:: max(1, len(shown) // PICTURES)][:PICTURES]
    rows = [picture_row(mask_panels(found, request, view)) for view in shown]
    return write_png(system.save_path("mask.png"), np.vstack(rows))
