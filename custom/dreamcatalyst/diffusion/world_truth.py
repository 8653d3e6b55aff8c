"""The closed form around a truth in 3D: what a capture becomes by an edit, as each view would show it.

An image operator cannot make what was not there. This prior is asked about views of a capture whose edits are known in
3D (a synthetic scene), and x_0 given image and instruction lies around the render of the *edited* scene from the same
camera: all views agree, and an edit may add. It is the oracle for edits that grow; of photographs there is no such
truth, and the closed form or a network serves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import PriorError
from .closed_form import ClosedForm, SourceImage
from .operators import Instruction


@dataclass
class Source:
    """Where the truth comes from. image: number of a view to the edited scene there, in [0,1]."""

    image: Callable[[int], Float[Tensor, "H W 3"]] | None = None


class WorldTruth(ClosedForm):
    """x_0 | image, y ~ N(render of the edited scene, s^2); the rest as in ClosedForm. `truth.image` is set by the run
    that knows it, before the first view is asked about."""

    takes_truth = True

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.truth = Source()  # shared by the copies that `with_spread` makes

    def tell_truth(self, image: Callable[[int], Float[Tensor, "H W 3"]]) -> None:
        self.truth.image = image

    def with_spread(self, spread: float) -> WorldTruth:
        other = super().with_spread(spread)
        other.truth = self.truth
        return other

    def embed(self, prompts: Sequence[str]) -> list[Instruction | None]:
        """Any instruction: it asks for the edit whose truth was told. None, the identity, for an empty one."""
        return [_instruction(prompt) if prompt.strip() else None for prompt in prompts]

    @torch.no_grad()
    def condition_of(self, images: Float[Tensor, "B 3 H W"], view: int) -> SourceImage:
        if self.truth.image is None:
            raise PriorError(
                "world-truth: there is no edited scene to look at. This prior is for synthetic scenes whose edit is "
                "known: data.source=demo:statue; photographs need another one, such as prior_type=closed-form"
            )
        condition = SourceImage(self.encode(images))
        shown = self.truth.image(view).to(images).permute(2, 0, 1)[None]
        if shown.shape != images.shape:
            raise PriorError(f"world-truth: view {view} is {tuple(images.shape)}, its truth {tuple(shown.shape)}")
        condition.assume(self.encode(shown))
        return condition


@lru_cache(maxsize=64)
def _instruction(prompt: str) -> Instruction:
    return Instruction(prompt)
