"""The closed form around a truth in 3D: what a made world becomes, as each view would show it.

An image operator cannot make what was not there. This prior is asked about views of a made world, and x_0 given image
and instruction lies around the render of the *edited* world from the same camera: all views agree, and an edit may add.
It is the oracle for edits that grow; on a capture there is no such truth, and the closed form or a network serves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..demo.edits import EDITS, Edit, find_edit
from ..errors import PriorError, nearest
from .closed_form import ClosedForm, SourceImage


@dataclass
class Source:
    """Where the truth comes from. image: number of a view to the edited world there, [H,W,3] in [0,1]."""

    image: Callable[[int], Tensor] | None = None


class WorldTruth(ClosedForm):
    """x_0 | image, y ~ N(render of the edited world, s^2); the rest as in ClosedForm. `truth.image` is set by the run
    that has the world, before the first view is asked about."""

    takes_truth = True

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.truth = Source()  # shared by the copies that `with_spread` makes

    def with_spread(self, spread: float) -> WorldTruth:
        other = super().with_spread(spread)
        other.truth = self.truth
        return other

    def embed(self, prompts: Sequence[str]) -> list[Edit | None]:
        """The made world's edit that each instruction names; None for an empty one. Raises PriorError."""
        found = []
        for prompt in prompts:
            edit = find_edit(prompt) if prompt.strip() else None
            if edit is None and prompt.strip():
                known = [each.phrases[0] for each in EDITS.values() if each.phrases[0]]
                raise PriorError(
                    f"world-truth: no edit of made worlds is called '{prompt}'.{nearest(prompt, known)} "
                    f"Known, in several wordings: {', '.join(known)}."
                )
            found.append(edit)
        return found

    @torch.no_grad()
    def condition_of(self, images: Tensor, view: int) -> SourceImage:
        if self.truth.image is None:
            raise PriorError(
                "world-truth: there is no edited world to look at. This prior is for made worlds whose edit is known: "
                "data.source=demo:statue; photographs need another one, such as prior_type=closed-form"
            )
        made = SourceImage(self.encode(images))
        shown = self.truth.image(view).to(images).permute(2, 0, 1)[None]
        if shown.shape != images.shape:
            raise PriorError(f"world-truth: view {view} is {tuple(images.shape)}, its truth {tuple(shown.shape)}")
        made.assume(self.encode(shown))
        return made
