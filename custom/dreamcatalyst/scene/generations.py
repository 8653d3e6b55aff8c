"""Hierarchical splats: generations, how strongly each is held, and what it is held to.

Source: GaussianEditor (Chen et al. 2024), section 4.2. Splats that were there from the beginning are generation 0;
those that one densification adds are a generation of their own. Old generations are held ever tighter, so that coarse
shape settles while the newest splats are still free to make detail.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from ..errors import SceneError, choose
from .gaussians import PARAMETERS
from .trainable import Splats

ANCHORS = ("last-densify", "source")
GENERATION = "generation"  # the per-splat state, int64


class Generations:
    """How many generations there are and the weight of each, with anchors as per-splat state of the splats.

    weights: one number >= 0 per generation, the first one `first`. A generation is born with weight 0; the next
    densification gives it `init`, each one after that multiplies it by `multiplier`, up to `cap`. Generation 0 starts
    at `first` and is multiplied from the first densification on.
    anchor: "last-densify" (what every splat was after the last densification: as published, a bound on how fast it
    moves, not on how far) or "source" (what it was when the run began; for a later splat, when it was born).
    anchored: the raw parameters that have an anchor, kept as the state "anchor_<parameter>".
    """

    def __init__(
        self,
        first: float,
        init: float,
        multiplier: float,
        cap: float,
        *,
        anchor: str = "last-densify",
        anchored: Iterable[str] = PARAMETERS,
    ) -> None:
        self.weights = [float(first)]
        self.init, self.multiplier, self.cap = float(init), float(multiplier), float(cap)
        self.anchor = choose("anchor", anchor, ANCHORS)
        self.anchored = tuple(anchored)

    def __len__(self) -> int:
        """Number of generations so far."""
        return len(self.weights)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the per-splat states that splats with these generations have."""
        return (GENERATION, *map(anchor_of, self.anchored))

    def begin(self, splats: Splats) -> None:
        """Make every (editable) splat generation 0, anchored where it is."""
        splats.state[GENERATION] = torch.zeros(len(splats), dtype=torch.int64, device=splats.parameters["means"].device)
        self._anchor_here(splats)

    def newborn(
        self, splats: Splats, parents: Int[Tensor, " M"], changed: Mapping[str, Shaped[Tensor, "M ..."]]
    ) -> dict[str, Shaped[Tensor, "M ..."]]:
        """What `Splats.rearrange` needs to know of children besides `changed`: their generation, and that each is
        anchored to its own parameters at birth, not to its parent's anchor. parents [M]: rows."""
        born = {
            anchor_of(name): changed[name] if name in changed else splats.parameters[name].detach()[parents]
            for name in self.anchored
        }
        return {GENERATION: torch.full_like(parents, len(self)), **born}

    def advance(self, splats: Splats) -> None:
        """One densification has happened, whether it added splats or not: anchors first, then weights move on."""
        if self.anchor == "last-densify":
            self._anchor_here(splats)
        newest = len(self.weights) - 1
        self.weights = [min(self.multiplier * weight, self.cap) for weight in self.weights]
        if newest > 0:
            self.weights[newest] = self.init
        self.weights.append(0.0)

    def weight_of(self, splats: Splats) -> Float[Tensor, " E"]:
        """The weight of each splat's generation, [E]."""
        return splats.parameters["means"].new_tensor(self.weights)[splats.state[GENERATION]]

    def _anchor_here(self, splats: Splats) -> None:
        for name in self.anchored:
            splats.state[anchor_of(name)] = splats.parameters[name].detach().clone()

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint; generation and anchors of each splat are saved with the splats."""
        return {"weights": list(self.weights)}

    def load_state_dict(self, saved: Mapping[str, Any], splats: Splats) -> None:
        """The inverse of `state_dict`, for splats that were restored. Raises SceneError where these lack a state."""
        missing = [name for name in self.states if name not in splats.state]
        if missing:
            raise SceneError(
                f"resume: the checkpoint lacks the per-splat state {', '.join(missing)}; "
                "were anchors turned on after it was made? Resume with the anchors that it was made with"
            )
        self.weights = [float(weight) for weight in saved["weights"]]


def anchor_of(parameter: str) -> str:
    """The name of the state that holds the anchor of a raw parameter."""
    return f"anchor_{parameter}"
