"""Density control: what is chosen, what happens to it, and what it must not depend on."""

import math

import pytest
import torch
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import Render
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.generations import Generations
from dreamcatalyst.scene.trainable import Splats
from dreamcatalyst.train.densify import DensifyConfig, densify, observe, reset_opacity, screen_statistics, select
from dreamcatalyst.train.edit import EditSystem
from dreamcatalyst.train.optim import LearningRates


def make_splats(scales, opacities=None, state=None, editable=None) -> Splats:
    n = len(scales)
    generator = torch.Generator().manual_seed(0)
    scene = Gaussians.from_colors(
        torch.randn(n, 3, generator=generator),
        torch.tensor(scales, dtype=torch.float32)[:, None].expand(n, 3).clone(),
        torch.rand(n, 3, generator=generator),
        torch.full((n,), 0.5) if opacities is None else torch.tensor(opacities),
    )
    splats = Splats(scene, state, None if editable is None else torch.tensor(editable))
    splats.state.update(screen_statistics(splats))
    splats.make_optimizer(LearningRates().at(0, 10, 1.0))
    return splats


def with_gradient(splats: Splats, gradient) -> Splats:
    splats.state["grad_sum"] = torch.tensor(gradient, dtype=torch.float32)
    splats.state["grad_count"] = torch.ones(len(splats))
    return splats


def render_with_gradient(gradient: torch.Tensor) -> Render:
    views, n = gradient.shape[:2]
    means2d = torch.zeros(views, n, 2, requires_grad=True)
    means2d.grad = gradient
    blank = torch.zeros(views, 8, 8, 3)
    return Render(blank, blank[..., :1], None, None, means2d, torch.ones(views, n, dtype=torch.int32))


CONFIG = DensifyConfig(grad_threshold=0.5, dense_size=0.1, max_size=0.0)


def generator():
    return torch.Generator().manual_seed(1)


def test_small_splats_are_cloned_and_large_ones_split():
    splats = with_gradient(make_splats([0.01, 0.01, 1.0, 1.0], state={"birth": torch.arange(4)}), [1.0, 0.1, 1.0, 0.1])
    before = splats.scene.detach().clone()
    report = densify(splats, CONFIG, 1.0, generator())
    assert (report.cloned, report.split, report.pruned) == (1, 1, 0)
    assert splats.state["birth"].tolist() == [0, 1, 3, 0, 2, 2]  # survivors, the clone, the two halves
    after = splats.scene
    assert torch.equal(after.means[3], before.means[0]) and torch.equal(after.log_scales[3], before.log_scales[0])
    torch.testing.assert_close(after.log_scales[4:], before.log_scales[[2, 2]] - math.log(1.6))
    assert splats.state["grad_sum"].abs().sum() == 0 and len(splats.state["grad_sum"]) == 6


def test_halves_are_drawn_from_their_parent():
    splats = with_gradient(make_splats([2.0] * 4000), [1.0] * 4000)
    parent = splats.scene.detach().clone()
    densify(splats, CONFIG, 1.0, generator())
    offset = splats.scene.means.detach() - parent.means.repeat(2, 1)
    assert offset.std().item() == pytest.approx(2.0, rel=0.02)
    assert offset.mean().abs().item() < 0.05


def test_faint_and_huge_splats_go():
    splats = with_gradient(make_splats([0.01, 0.01, 5.0], [0.5, 0.001, 0.5]), [0.0, 1.0, 0.0])
    report = densify(splats, DensifyConfig(grad_threshold=0.5, max_size=0.1), 10.0, generator())
    assert (report.cloned, report.split, report.pruned) == (0, 0, 2)
    assert len(splats) == 1


def test_an_edit_keeps_what_is_huge_in_its_source():
    """A sky of large splats is no floater: without it a global edit would end with a black sky."""
    splats = with_gradient(make_splats([0.01, 0.01, 5.0], [0.5, 0.001, 0.5]), [0.0, 1.0, 0.0])
    config = EditSystem.parts["densify"](grad_threshold=0.5)
    assert densify(splats, config, 10.0, generator()).pruned == 1
    assert splats.scene.scales.max().item() == pytest.approx(5.0)


def test_the_last_splats_are_not_taken():
    splats = make_splats([0.1, 0.1], opacities=[1e-4, 1e-4])
    with pytest.raises(SceneError, match="every splat"):
        densify(splats, CONFIG, 1.0, generator())
    assert len(splats) == 2


def test_screen_size_is_measured_before_it_is_reset():
    splats = with_gradient(make_splats([0.01, 0.01]), [0.0, 0.0])
    splats.state["max_radius"] = torch.tensor([30.0, 3.0])
    report = densify(splats, DensifyConfig(max_radius=20.0, max_size=0), 1.0, generator())
    assert report.pruned == 1 and splats.state["max_radius"].tolist() == [0.0]


def test_the_largest_gradients_go_first():
    gradient = torch.tensor([0.6, 0.9, 0.0, 0.7, 0.8])

    def chosen(given, room, **options):
        found, held_back = select(given, DensifyConfig(**{"grad_threshold": 0.5, **options}), room)
        return found.tolist(), held_back

    assert chosen(gradient, 2) == ([False, True, False, False, True], 2)
    assert chosen(gradient, 99, top_fraction=0.75) == ([False, True, False, True, True], 0)
    assert chosen(gradient, 1, top_fraction=0.75) == ([False, True, False, False, False], 2)
    assert chosen(gradient, 0) == ([False] * 5, 4) == chosen(gradient, -7)
    assert chosen(torch.zeros(3), 9, grad_threshold=0.0) == ([False] * 3, 0)


def test_the_cap_holds():
    splats = with_gradient(make_splats([0.01, 1.0] * 10), [1.0] * 20)
    densify(splats, DensifyConfig(grad_threshold=0.5, dense_size=0.1, max_size=0, max_splats=23), 1.0, generator())
    assert len(splats) == 23


@pytest.mark.parametrize("scale", [1.0, 65536.0, 1e-3])
def test_decisions_do_not_depend_on_the_loss_scale(scale):
    gradient = torch.randn(1, 6, 2, generator=generator()) * 0.1
    splats = make_splats([0.01] * 6)
    observe(splats, render_with_gradient(gradient * scale), loss_scale=scale)
    expected = (gradient[0] * 4).norm(dim=-1)  # half of 8 pixels
    torch.testing.assert_close(splats.state["grad_sum"], expected)


def test_the_mean_over_views_does_not_depend_on_how_many_are_drawn_at_once():
    gradient = torch.randn(1, 5, 2, generator=generator())
    one, three = make_splats([0.01] * 5), make_splats([0.01] * 5)
    observe(one, render_with_gradient(gradient))
    observe(three, render_with_gradient(gradient.expand(3, 5, 2) / 3))  # the loss is a mean over three views
    torch.testing.assert_close(
        one.state["grad_sum"] / one.state["grad_count"], three.state["grad_sum"] / three.state["grad_count"]
    )


def test_a_step_that_overflowed_leaves_no_trace():
    splats = make_splats([0.01] * 3)
    observe(splats, render_with_gradient(torch.full((1, 3, 2), torch.inf)))
    assert splats.state["grad_count"].sum() == 0


def test_moments_stay_with_their_splats():
    splats = make_splats([0.01, 0.01, 1.0])
    sum((p.square().sum() for p in splats.parameters.values()), torch.zeros(())).backward()
    splats.optimizer.step()
    moment = splats.optimizer.state[splats.parameters["means"]]["exp_avg"].clone()
    densify(with_gradient(splats, [1.0, 0.0, 1.0]), CONFIG, 1.0, generator())
    after = splats.optimizer.state[splats.parameters["means"]]["exp_avg"]
    assert torch.equal(after[:2], moment[:2]) and after[2:].abs().sum() == 0
    assert {id(p) for g in splats.optimizer.param_groups for p in g["params"]} == set(
        map(id, splats.parameters.values())
    )


def test_opacity_reset():
    splats = make_splats([0.01, 0.01], [0.9, 0.004])
    sum((p.square().sum() for p in splats.parameters.values()), torch.zeros(())).backward()
    splats.optimizer.step()
    before = splats.scene.opacities.detach().clone()
    reset_opacity(splats)
    torch.testing.assert_close(splats.scene.opacities.detach(), torch.tensor([0.01, float(before[1])]))
    assert splats.optimizer.state[splats.parameters["logit_opacities"]]["exp_avg"].abs().sum() == 0


def test_frozen_splats_are_neither_densified_nor_pruned():
    scales, opacities = [0.01, 1.0, 9.0, 0.01, 1.0, 9.0], [0.5, 0.5, 0.5, 0.001, 0.001, 0.5]
    splats = make_splats(scales, opacities, {"row": torch.arange(3)}, [True, True, True, False, False, False])
    frozen = splats.frozen.clone()
    densify(with_gradient(splats, [1.0, 1.0, 0.0]), DensifyConfig(grad_threshold=0.5, max_size=2.0), 1.0, generator())
    assert splats.state["row"].tolist() == [0, 0, 1, 1] and splats.total == 7
    assert all(torch.equal(getattr(splats.frozen, name), getattr(frozen, name)) for name in PARAMETERS)
    assert torch.equal(splats.scene.means[:3], frozen.means)


def test_screen_gradients_of_frozen_splats_are_left_out():
    """Whether the renderer hands over means2d of all splats, frozen ones first, or of the editable ones alone."""
    gradient = torch.randn(2, 5, 2, generator=generator())
    every, own = (make_splats([0.01] * 5, editable=[False, True, False, True, True]) for _ in range(2))
    observe(every, render_with_gradient(gradient))
    observe(own, render_with_gradient(gradient[:, 2:]))
    assert len(own.state["grad_sum"]) == 3 and own.state["grad_sum"].min() > 0
    for name in ("grad_sum", "grad_count", "max_radius"):
        assert torch.equal(every.state[name], own.state[name])


def test_the_cap_counts_editable_splats_alone():
    """More frozen ones than the cap change nothing; it holds for those that cost gradients and moments."""
    splats = with_gradient(make_splats([0.01] * 24, editable=[True] * 4 + [False] * 20), [1.0] * 4)
    report = densify(splats, DensifyConfig(grad_threshold=0.5, max_splats=7), 1.0, generator())
    assert (report.cloned, report.held_back) == (3, 1) and (len(splats), splats.total) == (7, 27)


def test_an_object_may_vanish_where_other_splats_are_left():
    splats = make_splats([0.1] * 3, [1e-4, 1e-4, 0.5], editable=[True, True, False])
    report = densify(splats, CONFIG, 1.0, generator())
    assert report.pruned == 2 and len(splats) == 0 and splats.total == 1
    splats.scene.means.sum().backward()  # and the run goes on
    splats.optimizer.step()
    observe(splats, render_with_gradient(torch.randn(1, 1, 2)))
    assert densify(splats, CONFIG, 1.0, generator()) == type(report)()
    reset_opacity(splats)


@pytest.mark.parametrize("anchor", ["last-densify", "source"])
def test_children_are_a_generation_of_their_own_and_hold_to_where_they_were_born(anchor):
    splats, generations = make_splats([0.01, 1.0, 0.01]), Generations(0.05, 0.1, 1.3, 10, anchor=anchor)
    generations.begin(splats)
    source = splats.scene.detach().clone()
    with torch.no_grad():
        splats.parameters["means"] += 0.5
    densify(with_gradient(splats, [1.0, 1.0, 0.0]), CONFIG, 1.0, generator(), generations)
    assert splats.state["generation"].tolist() == [0, 0, 1, 1, 1]  # two survivors, the clone, the two halves
    assert generations.weights == pytest.approx([0.065, 0.0])
    for name in PARAMETERS:
        own, anchors = splats.parameters[name].detach(), splats.state[f"anchor_{name}"]
        assert torch.equal(anchors[2:], own[2:])
        expected = own[:2] if anchor == "last-densify" else getattr(source, name)[[0, 2]]
        assert torch.equal(anchors[:2], expected)


def test_weights_and_anchors_move_on_where_nothing_was_added():
    splats, generations = make_splats([0.01]), Generations(0.05, 0.1, 1.3, 10)
    generations.begin(splats)
    with torch.no_grad():
        splats.parameters["means"] += 0.5
    densify(splats, CONFIG, 1.0, generator(), generations)
    assert len(generations) == 2 and torch.equal(splats.state["anchor_means"], splats.parameters["means"])


def test_a_refused_densification_leaves_generations_as_they_were():
    splats, generations = make_splats([0.1], [1e-4]), Generations(0.05, 0.1, 1.3, 10)
    generations.begin(splats)
    with pytest.raises(SceneError, match="every splat"):
        densify(splats, CONFIG, 1.0, generator(), generations)
    assert generations.weights == [0.05]
