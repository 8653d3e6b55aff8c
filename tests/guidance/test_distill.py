"""What surrounds the rules: calls of the prior, the loss, refusals."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm
from dreamcatalyst.errors import ConfigError, NumericalError, PriorError
from dreamcatalyst.guidance.distill import check_prior, distillation_gradient, distillation_loss
from dreamcatalyst.guidance.rules import get_rule


class Recording(ClosedForm):
    """Notes how many rows each call asks for, and whether anything could carry a graph into it."""

    def __init__(self, prior):
        super().__init__(prior.config)
        self.calls, self.graph = [], False

    def predict_noise(self, rows, timestep):
        self.calls.append(len(rows))
        self.graph |= torch.is_grad_enabled() or any(row.noisy.requires_grad for row in rows)
        return super().predict_noise(rows, timestep)


def gradient(world, prior, rule, **options):
    defaults = {"image": world.condition, "text": world.text, "timestep": 501, "noise": world.noise}
    x = options.pop("x", world.x)
    return distillation_gradient(prior, rule, x, options.pop("x_src", world.source), **{**defaults, **options})


@pytest.mark.parametrize(
    "name, rows, rows_without_image_guidance",
    [("sds", 3, 2), ("dds", 5, 3), ("pds", 5, 3), ("dreamcatalyst", 5, 3), ("csd-like", 2, 2)],
)
def test_rows_per_step(world, name, rows, rows_without_image_guidance):
    for w_i, expected in ((1.5, rows), (1.0, rows_without_image_guidance)):
        prior = Recording(world.prior)
        gradient(world, prior, get_rule(name), image_guidance_scale=w_i)
        assert prior.calls == [expected]


@pytest.mark.parametrize("name", ["dds", "pds"])
def test_rows_per_step_with_a_source_text(world, name):
    prior = Recording(world.prior)
    gradient(world, prior, get_rule(name), source_text=world.other)
    assert prior.calls == [6]


def test_a_step_without_editing_weight_does_not_call(world):
    prior = Recording(world.prior)
    g = gradient(world, prior, get_rule("dreamcatalyst", delta=0.0, gamma=0.0))
    assert prior.calls == [] and torch.allclose(g, 0.075 * 2.718281828459045**0.5 * (world.x - world.source))


def test_no_graph_reaches_the_prior(world):
    prior = Recording(world.prior)
    x = world.x.clone().requires_grad_()
    g = gradient(world, prior, get_rule("dreamcatalyst"), x=x)
    assert not g.requires_grad and not prior.graph


def test_a_batch_is_its_views(world):
    whole = gradient(world, world.prior, get_rule("dreamcatalyst"))
    for i in range(2):
        part = [tensor[i : i + 1] for tensor in (world.x, world.source, world.noise)]
        condition = world.prior.condition(world.images[i : i + 1])
        one = gradient(
            world, world.prior, get_rule("dreamcatalyst"), x=part[0], x_src=part[1], noise=part[2], image=condition
        )
        assert torch.allclose(one, whole[i : i + 1], rtol=0, atol=1e-12)


def test_half_precision_latents_give_a_float32_gradient(world):
    half = [tensor.half() for tensor in (world.x, world.source, world.noise)]
    g = gradient(world, world.prior, get_rule("dreamcatalyst"), x=half[0], x_src=half[1], noise=half[2])
    assert g.dtype == torch.float32


# --- the loss


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loss_has_the_gradient_of_the_rule(dtype):
    x = torch.randn(3, 4, 8, 8, dtype=dtype).requires_grad_()
    g = 1e-6 * torch.randn(3, 4, 8, 8, dtype=dtype)  # far below what x - (x - g) could keep in float32
    for reduction, count in (("mean", g.numel()), ("sum", 3)):
        loss = distillation_loss(x, g, reduction)
        assert torch.allclose(loss, 0.5 * g.square().sum() / count, rtol=1e-5)
        (got,) = torch.autograd.grad(loss, x)
        assert torch.allclose(got, g / count, rtol=1e-6, atol=0)


def test_loss_of_the_mean_does_not_depend_on_resolution():
    losses = [distillation_loss(torch.zeros(1, 4, n, n), torch.full((1, 4, n, n), 0.3)).item() for n in (8, 64)]
    assert losses[0] == pytest.approx(losses[1])


def test_unknown_reduction():
    with pytest.raises(ConfigError, match="mean, sum"):
        distillation_loss(torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1), "median")


# --- refusals


def test_numbers_that_are_not_finite_are_found_with_their_timestep(world):
    x = world.x.clone()
    x[0, 0, 0, 0] = float("nan")
    with pytest.raises(NumericalError, match="1 of 180 .* timestep 501"):
        gradient(world, world.prior, get_rule("dreamcatalyst"), x=x)


@pytest.mark.usefixtures("unchecked")
def test_shapes_must_agree(world):
    with pytest.raises(PriorError, match="noise"):
        gradient(world, world.prior, get_rule("dreamcatalyst"), noise=world.noise[:1])


@pytest.mark.parametrize("name", ["dds", "pds", "dreamcatalyst", "csd-like"])
def test_rules_that_compare_with_the_source_want_it(world, name):
    with pytest.raises(ConfigError, match=name):
        gradient(world, world.prior, get_rule(name), x_src=None)


def test_sds_runs_without_a_source(world):
    with_source = gradient(world, world.prior, get_rule("sds"))
    assert torch.equal(gradient(world, world.prior, get_rule("sds"), x_src=None), with_source)


@pytest.mark.parametrize("name", ["dreamcatalyst", "csd-like", "in2n"])
def test_rules_of_the_image_row_refuse_text_to_image_priors(world, name):
    world.prior.takes_image = False
    with pytest.raises(PriorError, match=name):
        check_prior(get_rule(name), world.prior)
    for other in ("sds", "dds", "pds"):
        check_prior(get_rule(other), world.prior)


def test_a_rule_is_a_frozen_row():
    with pytest.raises(dataclasses.FrozenInstanceError):
        get_rule("dds").name = "mine"
