"""A look before a run: what the prior itself makes of one view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ..config import Count, DdimSteps, Number
from ..guidance.guidance import Guidance
from ..report.pictures import picture_row


@dataclass(frozen=True)
class PreviewConfig:
    """The grid that --preview draws: a row for each prompt, a column for each guidance scale."""

    view: Count | None = None  # number of the view; null: the first one held out
    prompts: tuple[str, ...] = ()  # empty: the run's own prompt
    guidance_scales: tuple[Number, ...] = ()  # empty: the run's own scale
    diffusion_steps: DdimSteps = 20


def preview_sheet(guidance: Guidance, source: Tensor, index: int, config: PreviewConfig) -> np.ndarray:
    """The source render [H,W,3] of view `index`, and the prior's own edits of it, as one picture, uint8."""
    scales = config.guidance_scales or (guidance.config.guidance_scale,)
    prompts = config.prompts or (guidance.prompt,)
    rows = []
    for prompt in prompts:
        panels = [("source", source)]
        for scale in scales:
            edit = guidance.sample(source, index, prompt, scale, config.diffusion_steps)
            panels.append((prompt if len(scales) == 1 else f"{prompt} ({scale:g})", edit))
        rows.append(picture_row(panels))
    return np.vstack(rows)
