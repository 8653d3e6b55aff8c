"""Density control by sampling against what the paper promises of it (Kheradmand et al. 2024)."""

import pytest
import torch
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.trainable import Splats
from dreamcatalyst.train.density import DensifyConfig, Moment
from dreamcatalyst.train.mcmc import Mcmc, relocated
from dreamcatalyst.train.optim import LearningRates


def make(opacities, max_splats=1000, **options) -> tuple[Splats, Mcmc]:
    n, draw = len(opacities), torch.Generator().manual_seed(0)
    scales = torch.rand(n, 3, generator=draw) * 0.2 + 0.05
    quats = torch.randn(n, 4, generator=draw)
    means, colours = torch.randn(n, 3, generator=draw), torch.rand(n, 3, generator=draw)
    splats = Splats(Gaussians.from_colors(means, scales, colours, torch.tensor(opacities), quats))
    splats.make_optimizer(LearningRates().at(0, 10, 1.0))
    config = DensifyConfig(strategy="mcmc", max_splats=max_splats, options=options, every=1, start=0)
    return splats, config.make()


MOMENT = Moment(step=1, max_steps=10, extent=1.0, seed=3)


@pytest.mark.parametrize("opacity, copies", [(0.1, 2), (0.9, 2), (0.6, 7), (0.99, 51)])
def test_copies_in_one_place_look_as_the_one_that_stood_there(opacity, copies):
    """Peak and integral of the composite along an axis, by quadrature."""
    new, scale = relocated(torch.tensor([opacity]).double(), torch.ones(1, 3).double(), torch.tensor([copies]))
    x = torch.linspace(-12, 12, 20001, dtype=torch.float64)

    def composite(peak, width, times):
        return 1 - (1 - peak * torch.exp(-0.5 * (x / width) ** 2)) ** times

    one, many = composite(opacity, 1.0, 1), composite(new, scale[0, 0], copies)
    assert float(many.max()) == pytest.approx(opacity, abs=1e-7)
    assert float(torch.trapezoid(many, x)) == pytest.approx(float(torch.trapezoid(one, x)), rel=1e-6)


def test_dead_splats_go_where_others_are_and_their_number_grows_up_to_the_cap():
    splats, mcmc = make([0.001] * 10 + [0.5] * 30, max_splats=41)
    places = splats.edited.means[10:].detach().clone()
    mcmc.densify(splats, MOMENT)
    scene = splats.edited.detach()
    assert len(splats) == 41 and bool((scene.opacities > 0.005).all())
    same = (scene.means[:, None] == places).all(-1)
    assert bool(same.any(1).all() and same.any(0).all())
    mcmc.densify(splats, MOMENT)
    assert len(splats) == 41
    grown, control = make([0.5] * 40)
    control.densify(grown, MOMENT)
    assert len(grown) == 42


def test_those_that_share_a_place_begin_without_moments():
    splats, mcmc = make([0.001, 0.5, 0.5])
    for parameter in splats.parameters.values():
        parameter.grad = torch.ones_like(parameter)
    splats.optimizer.step()
    mcmc.densify(splats, MOMENT)
    means = splats.parameters["means"]
    shared = (means[:, None] == means).all(-1).sum(1) > 1
    moment = splats.optimizer.state[means]["exp_avg"]
    assert shared.sum() == 2 and bool((moment[shared] == 0).all()) and bool((moment[~shared] != 0).all())


def test_noise_follows_the_covariance_of_faint_splats_and_leaves_opaque_ones():
    splats, mcmc = make([0.002] * 4000 + [0.9])
    with torch.no_grad():
        for name in PARAMETERS[1:3]:
            splats.parameters[name][:-1] = splats.parameters[name][0].clone()
    before = splats.edited.detach().clone()
    mcmc.shake(splats, MOMENT)
    moved = (splats.edited.means - before.means).detach()
    assert torch.equal(moved[-1], torch.zeros(3))
    first = before[0:1]
    axis = torch.zeros(1, 3)
    axis[0, int(first.scales.argmax())] = 1
    w, x, y, z = torch.nn.functional.normalize(first.quats, dim=-1)[0].tolist()
    turn = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    covariance = turn @ torch.diag(first.scales[0].square()) @ turn.T
    rate, faint = 1.6e-4, torch.sigmoid(torch.tensor(-100 * (0.002 - 0.005)))
    expected = (5e5 * rate * faint) ** 2 * covariance @ covariance
    torch.testing.assert_close(torch.cov(moved[:-1].T), expected, rtol=0.12, atol=0.02 * float(expected.max()))
    again, other = make([0.002] * 4000 + [0.9])
    other.shake(again, MOMENT)
    assert torch.equal(again.edited.means[-1], before.means[-1])


def test_regularisers_are_means_of_opacity_and_scale():
    splats, mcmc = make([0.25, 0.75], opacity_weight=0.1, scale_weight=2.0)
    terms = mcmc.terms(splats)
    assert terms["opacities"].item() == pytest.approx(0.05)
    assert terms["scales"].item() == pytest.approx(2 * float(splats.edited.scales.mean().detach()))
    assert make([0.5], opacity_weight=0, scale_weight=0)[1].terms(splats) == {}
