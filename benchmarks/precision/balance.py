"""The guidance scales at which every rule comes to rest at the known edit, on one and the same exact prior.

On the closed-form prior the fixed point is known (docs/closed-form.md). With s_image = s_null = v the condition
rho = 1 is sum_t a sqrt(abar) n k_v = sum_t b, n = w_y - 1 (csd-like: n = w_y); so v is solved once, for the paper's
rule at the paper's scales, and each other rule's w_y follows. All of them then want the same picture, and what is left
to compare is how fast they come to it.
"""

from __future__ import annotations

from dreamcatalyst.diffusion.closed_form import ClosedForm, noise_slope
from dreamcatalyst.diffusion.noise import abar_at
from dreamcatalyst.guidance.config import GuidanceConfig, chosen_rule, chosen_schedule
from dreamcatalyst.guidance.fixed_point import balanced
from dreamcatalyst.guidance.rules import EDIT_NULL, Rule

PAPER = 7.5, 1.5  # w_y, w_I


def common_prior(reference: GuidanceConfig) -> ClosedForm:
    """The prior whose spreads let the rule of `reference` rest at the edit at the paper's scales."""
    prior, rule = ClosedForm(), chosen_rule(reference)
    return balanced(prior, rule, chosen_schedule(reference, rule).rest(prior.alphas_cumprod), *PAPER)


def balanced_scale(prior: ClosedForm, config: GuidanceConfig) -> float:
    """w_y at which the rule of `config` rests at the edit on `prior` (whose s_image equals its s_null); for rules that
    compare pictures 1, at which the prior's own samples are those of the edit."""
    rule = chosen_rule(config)
    if not isinstance(rule, Rule):
        return 1.0
    pull = identity = 0.0
    for t in chosen_schedule(config, rule).rest(prior.alphas_cumprod):
        a, b = rule.weights(t, prior.alphas_cumprod)
        abar = abar_at(prior.alphas_cumprod, t)
        pull += a * abar**0.5 * noise_slope(abar, prior.spreads()[1])
        identity += b
    return identity / pull + (0.0 if rule.reference == EDIT_NULL else 1.0)
