"""A segmenter of one's own: the splats above a height."""

from dataclasses import dataclass

from dreamcatalyst.config import Number
from dreamcatalyst.segment.api import SEGMENTERS, Segmenter


@SEGMENTERS.add("above")
@dataclass(frozen=True)
class Above(Segmenter):
    height: Number = 0.0  # world units

    def __call__(self, request, views):
        means = request.scene.means
        return (means[:, 2] + request.origin[2] > self.height).to(means)
