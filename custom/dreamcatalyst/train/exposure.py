"""Photographs are not all exposed alike: an affine colour for each of those that splats are fitted to.

A render is seen through its photograph's own transform before it is compared, as in the later code of 3DGS. What all
transforms have in common is the splats' to say, so their mean is held to the identity; held-out views are scored with
that, since a transform fitted on them would have seen the answer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import SceneError

DECAY = 0.1  # fraction of the rate that is left at the end of a run (3DGS: 0.01 to 0.001)


class Exposures:
    """Transforms [3,4] of V photographs, (matrix | offset) of colours in [0,1]. Adam's moments rest while other views
    are drawn: where they run on, they carry a transform far between two visits.

    views: the index of each in the capture. rate: Adam's, at the start.
    """

    def __init__(self, views: Sequence[int], rate: float, device: torch.device):
        self.places = {view: place for place, view in enumerate(views)}
        self.rate = rate
        self.transforms: list[torch.Tensor] = [torch.nn.Parameter(torch.eye(3, 4, device=device)) for _ in views]
        self.optimizer = torch.optim.Adam(self.transforms, lr=rate, eps=1e-15)

    @property
    def colours(self) -> Float[Tensor, "V 3 4"]:
        """All transforms."""
        return torch.stack(self.transforms)

    def __call__(self, images: Float[Tensor, "B H W 3"], views: Sequence[int]) -> Float[Tensor, "B H W 3"]:
        """Renders [B,H,W,3] as the photographs of these views were exposed."""
        own = torch.stack([self.transforms[self.places[view]] for view in views]).to(images)
        return torch.einsum("bhwi,boi->bhwo", images, own[..., :3]) + own[:, None, None, :, 3]

    @torch.no_grad()
    def step(self, progress: float) -> None:
        """Update by the gradients of a step. progress: of the run, in [0,1]. A gradient that is not finite, where mixed
        precision overflowed, is left out, as the splats' is."""
        grads = [transform.grad for transform in self.transforms if transform.grad is not None]
        if all(bool(torch.isfinite(grad).all()) for grad in grads):
            self.optimizer.param_groups[0]["lr"] = self.rate * DECAY**progress
            self.optimizer.step()
        self.optimizer.zero_grad()
        common = self.colours.mean(0) - torch.eye(3, 4, device=self.transforms[0].device)
        for transform in self.transforms:
            transform -= common

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"colours": self.colours.detach(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """The inverse. Raises SceneError where they are of other photographs."""
        if len(saved["colours"]) != len(self.transforms):
            got, expected = len(saved["colours"]), len(self.transforms)
            raise SceneError(f"resume: the checkpoint has the exposures of {got} photographs, expected {expected}")
        with torch.no_grad():
            for transform, colours in zip(self.transforms, saved["colours"], strict=True):
                transform.copy_(colours)
        self.optimizer.load_state_dict(saved["optimizer"])
