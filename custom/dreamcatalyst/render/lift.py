"""Pictures of weights brought back to the splats that they were seen on: how much of each splat lies inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ..data.camera import Cameras
from ..errors import SceneError
from ..scene.gaussians import Gaussians
from .api import rasterize

Masks = Shaped[Tensor, "V H W"] | Sequence[Shaped[Tensor, "H W"]]


@dataclass(frozen=True)
class Evidence:
    """What some views say of each splat; evidence of other views is added to it with +.

    inside [N]: sum over views and pixels of alpha T M; total [N]: of alpha T; both in pixels, 0 <= inside <= total.
    Of `vote`: sums of M and of 1, in pixels.
    """

    inside: Float[Tensor, " N"]
    total: Float[Tensor, " N"]

    def __add__(self, other: Evidence) -> Evidence:
        return Evidence(self.inside + other.inside, self.total + other.total)


def lift(
    scene: Gaussians,
    cameras: Cameras,
    masks: Masks,
    *,
    backend: str = "auto",
    antialiased: bool = False,
) -> Evidence:
    """How much of each splat is seen, and how much of that lies inside the masks (GaussianEditor, Chen et al. 2024,
    equation 3, normalised by what is seen).

    cameras: V views; masks [V,H,W] (or V tensors [H,W]) in [0,1]; backend, antialiased: as in `api.rasterize`.
    A pixel of a rendered feature is the sum of alpha T times the splats' features. Its derivative in them, with the
    mask as cotangent, is the sum that is wanted, whatever draws it; nothing else is differentiated. One view is in
    memory at a time. The sums have the scene's type and device and no graph. Raises SceneError for masks of another
    number or size than the views.
    """
    _check(cameras, masks)
    scene, found = scene.detach(), scene.means.new_zeros(len(scene), 2)
    for v in range(len(cameras)):
        features = torch.zeros_like(found, requires_grad=True)
        with torch.enable_grad():
            image = rasterize(
                scene, cameras[v], features=features, sh_degree=0, backend=backend, antialiased=antialiased
            ).features
        if image is None:
            raise SceneError(f"lift: backend '{backend}' draws no features")
        mask = masks[v].to(image)
        (gradient,) = torch.autograd.grad(image, features, torch.stack([mask, torch.ones_like(mask)], dim=-1)[None])
        found += gradient
    return Evidence(*found.unbind(dim=1))


def vote(scene: Gaussians, cameras: Cameras, masks: Masks, *, antialiased: bool = False) -> Evidence:
    """GaussianEditor's count as its code has it, for comparison: every splat that contributes to a pixel counts there
    with M and with 1, however little of it is seen.

    Arguments and result as in `lift`. What contributes is decided by render/thresholds.py. It is no derivative of an
    image, so it runs on the CPU in float32, wherever the scene is.
    """
    from .cpu.vote import count

    _check(cameras, masks)
    on_cpu, cameras = scene.detach().to("cpu", torch.float32), cameras.to("cpu", torch.float32)
    found = torch.zeros(len(scene), 2)
    for v in range(len(cameras)):
        found += count(on_cpu, cameras[v], masks[v].to("cpu", torch.float32), antialiased)
    return Evidence(*found.to(scene.means).unbind(dim=1))


def _check(cameras: Cameras, masks: Masks) -> None:
    sizes = sorted({tuple(mask.shape) for mask in masks})
    size = (cameras.height, cameras.width)
    if len(masks) != len(cameras) or sizes != [size]:
        raise SceneError(f"masks: got {len(masks)} of shapes {sizes}, expected {len(cameras)} of shape {size}")
