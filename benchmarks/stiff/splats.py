"""Stiff and extreme splats, cameras and images: the compiled renderer in float32 against the dense one in float64."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.data.loader import open_capture
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.render.projection import project
from dreamcatalyst.render.thresholds import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.ply import read_ply, write_ply
from dreamcatalyst.scene.plyfile import read_vertices
from torch import Tensor

from .cases import Case, Check, compare, worst

DEPTH = 4.0  # of the middle of the cloud before the camera
MARGIN = 1e-2  # a decision of the image model is open where it turns on less than this, relatively
LEAST = 0.2  # of a case's pixels must be decided


def cloud(n: int = 30, degree: int = 1, seed: int = 0) -> Gaussians:
    """An ordinary cloud of splats in a box of two world units around (0, 0, DEPTH), float64, with numbers that float32
    has not."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    means = torch.rand(n, 3, generator=g, dtype=torch.float64) * 2 - 1
    return Gaussians(
        means=means + means.new_tensor([0.0, 0.0, DEPTH]),
        quats=normal(n, 4),
        log_scales=normal(n, 3) * 0.4 - 2.0,
        logit_opacities=normal(n),
        sh0=normal(n, 1, 3),
        shN=normal(n, (degree + 1) ** 2 - 1, 3) * 0.3,
    )


def pinhole(width: int = 21, height: int = 17, focal: float = 1.4, eye: tuple[float, float, float] = (0, 0, 0)):
    """A camera at `eye` that looks along z; focal: in image widths."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.tensor(eye, dtype=torch.float64)
    pixels = focal * width
    K = torch.tensor([[pixels, 0, 0.53 * width], [0, pixels, 0.48 * height], [0, 0, 1]], dtype=torch.float64)
    return Cameras(viewmat[None], K[None], width, height)


def decided(scene: Gaussians, cameras: Cameras, antialiased: bool, margin: float) -> Tensor:
    """Pixels [H,W] in which no splat's alpha stands near a threshold of the image model, and no transmittance near the
    stop: at the others, the image jumps, and float32 may land on either side."""
    splats = project(scene.means, scene.quats, scene.scales, cameras)
    order = splats.depths[0].argsort(stable=True)
    order = order[splats.in_front[0, order]]
    opacities = scene.opacities * (splats.compensation[0] if antialiased else 1.0)
    means, dets = splats.means2d[0, order], splats.dets[0, order]
    _, xy, yy = splats.covs2d[0, order].unbind(-1)
    x = torch.arange(cameras.width).double()[None, :, None] + 0.5 - means[:, 0]
    y = torch.arange(cameras.height).double()[:, None, None] + 0.5 - means[:, 1]
    alpha = opacities[order] * torch.exp(-0.5 * ((x - y * (xy / yy)) ** 2 * (yy / dets) + y * y / yy))
    edge = torch.zeros(alpha.shape[:2], dtype=torch.bool)
    for threshold in (ALPHA_MIN, ALPHA_MAX):
        edge |= ((alpha / threshold - 1).abs() < margin).any(-1)
    drawn = torch.where(alpha >= ALPHA_MIN, alpha.clamp_max(ALPHA_MAX), 0.0)
    through = torch.cumprod(1 - drawn, dim=-1)
    return ~(edge | ((through / TRANSMITTANCE_MIN - 1).abs() < margin).any(-1))


def outcome(scene: Gaussians, cameras: Cameras, backend: str, cotangents: Tensor, window=None, **options: Any):
    """Images [H,W,4] (rgb, alpha) and the derivatives of sum(cotangents * images) by parameter. window: (left, top) of
    the part of the image that cotangents [h,w,4] cover; all of it where None."""
    scene = scene.detach().clone()
    leaves = {name: value.requires_grad_() for name, value in scene.parameters()}
    render = rasterize(scene, cameras, backend=backend, background=scene.means.new_tensor([0.2, 0.5, 0.9]), **options)
    image = torch.cat([render.rgb[0], render.alpha[0]], dim=-1)
    if window is not None:
        (left, top), (h, w) = window, cotangents.shape[:2]
        image = image[top : top + h, left : left + w]
    image.backward(cotangents.to(image))
    grads = {n: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for n, leaf in leaves.items()}
    return image.detach(), grads


def drawn(
    change: Callable[[Gaussians], None] | None = None,
    *,
    n: int = 30,
    degree: int = 1,
    camera: Cameras | None = None,
    crop: tuple[int, int, int, int] | None = None,
    margin: float = MARGIN,
    **options: Any,
) -> Callable[[], list[Check]]:
    """A case: a cloud of `n` splats, changed in place, seen by one camera. crop: (left, top, width, height) of the
    window in which the reference looks, where all of the image is too large for it."""

    def run() -> list[Check]:
        scene, cameras = cloud(n, degree), camera or pinhole()
        if change is not None:
            change(scene)
        half, seen, half_seen = scene.to(dtype=torch.float32), cameras, cameras.to(dtype=torch.float32)
        half_seen = half_seen.to(dtype=torch.float64)
        if crop is not None:
            seen, half_seen = seen.cropped(*crop), half_seen.cropped(*crop)
        rounded = half.to(dtype=torch.float64), half_seen
        return judged((scene, seen), rounded, (half, cameras), crop and crop[:2], margin, **options)

    return run


def judged(
    true: tuple[Gaussians, Cameras],
    rounded: tuple[Gaussians, Cameras],
    given: tuple[Gaussians, Cameras],
    window: tuple[int, int] | None = None,
    margin: float = MARGIN,
    **options: Any,
) -> list[Check]:
    """Image and derivatives of the compiled renderer for `given` against the reference's for `true` and `rounded`."""
    settled = decided(*true, options.get("antialiased", False), margin)
    share = float(settled.double().mean())
    if share < LEAST:
        raise ValueError(f"only {share:.0%} of the pixels are decided, so that little would be shown")
    where = settled[..., None]
    cotangents = torch.randn(*settled.shape, 4, generator=torch.Generator().manual_seed(7)).double() * where
    truth, slopes = outcome(*true, "reference", cotangents, **options)
    nearby, moved_slopes = outcome(*rounded, "reference", cotangents, **options)
    got, grads = outcome(*given, "cpu", cotangents, window, **options)
    image = compare("image", got * where, truth * where, nearby * where)
    each = {name: compare(name, grads[name], slopes[name], moved_slopes[name]) for name in PARAMETERS}
    finite = image.finite and bool(got.isfinite().all())
    return [Check("image", finite, image.error, image.tolerance), worst("gradient", each)]


def recentred() -> list[Check]:
    """Splats (a PLY of doubles) and cameras (INRIA's cameras.json) of a world around 1e6, as they are loaded, and what
    is written again."""
    scene, cameras, far = cloud(), pinhole(20, 16), np.array(FAR_AWAY)
    K = cameras.Ks.clone()
    K[:, :2, 2] = torch.tensor([10.0, 8.0])  # this format's principal point is the middle
    cameras = replace(cameras, Ks=K)
    with tempfile.TemporaryDirectory() as folder:
        ply = write_ply(Path(folder) / "far.ply", scene, origin=FAR_AWAY)
        axes, focal, size = np.eye(3).tolist(), float(K[0, 0, 0]), {"width": 20, "height": 16}
        places = [(far + [x, 0, 0]).tolist() for x in (0.0, -2.0, 2.0)]
        entries = [{"position": place, "rotation": axes, "fx": focal, "fy": focal, **size} for place in places]
        (Path(folder) / "cameras.json").write_text(json.dumps(entries))
        capture = open_capture(Path(folder))
        loaded = read_ply(ply, origin=capture.origin)
        written = read_vertices(write_ply(Path(folder) / "again.ply", loaded, origin=capture.origin))
        back = torch.from_numpy(np.stack([written.columns[name] for name in "xyz"], axis=1) - far)
    rounded = scene.to(dtype=torch.float32).to(dtype=torch.float64), cameras.to(dtype=torch.float32)
    rounded = rounded[0], rounded[1].to(dtype=torch.float64)
    checks = judged((scene, cameras), rounded, (loaded, capture.views[0].camera))
    return [*checks, compare("positions written", back, scene.means, rounded[0].means)]


# --- the changes


def put(**values: Any) -> Callable[[Gaussians], None]:
    """Fill these raw parameters, for all splats alike."""

    def change(scene: Gaussians) -> None:
        for name, value in values.items():
            tensor = getattr(scene, name)
            tensor[:] = torch.as_tensor(value, dtype=tensor.dtype)

    return change


def scaled(*sizes: float) -> Callable[[Gaussians], None]:
    """Scales in world units: one for all axes, or one for each."""
    return put(log_scales=torch.tensor(sizes, dtype=torch.float64).log())


def both(*changes: Callable[[Gaussians], None]) -> Callable[[Gaussians], None]:
    """One change after the other."""

    def change(scene: Gaussians) -> None:
        for one in changes:
            one(scene)

    return change


def times(name: str, factor: float | list[float]) -> Callable[[Gaussians], None]:
    """Multiply a raw parameter; a list: in turn over the splats."""

    def change(scene: Gaussians) -> None:
        value = getattr(scene, name)
        each = torch.as_tensor(factor, dtype=value.dtype).reshape(-1)
        each = each.repeat(-(-len(value) // len(each)))[: len(value)]
        value *= each.reshape(-1, *[1] * (value.ndim - 1))

    return change


def spread_scales(scene: Gaussians) -> None:
    """Every axis of every splat its own scale, from 1e-8 to 1e4."""
    g = torch.Generator().manual_seed(1)
    exponents = torch.rand(len(scene), 3, generator=g, dtype=torch.float64) * 12 - 8
    scene.log_scales[:] = exponents * torch.log(torch.tensor(10.0, dtype=torch.float64))


def moved(*offset: float) -> Callable[[Gaussians], None]:
    """All splats by this offset."""

    def change(scene: Gaussians) -> None:
        scene.means.add_(torch.tensor(offset, dtype=torch.float64))

    return change


def on_a_ray(scene: Gaussians) -> None:
    """All splats on the optical axis of a pixel's centre, one behind the other."""
    scene.means[:, :2] = 0.0
    scene.means[:, 2] = torch.linspace(2, 6, len(scene), dtype=torch.float64)


def small_in_the_middle(scene: Gaussians) -> None:
    """All splats within a hundredth of the box, and a twentieth of their size."""
    scene.means[:, :2].mul_(0.01)
    scene.log_scales.sub_(3.0)


def in_layers(scene: Gaussians) -> None:
    """Depths an eighth apart: what float32 can still tell apart at a distance of 1e6."""
    scene.means[:, 2] = DEPTH + 0.125 * torch.arange(len(scene)).double()


def at_depths(*depths: float) -> Callable[[Gaussians], None]:
    """Depths in turn over the splats, x and y in proportion, so that each stays where it is in the image."""

    def change(scene: Gaussians) -> None:
        new = torch.tensor(depths, dtype=torch.float64).repeat(-(-len(scene) // len(depths)))[: len(scene)]
        scene.means[:, :2] *= (new / scene.means[:, 2])[:, None]
        scene.means[:, 2] = new

    return change


FAR_AWAY = (1e6, -1e6, 1e6)
NEAR_SIDES = (0.01 * (1 - 1e-3), 0.01 * (1 + 1e-3), 0.02)
CASES = [
    Case("splats", name, run)
    for name, run in {
        "an ordinary cloud": drawn(),
        "ordinary, antialiased": drawn(antialiased=True),
        "scales of 1e-8": drawn(scaled(1e-8)),
        "scales of 1e-8, antialiased": drawn(scaled(1e-8), antialiased=True),
        "scales of 1e-4": drawn(scaled(1e-4)),
        "scales of 1e2": drawn(both(scaled(1e2), put(logit_opacities=-2.0))),
        "scales of 1e4": drawn(both(scaled(1e4), put(logit_opacities=-2.0))),
        "each axis from 1e-8 to 1e4": drawn(spread_scales),
        "each axis from 1e-8 to 1e4, antialiased": drawn(spread_scales, antialiased=True),
        "needles of condition 1e8": drawn(scaled(1.0, 1e-8, 1e-8)),
        "needles of condition 1e8, antialiased": drawn(scaled(1.0, 1e-8, 1e-8), antialiased=True),
        "needles from 1e4 to 1e-4": drawn(scaled(1e4, 1e-4, 1e-4)),
        "discs of condition 1e8": drawn(both(scaled(1.0, 1.0, 1e-8), put(logit_opacities=-2.0))),
        "opacity logits of 50": drawn(put(logit_opacities=50.0)),
        "opacity logits of -50": drawn(put(logit_opacities=-50.0)),
        "opacity logits of 1000 and -1000": drawn(both(put(logit_opacities=1000.0), times("logit_opacities", [1, -1]))),
        "zero quaternions": drawn(put(quats=0.0)),
        "quaternions of 1e20": drawn(times("quats", 1e20)),
        "quaternions of 1e30 to 1e-10": drawn(times("quats", [1e30, 1e-10, 1.0])),
        "30 coincident splats": drawn(put(means=[0.1, -0.05, DEPTH])),
        "3000 coincident splats": drawn(put(means=[0.1, -0.05, DEPTH]), n=3000, camera=pinhole(9, 7)),
        "100,000 on one ray, opaque": drawn(on_a_ray, n=10**5, degree=0, camera=pinhole(1, 1), margin=1e-4),
        "a million on one ray, faint": drawn(
            both(on_a_ray, put(logit_opacities=-5.4)), n=10**6, degree=0, camera=pinhole(1, 1), margin=1e-4
        ),
        "a camera inside of splats": drawn(both(at_depths(0.011, 0.5, 3.0), scaled(1.0), put(logit_opacities=-1.0))),
        "a camera in the middle of a splat": drawn(lambda scene: scene.means[:3].zero_(), degree=3),
        "splats on the near plane": drawn(both(at_depths(*NEAR_SIDES), scaled(1e-4))),
        "large splats on the near plane": drawn(both(at_depths(*NEAR_SIDES), scaled(1.0))),
        "far away, 1e4": drawn(camera=pinhole(focal=1.4e4 / DEPTH, eye=(0, 0, -1e4))),
        "far away, 1e6, in layers": drawn(in_layers, camera=pinhole(focal=1.4e6 / DEPTH, eye=(0, 0, -1e6))),
        "far away, 1e6, all on one pixel": drawn(in_layers, camera=pinhole(eye=(0, 0, -1e6))),
        "a world around 1e6, as it is loaded": recentred,
        "a world around 1e6, left where it is": drawn(moved(*FAR_AWAY), camera=pinhole(eye=FAR_AWAY)),
        "a world of 1e-4": drawn(both(times("means", 1e-1), times("log_scales", 2.0)), camera=pinhole()),
        "colour coefficients of 1e3": drawn(both(times("sh0", 1e3), times("shN", 1e3)), degree=3),
        "colour coefficients of -1e3": drawn(put(sh0=-1e3)),
        "no splat": drawn(n=0),
        "one splat": drawn(n=1),
        "an image of 1 x 1": drawn(camera=pinhole(1, 1)),
        "an image of 4096 x 8": drawn(camera=pinhole(4096, 8)),
        "an image of 8 x 4096": drawn(camera=pinhole(8, 4096, focal=100.0)),
        "an image of 4096 x 2304, a crop": drawn(
            small_in_the_middle, camera=pinhole(4096, 2304), crop=(2140, 1083, 61, 47)
        ),
        "an image of 63 x 17": drawn(camera=pinhole(63, 17)),
        "a view of 179 degrees": drawn(camera=pinhole(focal=0.005)),
        "all splats behind": drawn(moved(0, 0, -2 * DEPTH)),
        "splats a million pixels away": drawn(moved(2e5, 0, 0)),
    }.items()
]
