"""Which splats an edit may touch: weights [N] from what views say of them, and masks from weights.

Distances are in world units.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import SceneError

FAINTEST = 1e-3  # the least update that a splat of a feathered mask gets: none is frozen by its own mask


def soft_weights(
    means: Float[Tensor, "N 3"],
    inside: Float[Tensor, " N"],
    total: Float[Tensor, " N"],
    *,
    min_evidence: float = 0.5,
    neighbours: int = 8,
) -> Float[Tensor, " N"]:
    """inside / total [N] in [0,1] where at least `min_evidence` (pixels) of a splat is seen over all views.

    Splats of which less is seen are undecided, whatever their ratio: they take the mean weight of the `neighbours`
    nearest decided ones, weighted by inverse distance. means [N,3]; inside, total [N] as of render/lift.py.
    Raises SceneError where no splat is decided.
    """
    decided = total >= min_evidence
    count = int(decided.sum())
    if count == 0:
        most = float(total.max()) if len(total) else 0.0
        raise SceneError(
            f"mask: of none of {len(total)} splats at least min_evidence={min_evidence:g} pixels are seen in the "
            f"masked views (at most {most:.3g}). Do these cameras look at these splats?"
        )
    weights = (inside / total.clamp_min(torch.finfo(total.dtype).tiny)).clamp(0, 1)
    if count == len(total):
        return weights
    distances, nearest = _nearest(means[decided], means[~decided], min(neighbours, count))
    nearness = 1 / np.maximum(distances, 1e-12)
    votes = weights[decided].cpu().double().numpy()[nearest]
    weights[~decided] = torch.from_numpy((nearness * votes).sum(axis=1) / nearness.sum(axis=1)).to(weights)
    return weights.clamp(0, 1)


def threshold(weights: Float[Tensor, " N"], level: float = 0.5) -> Bool[Tensor, " N"]:
    """Splats whose weight is at least `level`, bool [N]. Raises SceneError where there is none, which says what other
    levels would find."""
    mask = weights >= level
    if not bool(mask.any()):
        lower = [part * level for part in (0.75, 0.5, 0.25)]
        others = ", ".join(f"{int((weights >= value).sum())} at {value:.3g}" for value in lower)
        highest = float(weights.max()) if len(weights) else 0.0
        raise SceneError(
            f"mask: is empty: threshold {level:g} finds 0 of {len(weights)} splats ({others}; the highest weight is "
            f"{highest:.3g}). Lower mask.threshold, or look at the 2D masks"
        )
    return mask


def invert(mask: Bool[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Everything else, bool [N]. Raises SceneError where nothing else is left."""
    if bool(mask.all()):
        raise SceneError(f"mask: all {len(mask)} splats are in it, so that its inverse is empty. Set mask.invert=false")
    return ~mask


def grow(means: Float[Tensor, "N 3"], mask: Bool[Tensor, " N"], distance: float) -> Bool[Tensor, " N"]:
    """The mask and every splat whose centre is at most `distance` from a masked one, bool [N]. means [N,3]."""
    if distance <= 0 or not bool(mask.any()) or bool(mask.all()):
        return mask
    found, _ = _nearest(means[mask], means[~mask], 1)
    grown = mask.clone()
    grown[~mask] = torch.from_numpy(found[:, 0] <= distance).to(mask.device)
    return grown


def feather(means: Float[Tensor, "N 3"], mask: Bool[Tensor, " N"], width: float) -> Float[Tensor, " N"]:
    """How much of its update each splat takes, [N]: 0 outside of the mask, and in it in (0,1], rising with the distance
    to the nearest splat outside, to 1 at `width`. width 0, and a mask of all splats: 1 throughout the mask.

    It scales the update, not the gradient: Adam divides a gradient by its own size, and would undo the scale.
    """
    update = mask.to(means.dtype)
    if width <= 0 or not bool(mask.any()) or bool(mask.all()):
        return update
    distances, _ = _nearest(means[~mask], means[mask], 1)
    update[mask] = torch.from_numpy(distances[:, 0] / width).to(update).clamp(FAINTEST, 1)
    return update


def distances_to(points: Float[Tensor, "P 3"], queries: Float[Tensor, "Q 3"]) -> Float[Tensor, " Q"]:
    """How far each of `queries` [Q,3] is from the nearest of `points` [P,3], [Q]."""
    return torch.from_numpy(_nearest(points, queries, 1)[0][:, 0]).to(queries)


def _nearest(
    points: Float[Tensor, "P 3"], queries: Float[Tensor, "Q 3"], k: int
) -> tuple[Float[np.ndarray, "Q k"], Int[np.ndarray, "Q k"]]:
    """Distances [Q,k] of `queries` [Q,3] to their k nearest `points` [P,3], and the numbers [Q,k] of those."""
    from scipy.spatial import KDTree

    there, here = (t.detach().cpu().double().numpy() for t in (points, queries))
    query: Any = KDTree(there).query  # whose annotation knows no list for k, which keeps the axis of one neighbour
    return query(here, k=[*range(1, k + 1)])
