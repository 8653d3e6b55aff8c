"""Trainable splats: after any rearrangement parameters, Adam moments and state of a splat are still its own."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.errors import SceneError
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.generations import Generations
from dreamcatalyst.scene.trainable import Splats
from hypothesis import given, settings
from hypothesis import strategies as st

RATES = dict.fromkeys(PARAMETERS, 1e-2)


def numbered(n: int, sh_degree: int = 1) -> Splats:
    """n splats in whose every tensor each value of row i is i (the state "row" too); Adam has made no step yet."""
    row = torch.arange(n, dtype=torch.float32)

    def full(*shape: int) -> torch.Tensor:
        return row.reshape(n, *[1] * len(shape)).expand(n, *shape).clone()

    scene = Gaussians(full(3), full(4), full(3), full(), full(1, 3), full((sh_degree + 1) ** 2 - 1, 3))
    splats = Splats(scene.with_extra(label=full(2)), state={"row": torch.arange(n)})
    splats.make_optimizer(RATES)
    return splats


def give_moments(splats: Splats) -> None:
    """One Adam step with gradient i+1 for row i, undone in the parameters: moments (1-beta) (i+1)^power remain."""
    for name, value in splats.parameters.items():
        shape = (-1, *[1] * (value.ndim - 1))
        value.grad = (torch.arange(len(splats), dtype=torch.float32) + 1).reshape(shape).expand_as(value).clone()
        splats.parameters[name].grad = value.grad
    kept = {name: value.detach().clone() for name, value in splats.parameters.items()}
    splats.optimizer.step()
    with torch.no_grad():
        for name, value in splats.parameters.items():
            value.copy_(kept[name])
    splats.optimizer.zero_grad()


def moments(splats: Splats, name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """First and second moment of a parameter, [N] (the first number of each row)."""
    state = splats.optimizer.state[splats.parameters[name]]
    return state["exp_avg"].flatten(1)[:, 0] if state["exp_avg"].ndim > 1 else state["exp_avg"], (
        state["exp_avg_sq"].flatten(1)[:, 0] if state["exp_avg_sq"].ndim > 1 else state["exp_avg_sq"]
    )


def surgeries(max_operations: int = 5):
    """Random sequences of (share of rows kept, share of rows that get a child, seed)."""
    share = st.floats(0.0, 1.0)
    return st.lists(st.tuples(share, share, st.integers(0, 1000)), min_size=1, max_size=max_operations)


@given(st.integers(1, 12), surgeries(), st.sampled_from([0, 1, 3]))
@settings(max_examples=60, deadline=None)
def test_every_row_keeps_its_own(n, operations, sh_degree):
    """A model on plain lists: (original row, whether it has moments) per splat."""
    splats = numbered(n, sh_degree)
    give_moments(splats)
    model = [(i, True) for i in range(n)]
    for keep_share, child_share, seed in operations:
        g = torch.Generator().manual_seed(seed)
        keep = (torch.rand(len(splats), generator=g) < keep_share).nonzero()[:, 0]
        keep = keep[torch.randperm(len(keep), generator=g)]  # rows may move, too
        parents = (torch.rand(len(splats), generator=g) < child_share).nonzero()[:, 0]
        splats.rearrange(keep, parents, {"means": splats.parameters["means"].detach()[parents]})
        model = [model[i] for i in keep.tolist()] + [(model[i][0], False) for i in parents.tolist()]
        rows = torch.tensor([row for row, _ in model], dtype=torch.float32)
        for name, value in [*splats.parameters.items(), *splats.state.items()]:
            assert value.shape[0] == len(model)
            expected = rows.to(value).reshape(-1, *[1] * (value.ndim - 1)).expand_as(value)
            assert torch.equal(value.detach(), expected), name
        known = torch.tensor([float(alive) for _, alive in model])
        for name in PARAMETERS:
            first, second = moments(splats, name) if splats.parameters[name].numel() else ((rows + 1) * 0.1, rows)
            if splats.parameters[name].numel():
                torch.testing.assert_close(first, known * (rows + 1) * 0.1)
                torch.testing.assert_close(second, known * (rows + 1) ** 2 * 0.001)
        saved = Splats.from_state_dict(splats.state_dict(), torch.device("cpu"))
        for name, value in [*splats.parameters.items(), *splats.state.items()]:
            assert torch.equal((saved.parameters | saved.state)[name], value)
        assert list(saved.scene.extra) == ["label"]


def test_optimizer_and_splats_hold_the_same_leaves_after_a_rearrangement():
    splats = numbered(4)
    give_moments(splats)
    splats.rearrange(torch.tensor([3, 1]), torch.tensor([0]), {})
    groups = {group["name"]: group["params"] for group in splats.optimizer.param_groups}
    assert list(groups) == list(PARAMETERS)
    for name, value in splats.parameters.items():
        assert len(groups[name]) == 1 and groups[name][0] is value and value.is_leaf and value.requires_grad
    assert set(splats.optimizer.state) == set(splats.parameters.values())  # none of the old ones is left


def test_steps_after_a_rearrangement_are_those_of_adam():
    """Survivors go on as if nothing had happened; a child moves as one whose moments are zero at that step."""
    splats, alone = numbered(3), numbered(3)
    for s in (splats, alone):
        give_moments(s)
    splats.rearrange(torch.tensor([0, 2]), torch.tensor([1]), {})
    for s in (splats, alone):
        for value in s.parameters.values():
            value.grad = torch.ones_like(value)
        s.optimizer.step()
    for name in PARAMETERS:
        assert torch.equal(splats.parameters[name][:2], alone.parameters[name][[0, 2]])
    # Kingma & Ba 2015 at step 2: m = (1 - b1) / (1 - b1^2), v = (1 - b2) / (1 - b2^2), step = lr m / sqrt(v).
    step = 1e-2 * (0.1 / (1 - 0.9**2)) / ((0.001 / (1 - 0.999**2)) ** 0.5)
    torch.testing.assert_close(splats.parameters["means"][2].detach(), torch.full((3,), 1 - step))


def test_children_take_what_is_given_and_the_rest_of_their_parents():
    splats = numbered(3)
    placed, marked = torch.tensor([[9.0, 8, 7], [6, 5, 4]]), torch.tensor([70, 80])
    splats.rearrange(torch.arange(3), torch.tensor([2, 2]), {"means": placed, "row": marked})
    assert torch.equal(splats.parameters["means"][3:].detach(), placed)
    assert splats.state["row"].tolist() == [0, 1, 2, 70, 80]
    assert torch.equal(splats.parameters["quats"][3:].detach(), torch.full((2, 4), 2.0))
    assert torch.equal(splats.scene.extra["label"][3:], torch.full((2, 2), 2.0))


def test_no_row_may_be_left():
    splats = numbered(3)
    give_moments(splats)
    nobody = torch.zeros(0, dtype=torch.long)
    splats.rearrange(nobody, nobody, {})
    assert len(splats) == 0 and len(splats.scene) == 0
    assert all(len(value) == 0 for value in moments(splats, "means"))


def test_before_the_first_step_and_without_an_optimizer():
    splats = numbered(3)
    splats.rearrange(torch.tensor([1]), torch.tensor([0, 2]), {})
    assert not splats.optimizer.state
    for value in splats.parameters.values():
        value.grad = torch.ones_like(value)
    splats.optimizer.step()
    bare = Splats(numbered(3).scene)
    bare.rearrange(torch.tensor([1]), torch.tensor([0, 2]), {})
    assert bare.optimizer is None and bare.parameters["means"][:, 0].tolist() == [1, 0, 2]


def test_the_scene_shares_memory_and_graph():
    splats = numbered(2)
    splats.scene.means.sum().backward()
    assert torch.equal(splats.parameters["means"].grad, torch.ones(2, 3))
    assert splats.scene.means.data_ptr() == splats.parameters["means"].data_ptr()


def test_splats_own_their_memory():
    scene = numbered(2).scene.detach()
    splats = Splats(scene)
    with torch.no_grad():
        splats.parameters["means"] += 1
    assert scene.means[0, 0] == 0


@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_refused():
    splats = numbered(3)
    with pytest.raises(SceneError, match="'meens' is no per-splat tensor. Known: means"):
        splats.rearrange(torch.arange(3), torch.tensor([0]), {"meens": torch.zeros(1, 3)})
    with pytest.raises(SceneError, match="'means' has 2 rows for 1 children"):
        splats.rearrange(torch.arange(3), torch.tensor([0]), {"means": torch.zeros(2, 3)})
    with pytest.raises(SceneError, match="no splats in it .*weights"):
        Splats.from_state_dict({"weights": 1}, torch.device("cpu"))


# --- frozen splats and feathered borders


def test_frozen_splats_come_first_and_cost_nothing_that_can_be_trained():
    scene = numbered(5).scene.detach()
    splats = Splats(scene, {"row": torch.tensor([1, 4])}, torch.tensor([False, True, False, False, True]))
    assert (len(splats), splats.total) == (2, 5)
    order = [0.0, 2.0, 3.0, 1.0, 4.0]
    assert splats.scene.means[:, 0].tolist() == order and splats.scene.extra["label"][:, 0].tolist() == order
    assert splats.edited.means.data_ptr() == splats.parameters["means"].data_ptr()
    splats.scene.means.sum().backward()
    assert torch.equal(splats.parameters["means"].grad, torch.ones(2, 3))
    for name, value in [*splats.frozen.parameters(), *splats.frozen.extra.items()]:
        assert not value.requires_grad and value.is_contiguous()
        assert value.data_ptr() != (getattr(scene, name) if name in PARAMETERS else scene.extra[name]).data_ptr()


def test_a_mask_of_everything_is_no_mask():
    splats = Splats(numbered(3).scene, editable=torch.ones(3, dtype=torch.bool))
    assert splats.frozen is None and splats.scene.means.data_ptr() == splats.parameters["means"].data_ptr()


def held_bytes(splats: Splats) -> int:
    """Gradients, moments and state of splats after a step."""
    tensors = [*splats.state.values(), *(value.grad for value in splats.parameters.values())]
    for moments in splats.optimizer.state.values():
        tensors += [moments["exp_avg"], moments["exp_avg_sq"]]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def test_a_mask_of_a_twentieth_keeps_a_twentieth():
    """Gradients, moments and anchors; the floor that was set is a tenth."""
    scene, held = numbered(2000, 3).scene.detach(), []
    for editable in (None, torch.arange(2000) < 100):
        splats, generations = Splats(scene, editable=editable), Generations(1, 0.1, 2, 10, anchor="source")
        generations.begin(splats)
        splats.make_optimizer(RATES)
        sum(value.sum() for _, value in splats.scene.parameters()).backward()
        splats.optimizer.step()
        held.append(held_bytes(splats))
    assert held[1] * 20 == held[0]


def test_frozen_splats_are_in_the_checkpoint():
    splats = Splats(numbered(4).scene, editable=torch.tensor([True, False, True, False]))
    back = Splats.from_state_dict(splats.state_dict(), torch.device("cpu"))
    assert (len(back), back.total) == (2, 4)
    for name, value in [*splats.scene.parameters(), *splats.scene.extra.items()]:
        assert torch.equal(value, getattr(back.scene, name) if name in PARAMETERS else back.scene.extra[name])


def test_a_feathered_border_scales_the_update_of_every_parameter():
    share = torch.tensor([1.0, 0.25, 0.5])
    feathered, plain = numbered(3), numbered(3)
    feathered.state["update"] = share
    before = feathered.scene.detach().clone()
    for splats in (feathered, plain):
        for value in splats.parameters.values():
            value.grad = torch.ones_like(value)
        with splats.scaled_update():
            splats.optimizer.step()
    for name in PARAMETERS:
        start, whole = getattr(before, name), plain.parameters[name].detach()
        weight = share.reshape(-1, *[1] * (start.ndim - 1))
        torch.testing.assert_close(feathered.parameters[name].detach() - start, weight * (whole - start))
        assert torch.equal(feathered.parameters[name][0], whole[0])


def test_the_gradient_scaled_instead_would_have_been_undone_by_adam():
    """Why the update is scaled: Adam's first step is the same for a gradient of any size."""
    splats = numbered(2)
    splats.parameters["means"].grad = torch.tensor([1.0, 0.01])[:, None].expand(2, 3).clone()
    splats.optimizer.step()
    moved = splats.parameters["means"].detach()[:, 0] - torch.tensor([0.0, 1.0])
    torch.testing.assert_close(moved, torch.tensor([-0.01, -0.01]))


def test_children_inherit_the_share_of_the_update():
    splats = numbered(3)
    splats.state["update"] = torch.tensor([1.0, 0.25, 0.5])
    splats.rearrange(torch.tensor([0]), torch.tensor([1, 2]), {})
    assert splats.state["update"].tolist() == [1.0, 0.25, 0.5]


@pytest.mark.usefixtures("unchecked")
def test_masks_and_states_that_do_not_fit_are_refused():
    scene = numbered(3).scene
    with pytest.raises(SceneError, match=r"editable is torch.bool \(2,\), expected torch.bool \(3,\)"):
        Splats(scene, editable=torch.ones(2, dtype=torch.bool))
    with pytest.raises(SceneError, match="editable is torch.float32"):
        Splats(scene, editable=torch.ones(3))
    with pytest.raises(SceneError, match=r"state 'row' has \(3,\), expected 1 rows"):
        Splats(scene, {"row": torch.arange(3)}, torch.tensor([True, False, False]))
    for share in (0.0, 1.5, float("nan")):
        with pytest.raises(SceneError, match=r"state 'update' leaves \(0,1\]"):
            Splats(scene, {"update": torch.tensor([1.0, share, 0.5])})
