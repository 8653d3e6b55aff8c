"""Consistency between views on a flat wall, where it is known which pixel shows which."""

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.render.api import Render
from dreamcatalyst.report.consistency import disagreement, lifted, looked_up, nearest_views

SIZE, DEPTH, FOCAL = 32, 4.0, 40.0


def camera(x):
    """A camera at (x, 0, 0) that looks along z, at a wall at z = DEPTH."""
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1.0]])
    return Cameras(viewmat[None], K[None], SIZE, SIZE)


def wall(x, depth=DEPTH, shift=0.0):
    """What it sees: a colour that is linear in the wall's own place, so that looking it up is exact."""
    along = (torch.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL * depth + x
    red = (0.5 + 0.1 * along).expand(SIZE, SIZE)
    rgb = torch.stack([red, red * 0 + 0.3, red * 0 + shift], dim=-1)[None]
    full = torch.ones(1, SIZE, SIZE, 1)
    return Render(rgb, full, depth * full, None, torch.zeros(1, 0, 2), torch.zeros(1, 0, dtype=torch.int32))


def test_a_pixel_s_point_lies_on_its_ray_at_its_depth():
    points = lifted(wall(1.0).depth[0], camera(1.0))
    assert torch.allclose(points[..., 2], torch.tensor(DEPTH))
    want = torch.tensor([1.0 + (0.5 - SIZE / 2) / FOCAL * DEPTH, (0.5 - SIZE / 2) / FOCAL * DEPTH])
    torch.testing.assert_close(points[0, 0, :2], want)


def test_the_same_wall_agrees_and_is_seen_where_both_look():
    colours, seen = looked_up(lifted(wall(0.0).depth[0], camera(0.0)), wall(0.5), camera(0.5))
    shift = round(0.5 / DEPTH * FOCAL)  # pixels: the first ones lie outside of the other view
    assert not seen[:, : shift - 1].any() and seen[:, shift + 1 :].all()
    assert disagreement(wall(0.0), camera(0.0), wall(0.5), camera(0.5)) == pytest.approx(0.0, abs=1e-6)


def test_another_colour_is_its_distance():
    found = disagreement(wall(0.0), camera(0.0), wall(0.5, shift=0.3), camera(0.5))
    assert found == pytest.approx(0.3 / 3**0.5, abs=1e-6)  # of one channel in three


def test_what_is_hidden_or_not_shared_says_nothing():
    nearer = wall(0.5, depth=DEPTH / 2, shift=0.9)  # another view with something in front of the wall
    assert disagreement(wall(0.0), camera(0.0), nearer, camera(0.5)) is None
    assert disagreement(wall(0.0), camera(0.0), wall(9.0), camera(9.0)) is None


def test_neighbours_are_the_nearest_by_place_and_direction():
    eyes = torch.tensor([[4.0, 0, 0], [3.9, 0.8, 0], [0, 4.0, 0], [-4.0, 0, 0]])
    K = camera(0).Ks.expand(4, 3, 3)
    ring = Cameras(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0, 1])), K, SIZE, SIZE)
    assert nearest_views(ring, 0, (1, 2, 7)) == [1, 2, 3]
    assert nearest_views(ring[0], 0, (1, 7)) == []
