"""Splats moved as one thing: nothing of how they look changes, from wherever they are seen."""

import math
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.harmonics import basis, turned
from dreamcatalyst.scene.place import (
    ADDED,
    Similarity,
    frames,
    joined,
    moved,
    rotation_from,
    stance,
    turn_between,
    with_degree,
)

from benchmarks.stiff.splats import cloud


def rotation(seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return rotation_from(torch.randn(4, generator=g, dtype=torch.float64).tolist())


def directions(n: int, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_harmonics_turn_exactly(degree, seed):
    """f'(R d) = f(d) for every direction, and turning back gives what was there."""
    g = torch.Generator().manual_seed(seed)
    sh, turn, dirs = torch.randn(5, (degree + 1) ** 2, 3, generator=g).double(), rotation(seed), directions(200, seed)
    after = turned(sh, turn)
    before, now = (torch.einsum("dk,nkc->ndc", basis(d, degree), s) for d, s in ((dirs, sh), (dirs @ turn.T, after)))
    torch.testing.assert_close(now, before, atol=1e-13, rtol=1e-13)
    torch.testing.assert_close(turned(after, turn.T), sh, atol=1e-13, rtol=1e-13)
    torch.testing.assert_close(after.square().sum(1), sh.square().sum(1), atol=1e-12, rtol=1e-12)  # orthogonal


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_splats_and_cameras_moved_together_give_the_same_picture(seed):
    """Of degree 3: positions, shapes and colours by direction are all turned, scaled and shifted."""
    scene = cloud(20, 3, seed).to(dtype=torch.float64)
    turn, scale, shift = rotation(seed + 5), 1.7, torch.tensor([0.3, -2.0, 5.0]).double()
    target = torch.tensor([0.0, 0.0, 4.0]).double()
    eyes = target + 3.5 * directions(3, seed)
    up = torch.tensor([0.0, 1.0, 0.0]).double()
    K = torch.tensor([[19.0, 0, 7.1], [0, 17.0, 4.8], [0, 0, 1]]).double().expand(3, 3, 3).clone()
    here = Cameras(look_at(eyes, target, up), K, 15, 10)
    to = [scale * point @ turn.T + shift for point in (eyes, target)]
    there = Cameras(look_at(*to, turn @ up), K, 15, 10)
    one = rasterize(scene, here, depth=True, backend="reference")
    other = rasterize(moved(scene, Similarity(turn, scale, shift)), there, depth=True, backend="reference")
    # The blur of 0.3 pixels is of the image, and so is the near plane's place: neither depends on the world's unit.
    torch.testing.assert_close(other.rgb, one.rgb, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(other.depth, scale * one.depth, atol=1e-8, rtol=1e-9)


def test_a_move_to_where_it_is_changes_no_bit():
    scene = cloud(10, 3, 1)
    same = moved(scene, Similarity(torch.eye(3).double(), 1.0, torch.zeros(3).double()))
    for name in PARAMETERS:
        assert torch.equal(getattr(same, name), getattr(scene, name)), name


@pytest.mark.parametrize("scale", [0.0, -1.0, math.inf, math.nan])
def test_scales_that_are_none(scale):
    with pytest.raises(SceneError, match="expected more than 0"):
        moved(cloud(3, 0, 0), Similarity(torch.eye(3).double(), scale, torch.zeros(3).double()))


def test_rotations_of_angles_and_quaternions():
    quarter = rotation_from([0, 0, 90])
    torch.testing.assert_close(quarter @ torch.tensor([1.0, 0, 0]).double(), torch.tensor([0, 1.0, 0]).double())
    torch.testing.assert_close(rotation_from([math.sqrt(0.5), 0, 0, math.sqrt(0.5)]), quarter)
    # about the fixed axes: first x, then y, then z
    parts = [rotation_from([30, 0, 0]), rotation_from([0, 40, 0]), rotation_from([0, 0, 50])]
    torch.testing.assert_close(rotation_from([30, 40, 50]), parts[2] @ parts[1] @ parts[0])


@pytest.mark.parametrize("seed", range(3))
def test_the_smallest_turn_between_two_directions(seed):
    a, b = directions(2, seed)
    turn = turn_between(a, b)
    torch.testing.assert_close(turn @ a, b)
    torch.testing.assert_close(turn @ turn.T, torch.eye(3).double())
    angle = math.acos((float(turn.trace()) - 1) / 2)
    assert angle == pytest.approx(math.acos(float(a @ b)), abs=1e-9)
    torch.testing.assert_close(turn_between(a, -a) @ a, -a)
    torch.testing.assert_close(turn_between(a, a), torch.eye(3).double())


def test_frames_turn_z_onto_normals():
    normals = torch.cat([directions(20, 0), torch.tensor([[0, 0, 1.0], [0, 0, -1.0]]).double()])
    w, x, y, z = frames(normals).unbind(-1)
    got = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    torch.testing.assert_close(got, normals, atol=1e-6, rtol=0)


def test_where_a_thing_stands():
    """A box of points, 2 x 4 x 6, around (1, 2, 3); a stray splat and faint ones do not move its foot."""
    corner = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    corner[:8] = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    box = cloud(3000, 0, 0).to(dtype=torch.float32)
    box = replace(
        box,
        means=corner * torch.tensor([2.0, 4, 6]) + torch.tensor([1.0, 2, 3]),
        logit_opacities=torch.full((3000,), 2.0),
    )
    stands = stance(box, torch.tensor([0.0, 0, 1]))
    torch.testing.assert_close(stands.foot.float(), torch.tensor([1.0, 2, 0]), atol=0.02, rtol=0)
    assert stands.height == pytest.approx(6, abs=0.02) and stands.radius == pytest.approx(2, abs=0.02)
    means, opacities = box.means.clone(), box.logit_opacities.clone()
    means[100], means[101:200], opacities[101:200] = torch.tensor([0.0, 0, -50]), -90.0, -6.0
    stray = replace(box, means=means, logit_opacities=opacities)
    assert stance(stray, torch.tensor([0.0, 0, 1])).height == pytest.approx(6, abs=0.05)
    with pytest.raises(SceneError, match="no size"):
        stance(replace(box, means=torch.zeros_like(means)), torch.tensor([0.0, 0, 1]))


def test_what_is_joined_keeps_its_bits():
    scene, thing = cloud(12, 1, 0).with_extra(part=torch.arange(12)), cloud(5, 3, 1).with_extra(other=torch.ones(5))
    whole = joined(scene, thing)
    assert len(whole) == 17 and whole.sh_degree == 3
    assert torch.equal(whole.extra[ADDED] > 0.5, torch.arange(17) >= 12)
    assert torch.equal(whole.extra["part"], torch.cat([torch.arange(12), torch.zeros(5, dtype=torch.long)]))
    for name in PARAMETERS:
        assert torch.equal(getattr(whole, name)[:12], getattr(with_degree(scene, 3), name)), name
        assert torch.equal(getattr(whole, name)[12:], getattr(thing, name)), name
    assert torch.equal(whole.shN[:12, :3], scene.shN) and not bool(whole.shN[:12, 3:].any())
