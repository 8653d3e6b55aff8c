"""The exact prior around the truth of a synthetic scene."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.diffusion.api import Row
from dreamcatalyst.diffusion.noise import abar_at
from dreamcatalyst.diffusion.world_truth import WorldTruth
from dreamcatalyst.errors import PriorError


@pytest.fixture
def prior():
    return WorldTruth().with_spread(0.3)


def test_the_edit_is_the_truth_of_the_view_that_is_asked_about(prior):
    truths = {3: torch.rand(4, 6, 3), 5: torch.rand(4, 6, 3)}
    prior.truth.image = truths.get
    source = torch.rand(1, 3, 4, 6)
    text = prior.embed(["Give the bear a party hat"])[0]
    for view, truth in truths.items():
        edit = prior.known_edit(prior.condition_of(source, view), text)
        torch.testing.assert_close(edit[0].permute(1, 2, 0), truth)
        torch.testing.assert_close(prior.known_edit(prior.condition_of(source, view), None), source)
    both = prior.stack([prior.condition_of(source, 3), prior.condition_of(source, 5)])
    torch.testing.assert_close(prior.known_edit(both, text), torch.stack(list(truths.values())).permute(0, 3, 1, 2))


def test_the_noise_prediction_is_that_of_a_gaussian_around_the_truth(prior):
    """E[eps | x_t] at x_t = sqrt(abar) m is 0 at the mean m and nowhere else."""
    truth = torch.rand(4, 6, 3)
    prior.truth.image = lambda view: truth
    condition, text = prior.condition_of(torch.rand(1, 3, 4, 6), 0), prior.embed(["Add a scarf"])[0]
    mean = prior.encode(truth.permute(2, 0, 1)[None])
    noisy = abar_at(prior.alphas_cumprod, 500) ** 0.5 * mean
    at_truth, without = prior.predict_noise([Row(noisy, text, condition), Row(noisy, None, condition)], 500)
    assert at_truth.abs().max() < 1e-6 and without.abs().max() > 0.1


def test_what_it_cannot_know_is_said(prior):
    with pytest.raises(PriorError, match="no edited scene to look at.*data.source=demo:statue"):
        prior.condition_of(torch.rand(1, 3, 4, 6), 0)
    prior.truth.image = lambda view: torch.rand(8, 8, 3)
    with pytest.raises(PriorError, match="its truth"):
        prior.condition_of(torch.rand(1, 3, 4, 6), 0)
