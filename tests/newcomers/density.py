"""A density strategy of one's own: it keeps a share of the splats, the most opaque ones."""

from dataclasses import dataclass
from typing import Annotated

import torch
from dreamcatalyst.config import Range
from dreamcatalyst.train.density import DENSITY, Density


@DENSITY.add("thin-out")
class ThinOut(Density):
    @dataclass(frozen=True)
    class Config:
        share: Annotated[float, Range("(0, 1]")] = 0.5  # of the splats that stay

    def densify(self, splats, moment):
        opacities = splats.edited.detach().opacities
        keep = opacities.argsort(descending=True, stable=True)[: max(1, round(self.options.share * len(splats)))]
        splats.rearrange(keep.sort().values, torch.zeros(0, dtype=torch.int64, device=keep.device), {})
