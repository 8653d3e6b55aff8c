"""Dataset update: when a view is edited, from which noise level, and that a resumed run goes on as it would have."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.diffusion.closed_form import ClosedForm
from dreamcatalyst.diffusion.noise import keyed_noise
from dreamcatalyst.errors import ConfigError, PriorError
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.ddim import edit_image
from dreamcatalyst.guidance.edited_views import EditedViews
from dreamcatalyst.guidance.guidance import Guidance

SIZE = 8


def guidance(**options) -> Guidance:
    return Guidance(GuidanceConfig(**{"rule": "in2n", "diffusion_steps": 4, **options}), "Make it sunset")


def picture(seed: int) -> torch.Tensor:
    return torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(seed))


def visit(made: Guidance, view: int, step: int, render: torch.Tensor | None = None) -> torch.Tensor:
    """The gradient of the step's loss in the render [H,W,3]."""
    rgb = (picture(100 + step) if render is None else render)[None].requires_grad_()
    made.step(rgb, picture(view)[None], [view], step, 100).loss.backward()
    return rgb.grad[0]


def test_a_view_is_edited_at_its_first_visit_and_at_multiples_of_per_editing_step(monkeypatch):
    made, edits = guidance(per_editing_step=10), []
    edit = made.objective.picture
    monkeypatch.setattr(made.objective, "picture", lambda *args: (edits.append(args[2:]), edit(*args))[1])
    for step, view in [(3, 0), (4, 0), (5, 1), (10, 0), (11, 1), (20, 1), (21, 0)]:
        visit(made, view, step)
    assert edits == [(0, 3), (1, 5), (0, 10), (1, 20)]


def test_with_zero_only_first_visits_edit():
    views = EditedViews(0, 0.02, 0.98)
    assert views.due(4, 0) and views.due(4, 10)
    views.put(4, picture(0))
    assert not views.due(4, 0) and not views.due(4, 10)


def test_later_edits_take_place_between_two_steps():
    """First visits are edited at any time (GaussianEditor: begin < step < until)."""
    views = EditedViews(10, 0.02, 0.98, begin=20, until=50)
    assert views.due(4, 0) and views.due(4, 60)
    views.put(4, picture(0))
    assert [step for step in range(0, 80) if views.due(4, step)] == [30, 40]


def test_the_loss_is_the_mean_absolute_difference_from_the_kept_edit():
    made = guidance()
    visit(made, 0, 1)
    target, rgb = made.objective.edited.get(0, like=picture(0)), picture(7)
    given = made.step(rgb[None], picture(0)[None], [0], 2, 100)
    torch.testing.assert_close(given.loss, (rgb - target).abs().mean())
    torch.testing.assert_close(visit(made, 0, 2, rgb.clone()), torch.sign(rgb - target) / rgb.numel())


def test_the_edit_is_a_denoising_run_of_the_noised_render_conditioned_on_the_source():
    made = guidance()
    render, source = picture(50), picture(3)
    got = made.objective.picture(render, source, 3, 17)
    prior = made.prior
    latents, condition = prior.encode(render.permute(2, 0, 1)[None]), prior.condition(source.permute(2, 0, 1)[None])
    wanted = edit_image(
        prior,
        latents,
        keyed_noise(0, 17, 3, latents.shape[1:])[None],
        image=condition,
        text=prior.embed(["Make it sunset"])[0],
        timestep=made.objective.edited.timestep(3, 17, 1000),
        steps=4,
    )
    assert torch.equal(got, prior.decode(wanted)[0].permute(1, 2, 0))


def test_noise_levels_are_even_between_the_limits_and_a_function_of_seed_step_and_view():
    views = EditedViews(10, 0.02, 0.98, seed=1)
    drawn = torch.tensor([views.timestep(view, step, 1000) for view in range(20) for step in range(100)]).double()
    assert drawn.min() >= 20 and drawn.max() <= 980
    assert abs(drawn.mean() - 500) < 4 * 277.4 / len(drawn) ** 0.5  # of 961 even values the spread is 277.4
    assert drawn[:100].unique().numel() > 80
    assert views.timestep(3, 4, 1000) == EditedViews(1, 0.02, 0.98, seed=1).timestep(3, 4, 1000)
    others = {EditedViews(10, 0.02, 0.98, seed).timestep(view, 5, 1000) for seed in range(3) for view in range(3)}
    assert len(others) > 6


def test_a_resumed_run_compares_with_the_same_pictures(tmp_path):
    def run(made, steps):
        return [visit(made, step % 2, step) for step in steps]

    through = guidance()
    wanted = run(through, range(1, 13))
    first = guidance()
    run(first, range(1, 7))
    torch.save(first.state_dict(), tmp_path / "state.pt")
    resumed = guidance()
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for got, want in zip(run(resumed, range(7, 13)), wanted[6:], strict=True):
        assert torch.equal(got, want)


def test_options_that_cannot_be_are_named():
    with pytest.raises(ConfigError, match="per_editing_step: got -1"):
        guidance(per_editing_step=-1)
    with pytest.raises(ConfigError, match="edit_begin_step 9 and edit_until_step 3"):
        guidance(edit_begin_step=9, edit_until_step=3)
    with pytest.raises(ConfigError, match="edit_min_percent 0.5 and edit_max_percent 0.2"):
        guidance(edit_min_percent=0.5, edit_max_percent=0.2)


def test_known_edit_needs_a_prior_that_knows(monkeypatch):
    monkeypatch.setattr(ClosedForm, "exact", False)
    with pytest.raises(PriorError, match="rule 'known-edit' compares with an edit that is known"):
        guidance(rule="known-edit")
