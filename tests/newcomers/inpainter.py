"""An inpainter of one's own: one colour."""

from dataclasses import dataclass

import torch
from dreamcatalyst.config import Colour
from dreamcatalyst.inpaint.api import INPAINTERS, Inpainter


@INPAINTERS.add("plain")
@dataclass(frozen=True)
class Plain(Inpainter):
    colour: Colour = (1.0, 0.0, 0.0)  # RGB

    def fill(self, image, hole, loaded=None):
        return torch.zeros_like(image) + image.new_tensor(self.colour)
