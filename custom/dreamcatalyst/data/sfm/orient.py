"""A world of sensible axes and size for a reconstruction, whose own are those of its first pair of views."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

UP = np.array([0.0, -1.0, 0.0])  # of COLMAP captures, by which viewers and data.orbit_up go: y points down
LEVEL = 0.05  # share of the cameras' x axes that must be spread over a second direction, to say what is level


def up_of(rotations: Float[np.ndarray, "V 3 3"]) -> Float[np.ndarray, " 3"]:
    """Which way is up, of cameras world to camera.

    People hold cameras level, so up is the direction to which their x axes are most nearly perpendicular; where these
    hardly differ, the mean of what is up in the photographs.
    """
    mean = -rotations[:, 1].mean(axis=0)
    values, axes = np.linalg.eigh(rotations[:, 0].T @ rotations[:, 0] / len(rotations))
    normal = axes[:, 0] * np.sign(axes[:, 0] @ mean)
    steady = float(np.linalg.norm(mean)) > 0.3
    if values[1] < LEVEL or (steady and normal @ mean < np.cos(np.radians(40)) * np.linalg.norm(mean)):
        normal = mean
    length = float(np.linalg.norm(normal))
    return normal / length if length > 1e-6 else UP


def middle_of(
    rotations: Float[np.ndarray, "V 3 3"], centres: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, " 3"]:
    """The point nearest to all optical axes, if it lies before most cameras; else the median of the points."""
    forward = rotations[:, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) < 1e3:
        point = np.linalg.solve(total, (across @ centres[:, :, None]).sum(axis=0)[:, 0])
        if np.mean(((point - centres) * forward).sum(axis=1) > 0) > 0.5:
            return point
    return np.median(points, axis=0) if len(points) else centres.mean(axis=0)


def similarity(
    rotations: Float[np.ndarray, "V 3 3"], centres: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "P 3"]
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """Scale s, rotation R and translation t of x' = s R x + t, into the world where up is -y, what the cameras look at
    is (0,0,0), the mean camera lies towards -z, and the farthest camera is 1 from the mean of all."""
    up = up_of(rotations)
    middle = middle_of(rotations, centres, points)
    forward = middle - centres.mean(axis=0)
    forward = forward - up * (forward @ up)
    if np.linalg.norm(forward) < 1e-3 * np.linalg.norm(centres - middle, axis=1).mean():  # they stand all round
        forward = centres[0] - middle
        forward = up * (forward @ up) - forward
    if np.linalg.norm(forward) < 1e-9:
        forward = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    forward = forward / np.linalg.norm(forward)
    R = np.stack([np.cross(-up, forward), -up, forward])
    extent = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    scale = 1.0 / extent if extent > 0 else 1.0
    return scale, R, -scale * R @ middle


def poses(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations [V,3,3] world to camera, centres [V,3] and points [P,3] of a pycolmap Reconstruction."""
    images = [model.images[i] for i in model.reg_image_ids()]
    rotations = np.stack([image.cam_from_world().rotation.matrix() for image in images])
    centres = np.stack([image.projection_center() for image in images])
    xyz = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    return rotations, centres, xyz
