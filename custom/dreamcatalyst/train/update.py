"""One update of the splats: from the terms of a loss to parameters that moved, or to an error and nothing that did."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import NumericalError
from ..loss.terms import gradient_shares, total, update_share
from ..render.api import Render
from ..report.clock import LOGGING, Clock
from ..scene.trainable import Splats
from .density import Density
from .finite import gradient_norms, require_finite, restore, snapshot


@dataclass(frozen=True)
class Updater:
    """What carries an update out.

    backward: from a scalar loss to gradients. optimizer: makes them zero (zero_grad) and takes a step, with what
    Lightning has around it. loss_scale: by which mixed precision multiplies the loss, None where there is none.
    after_step: what else moves splats in a step, after the optimizer has. density: looks at the gradients.
    """

    splats: Splats
    density: Density
    clock: Clock
    backward: Callable[[Tensor], None]
    optimizer: torch.optim.Optimizer
    after_step: Callable[[], None]
    loss_scale: float | None = None

    def __call__(
        self, terms: Mapping[str, Tensor], render: Render, rates: Mapping[str, float], shares: bool, anchored: bool
    ) -> dict[str, float]:
        """Move the splats. terms: of the loss, by name. render: whose screen gradients density control looks at.
        rates: learning rate by parameter. shares: whether to tell what each term contributes. anchored: whether
        after_step pulls towards anchors, which has no gradient and so is told apart. Returns the step's numbers.

        Raises NumericalError, and leaves the splats as they were.
        """
        splats, stage, parameters = self.splats, self.clock.stage, self.splats.parameters
        for group in splats.optimizer.param_groups:
            group["lr"] = rates[group["name"]]
        loss, numbers = total(terms), {}
        require_finite("render", colours=render.rgb)
        require_finite("loss", loss=loss)
        render.means2d.retain_grad()
        self.optimizer.zero_grad()
        if len(terms) > 1 and shares:
            with stage(LOGGING):
                numbers = {f"share_{name}": share for name, share in gradient_shares(terms, parameters).items()}
            render.means2d.grad = None  # what arrived there on the way is not the step's
        with stage("backward"), torch.autocast(loss.device.type, enabled=False):  # it is for what goes forward only
            self.backward(loss)
            norms = {} if self.loss_scale is not None else gradient_norms(parameters)
        self.density.observe(splats, render, self.loss_scale or 1.0)
        with stage("optimizer"):
            before = snapshot(parameters)
            with splats.scaled_update():
                self.optimizer.step()
                stepped = snapshot(parameters) if shares and anchored else None
                self.after_step()
                if stepped is not None:
                    numbers["share_anchor_step"] = update_share(before, stepped, list(parameters.values()))
            try:
                require_finite("optimizer", **parameters)
            except NumericalError:
                restore(parameters, before)
                raise
        return {"loss": float(loss.detach()), **numbers, **{f"norm_{name}": norm for name, norm in norms.items()}}
