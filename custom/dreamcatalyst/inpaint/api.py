"""Pictures with holes, filled: one call, whatever fills them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..config import parse
from ..errors import choose
from ..registry import Registry

INPAINTERS = Registry("inpainter", __package__)
INPAINTERS.add("telea", ".opencv:Telea")
INPAINTERS.add("navier-stokes", ".opencv:NavierStokes")
INPAINTERS.add("shiftmap", ".opencv:ShiftMap")
INPAINTERS.add("fsr", ".opencv:Fsr")
INPAINTERS.add("stable-diffusion", ".stable_diffusion:StableDiffusionInpainting")


class Inpainter(ABC):
    """One way to fill holes: a frozen dataclass whose fields are its options.

    `load` is called once, before a scene is read, and says what is wrong with files that are missing. `fill` is called
    for picture after picture.
    """

    def load(self, device: torch.device) -> Any:
        """What `fill` needs beside the picture, such as a model on `device`; None where there is nothing to load."""
        return None

    @abstractmethod
    def fill(
        self, image: Float[Tensor, "H W 3"], hole: Bool[Tensor, "H W"], loaded: Any = None
    ) -> Float[Tensor, "H W 3"]:
        """image in [0,1], whose pixels inside of `hole` say nothing; a picture of the same size, in [0,1]. What it has
        outside of the hole is not used. loaded: what `load` gave."""


@dataclass(frozen=True)
class InpaintConfig:
    """What fills the holes of single views."""

    kind: str = "telea"  # telea | navier-stokes | shiftmap | fsr (OpenCV's) | stable-diffusion
    options: dict = field(default_factory=dict)  # the kind's own: the fields of its class in inpaint/

    def __post_init__(self) -> None:
        choose("inpainter", self.kind, INPAINTERS.names(), "kind")

    def inpainter(self) -> Inpainter:
        """The kind with its options. Raises ConfigError for options that cannot be."""
        return parse(INPAINTERS.get(self.kind), self.options, "system.inpaint.options")


def inpaint(
    inpainter: Inpainter, loaded: Any, image: Float[Tensor, "H W 3"], hole: Bool[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """`image` in [0,1] with the hole filled, and every other pixel as it was, to the bit. A picture that is all hole
    has nothing to be filled from, and one without a hole needs nothing: both come back as they are."""
    if bool(hole.all()) or not bool(hole.any()):
        return image
    filled = inpainter.fill(image.clamp(0, 1), hole, loaded).to(image)
    return torch.where(hole[..., None], filled.clamp(0, 1), image)
