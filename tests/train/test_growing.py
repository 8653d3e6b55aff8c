"""Edits that add what was not there: where they may, what holds them back, and that they come to it."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.demo.edits import apply_edit
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.guidance import Guidance
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.report.metrics import psnr
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.ply import read_ply
from dreamcatalyst.train.densify import DensifyConfig, candidate_children, candidate_parents, densify
from dreamcatalyst.train.editing import EditMethod
from dreamcatalyst.train.region import dilate

from tests.train.test_densify import generator, make_splats, with_gradient
from tests.train.test_runs import rows

BOX = "system.mask={kind: box, options: {low: [-0.36, -0.36, -0.02], high: [0.42, 0.36, 1.12]}}"


def gradients_above_the_outline(launch, monkeypatch, *options):
    """Of guidance and outside terms in the render, summed over pixels that only the new hat covers at the start."""
    found, step_loss = {}, EditMethod.step_loss

    def spy(self, batch, step):
        terms, render, numbers = step_loss(self, batch, step)
        index = batch["index"][0]
        above = self.region(index).bool() & (self.source.view(index)[1] < 1e-3)
        for name, term in terms.items():
            if term.requires_grad:
                grad = torch.autograd.grad(term, render.rgb, retain_graph=True)[0][0]
                found[name] = float((grad * above).abs().sum() / above.sum())
        return terms, render, numbers

    monkeypatch.setattr(EditMethod, "step_loss", spy)
    launch("grow.yaml", "data.width=64", "data.height=64", BOX, "trainer.max_steps=1", *options)
    monkeypatch.undo()
    return found


def test_guidance_reaches_beyond_the_outline(launch, monkeypatch):
    """Where the hat will be there is no editable splat yet."""
    assert gradients_above_the_outline(launch, monkeypatch)["guidance"] > 0
    everywhere = gradients_above_the_outline(launch, monkeypatch, "system.loss.region=everywhere")
    assert everywhere["guidance"] > 0 and "outside" not in everywhere
    assert gradients_above_the_outline(launch, monkeypatch, "system.loss.region=start")["guidance"] == 0


def test_a_share_is_widened_by_its_reach():
    share = torch.zeros(1, 20, 30, 1)
    share[0, 10, 15] = 0.7
    wide = dilate(share, 0.1)  # 3 pixels of 30
    assert wide[0, 7:14, 12:19].eq(0.7).all() and float(wide.sum()) == pytest.approx(0.7 * 49)
    assert torch.equal(dilate(share, 0.0), share)


@pytest.mark.parametrize("size", [8, 16])
def test_what_is_beside_the_rule_keeps_its_balance_whatever_the_reduction(size):
    """The ratio of the two gradients is the same under a mean and under a sum, and at any size of the image."""
    ratios = []
    for reduction in ("mean", "sum"):
        made = Guidance(GuidanceConfig(reduction=reduction), "Make it sunset")
        source = torch.rand(1, size, size, 3, generator=torch.Generator().manual_seed(0))
        rgb = (source + 0.1).requires_grad_()
        given = made.step(rgb, source, [0], 3, 10)
        leak = made.objective.in_balance((rgb - source).abs().mean(), given)
        rule, beside = (torch.autograd.grad(loss, rgb, retain_graph=True)[0].norm() for loss in (given.loss, leak))
        ratios.append(float(beside / rule))
    assert ratios[1] == pytest.approx(ratios[0], rel=1e-4)


def test_candidates_stand_about_the_splats_whose_gradients_are_largest():
    gradient = torch.tensor([0.0, 1.0, 3.0])
    drawn = candidate_parents(gradient, 20_000, generator())
    shares = torch.bincount(drawn, minlength=3) / len(drawn)
    torch.testing.assert_close(shares, torch.tensor([0.0, 0.1, 0.9]), atol=0.01, rtol=0)  # ~ gradient^2
    scene = make_splats([0.1] * 2000).scene.detach()
    config = DensifyConfig(candidate_reach=0.02, candidate_opacity=0.05)
    made = candidate_children(scene, config, 3.0, generator())
    assert float((made["means"] - scene.means).std()) == pytest.approx(0.06, rel=0.05)
    torch.testing.assert_close(made["logit_opacities"].sigmoid(), torch.full((2000,), 0.05))


def test_candidates_are_tried_only_where_there_is_room_and_asked_for():
    config = DensifyConfig(grad_threshold=1e9, max_size=0.0, candidates=0.5, candidates_least=3, max_splats=8)
    for explore, expected in ((True, 3), (False, 0)):
        splats = with_gradient(make_splats([0.1] * 4, state={"birth": torch.arange(4)}), [0.0, 0.0, 1.0, 0.0])
        report = densify(splats, config, 1.0, generator(), explore=explore)
        assert (report.tried, len(splats)) == (expected, 4 + expected)
        assert splats.state["birth"].tolist() == [0, 1, 2, 3] + [2] * expected  # a candidate has its parent's state
    full = with_gradient(make_splats([0.1] * 8), [1.0] * 8)
    assert densify(full, config, 1.0, generator(), explore=True).tried == 0
    still = with_gradient(make_splats([0.1] * 4), [0.0] * 4)
    densify(still, config, 1.0, generator(), explore=True)
    assert len(still) == 4


@pytest.mark.slow
def test_a_hat_grows_out_of_a_box_about_the_statue(launch):
    """At held-out views, where the hat is: 8 dB and more above the unedited scene; elsewhere the source stays."""
    trial = launch("grow.yaml", "data.width=96", "data.height=96", BOX, "trainer.max_steps=160")
    curve = rows(trial)
    assert curve[-1]["psnr_truth_inside"] > curve[0]["psnr_truth_inside"] + 8
    assert curve[-1]["psnr_source_outside"] > 35
    for name in ("share_guidance", "share_outside"):
        assert 0 < curve[-1][name] < 1
    assert curve[-1]["share_guidance"] + curve[-1]["share_outside"] == pytest.approx(1, abs=1e-3)
    world, last = make_world("statue"), read_ply(trial / "save" / "last.ply")
    frozen = last.extra["mask"] < 0.1
    low, high = torch.tensor([-0.36, -0.36, -0.02]), torch.tensor([0.42, 0.36, 1.12])
    outside = ~((world.scene.means >= low) & (world.scene.means <= high)).all(1)
    assert int(frozen.sum()) == int(outside.sum())
    for name in PARAMETERS:
        assert torch.equal(getattr(last, name)[frozen], getattr(world.scene, name)[outside]), name
    camera = world.cameras[8].resized(96, 96)  # and its depth is that of the hat, not of the sky behind
    truth = apply_edit(world, "party hat")
    hat = truth.means.new_zeros(len(truth), 1)
    hat[len(world.scene) :] = 1
    want = rasterize(truth, camera, features=hat, depth=True)
    got, before = (rasterize(scene, camera, depth=True) for scene in (last, world.scene))
    where = want.features.round()
    error, unedited = (((drawn.depth - want.depth).abs() * where).sum() / where.sum() for drawn in (got, before))
    assert error < 0.25 * unedited and float(psnr(got.rgb, want.rgb, where)) > 15


def test_an_edit_whose_outcome_is_not_known_is_told_before_the_first_step(launch, capsys):
    launch("grow.yaml", "system.prompt_processor.prompt=Give the bear a scraf", status=2)
    said = capsys.readouterr().err
    assert "no outcome of 'Give the bear a scraf' is known in demo:statue. Did you mean 'Give the bear a scarf'" in said
