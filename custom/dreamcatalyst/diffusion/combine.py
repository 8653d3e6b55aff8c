"""Text and image guidance as a weighted sum of noise predictions, of which only the rows that matter are computed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import PriorError
from .api import Prior, Row


@dataclass(frozen=True)
class Branch:
    """One guided noise prediction: noisy latents, what guides them, and how strongly.

    text: from `Prior.embed`, None for the null instruction; image: from `Prior.condition`;
    guidance_scale w_y, image_guidance_scale w_I: 1 is no amplification, w_y = 0 leaves the text out.
    """

    noisy: Float[Tensor, "B C h w"]
    text: Any
    image: Any
    guidance_scale: float
    image_guidance_scale: float


def branch_rows(branch: Branch, takes_image: bool) -> list[tuple[Row, float]]:
    """The rows of one branch with their coefficients, zeros included.

    With an image (Brooks et al. 2023): w_y (text, image) + (w_I - w_y) (null, image) + (1 - w_I) (null, null).
    Without: w_y (text) + (1 - w_y) (null), Ho & Salimans 2022. The null instruction is its own text: w_y drops out.
    Raises PriorError where a prior that takes an image gets none.
    """
    if takes_image and branch.image is None:
        raise PriorError("this prior is conditioned on an image and got none. Pass `Prior.condition` of the source")
    w_y = 0.0 if branch.text is None else branch.guidance_scale
    if not takes_image:
        return [(Row(branch.noisy, branch.text), w_y), (Row(branch.noisy), 1.0 - w_y)]
    w_i = branch.image_guidance_scale
    return [
        (Row(branch.noisy, branch.text, branch.image), w_y),
        (Row(branch.noisy, None, branch.image), w_i - w_y),
        (Row(branch.noisy), 1.0 - w_i),
    ]


def difference_rows(edit: Branch, reference: Branch | None = None, takes_image: bool = True) -> list[tuple[Row, float]]:
    """Every distinct row of (edit - reference) with its coefficient; rows of coefficient zero are left out.

    Rows are the same where noisy latents, text and image are the same objects: what a caller wants to cancel between
    the branches it passes as one object, never as an equal copy.
    """
    total: dict[tuple[int, int, int], tuple[Row, float]] = {}
    signed = [(branch, sign) for branch, sign in ((edit, 1.0), (reference, -1.0)) if branch is not None]
    for branch, sign in signed:
        for row, coefficient in branch_rows(branch, takes_image):
            key = (id(row.noisy), id(row.text), id(row.image))
            total[key] = (row, total.get(key, (row, 0.0))[1] + sign * coefficient)
    return [(row, coefficient) for row, coefficient in total.values() if coefficient != 0.0]


@torch.no_grad()
def predict_difference(prior: Prior, edit: Branch, reference: Branch | None, timestep: int) -> Float[Tensor, "B C h w"]:
    """eps_edit - eps_reference (eps_edit where there is no reference), without graph.

    One call of the prior for all rows, none where no row is left. The sum is taken in float32, in float64 where the
    latents are.
    """
    rows = difference_rows(edit, reference, prior.takes_image)
    total = torch.zeros_like(edit.noisy, dtype=torch.promote_types(edit.noisy.dtype, torch.float32))
    predictions = prior.predict_noise([row for row, _ in rows], timestep) if rows else []
    # Summed branch by branch, in the same order: equal branches then cancel to the bit.
    for ours in (True, False):
        parts = [
            (prediction.to(total.dtype), coefficient)
            for (row, coefficient), prediction in zip(rows, predictions, strict=True)
            if (row.noisy is edit.noisy) == ours
        ]
        if parts:
            total += _weighted_sum(parts)
    return total


def _weighted_sum(parts: list[tuple[Float[Tensor, "B C h w"], float]]) -> Float[Tensor, "B C h w"]:
    """sum c_i p_i as c_1 (p_1 - p_2) + (c_1 + c_2) (p_2 - p_3) + ... + (c_1 + ... + c_n) p_n: of a branch, w_y times
    what the text changes, w_I times what the image changes, and the null prediction. The c_i themselves grow with w_y
    and cancel, which would cost the digits that a large guidance scale amplifies."""
    sums = list(accumulate(coefficient for _, coefficient in parts))
    total = parts[-1][0] * sums[-1]
    for (prediction, _), (after, _), coefficient in zip(parts, parts[1:], sums, strict=False):
        total.add_(prediction - after, alpha=coefficient)
    return total
