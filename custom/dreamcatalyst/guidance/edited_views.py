"""Dataset update: the pictures that a scene is fitted to are, one by one, replaced by the prior's edits of its renders.

Source: Instruct-NeRF2NeRF, Haque et al. 2023, section 4.2; which steps edit: GaussianEditor, Chen et al. 2024.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..diffusion.noise import keyed_generator


class EditedViews:
    """The edited picture of every view that was visited so far, in 8 bits, like the photographs that it stands in for.

    every: a view is edited at its first visit, and again where it is visited at a step that is a multiple of `every`
    (0: never again), after step `begin` and before step `until` (None: to the end). lowest, highest: limits of the
    noise level of an edit, fractions of the prior's T.
    """

    def __init__(
        self, every: int, lowest: float, highest: float, seed: int = 0, begin: int = 0, until: int | None = None
    ):
        self.every, self.limits, self.seed = every, (lowest, highest), seed
        self.begin, self.until = begin, until
        self._images: dict[int, UInt8[Tensor, "H W 3"]] = {}

    def due(self, view: int, step: int) -> bool:
        """Whether the visit of `view` at `step` makes a new edit."""
        again = self.every > 0 and step % self.every == 0
        return view not in self._images or (again and self.begin < step and (self.until is None or step < self.until))

    def timestep(self, view: int, step: int, train_steps: int) -> int:
        """The noise level of that edit, even between the limits, a pure function of (seed, step, view)."""
        low, high = (int(limit * train_steps) for limit in self.limits)
        generator = keyed_generator(self.seed, "edit", step, view)
        return int(torch.randint(low, high + 1, (1,), generator=generator))

    def put(self, view: int, image: Float[Tensor, "H W 3"]) -> None:
        """Keep image in [0,1] as the picture of `view`."""
        self._images[view] = (image.detach() * 255).round().to("cpu", torch.uint8)

    def get(self, view: int, like: Float[Tensor, ...]) -> Float[Tensor, "H W 3"]:
        """The picture of `view` in [0,1], where and in the precision that `like` is."""
        return self._images[view].to(like) / 255

    def state_dict(self) -> dict[str, Any]:
        """All pictures, so that a resumed run goes on from the ones that it had."""
        return {"images": dict(self._images)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up the pictures of `state_dict`."""
        self._images = dict(state["images"])
