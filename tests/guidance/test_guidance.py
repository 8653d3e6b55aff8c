"""Prior, rule and instruction put together: what is computed once, what depends on what, and where an edit goes."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm
from dreamcatalyst.errors import ConfigError, DreamCatalystError, PriorError
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.distill import distillation_gradient
from dreamcatalyst.guidance.guidance import Guidance
from dreamcatalyst.guidance.rules import RULES, get_rule, gradient_rules

GRADIENT_RULES = gradient_rules()


def guidance(prompt: str = "Make it sunset", source_prompt: str = "", **options) -> Guidance:
    return Guidance(GuidanceConfig(**options), prompt, source_prompt)


def pictures(n: int = 2) -> torch.Tensor:
    return torch.rand(n, 6, 7, 3, generator=torch.Generator().manual_seed(0))


def gradient(made: Guidance, rgb: torch.Tensor, sources: torch.Tensor, index: list[int], step: int) -> torch.Tensor:
    """Of the step's loss in the renders."""
    rgb = rgb.clone().requires_grad_()
    return torch.autograd.grad(made.step(rgb, sources, index, step, 100).loss, rgb)[0]


@pytest.mark.parametrize("name", RULES.names())
def test_every_rule_brings_a_picture_to_its_edit(name):
    """What is left of the way is a third at most, though each step sees a single draw of noise, e and -e in turn."""
    made, source = guidance(rule=name, diffusion_steps=10, noise="alternating"), pictures(1)
    picture = source.clone().requires_grad_()
    optimizer = torch.optim.Adam([picture])
    for step in range(120):
        optimizer.param_groups[0]["lr"] = 0.02 * (1.0 - step / 120)
        optimizer.zero_grad()
        made.step(picture, source, [0], step, 120, visits=[step]).loss.backward()
        optimizer.step()
    edit = made.known_edit(source[0], 0)
    error, before = ((image - edit).square().mean().sqrt() for image in (picture.detach()[0], source[0]))
    assert error < 0.35 * before


def test_loss_carries_the_rules_gradient_through_the_encoder():
    """Latents are 2 x - 1, hence twice the mean loss's gradient g / numel."""
    made, rgb, sources = guidance(), pictures() * 0.9, pictures()
    given = made.step(rgb.requires_grad_(), sources, [4, 9], 30, 100)
    (got,) = torch.autograd.grad(given.loss, rgb)
    x, x_src = (made.prior.encode(images.detach().permute(0, 3, 1, 2)) for images in (rgb, sources))
    g = distillation_gradient(
        made.prior,
        made.rule,
        x,
        x_src,
        image=made.prior.condition(sources.permute(0, 3, 1, 2)),
        text=made.text,
        timestep=made.schedule.timestep(30, 100, made.prior.alphas_cumprod),
        noise=made.noise(x, [4, 9], 30),
    )
    torch.testing.assert_close(got, 2.0 * g.permute(0, 2, 3, 1) / g.numel())
    torch.testing.assert_close(given.gradient, g)
    assert given.gradient_rms == pytest.approx(g.square().mean().sqrt().item())


def test_source_latents_conditions_and_texts_are_computed_once(monkeypatch):
    calls = []

    def counted(name):
        plain = getattr(ClosedForm, name)
        monkeypatch.setattr(ClosedForm, name, lambda self, arg: (calls.append(name), plain(self, arg))[1])

    for name in ("encode", "condition", "embed"):
        counted(name)
    made, sources = guidance(), pictures()
    for step in range(3):
        made.step(pictures(), sources, [0, 1], step, 3)
    # Of encode: three renders and two sources; ClosedForm's condition encodes, too.
    assert {name: calls.count(name) for name in set(calls)} == {"encode": 3 + 2 + 2, "condition": 2, "embed": 1}


def test_a_batch_is_its_views():
    made, rgb, sources = guidance(), pictures() * 0.8, pictures()
    both = gradient(made, rgb, sources, [3, 5], 10)
    for i, view in enumerate((3, 5)):
        alone = gradient(guidance(), rgb[i : i + 1], sources[i : i + 1], [view], 10)
        torch.testing.assert_close(both[i], alone[0] / 2)  # the mean is over twice as many elements


@pytest.mark.parametrize("name", ["dreamcatalyst", "sds"])
def test_a_resumed_run_has_the_same_gradients(name):
    """Noise and timesteps are functions of seed, step and view, not of what was called before."""
    first, rgb, sources = guidance(rule=name), pictures() * 0.8, pictures()
    for step in range(20):
        first.step(rgb, sources, [0, 1], step, 100)
    torch.manual_seed(7)
    again = gradient(guidance(rule=name), rgb, sources, [0, 1], 20)
    assert torch.equal(gradient(first, rgb, sources, [0, 1], 20), again)
    for other in (
        gradient(first, rgb, sources, [0, 1], 21),
        gradient(guidance(rule=name), rgb, sources, [2, 3], 20),
        gradient(guidance(rule=name, seed=1), rgb, sources, [0, 1], 20),
    ):
        assert not torch.allclose(other, again)


@pytest.mark.parametrize("name", GRADIENT_RULES)
def test_the_expected_picture_is_where_the_mean_gradient_vanishes(name):
    """Of the timesteps that the rule rests under; two opposite draws of noise have exactly the mean."""
    made = guidance(rule=name, prior={"s": 0.2, "s_image": 3.0, "s_null": 0.8, "mu": 0.1}, guidance_scale=1.2)
    source = 0.4 + 0.2 * pictures(1)[0].double()
    expected = made.objective.expected(source, 0)
    assert expected.min() > 0.0 and expected.max() < 1.0  # nothing was clamped, or it would not vanish
    x, x_src = (made.prior.encode(image.permute(2, 0, 1)[None]) for image in (expected, source))
    total = torch.zeros_like(x)
    for t in made.objective.resting_timesteps:
        for sign in (1.0, -1.0):
            total += distillation_gradient(
                made.prior,
                made.rule,
                x,
                x_src,
                image=made.encode_source(source, 0)[1],
                text=made.text,
                timestep=t,
                noise=sign * torch.ones_like(x),
                guidance_scale=1.2,
                image_guidance_scale=1.5,
            )
    assert total.abs().max() / len(made.objective.resting_timesteps) < 1e-10


def test_by_default_the_expected_picture_is_the_edit():
    source = pictures(1)[0].double()
    for name in ("dreamcatalyst", "pds", "csd-like"):
        made = guidance(rule=name)
        torch.testing.assert_close(made.objective.expected(source, 0), made.known_edit(source, 0))
    assert not torch.allclose(made.objective.expected(source, 0, timestep=901), made.known_edit(source, 0))


def test_a_source_text_is_taken_off_the_edit():
    """dds and pds go to I + T(I) - R(I); the other rules never look at a source text."""
    source = 0.45 + 0.1 * pictures(1)[0].double()
    made = guidance("Make it sepia", "Make it night", rule="pds")
    sepia, night = (guidance(prompt).known_edit(source, 0) for prompt in ("Make it sepia", "Make it night"))
    torch.testing.assert_close(made.objective.expected(source, 0), (source + sepia - night).clamp(0, 1))
    assert guidance(rule="dreamcatalyst", source_prompt="a photo of a man").source_text is None
    with pytest.raises(PriorError, match="a photo of a man"):
        guidance(rule="dds", source_prompt="a photo of a man")


def test_nothing_is_expected_where_nothing_attracts_or_nothing_is_known(monkeypatch):
    source = pictures(1)[0]
    unstable = guidance(prior={"s": 0.4, "s_image": 0.05})
    assert unstable.objective.expected(source, 0) is None and unstable.known_edit(source, 0) is not None
    assert guidance(rule="known-edit").objective.expected(source, 0) is None
    made = guidance()
    monkeypatch.setattr(ClosedForm, "exact", False)
    assert made.objective.expected(source, 0) is None and made.known_edit(source, 0) is None


@pytest.mark.parametrize("scale", [1.0, 3.0, 7.5])
def test_the_priors_own_edit_is_the_known_one(scale):
    made, source = guidance(guidance_scale=scale), pictures(1)[0]
    sample = made.sample(source, 0, "Make it sunset", scale, 20)
    assert sample.shape == source.shape
    assert (sample - made.known_edit(source, 0)).square().mean().sqrt() < 0.01
    night = made.sample(source, 0, "Make it night", scale, 20)
    assert (night - guidance("Make it night").known_edit(source, 0)).square().mean().sqrt() < 0.01


@pytest.mark.parametrize(
    "options, message",
    [
        ({"rule": "dreamcatalist"}, "system.guidance.rule: .* mean 'dreamcatalyst'"),
        ({"prior_type": "ip2"}, "system.guidance.prior_type: .* mean 'ip2p'"),
        ({"prior": {"s_imag": 1.0}}, "system.guidance.prior: .* mean 's_image'"),
        ({"timesteps": "decresing"}, "system.guidance.timesteps: .* mean 'decreasing'"),
        ({"reduction": "meen"}, "system.guidance.reduction: .* mean 'mean'"),
        ({"min_step_percent": 0.95}, "min_step_percent 0.95 and max_step_percent 0.9"),
        ({"prompt": "Make it sunst"}, "prompt_processor.prompt: .* mean 'sunset'"),
        ({"chi": 100.0}, "s_image: no spread brings the rule 'dreamcatalyst'"),
        ({"rule": "pds", "timesteps": "decreasing-full"}, "at timestep 0 .* PDS .*raise min_step_percent"),
    ],
)
def test_mistakes_are_found_before_a_scene_is_loaded(options, message):
    with pytest.raises(DreamCatalystError, match=message):
        guidance(**options)


def test_every_rule_that_needs_an_image_refuses_a_text_to_image_prior(monkeypatch):
    monkeypatch.setattr(ClosedForm, "takes_image", False)
    for name in RULES.names():
        if get_rule(name).needs_image:
            with pytest.raises((PriorError, ConfigError), match=name):
                guidance(rule=name)
