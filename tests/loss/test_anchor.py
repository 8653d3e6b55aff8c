"""The anchor's pull in both forms, against the published formula written out and against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.loss.anchor import AnchorConfig, anchor_loss, anchor_step
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.trainable import Splats

ON = dict(kind="source", form="loss", lambda_color=5.0, weight_init_g0=0.5, weight_init=0.1, weight_multiplier=2.0)


def moved(n: int = 4, sh_degree: int = 1, editable: torch.Tensor | None = None, **options):
    """Splats in float64 with two generations, away from their anchors: (splats, generations, config)."""
    g = torch.Generator().manual_seed(0)
    scene = Gaussians.from_colors(
        torch.randn(n, 3, generator=g),
        torch.rand(n, 3, generator=g) + 0.1,
        torch.rand(n, 3, generator=g),
        torch.rand(n, generator=g) * 0.8 + 0.1,
        sh_degree=sh_degree,
    ).to(dtype=torch.float64)
    config = AnchorConfig(**{**ON, **options})
    splats, generations = Splats(scene, editable=editable), config.generations()
    if generations is not None:
        generations.begin(splats)
        for _ in range(2):
            generations.advance(splats)
        splats.state["generation"][1::2] = 1
    with torch.no_grad():
        for value in splats.parameters.values():
            value += torch.randn(value.shape, generator=g, dtype=torch.float64)
    return splats, generations, config


def test_the_loss_is_the_published_sum_of_means():
    splats, generations, config = moved(lambda_color=2.0, lambda_geo=3.0, lambda_opacity=5.0, lambda_scale=7.0)
    lambdas = dict(means=3, quats=3, log_scales=7, logit_opacities=5, sh0=2, shN=2)
    assert generations.weights == [2.0, 0.1, 0.0]
    expected = 0.0
    for name, strength in lambdas.items():
        terms = []
        for row in range(4):
            for a, b in zip(
                splats.parameters[name][row].reshape(-1).tolist(),
                splats.state[f"anchor_{name}"][row].reshape(-1).tolist(),
                strict=True,
            ):
                terms.append([2.0, 0.1][row % 2] * (a - b) ** 2)
        expected += strength * sum(terms) / len(terms)
    loss = anchor_loss(splats, generations, config)
    assert loss.item() == pytest.approx(expected, rel=1e-12)
    loss.backward()
    offset = splats.parameters["means"].detach() - splats.state["anchor_means"]
    weight = torch.tensor([2.0, 0.1, 2.0, 0.1], dtype=torch.float64)[:, None]
    torch.testing.assert_close(splats.parameters["means"].grad, 3 * 2 * weight * offset / 12)


def test_scenes_without_higher_harmonics_have_a_finite_loss():
    splats, generations, config = moved(sh_degree=0)
    loss = anchor_loss(splats, generations, config)
    loss.backward()
    assert loss > 0 and all(torch.isfinite(value.grad).all() for value in splats.parameters.values() if value.numel())


@pytest.mark.parametrize(
    "options",
    [
        dict(editable=torch.zeros(4, dtype=torch.bool)),
        dict(kind="none"),
        dict(weight_init_g0=0.0, weight_init=0.0),
        dict(lambda_color=0.0, lambda_geo=0.0, lambda_opacity=0.0, lambda_scale=0.0),
        dict(form="proximal"),
    ],
    ids=["no editable splats", "no anchor", "no weights", "no lambdas", "the other form"],
)
def test_where_nothing_weighs_the_loss_is_zero_without_a_graph(options):
    splats, generations, config = moved(**options)
    loss = anchor_loss(splats, generations, config)
    assert loss.item() == 0 and loss.shape == () and not loss.requires_grad


def test_generations_without_splats_and_newborn_ones_add_nothing():
    splats, generations, config = moved(weight_init_g0=0.0)
    splats.state["generation"][:] = 2  # generation 1, which has a weight, is left empty; 2 was just born
    assert generations.weights == [0.0, 0.1, 0.0]
    loss = anchor_loss(splats, generations, config)
    assert loss.item() == 0 and not loss.requires_grad
    before = splats.scene.detach().clone()
    anchor_step(splats, generations, AnchorConfig(**{**ON, "form": "proximal"}))
    assert all(torch.equal(splats.parameters[name], getattr(before, name)) for name in PARAMETERS)


def test_no_more_anchors_than_lambdas_ask_for():
    splats, generations, _ = moved(lambda_color=0.0, lambda_opacity=0.0)
    assert set(splats.state) == {"generation", "anchor_means", "anchor_quats", "anchor_log_scales"}
    assert moved(kind="none")[1] is None and not moved(kind="none")[0].state
    assert moved(weight_init_g0=0.0, weight_init=0.0)[1] is None  # as in the published deletions


def test_the_proximal_step_is_its_formula():
    splats, generations, config = moved(form="proximal", lambda_geo=3.0, proximal_rate=0.25)
    before = splats.scene.detach().clone()
    anchor_step(splats, generations, config)
    cw = 0.25 * 3 * torch.tensor([2.0, 0.1, 2.0, 0.1], dtype=torch.float64)[:, None]
    for name in ("means", "quats"):
        expected = (getattr(before, name) + cw * splats.state[f"anchor_{name}"]) / (1 + cw)
        torch.testing.assert_close(splats.parameters[name].detach(), expected, rtol=1e-12, atol=1e-12)
    offset = (before.logit_opacities - splats.state["anchor_logit_opacities"]) / (1 + 0.25 * 5 * 2.0)
    torch.testing.assert_close(
        splats.parameters["logit_opacities"][::2].detach(), (splats.state["anchor_logit_opacities"] + offset)[::2]
    )


def test_the_proximal_step_minimises_what_it_says():
    """a' minimises |a' - a|^2 + c w |a' - anchor|^2: its gradient there is zero."""
    splats, generations, config = moved(form="proximal", proximal_rate=0.1)
    start = splats.parameters["quats"].detach().clone()
    anchor_step(splats, generations, config)
    end, anchor = splats.parameters["quats"].detach(), splats.state["anchor_quats"]
    cw = 0.1 * 5 * generations.weight_of(splats)[:, None]
    torch.testing.assert_close((end - start) + cw * (end - anchor), torch.zeros_like(end), rtol=0, atol=1e-12)


def test_offsets_halve_and_stop_as_the_docstring_says():
    """Alone, an offset halves in ln 2 / ln(1 + c w) steps; under a push of lr per step it ends at lr / (c w)."""
    splats, generations, config = moved(n=1, form="proximal", proximal_rate=1e-3, lambda_geo=5.0)
    cw = 1e-3 * 5 * 2.0

    def offset() -> torch.Tensor:
        return splats.parameters["means"].detach() - splats.state["anchor_means"]

    start = offset()
    steps = round(math.log(2) / math.log1p(cw))
    for _ in range(steps):
        anchor_step(splats, generations, config)
    torch.testing.assert_close(offset(), start / 2, rtol=5e-3, atol=0)
    for _ in range(3000):
        with torch.no_grad():
            splats.parameters["means"] += 0.02
        anchor_step(splats, generations, config)
    torch.testing.assert_close(offset(), torch.full_like(start, 0.02 / cw))


def test_frozen_splats_are_not_pulled():
    splats, generations, config = moved(editable=torch.tensor([True, False, True, False]), form="proximal")
    frozen = splats.frozen.clone()
    anchor_step(splats, generations, config)
    assert all(torch.equal(getattr(splats.frozen, name), getattr(frozen, name)) for name in PARAMETERS)


def test_the_config_is_checked():
    assert parse(AnchorConfig, {"kind": "source", "lambda_geo": 50}, "system.anchor").lambdas["quats"] == 50
    for options, message in [
        ({"kind": "sauce"}, "unknown anchor 'sauce'. Did you mean 'source'"),
        ({"form": "proximate"}, "Did you mean 'proximal'"),
        ({"lambda_geo": -1.0}, "lambda_geo: got -1.0"),
        ({"weight_init": 11.0}, "weight_init: got 11.0, expected max_weight"),
        ({"proximal_rate": math.nan}, "proximal_rate: got nan"),
    ]:
        with pytest.raises(ConfigError, match=message):
            parse(AnchorConfig, options)
