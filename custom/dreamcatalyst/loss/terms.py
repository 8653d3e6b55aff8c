"""A loss as a sum of named terms, and how much each of them has to say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def total(terms: Mapping[str, Float[Tensor, ""]]) -> Float[Tensor, ""]:
    """The sum of the terms, a scalar."""
    return torch.stack([term.reshape(()) for term in terms.values()]).sum()


def gradient_shares(
    terms: Mapping[str, Float[Tensor, ""]], parameters: Mapping[str, Float[Tensor, ...]]
) -> dict[str, float]:
    """The share of each term in the gradient, in [0,1], by its name; together 1, or all 0 where there is no gradient.

    Adam divides every group of parameters by its own size, so shares are taken group by group, |grad of the term| over
    the sum of these norms over all terms, and averaged over the groups that have a gradient. The graphs are kept.
    """
    used = {name: value for name, value in parameters.items() if value.numel()}
    norms = {}
    for name, term in terms.items():
        if not term.requires_grad:
            norms[name] = next(iter(used.values())).new_zeros(len(used))
            continue
        grads = torch.autograd.grad(term, list(used.values()), retain_graph=True, allow_unused=True)
        norms[name] = torch.stack([term.new_zeros(()) if g is None else g.norm() for g in grads])
    every = torch.stack(list(norms.values()))  # [terms, groups]
    sums = every.sum(0)
    moved = sums > 0
    shares = every[:, moved] / sums[moved]
    means = shares.mean(1).tolist() if bool(moved.any()) else [0.0] * len(norms)
    return dict(zip(norms, means, strict=True))


@torch.no_grad()
def update_share(
    before: Sequence[Float[Tensor, ...]], between: Sequence[Float[Tensor, ...]], after: Sequence[Float[Tensor, ...]]
) -> float:
    """The share of a second step (between to after) in what it and a first one (before to between) move, in [0,1]: by
    their norms, parameter by parameter, averaged over those that move at all; 0 where none does."""
    first = torch.stack([(b - a).norm() for a, b in zip(before, between, strict=True)])
    second = torch.stack([(c - b).norm() for b, c in zip(between, after, strict=True)])
    moved = first + second > 0
    return float((second[moved] / (first + second)[moved]).mean()) if bool(moved.any()) else 0.0
