"""The statue: seeded, labelled, in the picture of every camera."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.demo import capture as demo_capture
from dreamcatalyst.demo.worlds import BEAR, PARTS, bear_statue, make_world, part_mask, statue_world
from dreamcatalyst.errors import ConfigError, DataError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians


@pytest.fixture(scope="module")
def world():
    return statue_world(seed=3, views=6, size=24)


def test_a_seed_gives_the_same_splats_again(world):
    again, other = statue_world(seed=3, views=6, size=24), statue_world(seed=4, views=6, size=24)
    for name, value in again.scene.parameters():
        assert torch.equal(value, getattr(world.scene, name))
    assert torch.equal(other.scene.means, world.scene.means)  # the shapes stay, their speckles are others
    assert not torch.equal(other.scene.sh0, world.scene.sh0)


def test_every_part_has_its_label(world):
    made = {"floor", "sky", *(name for name, _, _ in BEAR), "wall", "tree", "ball", "box", "pot", "plant"}
    assert set(PARTS) == made | {"hat", "rabbit ear", "scarf"}  # the latter are what edits add
    for part in {"floor", "sky", *(name for name, _, _ in BEAR)}:
        assert part_mask(world.scene, part).any(), part
    assert part_mask(world.scene, *PARTS).all()
    assert torch.equal(
        part_mask(world.scene, "eye", "nose"), part_mask(world.scene, "eye") | part_mask(world.scene, "nose")
    )
    with pytest.raises(ConfigError, match="unknown part 'haed'. Did you mean 'head'"):
        part_mask(world.scene, "haed")


@pytest.mark.parametrize("name", [name for name, _, _ in BEAR])
def test_splats_of_a_part_lie_on_its_ellipsoids(name):
    scene = bear_statue(seed=0)
    points = scene.means[part_mask(scene, name)]
    levels = [
        ((points - torch.tensor(center)) / torch.tensor(radii)).norm(dim=1)
        for part, center, radii in BEAR
        if part == name
    ]
    torch.testing.assert_close(
        torch.stack(levels).sub(1).abs().min(dim=0).values, torch.zeros(len(points)), atol=1e-5, rtol=0
    )


def test_the_lawn_lies_flat_and_the_sky_is_around_all_cameras(world):
    floor, sky = (world.scene.means[part_mask(world.scene, part)] for part in ("floor", "sky"))
    assert floor[:, 2].std() < 1e-6
    assert sky.norm(dim=1).min() > world.cameras.centers.norm(dim=1).max()
    assert (world.cameras.centers[:, 2] > floor[:, 2].max()).all()


def test_every_camera_sees_the_statue_in_its_middle(world):
    """Of the statue alone, so that neither lawn nor sky is what makes the middle opaque."""
    statue = world.scene[~part_mask(world.scene, "floor", "sky")]
    render = rasterize(statue, world.cameras, depth=True, backend="reference")
    assert (render.alpha[:, 11:13, 11:13] > 0.98).all()
    corners = render.alpha[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners < 0.02).all()
    depth = (world.cameras.centers - torch.tensor([0.0, 0.0, 0.46])).norm(dim=1)
    assert (render.depth[:, 12, 12, 0] < depth).all()  # its front, not its back


def test_the_world_has_no_hole(world):
    render = rasterize(world.scene, world.cameras, backend="reference")
    assert render.alpha.min() > 0.8 and render.alpha.mean() > 0.97
    assert render.rgb.isfinite().all() and render.rgb.amin() >= 0 and render.rgb.amax() < 1.1


def test_cameras_look_at_the_statue_upright(world):
    towards = torch.nn.functional.normalize(torch.tensor([0, 0, 0.46]) - world.cameras.centers, dim=1)
    torch.testing.assert_close((towards * world.cameras.forward).sum(dim=1), torch.ones(6))
    assert ((-world.cameras.viewmats[:, 1, :3] @ torch.tensor(world.up)) > 0.8).all()


def test_a_world_as_a_capture(world, monkeypatch):
    monkeypatch.setattr(demo_capture, "make_world", lambda name: world)
    capture = open_capture("demo:statue", CaptureOptions(width=12, height=12, test_every=3))
    assert (str(capture.source), len(capture), capture.test, capture.has_photos) == ("demo:statue", 6, [0, 3], True)
    cameras = world.cameras.resized(12, 12)
    assert torch.equal(capture.cameras().Ks, cameras.Ks) and torch.equal(capture.cameras().viewmats, cameras.viewmats)
    assert 1000 < len(capture.points.xyz) <= 6000
    assert capture.points.rgb.amin() >= 0 and capture.points.rgb.amax() <= 1
    with pytest.raises(DataError, match="'0001' has a camera but no photograph"):
        capture.image(1)
    image = rasterize(world.scene, cameras[1]).rgb[0]
    assert torch.equal(capture.image(1, lambda scene, camera: rasterize(scene, camera).rgb[0]), image)
    with pytest.raises(DataError, match="demo:statue: carries splats.*Leave out data.dataparser"):
        capture.transformed(torch.eye(4))


def test_only_a_format_that_is_asked_for_is_looked_for():
    with pytest.raises(DataError, match="demo:statue: is no capture. Looked for inria: cameras.json.*Found no such"):
        open_capture("demo:statue", CaptureOptions(format="inria"))


def test_an_unknown_world_is_named():
    with pytest.raises(ConfigError, match="data.source: unknown demo scene 'stature'. Did you mean 'statue'"):
        make_world("stature")


def test_a_world_of_another_seed_is_named_with_it():
    small = {"views": 2, "size": 8}
    assert torch.equal(make_world("random:7", **small).scene.means, make_world("random", seed=7, **small).scene.means)
    with pytest.raises(ConfigError, match="data.source: got the world 'random:x', expected a whole number"):
        make_world("random:x")


def test_a_world_is_a_plain_scene(world):
    assert isinstance(world.scene, Gaussians) and list(world.scene.extra) == ["part"]
    for name in PARAMETERS:
        assert getattr(world.scene, name).isfinite().all()
    torch.testing.assert_close(world.scene.quats.norm(dim=1), torch.ones(len(world.scene)))
