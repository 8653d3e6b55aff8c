"""From what views say of splats to the splats that may change."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.render.lift import lift, vote
from dreamcatalyst.scene.gaussians import Gaussians
from dreamcatalyst.scene.mask import FAINTEST, feather, grow, invert, soft_weights, threshold


def line(n: int) -> torch.Tensor:
    return torch.stack([torch.arange(n, dtype=torch.float32), torch.zeros(n), torch.zeros(n)], dim=-1)


def cameras_at(*eyes: tuple[float, float, float]) -> Cameras:
    viewmats = look_at(torch.tensor(eyes), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 24], [0, 0, 1]])
    return Cameras(viewmats, K.repeat(len(eyes), 1, 1), 48, 48)


@pytest.fixture
def screened():
    """A screen of 81 opaque splats at z = 0 and a splat 1 behind it, which two views from the front hardly see, and one
    from the side does; the cameras, and masks of where the screen is seen."""
    x, y = torch.meshgrid(torch.linspace(-0.8, 0.8, 9), torch.linspace(-0.8, 0.8, 9), indexing="ij")
    grid = torch.stack([x.flatten(), y.flatten(), torch.zeros(81)], dim=-1)
    means = torch.cat([grid, torch.tensor([[0.0, 0, 1.0]])])
    scales = torch.tensor([0.15, 0.15, 0.02]).repeat(82, 1)
    scales[81] = 0.1
    scene = Gaussians.from_colors(means, scales, torch.full((82, 3), 0.5), torch.full((82,), 0.95))
    cameras = cameras_at((0.0, 0, -4), (0.5, 0, -4), (-4.0, 0, 0.8))
    masks = (rasterize(scene[:81], cameras).alpha[..., 0] > 0.1).float()
    return scene, cameras, masks


def test_a_splat_behind_the_object_is_not_masked(screened):
    scene, cameras, masks = screened
    seen = lift(scene, cameras, masks)
    weights = soft_weights(scene.means, seen.inside, seen.total)
    assert seen.total[81] > 5  # one view sees it well
    assert weights[:81].min() > 0.9 and weights[81] < 0.1
    assert threshold(weights).tolist() == [True] * 81 + [False]


def test_the_unweighted_count_masks_what_is_behind(screened):
    scene, cameras, masks = screened
    counted = vote(scene, cameras, masks)
    # The two front views outvote the one that sees it, though what they see of it is next to nothing.
    assert counted.inside[81] / counted.total[81] > 0.5


def test_a_splat_that_no_view_sees_is_decided_by_its_neighbours():
    means = line(6)
    total = torch.tensor([9.0, 9, 9, 9, 9, 0.4])
    inside = torch.tensor([9.0, 9, 0, 0, 0, 0.4])  # what little is seen of the last lies wholly inside
    weights = soft_weights(means, inside, total, neighbours=2)
    assert weights.tolist() == [1, 1, 0, 0, 0, 0]
    assert soft_weights(means, inside, total, min_evidence=0.1, neighbours=2)[5] == 1


def test_neighbours_vote_by_inverse_distance():
    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [-3.0, 0, 0], [50.0, 0, 0]])
    inside, total = torch.tensor([0.0, 1.0, 0.5, 4.0]), torch.tensor([0.0, 1.0, 1.0, 4.0])
    weights = soft_weights(means, inside, total, neighbours=2)
    assert float(weights[0]) == pytest.approx((1 * 1 + 0.5 / 3) / (1 + 1 / 3))
    same_place = soft_weights(torch.zeros(2, 3), torch.tensor([0.0, 0.7]), torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(same_place, torch.tensor([0.7, 0.7]))


def test_nothing_seen_is_an_error():
    with pytest.raises(SceneError, match="of none of 4 splats at least min_evidence=0.5 pixels"):
        soft_weights(line(4), torch.zeros(4), torch.full((4,), 0.2))


def test_an_empty_mask_says_what_other_thresholds_find():
    with pytest.raises(SceneError, match=r"threshold 0.8 finds 0 of 4 splats \(1 at 0.6, 2 at 0.4, 3 at 0.2; .* 0.7"):
        threshold(torch.tensor([0.7, 0.45, 0.3, 0.0]), 0.8)
    with pytest.raises(SceneError, match="all 3 splats are in it"):
        invert(torch.ones(3, dtype=torch.bool))


def test_grow_takes_in_what_is_near():
    means = line(7)
    mask = torch.tensor([0, 0, 0, 1, 0, 0, 0]).bool()
    assert grow(means, mask, 0.0).tolist() == mask.tolist()
    assert grow(means, mask, 1.5).nonzero().flatten().tolist() == [2, 3, 4]
    assert grow(means, mask, 2.0).nonzero().flatten().tolist() == [1, 2, 3, 4, 5]
    assert bool(grow(means, ~mask, 1.0).all()) and mask.sum() == 1


def test_feather_falls_off_towards_the_border():
    means, mask = line(8), torch.tensor([0, 1, 1, 1, 1, 1, 1, 1]).bool()
    torch.testing.assert_close(feather(means, mask, 4.0), torch.tensor([0, 0.25, 0.5, 0.75, 1, 1, 1, 1]))
    assert feather(means, mask, 0.0).tolist() == mask.float().tolist()
    everything = torch.ones(8, dtype=torch.bool)
    assert feather(means, everything, 4.0).tolist() == [1.0] * 8
    on_top = feather(torch.zeros(2, 3), torch.tensor([True, False]), 1.0)
    torch.testing.assert_close(on_top, torch.tensor([FAINTEST, 0]))
