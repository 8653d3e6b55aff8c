"""The pull of splats towards their anchors, by generation and by group of parameters.

Source: GaussianEditor (Chen et al. 2024), section 4.2; groups and weights as in its published code, defaults as
DreamCatalyst's published 3DGS scripts run it. The proximal form is ours: the same pull as a decoupled step (as weight
decay is decoupled in AdamW, Loshchilov & Hutter 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import NonNegative
from ..errors import ConfigError, choose
from ..scene.generations import ANCHORS, Generations, anchor_of
from ..scene.trainable import Splats

GROUPS = {  # lambda of the config -> raw parameters that it weighs
    "color": ("sh0", "shN"),
    "geo": ("means", "quats"),
    "opacity": ("logit_opacities",),
    "scale": ("log_scales",),
}
FORMS = ("loss", "proximal")


@dataclass(frozen=True)
class AnchorConfig:
    """What splats are held to and how strongly. A splat's weight on a parameter is W[its generation] * lambda."""

    kind: str = "none"  # none | last-densify (as published: slows splats down) | source (ties them to the source scene)
    form: str = "proximal"  # a step of its own after the optimizer's; loss: as published
    weight_init_g0: NonNegative = 0.05  # W of the splats that the run begins with
    weight_init: NonNegative = 0.1  # W of a later generation, from its second densification on; before it is 0
    weight_multiplier: NonNegative = 1.3  # on every W, at each densification
    max_weight: NonNegative = 10.0  # no W grows beyond it
    lambda_color: NonNegative = 0.0  # SH coefficients: what an edit is mostly about (published: 5)
    lambda_geo: NonNegative = 5.0  # means (world units) and quaternions
    lambda_opacity: NonNegative = 5.0  # logits
    lambda_scale: NonNegative = 5.0  # logarithms
    proximal_rate: NonNegative = 0.2  # c: the share of its offset that a splat of weight 1 gives up in each step

    def __post_init__(self) -> None:
        choose("anchor", self.kind, ("none", *ANCHORS), "kind")
        choose("form of the anchor", self.form, FORMS, "form")
        for name in ("weight_init_g0", "weight_init"):
            value = getattr(self, name)
            if value > self.max_weight:
                raise ConfigError(f"{name}: got {value}, expected max_weight ({self.max_weight}) or less.")

    @property
    def lambdas(self) -> dict[str, float]:
        """The lambda of each raw parameter that can ever weigh anything, by its name in the scene."""
        if self.kind == "none" or self.weight_init_g0 == self.weight_init == 0:
            return {}
        every = {name: getattr(self, f"lambda_{group}") for group, names in GROUPS.items() for name in names}
        return {name: value for name, value in every.items() if value > 0}

    def generations(self) -> Generations | None:
        """The generations that this asks for, with anchors of no more parameters than weigh; None where none does."""
        if not self.lambdas:
            return None
        return Generations(
            self.weight_init_g0,
            self.weight_init,
            self.weight_multiplier,
            self.max_weight,
            anchor=self.kind,
            anchored=self.lambdas,
        )


def _weights(splats: Splats, generations: Generations | None) -> Float[Tensor, " E"] | None:
    """The weight of each splat [E], None where none weighs anything (or there is none)."""
    if generations is None or not any(generations.weights):
        return None
    weights = generations.weight_of(splats)
    return weights if bool(weights.any()) else None


def anchor_loss(splats: Splats, generations: Generations | None, config: AnchorConfig) -> Float[Tensor, ""]:
    """The pull as a loss: the sum over raw parameters a of lambda_a * mean(W[generation] * (a - anchor_a)^2), the means
    over editable splats and the parameter's channels. A scalar; differentiable in the splats' parameters.

    Zero, and without a graph, where nothing weighs: no generations, all weights 0, no editable splats, another form.
    A parameter without channels (shN of degree 0) adds nothing.
    """
    total = splats.parameters["means"].new_zeros(())
    weights = _weights(splats, generations) if config.form == "loss" else None
    if weights is None:
        return total
    for name, strength in config.lambdas.items():
        value = splats.parameters[name]
        if value.numel():
            offset = (value - splats.state[anchor_of(name)]).reshape(len(splats), -1)
            total = total + strength * (weights[:, None] * offset.square()).mean()
    return total


@torch.no_grad()
def anchor_step(splats: Splats, generations: Generations | None, config: AnchorConfig) -> None:
    """The pull as a step of its own, to be taken after the optimizer's (and inside `Splats.scaled_update` with it):

        a <- (a + c w anchor_a) / (1 + c w),    w = W[generation] * lambda_a,    c = proximal_rate

    the minimum over a' of |a' - a|^2 + c w |a' - anchor_a|^2. c is a rate per step and per unit of weight: left alone,
    an offset halves in ln 2 / ln(1 + c w) steps, however many splats there are and however large the loss is. Adam
    moves a parameter by about its learning rate at most, so that offsets stay within about learning rate / (c w).
    Adam's moments know nothing of it. Does nothing where nothing weighs, or where the form is another.
    """
    weights = _weights(splats, generations) if config.form == "proximal" else None
    if weights is None:
        return
    for name, strength in config.lambdas.items():
        value = splats.parameters[name]
        pull = (config.proximal_rate * strength * weights).reshape(-1, *[1] * (value.ndim - 1))
        value.lerp_(splats.state[anchor_of(name)], pull / (1 + pull))
