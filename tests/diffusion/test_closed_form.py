"""The closed-form prior is the exact denoiser of what it claims."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.diffusion import closed_form
from dreamcatalyst.diffusion.api import Row
from dreamcatalyst.diffusion.closed_form import ClosedForm, ClosedFormConfig
from dreamcatalyst.errors import ConfigError, PriorError

CONFIG = ClosedFormConfig(s=0.05, s_image=0.4, s_null=0.9, mu=0.2)


def images(n=2, dtype=torch.float64):
    return torch.rand(n, 3, 6, 5, generator=torch.Generator().manual_seed(0), dtype=dtype)


def posterior_noise(x_t, mean, spread, abar):
    """E[eps | x_t] by quadrature over x_0 ~ N(mean, spread^2), from the definition x_t = A x_0 + sigma eps alone."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(120)
    x_0 = mean + spread * nodes
    eps = (x_t - abar**0.5 * x_0) / (1 - abar) ** 0.5
    likelihood = weights * np.exp(-0.5 * eps**2)
    return (likelihood * eps).sum() / likelihood.sum()


@pytest.mark.parametrize("timestep", [400, 700, 999])
def test_predictions_are_posterior_means(timestep):
    prior = ClosedForm(CONFIG)
    condition, (text,) = prior.condition(images()), prior.embed(["Make it sunset"])
    abar = float(prior.alphas_cumprod[timestep])
    noisy = torch.randn(2, 3, 6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    rows = [Row(noisy, text, condition), Row(noisy, None, condition), Row(noisy)]
    moments = [(2 * text(images()) - 1, 0.05), (2 * images() - 1, 0.4), (torch.full_like(noisy, 0.2), 0.9)]
    for got, (mean, spread) in zip(prior.predict_noise(rows, timestep), moments, strict=True):
        for i in ((0, 0, 0, 0), (1, 2, 5, 4), (0, 1, 3, 2)):
            expected = posterior_noise(noisy[i].item(), mean[i].item(), spread, abar)
            assert got[i].item() == pytest.approx(expected, abs=1e-10)


def test_latents_are_pixels():
    prior, x = ClosedForm(CONFIG), images().requires_grad_()
    latents = prior.encode(x)
    assert torch.allclose(prior.decode(latents), x) and not prior.decode(latents).requires_grad
    (gradient,) = torch.autograd.grad(latents.sum(), x)
    assert torch.equal(gradient, torch.full_like(x, 2.0))
    assert prior.decode(torch.tensor([-3.0, 3.0]).expand(1, 3, 1, 2)).unique().tolist() == [0.0, 1.0]


def test_the_operator_runs_once_per_condition():
    calls = []
    prior = ClosedForm(CONFIG)
    (text,) = prior.embed(["Make it sunset"])
    counted = dataclasses.replace(text, apply=lambda image: (calls.append(1), text.apply(image))[1])
    condition = prior.condition(images(1))
    for timestep in (900, 500, 201):
        prior.predict_noise([Row(images(1), counted, condition)], timestep)
    assert len(calls) == 1


def test_the_edit_is_known():
    prior = ClosedForm(CONFIG)
    (text,) = prior.embed(["Make it night"])
    assert torch.allclose(prior.known_edit(prior.condition(images()), text), text(images()))
    assert torch.allclose(prior.known_edit(prior.condition(images()), None), images())


def test_an_unknown_instruction_fails_at_once():
    with pytest.raises(PriorError, match="Make him a clown"):
        ClosedForm(CONFIG).embed(["Make him a clown"])


def test_open_spreads_say_how_to_close_them():
    with pytest.raises(PriorError, match="s_image"):
        ClosedForm().predict_noise([Row(images())], 500)
    assert ClosedForm(ClosedFormConfig(s_image=0.3)).spreads() == (0.05, 0.3, 0.3)
    with pytest.raises(ConfigError, match="s: got 0.0 .float., expected more than 0"):
        parse(ClosedFormConfig, {"s": 0.0})


def test_an_instruction_needs_an_image():
    prior = ClosedForm(CONFIG)
    with pytest.raises(PriorError, match="no image"):
        prior.predict_noise([Row(images(), prior.embed(["sunset"])[0])], 500)


def test_slope_is_that_of_a_point_mass_and_of_pure_noise():
    for abar in (0.1, 0.5, 0.9):
        assert closed_form.noise_slope(abar, 0.0) == pytest.approx((1 - abar) ** -0.5, rel=1e-14)
        assert closed_form.noise_slope(abar, 1.0) == pytest.approx((1 - abar) ** 0.5, rel=1e-14)
