"""Orbits around splats, and video paths: inside the hull of the cameras, closed, even, looking at the common point."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.data.formats import CaptureOptions
from dreamcatalyst.data.orbit import FOV, MARGIN, common_point, orbit_capture, video_path
from dreamcatalyst.errors import ConfigError, DataError
from dreamcatalyst.scene.gaussians import Gaussians
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
TARGET = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)


def ball(n: int = 2000, center=(5.0, -1.0, 2.0), radius: float = 3.0) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    means = directions * torch.rand(n, 1, generator=g) ** (1 / 3) * radius + torch.tensor(center)
    return Gaussians.from_colors(means, torch.full((n, 3), 1e-3), torch.rand(n, 3), torch.full((n,), 0.5))


def looking(eyes: torch.Tensor, target: torch.Tensor = TARGET, up: torch.Tensor = UP) -> Cameras:
    """Cameras of 40x30 pixels with an off-centre principal point at `eyes` [V,3]."""
    K = torch.tensor([[50, 0, 21], [0, 55, 14], [0, 0, 1]], dtype=torch.float64)
    return Cameras(look_at(eyes, target, up), K.repeat(len(eyes), 1, 1), 40, 30)


def ring(n: int, degrees: float = 360.0, radius: float = 4.0) -> torch.Tensor:
    """Eyes on an arc of a horizontal circle around TARGET, at heights that alternate."""
    angle = torch.arange(n, dtype=torch.float64) / (n if degrees == 360 else n - 1) * math.radians(degrees)
    height = -1.0 - 0.5 * (torch.arange(n) % 2)
    return TARGET + torch.stack([radius * angle.cos(), height, radius * angle.sin()], dim=1)


def in_hull(point: np.ndarray, corners: np.ndarray) -> bool:
    """Whether `point` is a convex combination of `corners`, to 1e-6: by linear programming."""
    corners = corners - point
    equalities = np.concatenate([corners.T, np.ones((1, len(corners)))])
    slack = np.concatenate([np.eye(3), -np.eye(3)], axis=1)  # what is missing to hit the point, to be least
    equalities = np.concatenate([equalities, np.concatenate([slack, np.zeros((1, 6))])], axis=1)
    cost = np.append(np.zeros(len(corners)), np.ones(6))
    found = linprog(cost, A_eq=equalities, b_eq=[0, 0, 0, 1], bounds=(0, None))
    return found.status == 0 and found.fun < 1e-6


def assert_looks_at(path: Cameras, point: torch.Tensor) -> None:
    towards = torch.nn.functional.normalize(point.to(path.centers) - path.centers, dim=1)
    torch.testing.assert_close((towards * path.forward).sum(dim=1), torch.ones_like(towards[:, 0]))


def steps(path: Cameras) -> torch.Tensor:
    """Distances between successive frames, the last one to the first."""
    return (path.centers - path.centers.roll(1, 0)).norm(dim=1)


# --- orbits


def test_an_orbit_goes_round_the_opacity_weighted_mean():
    scene = ball()
    capture = orbit_capture(scene, CaptureOptions())
    cameras = capture.cameras()
    weights = scene.opacities[:, None] / scene.opacities.sum()
    middle = (weights * scene.means).sum(dim=0)
    assert (len(capture), len(capture.test), capture.has_photos, capture.points) == (48, 6, False, None)
    assert (cameras.width, cameras.height) == (512, 512)
    assert_looks_at(cameras, middle)
    offsets = cameras.centers - middle
    median = (scene.means - middle).norm(dim=1).median() + 1e-3
    expected = MARGIN * median / math.sin(math.radians(FOV / 2))
    torch.testing.assert_close(offsets.norm(dim=1), expected.expand(48), rtol=2e-3, atol=0)
    assert (offsets[:, 1] < 1e-4).all()  # never below the middle, where -y is up
    azimuth = torch.atan2(offsets[:, 2], offsets[:, 0]).sort().values
    torch.testing.assert_close(azimuth.diff(), torch.full((47,), 2 * math.pi / 48), rtol=1e-3, atol=1e-4)


def test_a_full_ball_is_all_in_the_picture_and_fills_most_of_it():
    scene = ball()
    cameras = orbit_capture(scene, CaptureOptions()).cameras()
    points = torch.einsum("vij,nj->vni", cameras.viewmats[:, :3, :3], scene.means) + cameras.viewmats[:, None, :3, 3]
    pixels = torch.einsum("vij,vnj->vni", cameras.Ks, points)
    pixels = pixels[..., :2] / pixels[..., 2:]
    assert (points[..., 2] > 0).all() and (pixels > 0).all() and (pixels < 512).all()
    assert pixels.amax() - pixels.amin() > 0.75 * 512


def test_stray_splats_do_not_push_the_orbit_away():
    few = ball(40, center=(0.0, 0.0, 0.0), radius=1.0)
    near = ball(2000, center=(0.0, 0.0, 0.0), radius=1.0)
    stray = Gaussians.cat([near, few.map(lambda t: t)])
    stray = Gaussians(stray.means.clone(), *(value for _, value in list(stray.parameters())[1:]))
    stray.means[2000:] *= 500.0
    distance = [float((orbit_capture(s, CaptureOptions()).cameras().centers).norm(dim=1).mean()) for s in (near, stray)]
    assert distance[1] < 10 * distance[0]  # the farthest splats are 500 times as far away


@pytest.mark.parametrize("axis", ["x", "y", "z", "-x", "-y", "-z"])
def test_an_orbit_stands_upright_in_the_axis_that_is_named(axis):
    capture = orbit_capture(ball(), CaptureOptions(orbit_up=axis, orbit_views=12))
    up = torch.zeros(3)
    up["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    assert ((-capture.cameras().viewmats[:, 1, :3] @ up) > 0.8).all()  # tilted by 30 degrees at most
    assert f"taken to be {axis}" in capture.notices[0] and "data.orbit_up" in capture.notices[0]


@pytest.mark.parametrize(
    "options, size",
    [(dict(downscale=4), (128, 128)), (dict(width=96), (96, 96)), (dict(width=96, height=64), (96, 64))],
)
def test_orbits_have_the_size_that_is_asked_for(options, size):
    cameras = orbit_capture(ball(), CaptureOptions(**options)).cameras()
    assert (cameras.width, cameras.height) == size
    field = 2 * math.degrees(math.atan(min(size) / 2 / float(cameras.Ks[0, 0, 0])))
    assert field == pytest.approx(FOV, rel=1e-5)


def test_one_splat_and_none():
    one = ball(1)
    cameras = orbit_capture(one, CaptureOptions()).cameras()
    assert cameras.viewmats.isfinite().all()
    assert_looks_at(cameras, one.means[0])
    with pytest.raises(DataError, match="zero splats"):
        orbit_capture(one[:0], CaptureOptions())
    with pytest.raises(ConfigError, match="data.orbit_up: unknown orbit_up value 'w'.*Known: -x, -y, -z, x, y, z"):
        parse(CaptureOptions, {"orbit_up": "w"}, "data")


# --- the common point


def test_axes_that_meet_meet_in_the_common_point():
    torch.testing.assert_close(common_point(looking(ring(7, 200))), TARGET)


def test_two_skew_axes_meet_in_the_middle_of_their_common_normal():
    eyes = torch.tensor([[-3.0, 1.0, 0.0], [0.0, -1.0, -3.0]], dtype=torch.float64)
    cameras = looking(eyes, target=eyes + torch.tensor([[1.0, 0, 0], [0, 0, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(common_point(cameras), torch.zeros(3, dtype=torch.float64))


def test_parallel_axes_meet_before_their_mean_centre():
    eyes = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    cameras = looking(eyes, target=eyes + torch.tensor([0, 0, 5.0], dtype=torch.float64))
    torch.testing.assert_close(common_point(cameras), torch.tensor([0, 0, 2.0], dtype=torch.float64))


def test_cameras_that_look_outwards_have_no_common_point_behind_them():
    """The nearest point of their axes is the middle, behind all of them."""
    eyes = torch.tensor([[0.1, 0, 1.0], [-0.1, 0, 1.0], [0, 0.1, 1.0]], dtype=torch.float64)
    cameras = looking(eyes, target=2 * eyes)
    assert float(common_point(cameras)[2]) > 1.0


# --- video paths


@pytest.mark.parametrize("cameras", [8, 36])
def test_a_path_goes_round_where_the_cameras_do(cameras):
    given = looking(ring(cameras))
    path = video_path(given, 60)
    offsets = path.centers - TARGET
    turned = torch.atan2(offsets[:, 2], offsets[:, 0]).numpy()
    assert abs(np.unwrap(np.append(turned, turned[0]))[-1] - turned[0]) == pytest.approx(2 * math.pi)
    assert offsets[:, [0, 2]].norm(dim=1).min() > 0.75 * 4.0
    assert_looks_at(path, TARGET)


@pytest.mark.parametrize("degrees, cameras", [(30, 5), (120, 20), (240, 15), (360, 24)])
def test_paths_are_closed_even_and_within_the_hull(degrees, cameras):
    given = looking(ring(cameras, degrees))
    path = video_path(given, 48)
    assert (len(path), path.width, path.height) == (48, 40, 30)
    assert steps(path).max() < 1.25 * steps(path).mean()  # the step from the last to the first frame included
    assert all(in_hull(center.numpy(), given.centers.numpy()) for center in path.centers)
    assert_looks_at(path, TARGET)
    torch.testing.assert_close(path.Ks, given.Ks[:1].expand(48, 3, 3))


def test_a_path_covers_most_of_an_arc():
    given = looking(ring(20, 120))
    offsets = video_path(given, 64).centers - TARGET
    angle = torch.rad2deg(torch.atan2(offsets[:, 2], offsets[:, 0]))
    assert float(angle.max() - angle.min()) > 70.0


def test_a_path_over_an_arc_does_not_cut_through_what_is_looked_at():
    """The centre of a half circle is close to the object: the path must keep its distance, though in the hull."""
    offsets = video_path(looking(ring(25, 200)), 64).centers - TARGET
    assert offsets.norm(dim=1).min() > 0.8 * 4.0


@given(st.integers(1, 6), st.integers(0, 10_000), st.sampled_from(["any", "coincident", "parallel"]))
@settings(max_examples=60, deadline=None)
def test_any_cameras_have_a_path(n, seed, kind):
    g = torch.Generator().manual_seed(seed)
    eyes = torch.randn(n, 3, generator=g, dtype=torch.float64)
    target = torch.randn(n, 3, generator=g, dtype=torch.float64)
    if kind == "coincident":
        eyes = eyes[:1].expand(n, 3)
    if kind == "parallel":
        target = eyes + target[:1]
    given = looking(eyes, target=target)
    path = video_path(given.to(dtype=torch.float32), 7)
    assert path.viewmats.dtype == torch.float32 and path.viewmats.isfinite().all()
    rotation = path.viewmats[:, :3, :3].double()
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(7, 3, 3), atol=1e-5, rtol=0
    )
    assert all(in_hull(c.numpy(), given.centers.numpy()) for c in video_path(given, 7).centers)


def test_one_camera_gives_its_own_view():
    given = looking(TARGET + torch.tensor([[0.0, -1.0, -4.0]], dtype=torch.float64))
    torch.testing.assert_close(video_path(given, 3).viewmats, given.viewmats.expand(3, 4, 4))


def test_a_path_needs_frames():
    with pytest.raises(DataError, match="0 frames"):
        video_path(looking(ring(3)), 0)


def test_transparent_splats_have_no_middle():
    scene = Gaussians.from_colors(torch.randn(5, 3), torch.ones(5, 3), torch.zeros(5, 3), torch.zeros(5))
    with pytest.raises(DataError, match="transparent"):
        orbit_capture(scene, CaptureOptions())
