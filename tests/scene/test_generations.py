"""Generations: the published lists of weights, and what each kind of anchor ties a splat to."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.errors import ConfigError, SceneError
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.generations import ANCHORS, Generations
from dreamcatalyst.scene.trainable import Splats


def splats_at(x: list[float], editable: list[bool] | None = None) -> Splats:
    means = torch.tensor(x)[:, None].expand(-1, 3).clone()
    n = len(x)
    scene = Gaussians.from_colors(means, torch.full((n, 3), 0.1), torch.full((n, 3), 0.5), torch.full((n,), 0.5))
    return Splats(scene, editable=None if editable is None else torch.tensor(editable))


def move(splats: Splats, by: float) -> None:
    with torch.no_grad():
        for value in splats.parameters.values():
            value += by


def event(splats: Splats, generations: Generations, keep: list[int], parents: list[int], **changed) -> None:
    rows = torch.tensor(parents, dtype=torch.long)
    splats.rearrange(torch.tensor(keep), rows, {**changed, **generations.newborn(splats, rows, changed)})
    generations.advance(splats)


@pytest.mark.parametrize(
    ("first", "init", "multiplier", "events", "weights"),
    [
        (0.05, 0.1, 1.3, 6, [0.241, 0.286, 0.22, 0.169, 0.13, 0.1, 0]),  # GaussianEditor's interface
        (1, 0.1, 2, 3, [8, 0.2, 0.1, 0]),  # its classes' defaults
        (1, 0.1, 2, 4, [10, 0.4, 0.2, 0.1, 0]),  # the cap is reached
        (0, 0.02, 1.3, 3, [0, 0.026, 0.02, 0]),
        (0.05, 0.1, 1.3, 0, [0.05]),
    ],
)
def test_weights_are_the_published_lists(first, init, multiplier, events, weights):
    generations, splats = Generations(first, init, multiplier, 10), splats_at([0.0])
    generations.begin(splats)
    for _ in range(events):
        generations.advance(splats)
    assert generations.weights == pytest.approx(weights, abs=5e-4)
    assert len(generations) == events + 1


def test_children_are_the_generation_of_their_event_and_parents_keep_theirs():
    splats, generations = splats_at([0.0, 1.0]), Generations(1, 0.1, 2, 10)
    generations.begin(splats)
    assert splats.state["generation"].dtype == torch.int64
    event(splats, generations, [0, 1], [1])
    event(splats, generations, [0, 1, 2], [])  # an event without children is a generation without splats
    event(splats, generations, [0, 2], [0, 2])
    assert splats.state["generation"].tolist() == [0, 1, 3, 3]
    assert generations.weight_of(splats).tolist() == pytest.approx([8.0, 0.2, 0.0, 0.0])


def test_the_published_anchor_is_where_splats_were_at_the_last_event():
    splats, generations = splats_at([0.0, 1.0]), Generations(1, 0.1, 2, 10, anchor="last-densify")
    generations.begin(splats)
    move(splats, 0.5)
    assert splats.state["anchor_means"][:, 0].tolist() == [0.0, 1.0]
    event(splats, generations, [0, 1], [1])
    for name in PARAMETERS:
        assert torch.equal(splats.state[f"anchor_{name}"], splats.parameters[name])
        assert splats.state[f"anchor_{name}"].data_ptr() != splats.parameters[name].data_ptr() or name == "shN"


def test_the_source_anchor_stays_and_a_child_is_tied_to_its_birth():
    splats, generations = splats_at([0.0, 1.0]), Generations(1, 0.1, 2, 10, anchor="source")
    generations.begin(splats)
    move(splats, 0.5)
    event(splats, generations, [0, 1], [1, 1], means=torch.tensor([[7.0, 7, 7], [8, 8, 8]]))
    assert splats.state["anchor_means"][:, 0].tolist() == [0.0, 1.0, 7.0, 8.0]
    assert torch.equal(splats.state["anchor_quats"][2:], splats.parameters["quats"][2:])  # not the parent's anchor
    move(splats, 0.5)
    event(splats, generations, [0, 3], [])
    assert splats.state["anchor_means"][:, 0].tolist() == [0.0, 8.0]


@pytest.mark.parametrize("anchor", ANCHORS)
def test_only_what_is_asked_for_is_kept(anchor):
    splats, generations = splats_at([0.0, 1.0]), Generations(1, 0.1, 2, 10, anchor=anchor, anchored=["means"])
    generations.begin(splats)
    event(splats, generations, [0, 1], [0])
    assert set(splats.state) == {"generation", "anchor_means"} == set(generations.states)


def test_frozen_splats_have_neither_generation_nor_anchor():
    splats, generations = splats_at([0.0, 1.0, 2.0], [False, True, False]), Generations(1, 0.1, 2, 10)
    generations.begin(splats)
    assert all(len(value) == 1 for value in splats.state.values())
    event(splats, generations, [0], [0])
    assert splats.state["generation"].tolist() == [0, 1] and splats.total == 4


def test_a_checkpoint_restores_them():
    splats, generations = splats_at([0.0, 1.0]), Generations(0.05, 0.1, 1.3, 10, anchor="source")
    generations.begin(splats)
    event(splats, generations, [0, 1], [1])
    restored = Generations(0.05, 0.1, 1.3, 10, anchor="source")
    back = Splats.from_state_dict(splats.state_dict(), torch.device("cpu"))
    restored.load_state_dict(generations.state_dict(), back)
    assert restored.weights == generations.weights and set(back.state) == set(splats.state)
    event(splats, generations, [0], [1])
    event(back, restored, [0], [1])
    assert restored.weights == generations.weights
    for name, value in splats.state.items():
        assert torch.equal(back.state[name], value)


def test_splats_without_anchors_do_not_resume_a_run_with_them():
    generations = Generations(1, 0.1, 2, 10, anchored=["means"])
    with pytest.raises(SceneError, match="lacks the per-splat state generation, anchor_means"):
        generations.load_state_dict({"weights": [1.0]}, splats_at([0.0]))


def test_an_unknown_anchor_is_named():
    with pytest.raises(ConfigError, match="unknown anchor 'sauce'. Did you mean 'source'"):
        Generations(1, 0.1, 2, 10, anchor="sauce")
