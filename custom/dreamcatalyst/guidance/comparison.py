"""Rules that deliver pictures at work: the mean absolute difference of a render from the picture that replaces it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion.api import Prior
from ..diffusion.combine import Branch, difference_rows
from ..errors import PriorError
from .distill import check_prior
from .edited_views import EditedViews
from .fixed_point import with_wide_spread
from .objective import Objective, Step
from .oracle import exact_edit
from .prompted import PromptedPrior
from .rules import Replacement


class Comparison(Objective):
    """Subclasses say which picture replaces a view's (`target`), and how one is made (`picture`)."""

    gives_pictures = True

    def __init__(self, prompted: PromptedPrior, rule: Replacement):
        check_prior(rule, prompted.prior)
        if rule.needs_exact and not prompted.prior.exact:
            raise PriorError(
                f"rule '{rule.name}' compares with an edit that is known, which {prompted.config.prior_type} does not "
                "know: use prior_type closed-form, or another rule"
            )
        self.prompted, self.rule = prompted, rule

    def balanced(self) -> Prior:
        return with_wide_spread(self.prompted.closed_form)

    @abstractmethod
    def target(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], view: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        """The picture in [0,1] that stands for `view` at `step`."""

    def step(
        self,
        rgb: Float[Tensor, "B H W 3"],
        sources: Float[Tensor, "B H W 3"],
        index: Sequence[int],
        step: int,
        max_steps: int,
        visits: Sequence[int] | None = None,
    ) -> Step:
        target = torch.stack([self.target(*each, step) for each in zip(rgb, sources, index, strict=True)])
        difference = rgb - target
        return Step(difference.abs().mean(), -1, difference.detach(), target)


class KnownEdit(Comparison):
    """The edit itself, where the prior knows it: what a method can reach at best."""

    def target(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], view: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        return exact_edit(self.prompted, source, view, self.prompted.text)

    def picture(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], index: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        return self.target(render, source, index, step)


class DatasetUpdate(Comparison):
    """Instruct-NeRF2NeRF: the pictures of the capture are, one by one, replaced by edits of the renders."""

    def __init__(self, prompted: PromptedPrior, rule: Replacement):
        super().__init__(prompted, rule)
        config = prompted.config
        self.edited = EditedViews(
            config.per_editing_step,
            config.edit_min_percent,
            config.edit_max_percent,
            config.seed,
            config.edit_begin_step,
            config.edit_until_step,
        )

    @property
    def picture_rows(self) -> int:
        at = self.prompted
        rows = difference_rows(
            Branch(torch.zeros(1, 1, 1, 1), at.text, object(), *at.scales), None, at.prior.takes_image
        )
        return len(rows) * at.config.diffusion_steps

    def target(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], view: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        if self.edited.due(view, step):
            with self.prompted.stage("unet"):
                self.edited.put(view, self.picture(render, source, view, step))
        return self.edited.get(view, like=render)

    @torch.no_grad()
    def picture(
        self, render: Float[Tensor, "H W 3"], source: Float[Tensor, "H W 3"], index: int, step: int
    ) -> Float[Tensor, "H W 3"]:
        """The prior's edit of a render, noised to a level that is drawn, and conditioned on the source render
        of the view; in [0,1]."""
        at = self.prompted
        latents = at.encode(render[None], [index], step)
        timestep = self.edited.timestep(index, step, len(at.prior.alphas_cumprod))
        noise = at.noise(latents, [index], step)
        return at.edit_image(source, index, latents, noise, timestep=timestep, steps=at.config.diffusion_steps)

    def state_dict(self) -> dict[str, Any]:
        return {"edits": self.edited.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.edited.load_state_dict(state["edits"])


KNOWN_EDIT = Replacement("known-edit", KnownEdit, "the edit itself, where the prior knows it", needs_exact=True)
IN2N = Replacement("in2n", DatasetUpdate, "Instruct-NeRF2NeRF, Haque et al. 2023", needs_image=True)
