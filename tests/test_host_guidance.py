"""The guidances for the host's systems: every call form, whose text, which step, and what comes back."""

from __future__ import annotations

import re
from dataclasses import fields

import pytest
import torch
from dreamcatalyst import plugin
from dreamcatalyst.diffusion.api import Row
from dreamcatalyst.diffusion.noise import stable_diffusion_schedule
from dreamcatalyst.errors import ConfigError, PriorError
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.guidance import Guidance
from dreamcatalyst.guidance.timesteps import Schedule
from dreamcatalyst.host.config import ALIASES, WITHOUT_EFFECT, HostConfig, prior_options
from dreamcatalyst.host.guidance import content_key
from omegaconf import OmegaConf

from tests.diffusion.small_model import make_model

WORDS = "Make it sunset"
STEADY = {"s_image": 0.05}  # a closed-form prior on which the rules' samplers converge, at any scales
T = len(stable_diffusion_schedule())


def made(kind: str, **cfg):
    """The guidance `dreamcatalyst-<kind>` on the closed-form prior, as the host builds it from its YAML."""
    base = {"prior_type": "closed-form", "prompt": WORDS, "max_steps": 10}
    return plugin.find(f"dreamcatalyst-{kind}")(OmegaConf.create({**base, **cfg}))


def picture(height=8, width=8, seed=0, batch=1):
    return torch.rand(batch, height, width, 3, generator=torch.Generator().manual_seed(seed))


class Processor:
    """What a prompt processor of the host returns: text rows first, then rows without text."""

    def __init__(self, width=32, seed=0, prompt=WORDS):
        rows = torch.randn(2, 77, width, generator=torch.Generator().manual_seed(seed))
        self.text, self.null, self.prompt, self.asked = rows[:1], rows[1:], prompt, []

    def get_text_embeddings(self, elevation, azimuth, camera_distances, view_dependent_prompting=True):
        self.asked.append(view_dependent_prompting)
        n = len(elevation)
        return torch.cat([self.text.expand(n, -1, -1), self.null.expand(n, -1, -1)])


BATCH = {  # what comes with a batch of random cameras
    "elevation": torch.tensor([10.0]),
    "azimuth": torch.tensor([30.0]),
    "camera_distances": torch.tensor([1.5]),
    "height": 8,
    "width": 8,
    "rays_o": torch.zeros(1, 8, 8, 3),
}


# --- the loss


def loss_of(guidance, rgb, *args, **batch):
    """(result, gradient of the loss in rgb)."""
    rgb = rgb.clone().requires_grad_()
    out = guidance(rgb, *args, **batch)
    (gradient,) = torch.autograd.grad(out["loss_sds"], rgb)
    return out, gradient


def test_all_call_forms_give_the_same_loss():
    rgb, source = picture(seed=1), picture()
    ways = {
        "condition image": (source, Processor()),
        "batch": (Processor(),),
        "origin, target, source": (source, Processor(), Processor(seed=1)),
    }
    results = []
    for name, args in ways.items():
        batch = {**BATCH, "gt_rgb": source, "index": 3, "rgb_as_latents": False} if name == "batch" else {}
        results.append(loss_of(made("guidance"), rgb, *args, **batch))
    for out, gradient in results:
        assert torch.equal(gradient, results[0][1]) and gradient.any()
        assert (out["min_step"], out["max_step"]) == (200, 900)
        assert set(out) == {"loss_sds", "grad_norm", "min_step", "max_step"} and out["loss_sds"].ndim == 0


def test_the_loss_is_that_of_our_own_system_with_the_hosts_reduction():
    rgb, source = picture(seed=1), picture()
    guidance = made("guidance")
    guidance.update_step(0, 4)
    out, gradient = loss_of(guidance, rgb, source, Processor())
    ours = Guidance(GuidanceConfig(reduction="sum"), WORDS)
    x = rgb.clone().requires_grad_()
    step = ours.step(x, source, [content_key(source[0])], 4, 10)
    step.loss.backward()
    assert torch.equal(gradient, x.grad) and torch.equal(out["loss_sds"], step.loss)
    assert out["grad_norm"] == step.gradient.norm()
    # the gradient on the latents 2 rgb - 1 is the rule's own
    torch.testing.assert_close(gradient, 2 * step.gradient.permute(0, 2, 3, 1))


def test_the_name_of_the_loss_is_a_setting():
    assert "loss_dds" in made("guidance", loss_name="dds")(picture(), picture(), Processor())


def test_steps_are_those_that_the_host_announces_however_often_it_is_called():
    wanted = [Schedule().timestep(step, 10, stable_diffusion_schedule()) for step in range(10)]
    guidance, seen = made("guidance"), []
    rgb, source = picture(seed=1), picture()
    guidance(rgb, source, Processor())
    ask = guidance._guidance.step
    guidance._guidance.step = lambda *args: (given := ask(*args), seen.append(given.timestep))[0]
    for step in range(10):
        for _ in range(2):
            guidance.update_step(0, step)
            guidance(rgb, source, Processor())
    assert seen == [t for t in wanted for _ in range(2)]


def test_a_decreasing_schedule_needs_the_length_of_the_run():
    with pytest.raises(ConfigError, match=r"system.guidance.max_steps=\$\{trainer.max_steps\}"):
        made("guidance", max_steps=None)
    made("guidance", max_steps=None, max_iteration=1500)
    made("guidance", max_steps=None, rule="dds")  # draws its timesteps
    made("edit-guidance", max_steps=None, prior=STEADY)  # goes through them at every call


def test_limits_may_follow_the_hosts_schedules():
    guidance = made("guidance", rule="dds", max_step_percent=[0, 0.98, 0.5, 10], min_step_percent=0.02)
    for step, highest in ((0, 980), (5, 740), (10, 500)):
        guidance.update_step(0, step)
        assert guidance(picture(), picture(1), Processor())["max_step"] == highest
    guidance.set_min_max_steps(0.1, 0.3)
    out = guidance(picture(), picture(1), Processor())
    assert (out["min_step"], out["max_step"]) == (100, 300)


# --- the source image


def test_without_a_source_image_the_error_says_what_to_do():
    with pytest.raises(ConfigError, match="multiview-camera-datamodule.*references.*prior_type=sd"):
        made("guidance")(picture(), Processor(), **BATCH, rgb_as_latents=False)


def test_references_are_found_by_the_views_index(tmp_path):
    from PIL import Image

    stored = [(picture(seed=seed)[0] * 255).round().to(torch.uint8) for seed in (5, 6)]
    for i, image in enumerate(stored):
        Image.fromarray(image.numpy()).save(tmp_path / f"{i:03d}.png")
    rgb, wanted = picture(seed=1), stored[1][None].float() / 255
    for index in (1, torch.tensor([1])):
        got = loss_of(made("guidance", references=str(tmp_path)), rgb, Processor(), **BATCH, index=index)
        assert torch.equal(got[1], loss_of(made("guidance"), rgb, wanted, Processor())[1])
    with pytest.raises(ConfigError, match="holds 2 images, and that of view 7"):
        made("guidance", references=str(tmp_path))(rgb, Processor(), **BATCH, index=7)


@pytest.mark.parametrize("flag", ["rgb_as_latents", "guidance_eval", "test_info"])
def test_what_cannot_be_given_is_refused(flag):
    with pytest.raises(ConfigError, match=flag):
        made("guidance")(picture(), picture(), Processor(), **{flag: True})


# --- edited images


def test_edits_have_the_size_of_the_render_and_no_graph():
    short = {"diffusion_steps": 2, "prior": STEADY}
    edits = made("edit-guidance", **short)
    for height, width, options in ((8, 8, {}), (13, 7, {}), (13, 7, {"fixed_size": 8})):
        rgb = picture(height, width).requires_grad_()
        out = made("edit-guidance", **short, **options)(rgb, picture(16, 8), Processor())
        assert set(out) == {"edit_images"} and out["edit_images"].shape == rgb.shape
        assert not out["edit_images"].requires_grad and 0 <= out["edit_images"].min() <= out["edit_images"].max() <= 1
    batch = edits(picture(batch=3), picture(batch=3), Processor())["edit_images"]
    assert batch.shape == (3, 8, 8, 3)


def test_the_sampled_edit_comes_to_the_edit_that_is_known():
    """At scale 1 every step's fixed point is T(I), and its factor s^2 abar / (s^2 abar + 1 - abar) is small."""
    source = picture()
    guidance = made("edit-guidance", rule="dds", guidance_scale=1.0, condition_scale=1.0, prior=STEADY)
    edited = guidance(picture(seed=1), source, Processor())["edit_images"][0]
    known = guidance._guidance.known_edit(source[0], content_key(source[0]))
    torch.testing.assert_close(edited, known, rtol=0, atol=1e-4)


@pytest.mark.parametrize("rule, left", [("dreamcatalyst", 0.25), ("dds", 0.01), ("pds", 0.6), ("sds", 0.1)])
def test_a_sampler_that_diverges_is_refused_with_the_remedy_and_the_remedy_works(rule, left):
    """On the closed form the factor of a step is known: close to 1 - w_y at the spreads that make w_y 7.5 right.
    An identity term keeps a part of the way, at low noise the more."""
    with pytest.raises(ConfigError, match=rf"'{rule}' .* diverge. Set guidance_scale and condition_scale to 1 and .*s"):
        made("edit-guidance", rule=rule)
    steady = {"guidance_scale": 1.0, "condition_scale": 1.0, "prior": STEADY}
    with pytest.raises(ConfigError, match="lower max_step_percent"):  # a quarter of a makes b / a four times as large
        made("edit-guidance", preset="published-3dgs", **steady)
    made("edit-guidance", preset="published-3dgs", max_step_percent=0.5, **steady)
    source = picture()
    edited = made("edit-guidance", rule=rule, **steady)(picture(seed=1), source, Processor())["edit_images"]
    known = Guidance(GuidanceConfig(rule="known-edit"), WORDS).known_edit(source[0], 0)
    assert (edited[0] - known).square().mean().sqrt() < left * (source[0] - known).square().mean().sqrt()


def test_in2n_edits_the_render_and_known_edit_is_what_the_prior_knows():
    rgb, source = picture(seed=1), picture()
    ours = Guidance(GuidanceConfig(rule="in2n", diffusion_steps=3), WORDS)
    wanted = ours.objective.picture(rgb[0], source[0], content_key(source[0]), 6)
    guidance = made("edit-guidance", rule="in2n", diffusion_steps=3)
    guidance.update_step(0, 6)
    assert torch.equal(guidance(rgb, source, Processor())["edit_images"][0], wanted)
    known = made("edit-guidance", rule="known-edit")(rgb, source, Processor())["edit_images"][0]
    assert torch.equal(known, ours.known_edit(source[0], content_key(source[0])))


# --- text


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    return {"ip2p": str(make_model(root / "ip2p")), "sd": str(make_model(root / "sd", channels=4))}


def learned(kind, path, prior_type="ip2p", **cfg):
    options = {"prior_type": prior_type, "prior": {"path": path}, "max_steps": 10, "rule": "dds", **cfg}
    return plugin.find(f"dreamcatalyst-{kind}")(OmegaConf.create(options))


def test_text_is_the_hosts_text_first_and_then_its_null_rows(models):
    target, source_text = Processor(), Processor(seed=1)
    guidance = learned("guidance", models["ip2p"])
    guidance(picture(16, 16), picture(16, 16, 1), target, source_text)
    inner = guidance._guidance
    assert torch.equal(inner.text, target.text) and torch.equal(inner.source_text, source_text.text)
    assert torch.equal(inner.prior.null_text, target.null) and target.asked == [False]
    noisy = torch.randn(1, 4, 2, 2)
    rows = [Row(noisy), Row(noisy, target.null)]
    without, with_null = inner.prior.predict_noise(rows, 500)
    torch.testing.assert_close(without, with_null, rtol=1e-5, atol=1e-6)


def test_the_source_text_is_the_second_processors_on_every_prior():
    rgb, source, night = picture(seed=1), picture(), Processor(prompt="Make it night")
    guidance = made("guidance", rule="dds", prompt="")
    guidance(rgb, source, Processor(), night)
    ours = Guidance(GuidanceConfig(rule="dds"), WORDS, "Make it night")
    assert (guidance._guidance.text, guidance._guidance.source_text) == (ours.text, ours.source_text)
    unasked = made("guidance", prompt="")  # dreamcatalyst compares with no text
    unasked(rgb, source, Processor(), Processor(prompt="a photo of a man"))
    assert unasked._guidance.source_text is None


def test_texts_of_the_viewing_angles_are_asked_for_where_that_is_set(models):
    processor = Processor()
    guidance = learned("guidance", models["sd"], "sd", rule="sds", view_dependent_prompting=True)
    guidance(picture(16, 16), processor, **BATCH)
    assert processor.asked == [True]


def test_words_of_ones_own_go_through_the_priors_text_encoder(models):
    processor = Processor(width=48)
    guidance = learned("guidance", models["ip2p"], prompt="make it snow", source_prompt="photo of the fox")
    guidance(picture(16, 16), picture(16, 16, 1), processor)
    inner = guidance._guidance
    assert torch.equal(inner.text, inner.prior.embed(["make it snow"])[0]) and not processor.asked
    assert torch.equal(inner.source_text, inner.prior.embed(["photo of the fox"])[0])


def test_text_of_another_width_is_refused_with_the_remedy(models):
    with pytest.raises(ConfigError, match="width 1024.*takes 32.*pretrained_model_name_or_path"):
        learned("guidance", models["ip2p"])(picture(16, 16), picture(16, 16, 1), Processor(width=1024))
    with pytest.raises(ConfigError, match="system.guidance.prompt"):
        learned("guidance", models["ip2p"])(picture(16, 16), picture(16, 16, 1))


def test_a_text_to_image_prior_needs_no_source_image(models):
    guidance = learned("guidance", models["sd"], "sd", rule="sds", fixed_size=32)
    _, gradient = loss_of(guidance, picture(12, 12), Processor(), **BATCH, rgb_as_latents=False)
    assert gradient.shape == (1, 12, 12, 3) and gradient.any()
    with pytest.raises(ConfigError, match="passes none"):
        learned("guidance", models["sd"], "sd", rule="dds")(picture(16, 16), Processor(), **BATCH)
    with pytest.raises(PriorError, match="rule 'dreamcatalyst'"):
        learned("guidance", models["sd"], "sd", rule="dreamcatalyst")(picture(16, 16), picture(16, 16), Processor())


def test_an_edit_runs_on_a_learned_prior_at_a_size_that_is_no_multiple_of_eight(models):
    guidance = learned("edit-guidance", models["ip2p"], rule="dreamcatalyst", diffusion_steps=2)
    assert guidance(picture(19, 21), picture(19, 21, 1), Processor())["edit_images"].shape == (1, 19, 21, 3)


# --- the config


def test_our_own_keys_are_all_there_with_our_defaults_but_for_two():
    hosted = {f.name: f.default for f in fields(HostConfig)}
    differing = {f.name for f in fields(GuidanceConfig) if hosted[f.name] != f.default}
    assert differing == {"prior_type", "reduction"}


def test_the_keys_of_the_guidance_that_stood_there_are_taken(models):
    stood_there = {
        "dreamfusion": {"pretrained_model_name_or_path": "a/b", "weighting_strategy": "sds", "guidance_scale": 100.0},
        "instructpix2pix": {"min_step_percent": 0.02, "max_step_percent": 0.98, "use_sds": False},
        "control4d": {"control_type": "normal", "condition_scale": 1.0, "fixed_size": 512},
        "dreamcatalyst": {"max_iteration": 1500, "chi": 0.075, "delta": 0.05, "gamma": 0.2, "use_dds": True},
    }
    for keys in stood_there.values():
        for kind in ("guidance", "edit-guidance"):
            made(kind, **{"rule": "dds", "prior": STEADY, **keys})
    every = dict.fromkeys(WITHOUT_EFFECT, True)
    assert made("guidance", **every).settings() == made("guidance").settings()


@pytest.mark.parametrize("kind", ["guidance", "edit-guidance"])
@pytest.mark.parametrize(
    "wrong, line",
    [
        ({"guidence_scale": 5}, "system.guidance: unknown key 'guidence_scale'. Did you mean 'guidance_scale'?"),
        ({"prior": {"s_imge": 0.1}}, "system.guidance.prior: unknown key 's_imge'. Did you mean 's_image'?"),
        ({"guidance_scale": [1, 2]}, "system.guidance.guidance_scale: got [1, 2] (list), expected float."),
        ({"max_steps": "many"}, "system.guidance.max_steps: got 'many' (str), expected int."),
        ({"max_step_percent": [0.9, 0.5]}, "system.guidance.max_step_percent: a schedule of 2 numbers"),
        (
            {"max_step_percent": [0.9, 1.5, 1000]},
            "max_step_percent: got 1.5 in [0.9, 1.5, 1000]",
        ),  # not only at step 1000
        ({"references": "nowhere"}, "system.guidance.references: 'nowhere' is no folder"),
    ],
)
def test_a_wrong_key_or_value_is_found_when_the_host_builds_it(kind, wrong, line):
    with pytest.raises(ConfigError, match=re.escape(line)):
        made(kind, **wrong)


def test_every_key_of_the_host_is_a_field_and_none_stands_in_two_tables():
    names = {f.name for f in fields(HostConfig)}
    ours = {f.name for f in fields(GuidanceConfig)}
    assert {*ALIASES, *WITHOUT_EFFECT, *ours} <= names
    assert not set(ALIASES) & set(WITHOUT_EFFECT) and not ours & {*ALIASES, *WITHOUT_EFFECT}


def test_which_guidance_fits_which_system_is_said_by_the_one_that_does_not():
    """A system takes the keys that it needs from the answer."""
    answer = made("guidance")(picture(), picture(), Processor())
    with pytest.raises(ConfigError, match="asks for edit_images, got loss_sds.*-edit-guidance gives edit_images"):
        answer["edit_images"]
    with pytest.raises(ConfigError, match="loss_name: this system asks for loss_dds, got loss_sds. Set it to dds"):
        answer["loss_dds"]
    edits = made("edit-guidance", prior=STEADY, diffusion_steps=2)
    with pytest.raises(ConfigError, match="asks for loss_sds, got edit_images.* dreamcatalyst-guidance gives a loss"):
        edits(picture(), picture(), Processor())["loss_sds"]
    # A system that only goes through what it gets would train on without any loss of ours.
    with pytest.raises(ConfigError, match="asks for a loss, got dreamcatalyst-edit-guidance"):
        edits(picture(), Processor(), **BATCH, gt_rgb=picture(), rgb_as_latents=False)
    with pytest.raises(ConfigError, match="max_steps.*dreamcatalyst-edit-guidance gives edit_images"):
        made("guidance", max_steps=None)  # as where it stands in the place of a guidance that edits


def test_the_hosts_names_for_the_priors_options():
    said = HostConfig(
        prior_type="ip2p", ip2p_name_or_path="a/b", half_precision_weights=True, freeu_b1=1.2,
        enable_sequential_cpu_offload=True, enable_channels_last_format=True, prior={"offload": False},
    )  # fmt: skip
    assert prior_options(OmegaConf.structured(said)) == {
        "path": "a/b", "dtype": "fp16", "offload": False, "channels_last": True, "freeu": {"mode": "paper", "b1": 1.2},
    }  # fmt: skip
    assert prior_options(OmegaConf.structured(HostConfig())) == {}


@pytest.mark.parametrize("wrong", [{"rule": "dreamcatalist"}, {"timesteps": "uniforn"}, {"preset": "papers"}])
def test_a_wrong_name_is_found_when_the_host_builds_it(wrong):
    with pytest.raises(ConfigError, match="Did you mean"):
        made("guidance", **wrong)


@pytest.mark.parametrize("kind", ["guidance", "edit-guidance"])
def test_a_prior_that_will_not_do_is_found_when_the_host_builds_it(models, tmp_path, kind):
    """Not at the first edit, which in the host's systems may be hundreds of steps away."""
    with pytest.raises(PriorError, match="no such folder. Give a folder"):
        learned(kind, str(tmp_path / "nowhere"))
    with pytest.raises(PriorError, match="rule 'dreamcatalyst'"):
        learned(kind, models["sd"], "sd", rule="dreamcatalyst")
