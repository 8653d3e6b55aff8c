"""Where a rule comes to rest on the closed-form prior. Derivation: docs/closed-form.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..diffusion.closed_form import ClosedForm, noise_slope
from ..diffusion.noise import abar_at, signal_at
from ..errors import ConfigError
from .rules import EDIT_NULL, NOISE, Rule

WIDE = 10.0  # a spread far beyond that of images, which lie in [-1,1]


class MeanGradient(NamedTuple):
    """E[g] = stiffness (x - I) - pull (T(I) - R(I)) - drift (I - mu), over the noise; R(I) is what the reference makes
    of I: its own edit where dds and pds are given a source text, else I itself."""

    stiffness: float
    pull: float
    drift: float  # of sds only: nothing cancels mu


class FixedPoint(NamedTuple):
    """x* = I + rho (T(I) - R(I)) + drift (I - mu)."""

    rho: float
    drift: float


def mean_gradient(
    prior: ClosedForm, rule: Rule, timestep: int, guidance_scale: float, image_guidance_scale: float
) -> MeanGradient:
    """The coefficients of E[g] at one timestep."""
    abar = abar_at(prior.alphas_cumprod, timestep)
    a, b = rule.weights(timestep, prior.alphas_cumprod)
    k_s, k_i, k_n = (noise_slope(abar, spread) for spread in prior.spreads())
    edit, image = guidance_scale * k_s, (image_guidance_scale - guidance_scale) * k_i
    null = (1.0 - image_guidance_scale) * k_n
    if rule.reference == EDIT_NULL:  # both branches see x: what both contain cancels
        image, null = -guidance_scale * k_i, 0.0
    scale = a * abar**0.5
    drift = -null if rule.reference == NOISE else 0.0
    return MeanGradient(scale * (edit + image + null) + b, scale * edit, scale * drift)


def fixed_point(
    prior: ClosedForm, rule: Rule, timesteps: Sequence[int], guidance_scale: float, image_guidance_scale: float
) -> FixedPoint | None:
    """Where the gradient's mean over the noise and over `timesteps`, equally likely, vanishes; None where that is not
    stable (stiffness <= 0)."""
    parts = [mean_gradient(prior, rule, t, guidance_scale, image_guidance_scale) for t in timesteps]
    stiffness, pull, drift = map(sum, zip(*parts, strict=True))
    return FixedPoint(pull / stiffness, drift / stiffness) if stiffness > 0 else None


def contraction(
    prior: ClosedForm, rule: Rule, timestep: int, guidance_scale: float, image_guidance_scale: float
) -> float:
    """The factor by which one step of ddim.sample_rule multiplies the distance from the fixed point: it shrinks
    within -1..1 only."""
    abar = signal_at(prior.alphas_cumprod, timestep)
    a, _ = rule.weights(timestep, prior.alphas_cumprod)
    stiffness = mean_gradient(prior, rule, timestep, guidance_scale, image_guidance_scale).stiffness
    return 1.0 - ((1.0 - abar) / abar) ** 0.5 * stiffness / a


def check_sampler(
    prior: ClosedForm, rule: Rule, timesteps: Sequence[int], guidance_scale: float, image_guidance_scale: float
) -> None:
    """Raise ConfigError where the steps of ddim.sample_rule along `timesteps` lead away from the edit: where what
    is off at one of them comes out of the ones after it larger than it was."""
    worst, left = 0.0, 1.0
    for t in reversed(timesteps):
        left *= abs(contraction(prior, rule, t, guidance_scale, image_guidance_scale))
        worst = max(worst, left)
    if worst >= 1.0:
        raise ConfigError(
            f"system.guidance.guidance_scale: at {guidance_scale:g} and condition_scale {image_guidance_scale:g}, "
            f"{len(timesteps)} steps of the rule '{rule.name}' on the closed-form prior multiply an error by "
            f"{worst:.1e} and diverge. Set guidance_scale and condition_scale to 1 and prior.s_image to prior.s "
            f"({prior.config.s:g}), lower max_step_percent where that is not enough, or take rule in2n or known-edit"
        )


def balanced(
    prior: ClosedForm, rule: Rule, timesteps: Sequence[int], guidance_scale: float, image_guidance_scale: float
) -> ClosedForm:
    """The prior with s_image = s_null solved so that rho = 1 over `timesteps`; as it is where a spread is given.

    rho = 1 is sum_t a sqrt(abar) n k_v = sum_t b with n = w_y - 1, for csd-like, whose branches share all but the
    instruction, n = w_y. The left side falls as the spread v grows. A rule without identity term (b = 0) comes to T(I)
    only as v grows without limit, and gets WIDE; so does one whose scale leaves nothing to balance (w_y <= 1).
    Raises ConfigError where the identity term is too strong for any spread, and at a timestep without noise.
    """
    if _given(prior):
        return prior
    surplus = guidance_scale if rule.reference == EDIT_NULL else guidance_scale - 1.0
    abars = [abar_at(prior.alphas_cumprod, t) for t in timesteps]
    weights = [rule.weights(t, prior.alphas_cumprod) for t in timesteps]
    if max(abars) >= 1.0:
        raise ConfigError(
            f"system.guidance.prior.s_image: the run comes to rest at timestep {timesteps[abars.index(max(abars))]}, "
            "which is noiseless (abar = 1), and nothing can be balanced there. Raise min_step_percent, or give s_image."
        )

    def excess(spread: float) -> float:
        terms = zip(abars, weights, strict=True)
        return sum(a * abar**0.5 * surplus * noise_slope(abar, spread) - b for abar, (a, b) in terms)

    if surplus <= 0 or excess(WIDE) >= 0:
        return prior.with_spread(WIDE)
    if excess(0.0) <= 0:
        raise ConfigError(
            f"system.guidance.prior.s_image: no spread brings the rule '{rule.name}' to the edit at guidance_scale "
            f"{guidance_scale:g}: its identity weight is too strong. Give s_image a number, or raise guidance_scale."
        )
    low, high = 0.0, WIDE
    while low < (middle := 0.5 * (low + high)) < high:  # to the last bit
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return prior.with_spread(high)


def with_wide_spread(prior: ClosedForm) -> ClosedForm:
    """The prior with the spread of a rule without identity term, WIDE; as it is where a spread is given."""
    return prior if _given(prior) else prior.with_spread(WIDE)


def _given(prior: ClosedForm) -> bool:
    return prior.config.s_image is not None or prior.config.s_null is not None
