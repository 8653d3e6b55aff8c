"""Cameras without photographs: an orbit around given splats, and the path of a video among real views."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..errors import DataError
from .camera import Cameras, look_at
from .formats import AXES, CaptureOptions
from .sizes import fit
from .truth import SplatScene
from .views import Capture, View, split

SIZE = 512  # pixels of an orbit's square images
FOV = 50.0  # degrees, of an image's shorter side
# Half of the splats lie within the median distance. It is 0.79 of the radius of a full ball, which so takes 4/5 of the
# image, and leaves room for what is longer than wide.
MARGIN = 1.6
LEVEL = 1e-3  # weight of the images' own up, for cameras that all look one way
ROUND = 300.0  # degrees of azimuth from which on a capture goes round


def orbit_capture(scene: SplatScene, options: CaptureOptions) -> Capture:
    """Views without photographs on a ring around the opacity-weighted mean of the splats.

    The ring's height waves between 0 and 30 degrees above the middle. Its radius is such that a ball of MARGIN times
    the opacity-weighted median distance from the middle (each splat's largest standard deviation added) fills the
    image; the median leaves stray splats and far background aside. Which way is up is not in the splats:
    options.orbit_up says it, by default -y, as COLMAP's worlds are when the first photograph was held upright
    (OpenCV's y is down); nerfstudio's exports have z. Raises DataError for zero splats or fully
    transparent ones.
    """
    axis = options.orbit_up
    if len(scene.means) == 0:
        raise DataError("data: zero splats have no middle to go round; name a capture with data.source")
    opacity = scene.opacities.detach().cpu().double()
    means, sizes = scene.means.detach().cpu().double(), scene.scales.detach().cpu().double().amax(dim=1)
    if not opacity.sum() > 0:
        raise DataError("data: all splats are fully transparent, so there is nothing to go round; name a data.source")
    middle = (opacity[:, None] * means).sum(dim=0) / opacity.sum()
    radius = MARGIN * _median((means - middle).norm(dim=1) + sizes, opacity)

    _, width, height = fit(SIZE, SIZE, options)
    half = math.radians(FOV) / 2
    focal = 0.5 * min(width, height) / math.tan(half)
    n = options.orbit_views
    angle = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    tilt = torch.deg2rad(15 - 15 * torch.cos(3 * angle))
    up = torch.eye(3, dtype=torch.float64)[AXES[axis]] * (-1 if axis.startswith("-") else 1)
    eyes = middle + radius / math.sin(half) * _direction(_upright(up, up.roll(1)), angle, tilt)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).repeat(n, 1, 1)
    cameras = Cameras(look_at(eyes, middle, up), K.double(), width, height).to(dtype=torch.float32)
    train, test = split(n, options, "orbit")
    notice = f"orbit of {n} views around the splats; up is taken to be {axis}: set data.orbit_up if they lie on a side"
    views = [View(f"{i:04d}", cameras[i], None) for i in range(n)]
    return Capture(Path("orbit"), views, train, test, notices=(notice,), options=options)


def video_path(cameras: Cameras, n_frames: int) -> Cameras:
    """A smooth closed path of `n_frames` cameras among the given ones, all looking at their common point.

    Where the cameras go round that point (ROUND degrees of azimuth without a wider gap), the path goes round too,
    else it is a loop over the part that they cover. Each centre is an average of camera centres, weighted by how near
    they are in direction as seen from the common point, and so lies within their convex hull: nowhere does the path
    show what no camera was near. Up is the mean of the cameras' ups, intrinsics are their median.
    Raises DataError for n_frames < 1 or without cameras.
    """
    if n_frames < 1 or len(cameras) == 0:
        raise DataError(f"video: {n_frames} frames along {len(cameras)} cameras; expected at least one of each")
    viewmats, centers = cameras.viewmats.double(), cameras.to(dtype=torch.float64).centers
    target = common_point(cameras).double()
    up = viewmats[:, 1, :3].mean(dim=0).neg()
    up = normalize(up if up.norm() > 1e-3 else -viewmats[0, 1, :3], dim=0)
    outward = normalize(centers - target, dim=1)
    basis = _upright(up, outward.mean(dim=0))
    local = outward @ basis.T  # components along the mean view, to its side, and up
    azimuth, elevation = torch.atan2(local[:, 1], local[:, 0]), local[:, 2].clamp(-1, 1).asin()
    start, cover, gap = _arc(azimuth)
    low, high = (float(elevation.quantile(q)) for q in (0.1, 0.9))
    # Wide enough to pass smoothly from each camera to its neighbours, narrow enough to stay near them.
    width = min(max(0.5 * gap, min(0.15 * cover, 0.3), 0.02), 0.6)

    def eyes_at(turn: Tensor) -> Tensor:
        if cover >= math.radians(ROUND) - 1e-6:
            path = turn, elevation.median().expand_as(turn)
        else:  # an ellipse over the middle of what is covered
            path = start + cover / 2 * (1 - 0.8 * turn.cos()), (low + high) / 2 + (high - low) / 2 * turn.sin()
        nearness = _direction(basis, *path) @ outward.T
        return ((nearness - 1) / width**2).softmax(dim=1) @ centers

    turn = torch.linspace(0, 2 * math.pi, 8 * n_frames + 1, dtype=torch.float64, device=target.device)
    gone = np.append(0, eyes_at(turn).diff(dim=0).norm(dim=1).cumsum(dim=0).cpu())  # length of the path so far
    even = np.interp(gone[-1] * np.arange(n_frames) / n_frames, gone, turn.cpu())  # the same speed all along
    eyes = eyes_at(torch.from_numpy(even).to(turn))
    K = cameras.Ks.median(dim=0).values.repeat(n_frames, 1, 1)
    return Cameras(look_at(eyes, target, up).to(cameras.viewmats.dtype), K, cameras.width, cameras.height)


def common_point(cameras: Cameras) -> Tensor:
    """The point [3] nearest to all optical axes, by least squares.

    Along directions that the axes leave open (one camera, parallel ones), and where that point is not in front of the
    cameras, it is the one straight before their mean centre at twice their spread (1 world unit where they coincide).
    """
    centers, forward = cameras.to(dtype=torch.float64).centers, normalize(cameras.forward.double(), dim=1)
    middle, ahead = centers.mean(dim=0), forward.mean(dim=0)
    ahead = normalize(ahead if ahead.norm() > 1e-3 else forward[0], dim=0)
    spread = float((centers - middle).norm(dim=1).square().mean().sqrt())
    reach = 2 * spread if spread > 1e-6 * (1 + float(middle.norm())) else 1.0
    default = middle + reach * ahead
    across = torch.eye(3, dtype=torch.float64, device=centers.device) - forward[:, :, None] * forward[:, None, :]
    missing = (across @ (centers - default)[:, :, None])[:, :, 0].mean(dim=0)
    point = default + torch.linalg.pinv(across.mean(dim=0), rtol=1e-4, hermitian=True) @ missing
    depth = float(((point - centers) * forward).sum(dim=1).mean())
    return (point if depth > 0.1 * reach else default).to(cameras.viewmats.dtype)


def world_up(cameras: Cameras) -> Tensor:
    """The direction [3], unit, that is up in the world of these cameras, if they are held level: at right angles to
    what is right in their images, as far as those directions tell, and nearest to what is up in them."""
    viewmats = cameras.viewmats.double()
    right, up = viewmats[:, 0, :3], normalize(-viewmats[:, 1, :3].mean(dim=0), dim=0)
    spread = right.T @ right / len(right) - LEVEL * torch.outer(up, up)
    found = torch.linalg.eigh(spread).eigenvectors[:, 0]
    return found if float(found @ up) >= 0 else -found


def _median(values: Tensor, weights: Tensor) -> float:
    """The value below which half of the weight lies."""
    order = values.argsort()
    total = weights[order].cumsum(dim=0)
    return float(values[order][torch.searchsorted(total, total[-1] / 2).clamp(max=len(values) - 1)])


def _upright(up: Tensor, toward: Tensor) -> Tensor:
    """Rows [3,3]: the direction nearest to `toward` at right angles to `up`, the one to its side, and `up`."""
    flat = toward - (toward @ up) * up
    if float(flat.norm()) < 1e-6:
        flat = torch.linalg.cross(up, up.roll(1) + 2 * up.roll(2))  # any direction that is not up itself
    flat = normalize(flat, dim=0)
    return torch.stack([flat, torch.linalg.cross(up, flat), up])


def _direction(basis: Tensor, azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Unit vectors [n,3] at these angles (radians) of a basis made by `_upright`."""
    flat = elevation.cos()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin()], dim=1) @ basis


def _arc(azimuth: Tensor) -> tuple[float, float, float]:
    """The shortest arc that holds all angles: its start, its length, and the widest gap within it (radians)."""
    ordered = azimuth.sort().values
    gaps = torch.cat([ordered.diff(), ordered[:1] + 2 * math.pi - ordered[-1:]])
    widest = int(gaps.argmax())
    others = torch.cat([gaps[:widest], gaps[widest + 1 :]])
    start = float(ordered[(widest + 1) % len(ordered)])
    return start, float(2 * math.pi - gaps[widest]), float(others.max()) if len(others) else 0.0
