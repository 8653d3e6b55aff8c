"""Where each rule comes to rest, as docs/closed-form.md derives it, against the rules themselves in float64."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm, ClosedFormConfig
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.guidance.distill import distillation_gradient
from dreamcatalyst.guidance.fixed_point import balanced, contraction, fixed_point, mean_gradient
from dreamcatalyst.guidance.rules import get_rule, gradient_rules
from dreamcatalyst.guidance.timesteps import Schedule

GRADIENT_RULES = gradient_rules()
SCALES = [(7.5, 1.5), (3.0, 1.0), (1.0, 1.0), (5.0, 2.5)]
every_rule = pytest.mark.parametrize("name", GRADIENT_RULES)
every_scale = pytest.mark.parametrize("scales", SCALES)


def gradient(world, name, x, t, scales, noise, **options):
    return distillation_gradient(
        options.pop("prior", world.prior),
        get_rule(name),
        x,
        world.source,
        image=world.condition,
        text=world.text,
        timestep=t,
        noise=noise,
        guidance_scale=scales[0],
        image_guidance_scale=scales[1],
        **options,
    )


def mean(world, name, x, t, scales, **options):
    """E[g]: g is affine in the noise, so that two opposite draws average to the mean exactly."""
    halves = [gradient(world, name, x, t, scales, sign * world.noise, **options) for sign in (1, -1)]
    return 0.5 * (halves[0] + halves[1])


@every_rule
@every_scale
@pytest.mark.parametrize("t", [51, 201, 501, 901])
def test_mean_gradient_is_as_derived(world, name, scales, t):
    stiffness, pull, drift = mean_gradient(world.prior, get_rule(name), t, *scales)
    derived = stiffness * (world.x - world.source) - pull * (world.edited - world.source) - drift * (world.source - 0.2)
    assert torch.allclose(mean(world, name, world.x, t, scales), derived, rtol=0, atol=1e-10)


@every_rule
@every_scale
def test_the_mean_gradient_vanishes_at_the_fixed_point(world, name, scales):
    timesteps = [101, 201, 501, 901]
    at = fixed_point(world.prior, get_rule(name), timesteps, *scales)
    if at is None:  # not stable: the gradient drives away from wherever it vanishes
        assert sum(mean_gradient(world.prior, get_rule(name), t, *scales).stiffness for t in timesteps) <= 0
        return
    x = world.source + at.rho * (world.edited - world.source) + at.drift * (world.source - 0.2)
    assert sum(mean(world, name, x, t, scales) for t in timesteps).abs().max() < 1e-10
    further = x + 0.01  # and the gradient brings back what is moved away
    assert (sum(mean(world, name, further, t, scales) for t in timesteps) * 0.01).min() > 0


@pytest.mark.parametrize("name", ["dds", "pds"])
def test_with_a_source_text_the_difference_of_the_two_edits_is_added(world, name):
    rho = fixed_point(world.prior, get_rule(name), [301], 7.5, 1.5).rho
    x = world.source + rho * (world.edited - world.other_edited)
    assert mean(world, name, x, 301, (7.5, 1.5), source_text=world.other).abs().max() < 1e-10


def test_the_published_form_of_rho(world):
    """rho = a A w_y k_s / (a A [w_y k_s + (w_I - w_y) k_I + (1 - w_I) k_S] + b), written out at one timestep."""
    abar = world.prior.alphas_cumprod[201].item()
    k_s, k_i, k_n = ((1 - abar) ** 0.5 / (abar * v**2 + 1 - abar) for v in (0.05, 0.4, 0.9))
    a, b = get_rule("dreamcatalyst").weights(201, world.prior.alphas_cumprod)
    signal = a * abar**0.5
    expected = signal * 7.5 * k_s / (signal * (7.5 * k_s - 6.0 * k_i - 0.5 * k_n) + b)
    at = fixed_point(world.prior, get_rule("dreamcatalyst"), [201], 7.5, 1.5)
    assert at.rho == pytest.approx(expected, rel=1e-12) and at.drift == 0.0


@pytest.mark.parametrize("name", [n for n in GRADIENT_RULES if n != "sds"])
def test_the_gradient_is_free_of_noise_only_at_equal_spreads(world, name):
    def spread_of_noise(prior):
        draws = [gradient(world, name, world.x, 501, (7.5, 1.5), n * world.noise, prior=prior) for n in (-1.0, 2.0)]
        return (draws[0] - draws[1]).abs().max().item()

    assert spread_of_noise(ClosedForm(ClosedFormConfig(s=0.3, s_image=0.3, s_null=0.9))) < 1e-12
    assert spread_of_noise(ClosedForm(ClosedFormConfig(s=0.3, s_image=0.4, s_null=0.9))) > 1e-3


@pytest.mark.parametrize("name", ["dds", "pds"])
def test_a_source_text_makes_the_gradient_free_of_noise(world, name):
    draws = [gradient(world, name, world.x, 501, (7.5, 1.5), n * world.noise, source_text=world.other) for n in (-1, 2)]
    assert torch.allclose(*draws, rtol=0, atol=1e-11)


def test_sds_is_never_free_of_noise(world):
    prior = ClosedForm(ClosedFormConfig(s=0.3, s_image=0.3, s_null=0.3))
    draws = [gradient(world, "sds", world.x, 501, (7.5, 1.5), n * world.noise, prior=prior) for n in (-1, 2)]
    assert (draws[0] - draws[1]).abs().max() > 1e-2


def test_rules_without_a_stable_fixed_point(world):
    """csd-like: its stiffness a A w_y (k_s - k_I) + b falls below zero where the image spread is the smaller one.
    The others: where the image row is guided against, and is the steeper one."""
    narrow = ClosedForm(ClosedFormConfig(s=0.4, s_image=0.05))
    assert fixed_point(narrow, get_rule("csd-like"), [201], 7.5, 1.5) is None
    for name in ("sds", "dds", "pds", "dreamcatalyst"):
        assert fixed_point(narrow, get_rule(name), [201], 7.5, 1.5) is None
        assert fixed_point(narrow, get_rule(name), [201], 1.0, 1.0) is not None
    level = ClosedForm(ClosedFormConfig(s=0.3, s_image=0.3))
    at = fixed_point(level, get_rule("csd-like"), [201], 7.5, 1.5)
    a, b = get_rule("csd-like").weights(201, level.alphas_cumprod)
    assert at.rho == pytest.approx(mean_gradient(level, get_rule("csd-like"), 201, 7.5, 1.5).pull / b, rel=1e-12)
    assert at.rho > 20  # nothing holds it but the identity term: far past the edit


# --- the spread that makes rho one


def test_the_papers_coefficients_give_508():
    prior = balanced(ClosedForm(), get_rule("dreamcatalyst"), [201], 7.5, 1.5)
    s, s_image, s_null = prior.spreads()
    assert s == 0.05 and s_image == s_null == pytest.approx(5.08, abs=0.005)
    assert fixed_point(prior, get_rule("dreamcatalyst"), [201], 7.5, 1.5).rho == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", ["pds", "dreamcatalyst", "dreamcatalyst-psi2", "dreamcatalyst-psi3", "csd-like"])
@pytest.mark.parametrize("scales", [(7.5, 1.5), (3.0, 1.0), (12.0, 0.5)])
def test_rho_is_one_over_what_a_run_rests_under(name, scales):
    rule = get_rule(name)
    prior = ClosedForm()
    timesteps = Schedule(rule.timesteps).rest(prior.alphas_cumprod)
    prior = balanced(prior, rule, timesteps, *scales)
    assert fixed_point(prior, rule, timesteps, *scales).rho == pytest.approx(1.0, abs=1e-12)


def test_one_timestep_has_the_spread_in_closed_form():
    """k_v = b / (a A (w_y - 1)) solved for v: neither s nor w_I matters."""
    prior, rule = ClosedForm(), get_rule("dreamcatalyst")
    for t in (201, 401):
        abar = prior.alphas_cumprod[t].item()
        a, b = rule.weights(t, prior.alphas_cumprod)
        slope = b / (a * abar**0.5 * 6.5)
        spread = (((1 - abar) ** 0.5 / slope - (1 - abar)) / abar) ** 0.5
        for s, w_i in ((0.05, 1.5), (0.2, 0.7)):
            solved = balanced(ClosedForm(ClosedFormConfig(s=s)), rule, [t], 7.5, w_i)
            assert solved.spreads()[1] == pytest.approx(spread, rel=1e-12)


@pytest.mark.parametrize("name", ["dds", "sds"])
def test_without_identity_term_rho_comes_near_one(name):
    prior, rule = ClosedForm(), get_rule(name)
    timesteps = Schedule(rule.timesteps).rest(prior.alphas_cumprod)
    prior = balanced(prior, rule, timesteps, 7.5, 1.5)
    at = fixed_point(prior, rule, timesteps, 7.5, 1.5)
    assert 1.0 < at.rho < 1.06 and abs(at.drift) < 0.01


def test_given_spreads_are_kept_and_impossible_ones_refused():
    given = ClosedForm(ClosedFormConfig(s_image=0.3))
    assert balanced(given, get_rule("dreamcatalyst"), [201], 7.5, 1.5) is given
    with pytest.raises(ConfigError, match="s_image"):
        balanced(ClosedForm(), get_rule("dreamcatalyst", chi=100.0), [201], 7.5, 1.5)


def test_at_a_balanced_spread_the_sampler_overshoots_by_the_text_scale():
    """rho = 1 means stiffness = a A w_y k_s, so that a step leaves 1 - w_y sqrt(1-abar) k_s of the error."""
    rule = get_rule("dreamcatalyst")
    for w_y in (1.2, 1.9, 7.5):
        prior = balanced(ClosedForm(), rule, [201], w_y, 1.5)
        abar = prior.alphas_cumprod[201].item()
        left = 1 - w_y * (1 - abar) / (abar * 0.05**2 + 1 - abar)
        assert contraction(prior, rule, 201, w_y, 1.5) == pytest.approx(left, abs=1e-10)
        assert (abs(left) < 1) == (w_y < 2)
