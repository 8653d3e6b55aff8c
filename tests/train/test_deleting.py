"""Things taken away: what goes, what is put in its place, what stays to the bit, and what a second start finds."""

import json

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.inpaint.api import InpaintConfig, inpaint
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.report.clock import Clock
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.ply import read_ply
from dreamcatalyst.train.drawing import Drawer, RendererConfig
from dreamcatalyst.train.healing import HealConfig, Healer, opened

BOX = {"low": [-0.32, -0.37, 0.03], "high": [0.45, 0.37, 1.15]}  # of configs/delete.yaml
SIZE = 48
SMALL = ["trainer.max_steps=2", "system.mask.grow=0", "data.width=48", "data.height=48", "system.heal.views=6"]
GREEN, RED = torch.tensor([0.2, 0.6, 0.3]), torch.tensor([0.9, 0.1, 0.1])


def inside(scene):
    low, high = (torch.tensor(BOX[corner]) for corner in ("low", "high"))
    return ((scene.means >= low) & (scene.means <= high)).all(dim=1)


def grid(n, half, height, colour):
    """A flat square of n x n splats at z = height."""
    x, y = torch.meshgrid(torch.linspace(-half, half, n), torch.linspace(-half, half, n), indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3)
    wide = 1.3 * half / n
    scales = torch.tensor([wide, wide, 0.05 * wide]).expand(len(means), 3)
    return Gaussians.from_colors(means, scales, colour.expand(len(means), 3), torch.full((len(means),), 0.95))


def ring(n=6):
    """Cameras around the middle that look down at about 40 degrees."""
    angle = torch.arange(n) * (2 * torch.pi / n)
    eyes = torch.stack([1.6 * angle.cos(), 1.6 * angle.sin(), torch.full_like(angle, 1.3)], -1)
    K = torch.tensor([[[1.3 * SIZE, 0, SIZE / 2], [0, 1.3 * SIZE, SIZE / 2], [0, 0, 1.0]]])
    up = torch.tensor([0.0, 0.0, 1.0])
    return [Cameras(look_at(eye[None], torch.zeros(3), up), K, SIZE, SIZE) for eye in eyes]


@pytest.fixture(scope="module")
def flat():
    """A green floor with a square hole in its middle, a red lid that lies on the hole, and what is healed of it."""
    floor = grid(60, 1.5, 0.0, GREEN)
    floor = floor[floor.means[:, :2].abs().amax(dim=1) > 0.24]
    lid = grid(22, 0.3, 0.03, RED)
    scene, thing = Gaussians.cat([floor, lid]), torch.arange(len(floor) + len(lid)) >= len(floor)
    inpainter, cameras = InpaintConfig().inpainter(), dict(enumerate(ring()))
    draw = Drawer(RendererConfig(), Clock())
    healer = Healer(HealConfig(), draw, cameras, lambda picture, hole: inpaint(inpainter, None, picture, hole))
    return floor, cameras, healer, healer(scene, thing)


def test_the_hole_under_a_thing_is_closed_by_the_surface_around_it(flat):
    floor, cameras, _, healed = flat
    new = healed.scene[len(healed.scene) - healed.added :]
    assert healed.added > 0 and new.means[:, 2].abs().max() < 0.04  # in the floor's plane
    for camera in (*cameras.values(), ring(7)[3]):  # and one that was not looked at
        middle = (0, slice(SIZE // 2 - 2, SIZE // 2 + 2), slice(SIZE // 2 - 2, SIZE // 2 + 2))
        assert rasterize(floor, camera).alpha[middle].max() < 0.1  # there was nothing
        drawn = rasterize(healed.scene, camera)
        assert drawn.alpha[middle].min() > 0.9
        assert (drawn.rgb[middle] / drawn.alpha[middle] - GREEN).abs().max() < 0.06  # and none of the lid's red


def test_one_view_fills_what_all_see(flat):
    healed = flat[3]
    assert len(healed.pictures) < 4  # of 6: the others find the first one's splats in their holes


def test_what_other_views_have_seen_is_no_hole(flat):
    """The lid high over a whole floor: taken away, nothing is to be invented."""
    healer, floor = flat[2], grid(60, 1.5, 0.0, GREEN)
    lid = grid(14, 0.12, 0.5, RED)
    scene, thing = Gaussians.cat([floor, lid]), torch.arange(len(floor) + len(lid)) >= len(floor)
    healed = healer(scene, thing)
    assert healed.added == 0 and not healed.pictures and healed.taken == len(lid)
    assert torch.equal(healed.scene.means, floor.means)


def test_opening_leaves_what_is_wide_and_drops_what_is_narrow():
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[2:7, 2:7] = True
    mask[9] = True
    kept = mask.clone()
    kept[9] = False
    assert torch.equal(opened(mask), kept)


# --- runs


@pytest.fixture(scope="module")
def statue():
    return make_world("statue").scene


def test_everything_else_stays_to_the_bit_and_the_report_says_what_was_done(launch, statue):
    trial = launch("delete.yaml", *SMALL)
    source, last = read_ply(trial / "save" / "source.ply"), read_ply(trial / "save" / "last.ply")
    assert torch.equal(source.means, statue.means)  # undo is a copy
    counts = list(json.loads((trial / "report" / "summary.json").read_text())["counts"].values())
    taken, unseen, added, border = counts
    assert taken == int(inside(statue).sum()) and added > 0
    assert len(last) == len(source) - taken - unseen + added
    frozen = last[: len(last) - added - border]
    assert torch.equal(last.extra["mask"], (torch.arange(len(last)) >= len(frozen)).float())
    rows = {tuple(row): i for i, row in enumerate(source.means.tolist())}
    there = torch.tensor([rows[tuple(mean)] for mean in frozen.means.tolist()])
    assert bool((there[1:] > there[:-1]).all()) and not bool(inside(statue)[there].any())
    for name in PARAMETERS:
        assert torch.equal(getattr(frozen, name), getattr(source, name)[there]), name
    summary = json.loads((trial / "report" / "summary.json").read_text())
    assert {"psnr_truth_inside", "psnr_source_outside"} <= set(summary["mean"])
    page = (trial / "report" / "index.html").read_text()
    assert "Taken away: bear statue" in page and "splats put in" in page
    for name in ("mask.png", "fill.png"):
        assert (trial / "save" / name).stat().st_size > 0


def test_a_resumed_run_ends_as_one_that_was_not_stopped(launch):
    trial = launch("delete.yaml", *SMALL, "checkpoint.every_n_train_steps=1", "checkpoint.save_top_k=-1")
    whole = read_ply(trial / "save" / "last.ply")
    (trial / "save" / "last.ply").unlink()
    (first,) = trial.glob("ckpts/*step=1.ckpt")
    launch("delete.yaml", *SMALL, f"resume={first}")
    resumed = read_ply(trial / "save" / "last.ply")
    for name in PARAMETERS:
        assert torch.equal(getattr(resumed, name), getattr(whole, name)), name


def test_the_truth_of_a_removal_draws_nothing_of_the_thing_and_all_of_the_rest(statue):
    from dreamcatalyst.demo.edits import apply_edit

    world = make_world("statue", size=32, views=3)
    first, last = world.thing("bear statue").rows
    rest = torch.ones(len(statue), dtype=torch.bool)
    rest[first:last] = False
    without, expected = (rasterize(s, world.cameras).rgb for s in (apply_edit(world, "no bear statue"), statue[rest]))
    assert torch.equal(without, expected)
