"""Depth inside of a hole: planes go on exactly, a surface behind the hole's edge does not pull, and curves bend."""

import torch
from dreamcatalyst.inpaint.depth import continue_depth


def plane(a, b, c, size=48):
    """The depth of the plane a X + b Y + c Z = 1 at focal length `size`: 1/z = (a u + b v) / f + c."""
    v, u = torch.meshgrid(torch.arange(size) - size / 2, torch.arange(size) - size / 2, indexing="ij")
    return 1 / ((a * u + b * v) / size + c)


def disc(size=48, x=24, y=24, radius=9):
    v, u = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (u - x) ** 2 + (v - y) ** 2 < radius**2


def test_a_plane_goes_on_as_itself():
    depth, hole = plane(0.1, 0.4, 0.5), disc()
    spoiled = torch.where(hole, torch.tensor(9.0), depth)
    assert torch.allclose(continue_depth(spoiled, hole, 3), depth, rtol=1e-4)


def test_two_holes_go_on_in_their_own_planes():
    near, far = plane(0.0, 0.2, 0.5), plane(0.0, 0.2, 0.2)
    depth = torch.cat([near[:, :24], far[:, 24:]], dim=1)
    holes = disc(x=11, radius=6) | disc(x=36, radius=6)
    assert torch.allclose(continue_depth(torch.where(holes, torch.tensor(1.0), depth), holes, 3), depth, rtol=1e-4)


def test_what_is_far_behind_a_part_of_the_border_does_not_pull():
    ground = plane(0.0, 0.6, 0.6)
    behind = torch.where(torch.arange(48)[:, None] < 17, torch.tensor(30.0), ground)  # over the horizon of a pedestal
    hole = disc(y=24, radius=8)
    assert torch.allclose(continue_depth(behind, hole, 3)[hole], ground[hole], rtol=0.02)


def test_a_curved_surface_bends_and_stays_between_what_is_around():
    v, u = torch.meshgrid(torch.arange(48) - 24.0, torch.arange(48) - 24.0, indexing="ij")
    dome, hole = 3 + 0.002 * (u**2 + v**2), disc(radius=6)
    filled = continue_depth(torch.where(hole, torch.tensor(50.0), dome), hole, 3)
    assert (filled - dome)[hole].abs().max() < 0.1
    assert torch.equal(filled[~hole], dome[~hole])


def test_a_hole_with_nothing_around_it_stays():
    depth = torch.full((16, 16), 2.0)
    assert torch.equal(continue_depth(depth, torch.ones(16, 16, dtype=torch.bool), 3), depth)
