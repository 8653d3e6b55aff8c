"""What every diffusion prior keeps to, whichever it is; a newcomer is picked up by its registered name."""

import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.diffusion.api import PRIORS, Prior, Row

from tests.diffusion.small_model import make_model

PROMPT = "Make it sunset"  # known to all of them


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("folders")
    return {"ip2p": make_model(root / "ip2p"), "sd": make_model(root / "sd", channels=4)}


@pytest.fixture(params=PRIORS.names())
def prior(request, folders) -> Prior:
    cls = PRIORS.get(request.param)
    options = {"path": str(folders[request.param])} if request.param in folders else {"s_image": 5.0}
    return cls(parse(cls.Config, options), device="cpu")


@pytest.fixture
def images():
    return torch.rand(2, 3, 32, 24, generator=torch.Generator().manual_seed(0))


def condition_of(prior, images):
    """The condition of a batch; view by view, for a prior that must be told what each becomes."""
    if not prior.takes_truth:
        return prior.condition(images)
    prior.truth.image = lambda view: 1 - images[view].detach().permute(1, 2, 0)
    return prior.stack([prior.condition_of(image[None], view) for view, image in enumerate(images)])


def rows(prior, latents, condition) -> list[Row]:
    (text,) = prior.embed([PROMPT])
    if not prior.takes_image:
        return [Row(latents, text), Row(latents)]
    return [Row(latents, text, condition), Row(latents, None, condition), Row(latents)]


def test_schedule_is_one(prior):
    abar = prior.alphas_cumprod
    assert abar.dtype == torch.float64 and abar.device.type == "cpu"
    assert (abar > 0).all() and (abar <= 1).all() and (abar[1:] < abar[:-1]).all()


def test_latents_come_back_as_images(prior, images):
    latents = prior.encode(images)
    decoded = prior.decode(latents)
    assert latents.shape[0] == 2 and decoded.shape[:2] == (2, 3)
    assert decoded.shape[-2] >= 32 and decoded.shape[-1] >= 24
    assert decoded.min() >= 0 and decoded.max() <= 1 and not decoded.requires_grad


def test_the_gradient_returns_through_the_encoder_alone(prior, images):
    images.requires_grad_()
    latents = prior.encode(images)
    condition = condition_of(prior, images)
    for prediction in prior.predict_noise(rows(prior, latents, condition), 400):
        assert prediction.shape == latents.shape and not prediction.requires_grad
        assert torch.isfinite(prediction).all()
    latents.sum().backward()
    assert images.grad.abs().sum() > 0


def test_one_call_is_its_rows(prior, images):
    latents, condition = prior.encode(images).detach(), condition_of(prior, images)
    together = prior.predict_noise(rows(prior, latents, condition), 400)
    for row, prediction in zip(rows(prior, latents, condition), together, strict=True):
        torch.testing.assert_close(prior.predict_noise([row], 400)[0], prediction, rtol=1e-4, atol=1e-4)


def test_stacked_conditions_are_those_of_the_batch(prior, images):
    if prior.takes_truth:
        pytest.skip("its conditions are of single views, which tests/diffusion/test_world_truth.py stacks")
    latents = prior.encode(images).detach()
    stacked = prior.stack([prior.condition(images[:1]), prior.condition(images[1:])])
    whole = prior.predict_noise(rows(prior, latents, prior.condition(images)), 400)
    for one, other in zip(prior.predict_noise(rows(prior, latents, stacked), 400), whole, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


def test_an_embedding_is_the_same_object_each_time(prior):
    assert prior.embed([PROMPT])[0] is prior.embed([PROMPT])[0]
