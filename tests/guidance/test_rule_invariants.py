"""What every score-distillation rule must obey, whatever its timestep, scales and images."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm, ClosedFormConfig
from dreamcatalyst.diffusion.noise import keyed_noise
from dreamcatalyst.guidance.distill import distillation_gradient, distillation_loss
from dreamcatalyst.guidance.rules import EDIT_NULL, NOISE, SOURCE, SOURCE_NULL, get_rule, gradient_rules
from hypothesis import given, settings
from hypothesis import strategies as st

RULE_NAMES = gradient_rules()
OF_TWO_TEXTS = [name for name in RULE_NAMES if get_rule(name).reference == SOURCE]
OF_A_SOURCE = [name for name in RULE_NAMES if get_rule(name).reference in (SOURCE, SOURCE_NULL, EDIT_NULL)]
few = settings(max_examples=15, deadline=None, derandomize=True)
seeds, timesteps = st.integers(0, 10_000), st.integers(2, 999)  # PDS begins at its gap
scales, factors = st.floats(0, 20), st.floats(-5, 5)


def world(seed: int, count: int = 3) -> SimpleNamespace:
    """A closed-form prior and `count` views: source images, renders that differ from them, and noise; float64."""
    generator = torch.Generator().manual_seed(seed)
    prior = ClosedForm(ClosedFormConfig(s=0.05, s_image=0.4, s_null=0.9, mu=0.2))
    images = torch.rand(count, 3, 4, 5, generator=generator, dtype=torch.float64)
    source = prior.encode(images)
    text, other = prior.embed(["Make it sunset", "Make it night"])
    return SimpleNamespace(
        prior=prior,
        images=images,
        source=source,
        x=source + 0.3 * torch.randn(source.shape, generator=generator, dtype=torch.float64),
        noise=torch.stack([keyed_noise(seed, 0, v, source.shape[1:], torch.float64) for v in range(count)]),
        text=text,
        other=other,
    )


def gradient(w: SimpleNamespace, rule, t: int, views=slice(None), **changes) -> torch.Tensor:
    """g of some views of a world."""
    given_ = {"x": w.x, "source": w.source, "text": w.text, "source_text": None, "noise": w.noise, **changes}
    return distillation_gradient(
        w.prior,
        get_rule(rule) if isinstance(rule, str) else rule,
        given_["x"][views],
        given_["source"][views],
        image=w.prior.condition(w.images[views]),
        text=given_["text"],
        source_text=given_["source_text"],
        timestep=t,
        noise=given_["noise"][views],
        guidance_scale=given_.get("w_y", 7.5),
        image_guidance_scale=given_.get("w_i", 1.5),
    )


def assert_close(one: torch.Tensor, other: torch.Tensor) -> None:
    assert (one - other).abs().max() <= 1e-10 * (1 + other.abs().max())


@pytest.mark.parametrize("name", RULE_NAMES)
@given(seeds, timesteps, st.permutations(range(3)), scales, scales)
@few
def test_views_may_come_in_any_order_and_any_batches(name, seed, t, order, w_y, w_i):
    w, options = world(seed), {"w_y": w_y, "w_i": w_i}
    together = gradient(w, name, t, **options)
    assert torch.equal(gradient(w, name, t, list(order), **options), together[list(order)])
    alone = torch.cat([gradient(w, name, t, [v], **options) for v in range(3)])
    assert torch.equal(alone, together)


@pytest.mark.parametrize("name", RULE_NAMES)
@given(seeds, timesteps, factors, factors)
@few
def test_the_gradient_is_linear_in_both_weights(name, seed, t, alpha, beta):
    """g(alpha a, beta b) = alpha g(a, 0) + beta g(0, b)."""
    w, rule = world(seed), get_rule(name)

    def scaled(a: float, b: float):
        return replace(rule, a=lambda p, t, abar: a * rule.a(p, t, abar), b=lambda p, t, abar: b * rule.b(p, t, abar))

    parts = alpha * gradient(w, scaled(1, 0), t) + beta * gradient(w, scaled(0, 1), t)
    assert_close(gradient(w, scaled(alpha, beta), t), parts)


@pytest.mark.parametrize("name", OF_A_SOURCE)
@given(seeds, timesteps, scales, scales)
@few
def test_identical_branches_cancel_to_the_bit(name, seed, t, w_y, w_i):
    """At the source, without an instruction (dds, pds: with the same one on both sides), nothing is asked for."""
    w = world(seed)
    for text in (w.text, None) if name in OF_TWO_TEXTS else (None,):
        got = gradient(w, name, t, x=w.source.clone(), text=text, source_text=text, w_y=w_y, w_i=w_i)
        assert (got == 0).all()


@pytest.mark.parametrize("name", OF_TWO_TEXTS)
@given(seeds, timesteps, scales, scales)
@few
def test_exchanging_edit_and_source_turns_the_gradient_round(name, seed, t, w_y, w_i):
    w, options = world(seed), {"w_y": w_y, "w_i": w_i}
    there = gradient(w, name, t, text=w.text, source_text=w.other, **options)
    back = gradient(w, name, t, x=w.source, source=w.x, text=w.other, source_text=w.text, **options)
    assert_close(back, -there)


@pytest.mark.parametrize("name", RULE_NAMES)
@given(seeds, timesteps, scales)
@few
def test_a_guidance_scale_of_zero_leaves_the_instruction_out(name, seed, t, w_i):
    w = world(seed)
    assert_close(gradient(w, name, t, w_y=0.0, w_i=w_i), gradient(w, name, t, text=None, w_i=w_i))


@pytest.mark.parametrize("name", RULE_NAMES)
@given(seeds, timesteps, scales, scales, st.floats(0, 1))
@few
def test_the_gradient_is_affine_in_the_guidance_scale(name, seed, t, one, other, share):
    """The exact prior's and any other's: rows are weighted, not mixed."""
    w, middle = world(seed), share * one + (1 - share) * other
    ends = share * gradient(w, name, t, w_y=one) + (1 - share) * gradient(w, name, t, w_y=other)
    assert_close(gradient(w, name, t, w_y=middle), ends)


@pytest.mark.parametrize("name", [name for name in RULE_NAMES if get_rule(name).reference != NOISE])
@given(seeds, timesteps)
@few
def test_what_the_prior_thinks_of_any_image_cancels(name, seed, t):
    """mu, the mean of x_0 given nothing, is in both branches with the same weight."""
    w = world(seed)
    before = gradient(w, name, t)
    w.prior = ClosedForm(replace(w.prior.config, mu=-0.7))
    assert_close(gradient(w, name, t), before)


@given(seeds, st.sampled_from(["mean", "sum"]))
@few
def test_the_loss_carries_the_gradient(seed, reduction):
    w = world(seed)
    x, g = w.x.clone().requires_grad_(), gradient(w, "dreamcatalyst", 501)
    distillation_loss(x, g, reduction).backward()
    assert_close(x.grad, g / (x.numel() if reduction == "mean" else len(x)))


@pytest.mark.parametrize("name", ["pds", "dreamcatalyst"])
@given(seeds, timesteps, st.floats(1e-6, 1e6))
@few
def test_an_implicit_step_is_backward_euler_of_the_identity_term(name, seed, t, length):
    """x' = x - h g obeys x' = x - h [a (eps_edit - eps_ref) + b (x' - x_src)], and so cannot pass x_src by itself."""
    w = world(seed)
    explicit, implicit = get_rule(name), get_rule(name, implicit_step=length)
    a, b = explicit.weights(t, w.prior.alphas_cumprod)
    editing = gradient(w, explicit, t) - b * (w.x - w.source)
    after = w.x - length * gradient(w, implicit, t)
    assert_close(after + length * b * (after - w.source), w.x - length * editing)
    assert implicit.weights(t, w.prior.alphas_cumprod)[0] == pytest.approx(a / (1 + length * b), rel=1e-12)


def test_a_stiff_identity_term_needs_the_implicit_step():
    """Steps of length 1 with b = 50: explicitly each multiplies the distance from the source by -49."""
    w = world(0)
    left = {}
    for length in (0.0, 1.0):
        rule, x = get_rule("dreamcatalyst", delta=0.0, gamma=0.0, chi=50.0, implicit_step=length), w.x
        for _ in range(5):
            x = x - gradient(w, rule, 1, x=x)
        left[length] = float((x - w.source).abs().max() / (w.x - w.source).abs().max())
    assert left[0.0] == pytest.approx(49.0**5) and left[1.0] == pytest.approx(51.0**-5)
