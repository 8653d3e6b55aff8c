"""Random worlds: seeded, labelled, with the statue's own look among them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from dreamcatalyst.demo.bears import POSES, RANGES, bear_solids, posed
from dreamcatalyst.demo.random_world import LEVEL, random_light, random_world
from dreamcatalyst.demo.shapes import Light, facing, frames, plane, sphere_points, turn
from dreamcatalyst.demo.worlds import BEAR, Solid, make_world, part_mask, statue_world
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.render.api import rasterize

SEEDS = range(6)


@pytest.fixture(scope="module")
def worlds():
    return [random_world(seed, views=4, size=24) for seed in SEEDS]


def test_a_seed_gives_the_same_world_again(worlds):
    for seed in (0, 5):
        again, other = random_world(seed, views=2, size=48), worlds[1]
        for name, value in again.scene.parameters():
            assert torch.equal(value, getattr(worlds[seed].scene, name))
        assert not torch.equal(again.scene.sh0[:50], other.scene.sh0[:50])
    assert torch.equal(make_world("random", views=4, size=24).scene.means, worlds[0].scene.means)


def test_every_thing_has_its_rows_and_labels(worlds):
    parts = {"ball": ["ball"], "box": ["box"], "flower pot": ["pot"]}
    for world in [*worlds, statue_world(views=1)]:
        for thing in world.things:
            mine = torch.zeros(len(world.scene), dtype=torch.bool)
            mine[thing.rows[0] : thing.rows[1]] = True
            names = parts.get(thing.name) or list({name for name, _, _ in BEAR} - {"pedestal"})
            assert torch.equal(mine, part_mask(world.scene, *names)), thing.name
            for solid in thing.solids:
                on = solid.local(world.scene.means[solid.rows[0] : solid.rows[1]]).norm(dim=1)
                torch.testing.assert_close(on, torch.ones_like(on), atol=1e-4, rtol=0)


def test_a_thing_that_is_not_there_is_named():
    with pytest.raises(ConfigError, match="unknown thing in this world 'bear'. Did you mean 'bear statue'"):
        statue_world(views=1).thing("bear")


def test_worlds_are_closed_and_of_plain_colours(worlds):
    for world in worlds:
        render = rasterize(world.scene, world.cameras)
        assert render.alpha.min() > 0.7 and render.alpha.mean() > 0.95
        assert world.scene.sh_degree == 0  # the same from every side
        assert render.rgb.min() >= -0.01 and render.rgb.max() < 1.1


def test_what_stands_in_the_middle_is_seen_by_every_camera(worlds):
    for world in worlds:
        first, last = world.things[0].rows
        seen = rasterize(world.scene[first:last], world.cameras).alpha.flatten(1).mean(1)
        assert (seen > 0.02).all() and (seen < 0.7).all()


@pytest.mark.parametrize("pose", POSES)
def test_a_bear_of_every_pose_has_the_statues_parts(pose):
    expected = [name for name, _, _ in BEAR if name != "pedestal"]
    assert [part.name for part in posed(pose)] == expected


def test_bears_stand_on_the_ground():
    """The lowest point of an ellipsoid of radii r turned by R is |r * R_z| below its centre."""
    for seed in range(8):
        parts = bear_solids(np.random.default_rng(seed))
        low = [float(p.center[2] - (p.rotation[2] * p.radii).norm()) for p in parts]
        assert min(low) == pytest.approx(0, abs=1e-5)
        for part in parts:
            torch.testing.assert_close(part.rotation @ part.rotation.T, torch.eye(3), atol=1e-5, rtol=0)


def test_the_statue_lies_among_the_random_bears():
    angles = ("look", "nod", "spread", "raise", "splay")
    assert all(low < (0 if name in angles else 1) < high for name, (low, high) in RANGES.items())
    lights, own = [random_light(np.random.default_rng(seed)) for seed in range(200)], Light()
    for name in ("lamp", "ambient"):
        values = [getattr(light, name) for light in lights]
        assert min(values) < getattr(own, name) < max(values)
    height = math.asin(own.direction[2] / math.hypot(*own.direction))
    heights = [math.asin(light.direction[2]) for light in lights]
    assert min(heights) < height < max(heights)
    floor = statue_world(views=1).scene
    assert floor.means[part_mask(floor, "floor"), 2].unique().item() == pytest.approx(LEVEL)


def test_facing_undoes_frames():
    normals = sphere_points(200)
    scene = statue_world(views=1).scene[:200]
    scene = type(scene)(scene.means, frames(normals) * 3, *(v for _, v in list(scene.parameters())[2:]))
    torch.testing.assert_close(facing(scene), normals, atol=1e-5, rtol=0)


def test_turns_are_right_handed():
    x, y, z = torch.eye(3)
    for axis, start, end in (("x", y, z), ("y", z, x), ("z", x, y)):
        torch.testing.assert_close(turn(axis, 90) @ start, end, atol=1e-6, rtol=0)


def test_a_plane_fills_its_rectangle():
    points, normals, widths = plane((1.0, 2.0, 3.0), (0.0, 2.0, 0.0), (0.0, 0.0, 1.0), 0.1)
    assert len(points) == 40 * 20
    torch.testing.assert_close(points.mean(0), torch.tensor([1.0, 2.0, 3.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(points.amax(0), torch.tensor([1.0, 3.95, 3.95]))
    torch.testing.assert_close(normals[0], torch.tensor([1.0, 0.0, 0.0]))
    assert (widths > 0.05).all()


def test_local_coordinates_of_a_turned_solid():
    solid = Solid("head", torch.tensor([1.0, 0, 0]), torch.tensor([2.0, 1, 1]), turn("z", 90))
    torch.testing.assert_close(solid.local(torch.tensor([[1.0, 2, 0]])), torch.tensor([[1.0, 0, 0]]), atol=1e-6, rtol=0)
