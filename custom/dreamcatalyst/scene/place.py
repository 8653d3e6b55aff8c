"""Splats moved as one thing: turned, scaled and shifted, colour and all; and where a thing's foot is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import SceneError
from .gaussians import Gaussians
from .harmonics import turned

ADDED = "mask"  # the extra that marks splats that were put in: the weights of masks, so that `kept` finds them
SEEN = 0.1  # opacity from which on a splat belongs to a thing's outline
STRAY = 1e-3  # part of the splats that may lie below a thing's foot: those of a fit scatter


@dataclass(frozen=True)
class Similarity:
    """x' = scale * rotation x + translation. rotation [3,3]; translation [3], units of where it leads; float64."""

    rotation: Float[Tensor, "3 3"]
    scale: float
    translation: Float[Tensor, " 3"]


@dataclass(frozen=True)
class Stance:
    """How a thing stands along a direction that is up. foot [3]: the middle of its outline, at its lowest; height and
    radius (of the outline around the foot), world units."""

    foot: Float[Tensor, " 3"]
    height: float
    radius: float


def moved(scene: Gaussians, to: Similarity) -> Gaussians:
    """The same splats elsewhere: positions, rotations, scales and the spherical harmonics of their colours. In float64
    inside. Raises SceneError for a scale that is not positive."""
    if not 0 < to.scale < float("inf"):
        raise SceneError(f"move: got scale {to.scale}, expected more than 0")
    rotation = to.rotation.to(scene.means.device, torch.float64)
    means = to.scale * scene.means.double() @ rotation.T + to.translation.to(rotation)
    straight = torch.equal(rotation, torch.eye(3).to(rotation))
    sh = scene.sh if straight else turned(scene.sh, rotation)
    quats = scene.quats if straight else after(quaternion(rotation), scene.quats.double())
    return replace(
        scene,
        means=means.to(scene.means),
        quats=quats.to(scene.quats),
        log_scales=(scene.log_scales.double() + math.log(to.scale)).to(scene.log_scales),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )


def quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 4"]:
    """The unit quaternion, wxyz, of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation.detach().cpu().double().numpy()).as_quat().tolist()
    return torch.tensor([w, x, y, z], dtype=torch.float64, device=rotation.device)


def after(turn: Float[Tensor, " 4"], quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """`quats` and then `turn`: Hamilton's product turn * quats, wxyz."""
    a, (w, x, y, z) = turn, quats.unbind(-1)
    return torch.stack(
        [
            a[0] * w - a[1] * x - a[2] * y - a[3] * z,
            a[0] * x + a[1] * w + a[2] * z - a[3] * y,
            a[0] * y - a[1] * z + a[2] * w + a[3] * x,
            a[0] * z + a[1] * y - a[2] * x + a[3] * w,
        ],
        dim=-1,
    )


def frames(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 4"]:
    """Quaternions, wxyz, that turn the z axis onto unit `normals`."""
    x, y, z = normals.unbind(-1)
    quats = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=-1)
    quats[z < -1 + 1e-6] = quats.new_tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(quats, dim=-1)


def rotation_from(numbers: Sequence[float]) -> Float[Tensor, "3 3"]:
    """A rotation matrix of three angles, degrees, about the fixed axes x, then y, then z; or of a quaternion wxyz."""
    from scipy.spatial.transform import Rotation

    if len(numbers) == 4:
        w, x, y, z = numbers
        return torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix())
    return torch.from_numpy(Rotation.from_euler("xyz", list(numbers), degrees=True).as_matrix())


def turn_between(start: Float[Tensor, " 3"], end: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation [3,3] that turns the direction `start` into `end`; float64."""
    a, b = (torch.nn.functional.normalize(v.detach().cpu().double(), dim=0) for v in (start, end))
    axis, cosine = torch.linalg.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-12:  # half a turn, about any axis at right angles
        axis = torch.linalg.cross(a, torch.eye(3).double()[int(a.abs().argmin())])
        axis = torch.nn.functional.normalize(axis, dim=0)
        return 2 * torch.outer(axis, axis) - torch.eye(3).double()
    x, y, z = axis.tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3).double() + cross + cross @ cross / (1 + cosine)


def stance(scene: Gaussians, up: Float[Tensor, " 3"]) -> Stance:
    """How splats stand along the direction `up`. Faint ones do not count, and below the foot may lie a thousandth.
    Raises SceneError where all are in one place."""
    means, seen = scene.means.detach().double(), scene.opacities >= SEEN
    means = means[seen] if bool(seen.any()) else means
    up = torch.nn.functional.normalize(up.to(means), dim=0)
    across = torch.linalg.svd(up[None]).Vh[1:]  # two directions at right angles to it
    heights, sides = means @ up, means @ across.T
    stray = int(STRAY * len(means))
    low, high = (float(heights.sort().values[k]) for k in (stray, len(means) - 1 - stray))
    sides = sides.sort(dim=0).values[stray : len(means) - stray]
    middle = (sides[0] + sides[-1]) / 2
    radius = float((sides[-1] - sides[0]).max()) / 2
    if not high - low + radius > 0:
        raise SceneError(f"the thing's {len(scene)} splats are all in one place: it has no size")
    return Stance(middle @ across + low * up, high - low, radius)


def with_degree(scene: Gaussians, degree: int) -> Gaussians:
    """The same splats with coefficients up to `degree`, those that they lacked being 0."""
    lacking = (degree + 1) ** 2 - 1 - scene.shN.shape[1]
    return scene if lacking <= 0 else replace(scene, shN=torch.nn.functional.pad(scene.shN, (0, 0, 0, lacking)))


def joined(scene: Gaussians, thing: Gaussians) -> Gaussians:
    """The splats of `scene`, each as it is, and then those of `thing`, marked by the extra ADDED: 1, the others 0.

    The SH degree is the higher one of both. The other extras are the scene's; what the thing lacks of them is 0.
    """
    degree = max(scene.sh_degree, thing.sh_degree)
    extra = {}
    for name, value in scene.extra.items():
        like, same = value[:1], thing.extra.get(name)
        fits = same is not None and same.shape[1:] == value.shape[1:]
        extra[name] = same.to(value) if fits else like.new_zeros(len(thing), *value.shape[1:])
    parts = [with_degree(scene, degree), replace(with_degree(thing, degree).to(scene.means.device), extra=extra)]
    return Gaussians.cat(
        [part.with_extra(**{ADDED: torch.full_like(part.logit_opacities, k)}) for k, part in enumerate(parts)]
    )
