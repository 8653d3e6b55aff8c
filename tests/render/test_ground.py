"""The surface under a pixel, against a synthetic scene whose ground is a plane at z = -0.12, and whose sky is none."""

import pytest
import torch
from dreamcatalyst.data.orbit import world_up
from dreamcatalyst.demo.worlds import make_world, part_mask
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.render.ground import ground_at, level_under, require_level
from dreamcatalyst.scene.gaussians import Gaussians

LEVEL, UP = -0.12, torch.tensor([0.0, 0, 1])


@pytest.fixture(scope="module")
def world():
    return make_world("statue", size=96)


@pytest.mark.parametrize(("view", "x", "y"), [(0, 20.0, 80.0), (5, 80.0, 70.0), (11, 15.0, 60.0), (16, 85.0, 88.0)])
def test_the_lawn_under_a_pixel(world, view, x, y):
    """Where the pixel's own ray meets the plane of the lawn: by its own depth, before it by about a splat's width; as
    seen from above, within 3 mm of a statue of 1 m."""
    camera = world.cameras[view]
    found = ground_at(world.scene, camera, x, y, rasterize)
    ray = camera.viewmats[0, :3, :3].T @ torch.linalg.inv(camera.Ks[0]) @ torch.tensor([x, y, 1.0])
    exact = camera.centers[0] + ray * (LEVEL - camera.centers[0, 2]) / ray[2]
    off = found.point.float() - exact
    assert abs(float(off[2])) < 0.04 and float(off.norm()) < 0.1
    assert float(found.normal @ UP.double()) > 0.99
    require_level(found, UP.double(), "here")
    above = level_under(world.scene, found.point, UP.double(), 0.1, 0.5, rasterize)
    torch.testing.assert_close(found.at_level(UP.double(), above).float(), exact, atol=0.005, rtol=0)


def test_on_the_sky_nothing_stands(world):
    with pytest.raises(SceneError, match="tilted by"):
        require_level(ground_at(world.scene, world.cameras[0], 10, 5, rasterize), UP.double(), "here")
    bare = world.scene[~part_mask(world.scene, "sky")]
    assert ground_at(bare, world.cameras[0], 10, 5, rasterize) is None


def test_the_ground_is_the_nearest_surface_below_and_not_a_roof(world):
    """What lies far above the foot, or below it, is another surface; where nothing else is, the foot stays."""
    foot = torch.tensor([2.0, 0.0, 0.3]).double()
    assert level_under(world.scene, foot, UP.double(), 0.1, 0.5, rasterize) == 0.0
    empty = Gaussians.from_colors(torch.zeros(1, 3), torch.full((1, 3), 0.01), torch.ones(1, 3), torch.tensor([0.5]))
    assert level_under(empty, foot, UP.double(), 0.1, 0.5, rasterize) == 0.0


def test_up_in_the_world_of_level_cameras(world):
    torch.testing.assert_close(world_up(world.cameras).float(), UP, atol=1e-5, rtol=0)
    few = world.cameras[[0, 1, 2]]  # that look nearly one way
    torch.testing.assert_close(world_up(few).float(), UP, atol=0.05, rtol=0)
    torch.testing.assert_close(world_up(world.cameras[[0]]).float() @ UP, torch.tensor(1.0), atol=0.2, rtol=0)
