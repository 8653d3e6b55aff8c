"""Whole edit runs on small models in the real folder layout, at sides that are no multiple of 8."""

from __future__ import annotations

import pytest
import torch
from diffusers import UNet2DConditionModel
from dreamcatalyst.scene.ply import read_ply

from tests.diffusion.small_model import make_model

pytestmark = pytest.mark.usefixtures("one_thread")
ODD = ["data.width=27", "data.height=21", "data.max_view_num=3", "system.report.views=1", "system.report.every=0"]
WORDS = ["system.prompt_processor.prompt=make it snow"]
EVERY_PARAMETER = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    return {"ip2p": make_model(root / "ip2p"), "sd": make_model(root / "sd", channels=4)}


def on(models, prior_type, rule, *more):
    options = [f"system.guidance.prior_type={prior_type}", f"system.guidance.prior={{path: {models[prior_type]}}}"]
    return [*options, f"system.guidance.rule={rule}", "system.guidance.noise=independent", *WORDS, *ODD, *more]


@pytest.fixture
def calls(monkeypatch):
    """(images, whether autograd was on) of every call of any U-Net."""
    seen, forward = [], UNet2DConditionModel.forward

    def noted(self, sample, *args, **kwargs):
        seen.append((len(sample), torch.is_grad_enabled() or sample.requires_grad))
        return forward(self, sample, *args, **kwargs)

    monkeypatch.setattr(UNet2DConditionModel, "forward", noted)
    return seen


@pytest.mark.parametrize(
    "prior_type, rule, more, wanted",
    [
        ("ip2p", "sds", [], [3, 3]),
        ("ip2p", "dreamcatalyst", [], [5, 5]),
        ("ip2p", "dreamcatalyst", ["system.guidance.condition_scale=1"], [3, 3]),
        ("ip2p", "csd-like", [], [2, 2]),
        ("ip2p", "dds", [], [5, 5]),
        ("ip2p", "pds", ["system.prompt_processor.source_prompt=photo of the fox"], [6, 6]),
        ("ip2p", "dreamcatalyst", ["system.guidance.delta=0", "system.guidance.gamma=0"], []),
        ("ip2p", "dreamcatalyst", ["system.guidance.prior.max_rows=4", "data.batch_size=2"], [4, 4, 2] * 2),
        ("ip2p", "dreamcatalyst", ["system.guidance.noise=paired"], [10, 10]),
        ("sd", "pds", ["system.prompt_processor.source_prompt=photo of the fox"], [4, 4]),
        ("sd", "dds", [], [3, 3]),
    ],
)
def test_the_unet_sees_only_rows_that_matter_and_never_a_graph(launch, models, calls, prior_type, rule, more, wanted):
    trial = launch("closed-form.yaml", "trainer.max_steps=2", *on(models, prior_type, rule, *more))
    assert calls == [(images, False) for images in wanted]
    assert read_ply(trial / "save" / "last.ply").sh0.isfinite().all()


@pytest.mark.parametrize("rule, latents", [("dreamcatalyst", "mode"), ("sds", "sample"), ("in2n", "mode")])
def test_a_resumed_run_on_a_learned_prior_has_the_bits_of_an_uninterrupted_one(launch, models, rule, latents):
    more = [f"system.guidance.prior.latents={latents}", "system.guidance.diffusion_steps=2", "trainer.max_steps=6"]
    options = on(models, "ip2p", rule, *more, "checkpoint.every_n_train_steps=4")
    whole = launch("closed-form.yaml", *options, name="whole")
    (checkpoint,) = (whole / "ckpts").glob("*step=4.ckpt")
    kept = whole.parents[1] / "resumed" / "trial" / "ckpts" / checkpoint.name
    kept.parent.mkdir(parents=True)
    kept.write_bytes(checkpoint.read_bytes())
    resumed = launch("closed-form.yaml", *options, f"resume={kept}", name="resumed")
    one, other = (read_ply(trial / "save" / "last.ply") for trial in (whole, resumed))
    assert not torch.equal(one.sh0, read_ply(whole / "save" / "source.ply").sh0)
    for name in EVERY_PARAMETER:
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_a_prior_that_will_not_do_is_found_before_the_scene(launch, models, capsys):
    """The scene named here is not there either, and nobody has asked for it yet."""
    wrong = [("nowhere/at/all", "ip2p", "no such folder"), (models["ip2p"], "sd", "use prior 'ip2p'")]
    for path, prior_type, words in wrong:
        options = [f"system.guidance.prior={{path: {path}}}", f"system.guidance.prior_type={prior_type}", *WORDS]
        launch("closed-form.yaml", *options, "system.guidance.rule=sds", "system.gs_source=nowhere.ply", status=2)
        error = capsys.readouterr().err
        assert words in error and "nowhere.ply" not in error and "Traceback" not in error


def test_rules_of_the_image_row_refuse_a_text_to_image_model_by_name(launch, models, capsys):
    for rule in ("dreamcatalyst", "dreamcatalyst-psi2", "dreamcatalyst-psi3", "csd-like", "in2n"):
        launch("closed-form.yaml", *on(models, "sd", rule), "trainer.max_steps=1", status=2)
        assert f"rule '{rule}'" in capsys.readouterr().err


def test_a_checkpoint_of_a_fit_is_no_edit_to_go_on_from(launch, capsys):
    fit = launch("fit.yaml", "trainer.max_steps=1", name="fit")
    launch("closed-form.yaml", "trainer.max_steps=2", f"resume={fit / 'ckpts' / 'last.ckpt'}", status=2)
    error = capsys.readouterr().err
    assert "system_type was 'dreamcatalyst-fit-system'" in error and "system.gs_source" in error
    assert "Traceback" not in error
