"""Terms of a loss and their shares of the gradient."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.loss.terms import gradient_shares, total, update_share


def test_shares_follow_the_norms_group_by_group():
    a, b = torch.nn.Parameter(torch.tensor([3.0, 4.0])), torch.nn.Parameter(torch.tensor([1.0]))
    terms = {"one": 3 * a.sum() + b.sum(), "two": a.sum() + 3 * b.sum(), "none": torch.zeros(())}
    assert gradient_shares(terms, {"a": a, "b": b}) == pytest.approx({"one": 0.5, "two": 0.5, "none": 0.0})
    assert gradient_shares({"one": 3 * a.sum(), "two": a.sum()}, {"a": a, "b": b}) == pytest.approx(
        {"one": 0.75, "two": 0.25}
    )
    assert gradient_shares({"none": torch.zeros(())}, {"a": a}) == {"none": 0.0}
    assert total(terms).item() == pytest.approx(7 * 4 + 4)
    total(terms).backward()  # the graph is still there, and nothing was left in it
    assert a.grad.tolist() == [4.0, 4.0] and b.grad.tolist() == [4.0]


def test_empty_parameters_have_no_say():
    a, empty = torch.nn.Parameter(torch.ones(2)), torch.nn.Parameter(torch.ones(2, 0))
    assert gradient_shares({"one": a.sum(), "two": a.sum()}, {"a": a, "empty": empty}) == {"one": 0.5, "two": 0.5}


def test_the_share_of_a_second_step_is_taken_parameter_by_parameter():
    before, between = [torch.zeros(2), torch.zeros(1), torch.zeros(3, 0)], [torch.tensor([3.0, 4.0]), torch.zeros(1)]
    between.append(torch.zeros(3, 0))
    after = [torch.tensor([3.0, 4.0]), torch.ones(1), torch.zeros(3, 0)]
    assert update_share(before, between, after) == 0.5  # nothing of the first, all of the second, the third stays
    assert update_share(before, before, before) == 0.0
