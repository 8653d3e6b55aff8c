"""Depth pictures as surfaces: points project back, normals are the plane's, splats cover it, and hidden is hidden."""

import math

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.render.surface import seen, surface_normals, surface_points, surface_splats

SIZE = 32
UP = torch.tensor([0.0, 0.0, 1.0])


def camera(*eye, target=(0.0, 0.0, 0.0)):
    K = torch.tensor([[[1.2 * SIZE, 0, SIZE / 2 + 1], [0, 1.1 * SIZE, SIZE / 2 - 1], [0, 0, 1.0]]])
    return Cameras(look_at(torch.tensor([eye]), torch.tensor(target), UP), K, SIZE, SIZE)


def ground(view, height=0.0):
    """The depth of the plane z = height."""
    points = surface_points(view, torch.ones(SIZE, SIZE))  # where rays are at depth 1
    eye = view.centers[0]
    return (height - eye[2]) / (points - eye)[..., 2]


@pytest.fixture
def above():
    return camera(1.5, 0.7, 2.0)


def test_points_are_where_their_pixels_see_them(above):
    depth = ground(above)
    points = surface_points(above, depth)
    assert points[..., 2].abs().max() < 1e-5
    local = points @ above.viewmats[0, :3, :3].T + above.viewmats[0, :3, 3]
    u = local[..., 0] / local[..., 2] * above.Ks[0, 0, 0] + above.Ks[0, 0, 2]
    assert torch.allclose(u, (torch.arange(SIZE) + 0.5).expand(SIZE, SIZE), atol=1e-3)
    assert torch.allclose(local[..., 2], depth, atol=1e-5)


@pytest.mark.parametrize("eye, sign", [((1.5, 0.7, 2.0), 1.0), ((1.5, 0.7, -2.0), -1.0)])
def test_normals_are_on_the_side_that_is_seen(eye, sign):
    view = camera(*eye)
    normals = surface_normals(view, surface_points(view, ground(view)))
    assert torch.allclose(normals, sign * UP.expand_as(normals), atol=1e-3)


def test_splats_cover_their_surface_for_other_views_too(above):
    depth, whole = ground(above), torch.ones(SIZE, SIZE, dtype=torch.bool)
    colour = torch.tensor([0.2, 0.6, 0.3])
    splats = surface_splats(above, depth, colour.expand(SIZE, SIZE, 3), whole, 1)
    assert splats.sh_degree == 1 and len(splats) == SIZE**2
    for eye in ((1.5, 0.7, 2.0), (0.2, 0.1, 1.4), (-0.9, 0.8, 1.6)):  # the same view, from over it, from behind
        view = camera(*eye)
        drawn = rasterize(splats, view, depth=True)
        inside = (slice(10, 22), slice(10, 22))
        assert drawn.alpha[0][inside].min() > 0.95
        assert (drawn.rgb[0][inside] / drawn.alpha[0][inside] - colour).abs().max() < 0.01
        step = 1.5 * float((ground(view)[1:] - ground(view)[:-1]).abs().max())  # drawn depth is that of splats' centres
        assert ((drawn.depth[0, ..., 0] - ground(view))[inside]).abs().max() < step


def test_a_wall_hides_what_is_behind_it_and_backs_are_not_seen():
    """A camera that looks along x at a wall x = 0, and points before and behind the wall."""
    view, wall = camera(-3.0, 0.0, 0.0), torch.full((SIZE, SIZE), 3.0)
    points = torch.tensor([[-0.5, 0.0, 0.0], [0.05, 0.0, 0.0], [0.5, 0.0, 0.0], [-0.5, 0.0, 50.0], [-9.0, 0.0, 0.0]])
    towards = torch.tensor([[-1.0, 0.0, 0.0]]).expand(5, 3)
    slack = torch.full((5,), 0.1)
    expected = [True, True, False, False, False]  # before, in its slack, behind, beside the picture, behind the camera
    assert seen(points, towards, [(view, wall)], slack).tolist() == expected
    assert not seen(points, -towards, [(view, wall)], slack).any()
    other = (camera(3.0, 0.0, 0.0), torch.full((SIZE, SIZE), 3.0))
    assert seen(points, -towards, [(view, wall), other], slack).tolist() == [False, True, True, False, False]


def test_where_a_view_shows_nothing_everything_is_seen():
    view = camera(-3.0, 0.0, 0.0)
    far = torch.tensor([[40.0, 0.0, 0.0]])
    assert bool(seen(far, torch.tensor([[-1.0, 0.0, 0.0]]), [(view, torch.zeros(SIZE, SIZE))], torch.zeros(1)))
    assert math.isclose(float(view.centers[0, 0]), -3.0, abs_tol=1e-5)
