"""What docs/closed-form.md says in numbers and no other test says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from dreamcatalyst.diffusion.api import PRIORS
from dreamcatalyst.diffusion.closed_form import ClosedForm, ClosedFormConfig, noise_slope
from dreamcatalyst.guidance.config import NOISES
from dreamcatalyst.guidance.fixed_point import balanced, contraction, fixed_point, mean_gradient
from dreamcatalyst.guidance.rules import RULES, get_rule, gradient_rules
from dreamcatalyst.guidance.timesteps import POLICIES, Schedule
from dreamcatalyst.render.api import BACKENDS
from dreamcatalyst.scene.generations import ANCHORS
from dreamcatalyst.segment.api import SEGMENTERS
from dreamcatalyst.train.density import DENSITY

ROOT = Path(__file__).resolve().parents[2]
GRADIENT_RULES = gradient_rules()
SPREADS = {
    "dreamcatalyst": (5.08, 1),
    "dreamcatalyst-psi2": (6.36, 1),
    "dreamcatalyst-psi3": (6.23, 1),
    "csd-like": (5.47, 1),
    "pds": (1.89, 1),
    "dds": (10, 1.018),
    "sds": (10, 1.049),
}


@pytest.mark.parametrize("name", GRADIENT_RULES)
def test_the_table_of_balanced_spreads(name):
    rule, prior = get_rule(name), ClosedForm()
    timesteps = Schedule(rule.timesteps).rest(prior.alphas_cumprod)
    prior = balanced(prior, rule, timesteps, 7.5, 1.5)
    assert prior.spreads()[1] == pytest.approx(SPREADS[name][0], abs=0.005)
    assert fixed_point(prior, rule, timesteps, 7.5, 1.5).rho == pytest.approx(SPREADS[name][1], abs=5e-4)


def test_numbers_of_the_page():
    rule, level = get_rule("dreamcatalyst"), ClosedForm(ClosedFormConfig(s_image=0.05))
    abar = float(level.alphas_cumprod[201])
    a, b = rule.weights(201, level.alphas_cumprod)
    scale = 1.0 + b / (a * abar**0.5 * noise_slope(abar, 0.05))
    assert scale == pytest.approx(1.082, abs=5e-4)
    assert fixed_point(level, rule, [201], scale, 1.5).rho == pytest.approx(1.0, abs=1e-12)
    assert fixed_point(level, rule, [201], 7.5, 1.5).rho == pytest.approx(6.93, abs=0.005)
    assert fixed_point(level, get_rule("csd-like"), [201], 7.5, 1.5).rho == pytest.approx(91, abs=0.5)

    prior = balanced(ClosedForm(), rule, [201], 7.5, 1.5)
    for t, rho in ((901, 1.73), (701, 1.23), (501, 1.05), (301, 1.007)):
        assert fixed_point(prior, rule, [t], 7.5, 1.5).rho == pytest.approx(rho, abs=5e-3 if t > 301 else 5e-4)
    s, s_image, _ = prior.spreads()
    noise = a * (1 - abar) ** 0.5 * 7.5 * (noise_slope(abar, s) - noise_slope(abar, s_image))
    stiffness = mean_gradient(prior, rule, 201, 7.5, 1.5).stiffness
    assert (noise, stiffness, noise / stiffness) == pytest.approx((4.72, 8.33, 0.57), abs=0.005)


@pytest.mark.parametrize("name", ["sds", "dds"])
def test_without_identity_term_plain_scales_give_the_edit(name):
    at = fixed_point(ClosedForm(ClosedFormConfig(s_image=0.4, s_null=0.9)), get_rule(name), [101, 201, 901], 1.0, 1.0)
    assert at.rho == pytest.approx(1.0, abs=1e-12) and at.drift == 0.0


@pytest.mark.parametrize("name", GRADIENT_RULES)
def test_stable_wherever_spreads_grow_with_ignorance(name):
    for spreads in ((0.05, 0.05, 0.05), (0.05, 0.06, 3.0), (0.3, 1.0, 1.0), (0.01, 5.0, 50.0)):
        prior = ClosedForm(ClosedFormConfig(*spreads))
        for scales in ((1.0, 1.0), (7.5, 1.5), (100.0, 1.0), (2.0, 2.0)):
            assert all(fixed_point(prior, get_rule(name), [t], *scales) for t in (2, 21, 201, 501, 901, 999))


def test_where_the_sampler_converges_at_equal_spreads():
    prior = ClosedForm(ClosedFormConfig(s_image=0.05))
    for scales in ((1.0, 1.0), (7.5, 1.5)):
        factors = [contraction(prior, get_rule("dreamcatalyst"), t, *scales) for t in range(1000)]
        assert [abs(factor) < 1.0 for factor in factors] == [t <= 817 for t in range(1000)]
        assert all(0.0 <= contraction(prior, get_rule("dds"), t, *scales) < 1.0 for t in range(1000))


def test_the_page_of_choices_lists_every_one():
    """Of the keys whose choices are registered: no more and no fewer."""
    rows = re.findall(
        r"^\| `(system\.\S+)` \| (.*) \|$", (ROOT / "docs/choose.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    told = {key: set(re.findall(r"`([^`]+)`", choices)) for key, choices in rows}
    told["system.guidance.rule"] = {
        f"dreamcatalyst{name}" if name.startswith("-") else name for name in told["system.guidance.rule"]
    }
    assert told == {
        "system.guidance.prior_type": set(PRIORS.names()),
        "system.guidance.rule": set(RULES.names()),
        "system.guidance.timesteps": set(POLICIES.names()),
        "system.guidance.noise": set(NOISES),
        "system.mask.kind": {"none", *SEGMENTERS.names()},
        "system.anchor.kind": {"none", *ANCHORS},
        "system.densify.strategy": set(DENSITY.names()),
        "system.renderer.backend": {"auto", *BACKENDS.names()},
    }


def test_tests_that_the_pages_name_exist():
    """A page names the test that proves each statement; a renamed test must not leave it behind."""
    defined = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for page in ("closed-form.md", "distillation.md"):
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        named = {word for word in text.replace("`", " ").replace(",", " ").split() if word.startswith("test_")}
        named = {word.strip("[].") for word in named}
        assert named and not [name for name in named if f"def {name}(" not in defined]
