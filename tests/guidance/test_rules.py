"""The table of rules: each gradient against its paper, written out again; coefficients against published ones."""

from __future__ import annotations

import math

import pytest
import torch
from dreamcatalyst.diffusion.noise import stable_diffusion_schedule
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.guidance.distill import distillation_gradient
from dreamcatalyst.guidance.objective import Objective
from dreamcatalyst.guidance.rules import (
    PRESETS,
    RULES,
    Rule,
    get_rule,
    gradient_rules,
    noise_level,
    pds_coefficients,
    pds_coefficients_from_betas,
)

GRADIENT_RULES = gradient_rules()
ABAR = stable_diffusion_schedule()
W_Y, W_I = 7.5, 1.5


def gradient(world, name, x=None, timestep=501, noise=None, **options):
    options = {"text": world.text, "source_text": None, "guidance_scale": W_Y, "image_guidance_scale": W_I, **options}
    return distillation_gradient(
        world.prior,
        get_rule(name),
        world.x if x is None else x,
        world.source,
        image=world.condition,
        timestep=timestep,
        noise=world.noise if noise is None else noise,
        **options,
    )


# --- transcriptions that share no code with the product


def written_out(world, name, t, source_mean=None):
    """g of the rule `name` from its paper; source_mean: mean of x_0 given image and source text, None without text."""
    abar = math.prod(1 - (0.00085**0.5 + i / 999 * (0.012**0.5 - 0.00085**0.5)) ** 2 for i in range(t + 1))
    u, signal, sigma = (t - 1) / 1000, math.sqrt(abar), math.sqrt(1 - abar)

    def eps(x_t, mean, spread):  # minus sigma times the score of N(signal mean, abar spread^2 + sigma^2)
        return sigma * (x_t - signal * mean) / (abar * spread**2 + sigma**2)

    def guided(x_t, mean=None):
        null, image = eps(x_t, 0.2, 0.9), eps(x_t, world.source, 0.4)
        words = 0.0 if mean is None else W_Y * (eps(x_t, mean, 0.05) - image)
        return null + words + W_I * (image - null)

    x_t, x_t_src = signal * world.x + sigma * world.noise, signal * world.source + sigma * world.noise
    move = world.x - world.source
    edit = guided(x_t, world.edited)
    if name == "sds":
        return (1 - abar) * (edit - world.noise)
    delta = edit - guided(x_t_src, source_mean)
    identity = 0.075 * math.exp(u) * move
    psi = 0.2 + 0.8 * u ** (1 / math.e)
    return {
        "dds": lambda: delta,
        "pds": lambda: stochastic_latent_difference(world, t, edit, guided(x_t_src, source_mean), x_t, x_t_src),
        "dreamcatalyst": lambda: psi * delta + identity,
        "dreamcatalyst-psi2": lambda: delta + identity,
        "dreamcatalyst-psi3": lambda: (1 - 0.2 * u) * delta + identity,
        "csd-like": lambda: psi * (edit - guided(x_t)) + identity,
    }[name]()


def stochastic_latent_difference(world, t, edit, reference, x_t, x_t_src, gap=2):
    """z(x_tgt) - z(x_src) of PDS (Koo et al. 2024, equations 5-9) with the steps as its published code takes them."""
    abar, abar_p = ABAR[t].item(), ABAR[t - gap].item()
    beta = 1 - (ABAR[t] / ABAR[t - 1]).item()
    sigma = math.sqrt((1 - abar_p) / (1 - abar) * beta)

    def z(x_0, x_noisy, eps):
        x_p = math.sqrt(abar_p) * x_0 + math.sqrt(1 - abar_p) * 0.37  # any noise, the same in both: it cancels
        clean = (x_noisy - math.sqrt(1 - abar) * eps) / math.sqrt(abar)
        mean = math.sqrt(abar_p) * beta / (1 - abar) * clean + math.sqrt(1 - beta) * (1 - abar_p) / (1 - abar) * x_noisy
        return (x_p - mean) / sigma

    return z(world.x, x_t, edit) - z(world.source, x_t_src, reference)


@pytest.mark.parametrize("t", [21, 201, 501, 901])
@pytest.mark.parametrize("name", GRADIENT_RULES)
def test_gradients_are_the_papers(world, name, t):
    assert torch.allclose(gradient(world, name, timestep=t), written_out(world, name, t), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["dds", "pds"])
def test_gradients_with_a_source_text(world, name):
    got = gradient(world, name, timestep=301, source_text=world.other)
    assert torch.allclose(got, written_out(world, name, 301, world.other_edited), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["dds", "pds"])
def test_equal_texts_leave_the_source_alone(world, name):
    for text in (world.text, None):
        assert gradient(world, name, x=world.source, text=text, source_text=text).abs().max() < 1e-12


@pytest.mark.parametrize("name", [n for n in GRADIENT_RULES if n.startswith(("dreamcatalyst", "csd"))])
def test_the_null_instruction_leaves_the_source_alone(world, name):
    assert gradient(world, name, x=world.source, text=None).abs().max() < 1e-12


def test_sds_does_not_leave_the_source_alone(world):
    assert gradient(world, "sds", x=world.source, text=None).abs().max() > 0.1


@pytest.mark.parametrize("name", ["dreamcatalyst", "dds", "pds"])
def test_the_source_branch_sees_the_source(world, name):
    """e_src is a function of x_src: moving x_src changes more than the identity term."""
    rule, moved = get_rule(name), world.source + 0.1
    options = {"image": world.condition, "text": world.text, "timestep": 501, "noise": world.noise}
    both = [distillation_gradient(world.prior, rule, world.x, x_src, **options) for x_src in (world.source, moved)]
    a, b = rule.weights(501, ABAR)
    e_src_change = (both[0] - both[1] - b * (moved - world.source)) / a
    abar = ABAR[501].item()
    slope = (1 - abar) ** 0.5 * (1.5 / (abar * 0.16 + 1 - abar) - 0.5 / (abar * 0.81 + 1 - abar))
    assert torch.allclose(e_src_change, torch.full_like(e_src_change, slope * abar**0.5 * 0.1), rtol=0, atol=1e-12)


def test_csd_like_is_the_guidance_alone(world):
    """What the published code's source branch amounts to: w_y (eps(x, y, I) - eps(x, null, I)), whatever w_I."""
    results = [gradient(world, "csd-like", image_guidance_scale=w_i) for w_i in (1.5, 1.0, 4.0)]
    assert all(torch.allclose(other, results[0], rtol=0, atol=1e-12) for other in results)


@pytest.mark.parametrize("name", RULES.names())
def test_rows_are_complete(name):
    rule = get_rule(name)
    assert rule.name == name and rule.citation
    if not isinstance(rule, Rule):
        assert issubclass(rule.objective, Objective) and rule.objective.gives_pictures
        return
    a, b = rule.weights(501, ABAR)
    assert math.isfinite(a) and math.isfinite(b) and a >= 0 and b >= 0


# --- coefficients


@pytest.mark.parametrize(
    "t, u, identity, editing",
    [(901, 0.9, 0.075 * 2.459603, 0.2 + 0.8 * 0.961982), (201, 0.2, 0.075 * 1.221403, 0.2 + 0.8 * 0.553176)],
)
def test_noise_level_and_coefficients_at_both_ends(t, u, identity, editing):
    assert noise_level(t, 1000) == u == (t // 2) / 500  # index i of 500 DDIM steps, t = 2 i + 1
    a, b = get_rule("dreamcatalyst").weights(t, ABAR)
    assert a == pytest.approx(editing, abs=1e-5) and b == pytest.approx(identity, abs=1e-6)


@pytest.mark.parametrize("preset, first, last", [("paper", 5.3, 7.0), ("published-3dgs", 1.3, 1.75)])
def test_published_balance_of_editing_and_identity(preset, first, last):
    rule = get_rule("dreamcatalyst", preset)
    for t, ratio in ((901, first), (201, last)):
        a, b = rule.weights(t, ABAR)
        assert a / b == pytest.approx(ratio, rel=0.02)


def test_the_published_3dgs_setting_is_a_quarter():
    for t in (201, 555, 901):
        paper, published = (get_rule("dreamcatalyst", preset).weights(t, ABAR) for preset in PRESETS)
        assert published[0] == pytest.approx(paper[0] / 4, rel=1e-12) and published[1] == paper[1]


def test_psi2_and_psi3():
    assert get_rule("dreamcatalyst-psi2").weights(777, ABAR)[0] == 1.0
    assert get_rule("dreamcatalyst-psi3").weights(501, ABAR)[0] == pytest.approx(0.9, rel=1e-12)


def test_weights_exist_at_every_timestep():
    for name in GRADIENT_RULES:
        for t in (0, 1, 999) if name != "pds" else (2, 999):
            assert all(math.isfinite(weight) for weight in get_rule(name).weights(t, ABAR))


PUBLISHED = {21: ("1.61", ".232"), 101: (".314", ".115"), 201: (".140", ".092"), 401: (".049", ".081"),
             601: (".021", ".085"), 901: (".0062", ".1035")}  # fmt: skip


@pytest.mark.parametrize("t", PUBLISHED)
def test_pds_is_the_published_curve(t):
    for got, printed in zip(pds_coefficients(ABAR, t, gap=2), PUBLISHED[t], strict=True):
        digits = len(printed.split(".")[1])
        assert abs(got - float(printed)) <= 0.5 * 10**-digits


@pytest.mark.parametrize("gap", [1, 2, 3, 10])
@pytest.mark.parametrize("t", [21, 201, 501, 999])
def test_pds_is_its_definition(t, gap):
    abar, abar_p = ABAR[t].item(), ABAR[t - gap].item()
    alpha = (ABAR[t] / ABAR[t - 1]).item()
    c_0 = math.sqrt(abar_p) * (1 - alpha) / (1 - abar)
    c_1 = math.sqrt(alpha) * (1 - abar_p) / (1 - abar)
    sigma = math.sqrt((1 - abar_p) / (1 - abar) * (1 - alpha))
    phi, psi = pds_coefficients(ABAR, t, gap)
    assert phi == pytest.approx((math.sqrt(abar_p) - c_0 - c_1 * math.sqrt(abar)) / sigma, abs=1e-12)
    assert psi == pytest.approx(c_0 * math.sqrt((1 - abar) / abar) / sigma, rel=1e-11)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_pds_has_no_identity_term_at_gap_one(dtype):
    betas = (1 - ABAR / torch.cat([torch.ones(1, dtype=torch.float64), ABAR[:-1]])).to(dtype)
    assert all(pds_coefficients_from_betas(betas, t, gap=1)[0].item() == 0.0 for t in range(1, 1000))


@pytest.mark.parametrize("gap", [1, 2, 5])
def test_pds_does_not_cancel(gap):
    """float32 is within 1e-5 of float64 at every timestep beyond the gap."""
    betas = (1 - ABAR / torch.cat([torch.ones(1, dtype=torch.float64), ABAR[:-1]])).float()
    for t in range(gap, 1000):
        for narrow, wide in zip(
            pds_coefficients_from_betas(betas, t, gap), pds_coefficients_from_betas(betas.double(), t, gap), strict=True
        ):
            assert abs(narrow.item() - wide.item()) <= 1e-5 * abs(wide.item())


def test_pds_without_noise_to_come_from_is_an_error():
    with pytest.raises(ConfigError, match="noiseless"):
        pds_coefficients(ABAR, 1, gap=2)
    clean_start = torch.cat([torch.ones(3, dtype=torch.float64), ABAR])
    with pytest.raises(ConfigError, match="noiseless"):
        pds_coefficients(clean_start, 4, gap=2)
    with pytest.raises(ConfigError, match="gap"):
        pds_coefficients(ABAR, 100, gap=0)
    with pytest.raises(ConfigError, match="999"):
        pds_coefficients(ABAR, 1000, gap=2)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("dreamcatalist",), "Did you mean 'dreamcatalyst'"),
        (("dds", "papr"), "Did you mean 'paper'"),
    ],
)
def test_wrong_names_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        get_rule(*arguments)


def test_wrong_parameters_are_refused():
    with pytest.raises(ConfigError, match="Did you mean 'gamma'"):
        get_rule("dreamcatalyst", gama=1.0)
