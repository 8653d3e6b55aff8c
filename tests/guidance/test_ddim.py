"""Images instead of gradients: DDIM from the right noise level, and DreamCatalyst's equations 13 to 15."""

from __future__ import annotations

import math

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm, ClosedFormConfig
from dreamcatalyst.diffusion.combine import Branch, predict_difference
from dreamcatalyst.diffusion.noise import add_noise, keyed_noise
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.guidance.ddim import ddim_timesteps, edit_image, sample_rule
from dreamcatalyst.guidance.fixed_point import contraction, fixed_point
from dreamcatalyst.guidance.rules import get_rule


class Recording(ClosedForm):
    def __init__(self, prior):
        super().__init__(prior.config)
        self.asked = []

    def predict_noise(self, rows, timestep):
        self.asked.append((timestep, rows[0].noisy, len(rows)))
        return super().predict_noise(rows, timestep)


# --- DDIM


@pytest.mark.parametrize("first", [20, 199, 501, 980, 999])
@pytest.mark.parametrize("steps", [1, 7, 20])
def test_steps_begin_where_the_noise_is(first, steps):
    timesteps = ddim_timesteps(first, steps)
    assert timesteps[0] == first and len(timesteps) == steps and timesteps[-1] > 0
    gaps = [a - b for a, b in zip(timesteps, timesteps[1:], strict=False)]
    assert all(gap >= 1 for gap in gaps) and (not gaps or max(gaps) - min(gaps) <= 1)


def test_more_steps_than_timesteps_are_refused():
    assert ddim_timesteps(3, 4) == [3, 2, 1, 0]
    with pytest.raises(ConfigError, match="diffusion_steps"):
        ddim_timesteps(3, 5)


@pytest.mark.parametrize("timestep", [21, 555, 980])
def test_noise_is_added_at_the_first_ddim_timestep(world, timestep):
    prior = Recording(world.prior)
    edit_image(prior, world.x, world.noise, image=world.condition, text=world.text, timestep=timestep, steps=20)
    first, noisy, rows = prior.asked[0]
    abar = prior.alphas_cumprod[timestep].item()
    assert first == timestep and rows == 3 and len(prior.asked) == 20
    assert torch.equal(noisy, math.sqrt(abar) * world.x + math.sqrt(1 - abar) * world.noise)


def flow(noisy, abar, mean, spread):
    """The end of the probability flow of one Gaussian: x_0 keeps its quantile (Song et al. 2021)."""
    return mean + spread * (noisy - abar**0.5 * mean) / (abar * spread**2 + 1 - abar) ** 0.5


def test_ddim_ends_at_the_noise_of_timestep_zero_where_asked_to(world):
    """x = sqrt(abar_0) x_0 + sqrt(1 - abar_0) e of the last prediction, in place of x_0."""
    options = dict(image=world.condition, text=world.text, timestep=600, steps=5)
    clean = edit_image(world.prior, world.x, world.noise, **options)
    prior = Recording(world.prior)
    ended = edit_image(prior, world.x, world.noise, set_alpha_to_one=False, **options)
    t, noisy, _ = prior.asked[-1]
    abar, end = (prior.alphas_cumprod[i].item() for i in (t, 0))
    eps = (noisy - math.sqrt(abar) * clean) / math.sqrt(1 - abar)
    assert torch.allclose(ended, math.sqrt(end) * clean + math.sqrt(1 - end) * eps, rtol=0, atol=1e-12)
    assert not torch.allclose(ended, clean, atol=1e-3)


@pytest.mark.parametrize("name, text", [("instruction", True), ("null", False)])
def test_ddim_converges_to_the_flow(world, name, text):
    """At scales 1, 1 the prediction is that of one Gaussian, whose flow is known: first order in the step."""
    prior, t = ClosedForm(ClosedFormConfig(s=0.3, s_image=0.4)), 601
    abar = prior.alphas_cumprod[t].item()
    noisy = add_noise(world.x, world.noise, abar)
    mean, spread = (world.edited, 0.3) if text else (world.source, 0.4)
    errors = []
    for steps in (75, 150, 300):
        edited = edit_image(
            prior,
            world.x,
            world.noise,
            image=world.condition,
            text=world.text if text else None,
            timestep=t,
            steps=steps,
            guidance_scale=1.0,
            image_guidance_scale=1.0,
        )
        errors.append((edited - flow(noisy, abar, mean, spread)).abs().max().item())
    assert errors[2] < errors[1] < errors[0] and errors[2] < 0.03


def test_the_priors_own_edit_comes_from_noise_alone(world):
    prior = ClosedForm(ClosedFormConfig(s=0.05, s_image=5.0))
    options = {"image": world.condition, "text": world.text}
    noise = keyed_noise(0, 0, 0, world.source.shape, torch.float64)
    edited = edit_image(prior, None, noise, **options)
    assert (edited - world.edited).abs().max() < 0.25  # the edit that the prior knows, at its spread of 0.05
    assert torch.equal(edited, edit_image(prior, None, noise, **options))


# --- the rule as a sampler, and the paper's equations


def branches(world, x, eps_src, noise, t, scales=(7.5, 1.5)):
    """Equation 13's two branches: the edit is noised with eps_src, the source with `noise`."""
    abar = world.prior.alphas_cumprod[t].item()
    edit = Branch(add_noise(x, eps_src, abar), world.text, world.condition, *scales)
    return edit, Branch(add_noise(world.source, noise, abar), None, world.condition, *scales)


def source_prediction(world, noise, t, scales=(7.5, 1.5)):
    reference = branches(world, world.source, noise, noise, t, scales)[1]
    return predict_difference(world.prior, reference, None, t)


@pytest.mark.parametrize("t", [101, 501, 901])
def test_equation_13_is_one_step_along_the_dds_difference(world, t):
    abar, before = (world.prior.alphas_cumprod[i].item() for i in (t, t - 1))
    eps_src = source_prediction(world, world.noise, t)
    edit, reference = branches(world, world.x, eps_src, world.noise, t)
    step = world.x - math.sqrt((1 - abar) / abar) * predict_difference(world.prior, edit, reference, t)
    ours = math.sqrt(before) * step + math.sqrt(1 - before) * eps_src
    # Equations 3, 4 and 11 as they stand: Tweedie's estimate of the edited branch, then back to the level of t - 1.
    clean = (edit.noisy - math.sqrt(1 - abar) * predict_difference(world.prior, edit, None, t)) / math.sqrt(abar)
    assert torch.allclose(ours, math.sqrt(before) * clean + math.sqrt(1 - before) * eps_src, rtol=0, atol=1e-12)


@pytest.mark.parametrize("t", [101, 501, 901])
def test_the_zero_of_dds_is_the_steps_fixed_point_and_errors_shrink_as_derived(world, t):
    """x - x* is multiplied by 1 - sqrt(1-abar) K each time, K = w_y k_s + (w_I - w_y) k_I + (1 - w_I) k_S."""
    scales = (1.5, 1.0)
    abar = world.prior.alphas_cumprod[t].item()
    k_s, k_i = ((1 - abar) ** 0.5 / (abar * v**2 + 1 - abar) for v in (0.05, 0.4))
    factor = 1 - (1 - abar) ** 0.5 * (1.5 * k_s - 0.5 * k_i)
    assert factor == pytest.approx(contraction(world.prior, get_rule("dds"), t, *scales), abs=1e-14)
    eps_src = source_prediction(world, world.noise, t, scales)

    def difference(x):
        return predict_difference(world.prior, *branches(world, x, eps_src, world.noise, t, scales), t)

    def step(x):
        return x - math.sqrt((1 - abar) / abar) * difference(x)

    # Two points of an affine function give its zero.
    slope = (difference(world.x) - difference(world.source)) / (world.x - world.source)
    zero = world.source - difference(world.source) / slope
    assert torch.allclose(step(zero), zero, rtol=0, atol=1e-12)
    x = world.x
    for _ in range(5):
        x, last = step(x), x
        assert torch.allclose(x - zero, factor * (last - zero), rtol=0, atol=1e-12)
    # Equation 15: the objectives agree up to a factor in every x, but one step only leaves `factor` of the difference.
    assert torch.allclose(difference(step(world.x)), factor * difference(world.x), rtol=0, atol=1e-12)


def test_equation_15_is_exact_for_a_point_mass(world):
    """Where Tweedie's estimate does not depend on x, one step is the minimum of both objectives."""
    world.prior = ClosedForm(ClosedFormConfig(s=1e-9, s_image=1e-9, s_null=1e-9))
    t, abar = 301, world.prior.alphas_cumprod[301].item()
    eps_src = source_prediction(world, world.noise, t)

    def difference(x):
        return predict_difference(world.prior, *branches(world, x, eps_src, world.noise, t), t)

    once = world.x - math.sqrt((1 - abar) / abar) * difference(world.x)
    assert difference(once).abs().max() < 1e-10


def test_the_sampler_takes_the_papers_step(world):
    """With noise that the source branch reproduces (eps_src = eps), the rule's shared noise is equation 13's."""
    t = 501
    abar = world.prior.alphas_cumprod[t].item()
    base = source_prediction(world, torch.zeros_like(world.noise), t)
    gain = (source_prediction(world, torch.ones_like(world.noise), t) - base).mean()
    noise = base / (1 - gain)
    assert torch.allclose(source_prediction(world, noise, t), noise, rtol=0, atol=1e-12)
    got = sample_rule(
        world.prior, get_rule("dds"), world.source, [t], lambda i: noise,
        start=world.x, image=world.condition, text=world.text,
    )  # fmt: skip
    edit, _ = branches(world, world.x, noise, noise, t)
    eps = predict_difference(world.prior, edit, None, t)
    assert torch.allclose(got, (edit.noisy - math.sqrt(1 - abar) * eps) / math.sqrt(abar), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["dds", "pds", "dreamcatalyst", "dreamcatalyst-psi3"])
def test_the_sampler_comes_to_the_fixed_point(world, name):
    """Free of noise at equal spreads, so that repeated steps at one timestep reach x*, where they contract."""
    prior, t, scales = ClosedForm(ClosedFormConfig(s=0.3, s_image=0.3, s_null=0.3)), 301, (3.0, 1.5)
    assert abs(contraction(prior, get_rule(name), t, *scales)) < 0.7
    got = sample_rule(
        prior, get_rule(name), world.source, [t] * 80, lambda i: keyed_noise(0, i, 0, world.x.shape, torch.float64),
        image=world.condition, text=world.text, guidance_scale=scales[0], image_guidance_scale=scales[1],
    )  # fmt: skip
    rho = fixed_point(prior, get_rule(name), [t], *scales).rho
    assert torch.allclose(got, world.source + rho * (world.edited - world.source), rtol=0, atol=1e-10)


def test_the_sampler_needs_a_weight_on_the_edit(world):
    rule = get_rule("dreamcatalyst", delta=0.0, gamma=0.0)
    with pytest.raises(ConfigError, match="301"):
        sample_rule(world.prior, rule, world.source, [301], lambda i: world.noise, image=world.condition, text=None)
