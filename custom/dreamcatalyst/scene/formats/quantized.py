"""What lossy formats do alike: numbers as bytes, quaternions without their largest component, other axes, an order in
which neighbours lie together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from ...data.origin import ZERO, Origin
from ..gaussians import SH_C0, Gaussians

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components that are kept, by the largest
# In the order of the SH bases of degree 1 to 3 (Kerbl et al. 2023): the axes in whose sign each is odd.
ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
REST = {0: 0, 1: 3, 2: 8, 3: 15}  # coefficients above degree 0, by SH degree
BLOCK = 8192  # splats
Signs = tuple[int, int, int]


def assembled(
    means: np.ndarray,
    quats: Float[np.ndarray, "N 4"],
    log_scales: np.ndarray,
    logits: np.ndarray,
    sh0: np.ndarray,
    shN: np.ndarray,
    origin: Origin,
) -> Gaussians:
    """Splats of decoded arrays: means [N,3] of the file's world, sh0 [N,3], shN [N,K,3]; as float32, from `origin`."""
    if origin != ZERO:
        means = means.astype(np.float64) - origin
    arrays = (means, quats, log_scales, logits, sh0[:, None, :], shN)
    owned = [np.require(array, np.float32, ["C", "W"]) for array in arrays]  # what is mapped from a file is copied
    means_, quats_, logs_, logits_, sh0_, shN_ = map(torch.from_numpy, owned)
    return Gaussians(means_, quats_, logs_, logits_, sh0_, shN_)


def world_positions(scene: Gaussians, origin: Origin) -> Float[np.ndarray, "N 3"]:
    """Positions in the file's world, float64."""
    return scene.means.double().numpy() + origin


# --- numbers as bytes


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Rounded to whole numbers in 0..255."""
    out = np.rint(values)
    np.maximum(out, 0, out=out)
    return np.minimum(out, 255, out=out).astype(np.uint8)


def sh_bytes(shN: Float[np.ndarray, "N K 3"], width: float, steps: np.ndarray) -> UInt8[np.ndarray, "N K 3"]:
    """SH coefficients above degree 0 as 256ths of a range of `width` around 0, of which 128 is 0, in multiples of
    `steps` [K]. Block by block, so that all stays in cache."""
    out, each = np.empty(shN.shape, np.uint8), steps.astype(np.float32)[:, None]
    per_step, middle = 256 / width / each, 128 / each
    for start in range(0, len(shN), BLOCK):
        rows = slice(start, start + BLOCK)
        values = np.rint(shN[rows] * per_step + middle) * each
        np.maximum(values, 0, out=values)
        out[rows] = np.minimum(values, 255, out=values)
    return out


def opacity_bytes(logits: Float[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    """Opacities as 255ths."""
    return to_bytes(255 / (1 + np.exp(-logits.astype(np.float64))))


def opacity_logits(bytes_: UInt8[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """The inverse. 0 and 255 stand for half a step inside, so that the logits are finite."""
    steps = np.clip(np.arange(256), 0.5, 254.5) / 255
    return np.log(steps / (1 - steps)).astype(np.float32)[bytes_]


def color_bytes(sh0: Float[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours as 255ths."""
    return to_bytes((sh0 * SH_C0 + 0.5) * 255)


def byte_colors(bytes_: UInt8[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The inverse: SH coefficients of degree 0."""
    return ((np.arange(256) / 255 - 0.5) / SH_C0).astype(np.float32)[bytes_]


# --- quaternions


def unit(quats: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Of length 1; no rotation for a quaternion of zeros."""
    length = np.sqrt(np.einsum("nc,nc->n", quats, quats))[:, None]
    out = quats / np.where(length > 0, length, 1)
    out[length[:, 0] == 0] = (1, 0, 0, 0)
    return out


def drop_largest(quats: Float[np.ndarray, "N 4"]) -> tuple[Int64[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Which component of unit quaternions is the largest, and the three others, of the sign with which it is positive:
    each within 1 / sqrt(2) of zero."""
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1, 1)
    return largest, np.take_along_axis(quats, OTHERS[largest], axis=1) * sign.astype(quats.dtype)


def restore_largest(largest: Int64[np.ndarray, " N"], others: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    """The inverse."""
    quats = np.empty((len(others), 4), np.float32)
    np.put_along_axis(quats, OTHERS[largest], others.astype(np.float32, copy=False), axis=1)
    left = np.sqrt(np.maximum(1 - np.einsum("nc,nc->n", others, others), 0))
    np.put_along_axis(quats, largest[:, None], left[:, None].astype(np.float32), axis=1)
    return quats


# --- axes


def turned(scene: Gaussians, signs: Signs) -> Gaussians:
    """The scene in a world whose axes have these signs, which also turn right into left where their product is -1.

    A splat's own axes may be mirrored freely: with F = diag(signs), F R F is a rotation, and F (R S S' R') F is the
    covariance that it gives.
    """
    product = signs[0] * signs[1] * signs[2]
    axis = dict(zip("xyz", signs, strict=True))
    parity = [float(np.prod([axis[a] for a in odd])) for odd in ODD[: scene.shN.shape[1]]]
    return replace(
        scene,
        means=scene.means * scene.means.new_tensor(signs),
        quats=scene.quats * scene.quats.new_tensor([1, *(product * sign for sign in signs)]),
        shN=scene.shN * scene.shN.new_tensor(parity)[:, None],
    )


# --- order


def morton_order(scene: Gaussians) -> Int64[Tensor, " N"]:
    """Rows along Morton's curve through their positions, 21 bits an axis: neighbours on it are neighbours in space."""
    means = scene.means.double().numpy()
    low = means.min(axis=0, initial=0) if len(means) == 0 else means.min(axis=0)
    size = (means.max(axis=0) - low if len(means) else low) + 1e-30
    cells = ((means - low) / size * (2**21 - 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return torch.from_numpy(np.argsort(code, kind="stable"))


def _spread(cells: np.ndarray) -> np.ndarray:
    """21 bits of each number with two zeros between any two."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    return cells
