"""Whether cameras were found, and where not, what to photograph instead."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError
from .colmap import library
from .options import SfmOptions

FEW_FEATURES = 300  # per photograph: blurred, dark, or of a white wall
FLAT = 1.0  # degrees: what the median point is seen under, where all is photographed from one place
PAIRS = 40  # of those whose matches are farthest apart, that are asked what kind of movement they show
MATCHES = 30  # that a pair needs to tell it
EXPLAINED, MOST = 0.004, 0.85  # of the diagonal: how far from its place a match may be; and how many must be so near
SHOWN = 5  # names in a message
WALK = "Walk around the scene, and take a photograph at every other step that shows most of what the one before shows"
ONE_PLACE = (
    "the photographs are all taken from one place, where the camera was only turned: no depth can be told from that. "
    "Walk around the scene instead of turning in it"
)


def names_of(names: Sequence[str]) -> str:
    """A few names, and how many more there are."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(f"'{name}'" for name in names[:SHOWN]) + more


def require(source: Path, model: Any, names: Sequence[str], database: Path, options: SfmOptions) -> None:
    """Raise DataError where `model`, of the photographs `names`, has too few cameras, or all of them at one place.
    model: a pycolmap Reconstruction, None where there is none."""
    placed = set() if model is None else {model.images[i].name for i in model.reg_image_ids()}
    aside = [name for name in names if name not in placed]
    if model is not None and len(placed) >= 3 and parallax(model) < FLAT:
        raise DataError(f"{source}: {ONE_PLACE}")
    if len(placed) >= max(3, options.registered * len(names)):
        return
    found = f"cameras were found for {len(placed)} of {len(names)} photographs"
    left = f" (not for {names_of(aside)})" if placed else ""
    remedy = ". data.sfm.registered sets how few will do" if len(placed) >= 3 else ""
    raise DataError(f"{source}: {found}{left}: {reason(database, aside)}{remedy}")


def parallax(model: Any) -> float:
    """Degrees under which the median point of a model is seen by the two of its cameras that differ most, of some
    thousand of its points."""
    points = list(model.points3D.values())
    angles = []
    for point in points[:: max(1, len(points) // 1000)]:
        seen = {element.image_id for element in point.track.elements}
        rays = np.stack([model.images[i].projection_center() - point.xyz for i in seen])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(angles)) if angles else 0.0


def reason(database: Path, aside: Sequence[str]) -> str:
    """Why photographs got no camera, as far as their features and matches tell, and what to do. aside: their names."""
    with library() as pycolmap, pycolmap.Database.open(database) as data:
        images = {image.image_id: image for image in data.read_all_images()}
        features = {image.name: data.num_keypoints_for_image(number) for number, image in images.items()}
        poor = sorted(
            (name for name in aside if features.get(name, 0) < FEW_FEATURES), key=lambda n: features.get(n, 0)
        )
        if 2 * len(poor) > len(aside):
            few = np.median([features.get(name, 0) for name in poor])
            return (
                f"{names_of(poor)} show too little that can be recognized ({few:.0f} features in the median): they are "
                "blurred, dark, or of plain surfaces. Take sharp ones, in good light, that show textured things too"
            )
        pairs, geometries = data.read_two_view_geometries()
        verified = [(pair, g) for pair, g in zip(pairs, geometries, strict=True) if len(g.inlier_matches)]
        touched = {images[i].name for pair, _ in verified for i in pycolmap.pair_id_to_image_pair(pair)}
        alone = [name for name in aside if name not in touched]
        if 2 * len(alone) > len(aside):
            return f"{names_of(alone)} show nothing that the others show. {WALK}"
    return f"they overlap too little. {WALK}"


def require_movement(source: Path, database: Path) -> None:
    """Raise DataError where most of the pairs that differ most are those of a camera that was turned and not moved: of
    them models come out that look well and have no depth."""
    pairs = []
    with library() as pycolmap, pycolmap.Database.open(database) as data:
        lenses = {image.image_id: data.read_camera(image.camera_id) for image in data.read_all_images()}
        for number, found in zip(*data.read_two_view_geometries(), strict=True):
            ids = pycolmap.pair_id_to_image_pair(number)
            sizes = {(lenses[i].width, lenses[i].height) for i in ids}
            if len(found.inlier_matches) >= MATCHES and len(sizes) == 1:
                points = [data.read_keypoints(i)[:, :2] for i in ids]
                size = np.array(sizes.pop())
                first, second = (p[found.inlier_matches[:, side]] - size / 2 for side, p in enumerate(points))
                pairs.append((first, second, float(np.hypot(*size))))
    pairs = sorted(pairs, key=lambda p: np.median(np.linalg.norm(p[0] - p[1], axis=1)) / p[2])[-PAIRS:]
    if pairs and 2 * sum(turned(*pair) for pair in pairs) > len(pairs):
        raise DataError(f"{source}: {ONE_PLACE}")


def turned(first: np.ndarray, second: np.ndarray, diagonal: float) -> bool:
    """Whether a turn of a pinhole camera of any focal length explains almost all matches, pixels [M,2] from the middle
    of two photographs of that diagonal."""
    return any(
        np.mean(_off_a_turn(first, second, focal, EXPLAINED * diagonal) <= EXPLAINED * diagonal) > MOST
        for focal in diagonal * np.geomspace(0.4, 4.0, 16)
    )


def _off_a_turn(first: np.ndarray, second: np.ndarray, focal: float, near: float) -> np.ndarray:
    """Pixels by which the best turn of a camera of this focal length misses each match, [M]; it is that of the matches
    that it misses by less than `near`, or of the better half."""
    a, b = (np.concatenate([p, np.full((len(p), 1), focal)], axis=1) for p in (first, second))
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    away = np.zeros(len(a))
    for _ in range(3):
        keep = away <= max(near, float(np.median(away)))
        U, _, Vt = np.linalg.svd(b[keep].T @ a[keep])
        there = a @ (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
        away = np.linalg.norm(focal * there[:, :2] / np.maximum(there[:, 2:], 1e-6) - second, axis=1)
    return away
