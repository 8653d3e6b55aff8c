"""Relevance: the closed-form prior tells what it must be; any other prior takes the same way."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.diffusion.closed_form import noise_slope
from dreamcatalyst.errors import ConfigError, PriorError
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.guidance import Guidance
from dreamcatalyst.segment.api import MaskConfig, make_mask
from dreamcatalyst.segment.relevance import Answer, Relevance, normalised

from tests.diffusion.small_model import make_model


def test_it_is_the_edit_itself_for_a_prior_that_knows_it(disc_world):
    """Both predictions are linear in the noise, so that of a pair of signs k_s sqrt(abar) |T(I) - I| is left."""
    guidance, image = disc_world.request.guidance, disc_world.request.render(0).clamp(0, 1).double()
    options = Relevance(lowest=0.3, highest=0.9, timesteps=2, draws=1)
    answer = options.ask(guidance, image, 100, 1)
    found = answer.relevance
    edit = 2 * (guidance.known_edit(image, 100) - image).abs().mean(dim=-1)
    scale = 0.0
    for t in (round(0.3 * 999), round(0.9 * 999)):
        abar = float(guidance.prior.alphas_cumprod[t])
        scale += noise_slope(abar, guidance.prior.config.s) * abar**0.5 / 2
    torch.testing.assert_close(found.double(), scale * edit, rtol=1e-5, atol=1e-6)
    assert answer.noise.isnan().all()  # of one draw nothing is known of that
    twice = options.ask(guidance, image, 100, 2)
    assert twice.noise.max() < 1e-5 * twice.signal.max()  # this prior's predictions do not differ between draws


def test_signal_and_noise_are_told_apart():
    """Differences of 0.5 in all draws, with noise of 0.2 in each: 16 channels and 4 levels of a thousand pixels."""
    noise = 0.2 * torch.randn(4, 8, 16, 25, 40, generator=torch.Generator().manual_seed(0))
    nothing, something = Answer.of(noise), Answer.of(0.5 + noise)
    assert something.noise.mean() == pytest.approx(0.2, rel=0.02)
    assert something.signal.mean() == pytest.approx(0.5, rel=0.02)
    torch.testing.assert_close(nothing.noise, something.noise, atol=1e-5, rtol=0)
    assert nothing.signal.mean() < 0.02 < 0.15 < nothing.relevance.mean()


def test_unpaired_noise_leaves_its_own_magnitude(disc_world):
    image = disc_world.request.render(0).clamp(0, 1)
    paired = Relevance().ask(disc_world.request.guidance, image, 0, 2)
    plain = Relevance(noise="independent").ask(disc_world.request.guidance, image, 0, 2)
    assert plain.relevance.min() > paired.relevance.min() + 0.1


def test_outliers_are_clipped_at_the_fences():
    """0..100 evenly: quartiles 25 and 75, fences -50 and 150."""
    values = torch.arange(101.0)
    found = normalised({0: torch.cat([values, torch.tensor([1e6])])[None]})[0][0]
    most = 75.75 + 1.5 * 50.5  # of 102 values, numpy's quartiles
    torch.testing.assert_close(found[:101], values / most)
    assert found[101] == 1


def test_views_are_normalised_together():
    maps = {3: torch.linspace(0, 1, 100).view(10, 10), 7: torch.linspace(0, 0.1, 100).view(10, 10)}
    found = normalised(maps)
    assert found[3].max() == 1 and found[7].max() < 0.4


def test_rounding_errors_of_an_untouched_background_are_no_mask():
    generator = torch.Generator().manual_seed(0)
    values = 1e-7 * torch.rand(40, 40, generator=generator)
    values[:10, :10] = 0.5
    found = normalised({0: values})[0]
    assert float((found > 0.5).sum()) == 100


def plane(background: float, noise: float = 0.001) -> dict[int, Answer]:
    """Differences of 1 on a fifth of two views, of `background` elsewhere, with `noise` between draws."""
    values = torch.full((20, 20), background)
    values[:4] = 1.0
    return {view: Answer(m, m, torch.full_like(m, noise)) for view, m in {0: values, 5: values.flip(0)}.items()}


def test_an_edit_of_everything_is_told_from_one_of_a_thing():
    """What changes least is a share of what changes most, and more than what noise draws differ by."""
    assert Relevance().concerns_all(plane(0.2)) and not Relevance().concerns_all(plane(0.04))
    assert not Relevance(everywhere=1).concerns_all(plane(0.9))
    assert not Relevance(noise="independent").concerns_all(plane(0.2))
    assert not Relevance().concerns_all(plane(0.2, noise=0.1))  # as large as that it is for no edit, too


@pytest.mark.parametrize("scale", [1e-6, 0.3, 3.0])
def test_the_decision_is_free_of_scale(scale):
    for background, noise in ((0.2, 0.001), (0.2, 0.1), (0.04, 0.001)):
        given = plane(background, noise)
        other = {v: Answer(*(scale * x for x in (a.relevance, a.signal, a.noise))) for v, a in given.items()}
        assert Relevance().concerns_all(other) == Relevance().concerns_all(given)


@pytest.mark.parametrize(("background", "everything"), [(0.0, False), (0.3, True)])
def test_an_edit_of_everything_costs_a_look_at_a_few_views(disc_world, monkeypatch, background, everything):
    """Every view is asked once; at most six are asked twice, and first; where these say everything, no other is."""
    cameras, asked = [disc_world.request.cameras[0].resized(20, 20)] * 24, []
    request = dataclasses.replace(disc_world.request, cameras=cameras, render=lambda i: torch.zeros(20, 20, 3))

    def answer(self, guidance, source, view, draws):
        asked.append((view, draws))
        return plane(background)[0]

    monkeypatch.setattr(Relevance, "ask", answer)
    found = Relevance()(request, range(24))
    assert set(found) == set(range(24)) and all(bool((m == 1).all()) for m in found.values()) == everything
    assert asked == [(v, 2) for v in range(0, 24, 4)] + [(v, 1) for v in range(24) if v % 4 and not everything]


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_no_difference_is_an_error(value):
    with pytest.raises(PriorError, match="everywhere the same with the instruction as without"):
        normalised({0: torch.full((8, 8), value)})


@pytest.mark.parametrize("prior", ["ip2p", "sd"])
def test_neural_priors_of_odd_sizes(prior, disc_world, tmp_path):
    folder = make_model(tmp_path / prior, channels=8 if prior == "ip2p" else 4)
    config = GuidanceConfig(prior_type=prior, prior={"path": str(folder)}, rule="sds")
    guidance = Guidance(config, "make it red")
    cameras = [camera.resized(53, 45) for camera in disc_world.request.cameras]
    image = torch.rand(45, 53, 3, generator=torch.Generator().manual_seed(0))
    request = dataclasses.replace(disc_world.request, cameras=cameras, render=lambda i: image, guidance=guidance)
    calls = []
    predict = guidance.prior.predict_noise
    guidance.prior.predict_noise = lambda rows, t: (calls.append((len(rows), len(rows[0].noisy), t)), predict(rows, t))[
        1
    ]
    options = {"timesteps": 2, "draws": 3, "lowest": 0.5, "highest": 0.7}
    mask = make_mask(MaskConfig(kind="relevance", options=options, views=2, threshold=1e-3), request)
    assert {tuple(m.shape) for m in mask.images.values()} == {(45, 53)}
    assert calls == [(2, 6, 500), (2, 6, 699)] * 2  # both rows of all draws, in both signs, in one call


def test_without_a_prior_there_is_none(disc_world):
    request = dataclasses.replace(disc_world.request, guidance=None)
    with pytest.raises(ConfigError, match="relevance asks an edit's prior"):
        make_mask(MaskConfig(kind="relevance"), request)


@pytest.mark.parametrize(
    "options",
    [
        {"lowest": 0.9, "highest": 0.5},
        {"draws": 0},
        {"noise": "pink"},
        {"threshold": 1.0},
        {"blur": -1.0},
        {"everywhere": 0.0},
    ],
)
def test_options_that_cannot_be(options):
    with pytest.raises(ConfigError):
        parse(Relevance, options)
