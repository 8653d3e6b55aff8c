"""Edits that a mask confines: what is outside stays to the bit, what is inside moves, and both survive files."""

import json
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.ply import read_ply, write_ply

from tests.train.test_runs import assert_same_splats, rows

CENTER, RADIUS = (0.0, 0.0, 0.6), 0.5
MASK = f"system.mask={{kind: box, options: {{center: {list(CENTER)}, radius: {RADIUS}}}}}"
GROWING = [
    "system.densify.every=2",
    "system.densify.start=2",
    "system.densify.grad_threshold=1e-9",
    "system.densify.top_fraction=0.2",
]
ANCHORED = ["system.anchor.kind=last-densify"]


@pytest.fixture(scope="module")
def statue():
    """The synthetic scene's splats, as float32 in the order of a PLY of them."""
    return make_world("statue").scene


def inside(scene):
    return (scene.means - torch.tensor(CENTER)).norm(dim=1) <= RADIUS


def test_what_is_outside_of_the_mask_stays_to_the_bit(launch, statue):
    trial = launch("closed-form.yaml", "trainer.max_steps=8", MASK, *GROWING, *ANCHORED)
    last, outside = read_ply(trial / "save" / "last.ply"), statue[~inside(statue)]
    frozen, edited = last[: len(outside)], last[len(outside) :]
    for name in PARAMETERS:
        assert torch.equal(getattr(frozen, name), getattr(outside, name)), name
    assert len(edited) > int(inside(statue).sum())  # it was densified
    assert torch.equal(last.extra["mask"] >= 0.5, torch.arange(len(last)) >= len(outside))  # children inherit
    assert (trial / "save" / "mask.png").stat().st_size > 0


def test_every_attribute_moves_inside_of_the_mask(launch, statue):
    trial = launch("closed-form.yaml", "trainer.max_steps=8", MASK)
    edited = read_ply(trial / "save" / "last.ply")[int((~inside(statue)).sum()) :]
    before = statue[inside(statue)]
    for name in PARAMETERS[:5]:  # degree 0 has no shN; some splats are hidden by others
        moved = (getattr(edited, name) != getattr(before, name)).reshape(len(before), -1).any(dim=1)
        assert float(moved.float().mean()) > 0.4, name


@pytest.mark.parametrize("condition", [[], ["system.mask.feather=0.1"]])
def test_the_null_edit_in_a_mask_changes_no_bit(launch, condition):
    options = ["system.guidance.guidance_scale=0", "system.guidance.noise=independent", MASK, *condition]
    trial = launch("closed-form.yaml", "trainer.max_steps=4", *options)
    source, last = (read_ply(trial / "save" / name) for name in ("source.ply", "last.ply"))
    source = source[torch.argsort(inside(source).int(), stable=True)]  # what is frozen comes first
    for name in PARAMETERS:
        assert torch.equal(getattr(source, name), getattr(last, name)), name


def test_what_shows_outside_is_taken_back(launch):
    """Pixels beyond the mask ask for nothing, and splats of the mask that reach there are pulled back."""
    kept, free = (
        rows(
            launch("closed-form.yaml", "trainer.max_steps=60", MASK, f"system.loss.lambda_outside={weight}", name=name)
        )
        for weight, name in ((1, "kept"), (0, "free"))
    )
    assert kept[-1]["psnr_source_outside"] > free[-1]["psnr_source_outside"] + 3


def test_an_edit_inside_approaches_the_prior_s_and_leaves_the_rest(launch):
    trial = launch("closed-form.yaml", "trainer.max_steps=80", MASK, "system.report.every=0")
    curve = rows(trial)
    assert curve[-1]["psnr_edit_inside"] > curve[0]["psnr_edit_inside"] + 3
    assert curve[-1]["psnr_source_outside"] > curve[-1]["psnr_edit_inside"]
    assert curve[-1]["psnr_source_outside"] > 30


@pytest.mark.parametrize("anchor", ["last-densify", "source"])
def test_a_resumed_run_has_the_same_bits(launch, anchor):
    options = [MASK, *GROWING, f"system.anchor.kind={anchor}", "trainer.max_steps=6", "system.report.every=0"]
    options += ["system.mask.feather=0.02", "checkpoint.every_n_train_steps=3", "checkpoint.save_top_k=-1"]
    whole = launch("closed-form.yaml", *options, name="whole")
    (checkpoint,) = (whole / "ckpts").glob("*step=3.ckpt")
    copy = (
        whole.parents[1] / "again" / "trial" / "ckpts" / checkpoint.name
    )  # a resumed run writes beside its checkpoint
    copy.parent.mkdir(parents=True)
    copy.write_bytes(checkpoint.read_bytes())
    again = launch("closed-form.yaml", *options, f"resume={copy}", name="again")
    assert_same_splats(whole, again)


def test_edit_after_edit_with_the_first_scene_as_source(launch, statue):
    first = launch("closed-form.yaml", "trainer.max_steps=4", MASK, *GROWING, name="first")
    edited, source = first / "save" / "last.ply", first / "save" / "source.ply"
    second = launch(
        "closed-form.yaml",
        "trainer.max_steps=2",
        f"system.gs_source={edited}",
        f"system.original={source}",
        "system.mask.kind=kept",
        "system.prompt_processor.prompt=Make it autumn",
        name="second",
    )
    before, after = read_ply(edited), read_ply(second / "save" / "last.ply")
    outside = before.extra["mask"] < 0.5
    for name in PARAMETERS:  # undo is a copy: the source goes along unchanged
        assert torch.equal(getattr(read_ply(second / "save" / "source.ply"), name), getattr(statue, name)), name
        assert torch.equal(getattr(after, name)[: int(outside.sum())], getattr(before, name)[outside]), name
    assert len(after) == len(before)


@pytest.mark.parametrize("mask", ["{kind: box, options: {center: [0, 0, 0], radius: 1000}}", "{kind: relevance}"])
def test_a_mask_that_leaves_nothing_out_is_none(launch, tmp_path, statue, mask):
    """Night changes every pixel, so that relevance leaves nothing out either. The PLY still says so."""
    bright = write_ply(tmp_path / "bright.ply", replace(statue, sh0=2 * statue.sh0))  # masks are of clamped views
    options = [f"system.gs_source={bright}", "system.prompt_processor.prompt=Make it night", *GROWING, *ANCHORED]
    options += ["trainer.max_steps=4"]
    free, masked = (
        launch("closed-form.yaml", *options, *given, name=name)
        for given, name in (([], "free"), ([f"system.mask={mask}"], "masked"))
    )
    assert_same_splats(free, masked)
    assert bool((read_ply(masked / "save" / "last.ply").extra["mask"] == 1).all())
    plan = json.loads((masked / "report" / "plan.json").read_text())
    assert "frozen splats" in {part["name"] for part in plan["leaves_out"]}


def test_kept_masks_need_splats_that_carry_one(launch, tmp_path, statue, capsys):
    bare = write_ply(tmp_path / "bare.ply", statue[::10])
    launch("closed-form.yaml", f"system.gs_source={bare}", "system.mask.kind=kept", status=2)
    assert "property 'mask'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "left_out"),
    [
        ([], {"frozen splats", "anchors", "densification", "view-dependent colour", "perceptual network"}),
        ([MASK, *GROWING, *ANCHORED, "system.anchor.lambda_color=0"], {"anchor of sh0", "anchor of shN"}),
    ],
)
def test_the_plan_says_what_is_left_out(launch, options, left_out):
    trial = launch("closed-form.yaml", "trainer.max_steps=2", *options)
    plan = json.loads((trial / "report" / "plan.json").read_text())
    names = {part["name"] for part in plan["leaves_out"]}
    assert left_out <= names
    built = {part["name"] for part in plan["builds"]}
    assert not built & names
    assert plan["bytes"] == sum(part["bytes"] for part in plan["builds"])


def test_frozen_splats_do_not_keep_an_edit_from_growing(launch, statue, caplog):
    """A cap below the number of all splats, above that of the editable ones: it is reached, and said once."""
    editable = int(inside(statue).sum())
    cap = editable + 3
    assert cap < len(statue)
    trial = launch("closed-form.yaml", "trainer.max_steps=8", MASK, *GROWING, f"system.densify.max_splats={cap}")
    assert len(read_ply(trial / "save" / "last.ply")) == len(statue) + 3
    told = [record.getMessage() for record in caplog.records if "max_splats" in record.getMessage()]
    (warned,) = [text for text in told if "have no room" in text]
    assert f"system.densify.max_splats ({cap:,})" in warned
    plan = json.loads((trial / "report" / "plan.json").read_text())
    (note,) = [part["note"] for part in plan["builds"] if part["name"] == "densification"]
    assert f"3 times, every 2 steps, up to {cap:,} editable splats" == note


def test_the_plan_says_that_a_full_scene_is_not_densified(launch, statue):
    trial = launch("closed-form.yaml", "trainer.max_steps=3", *GROWING, "system.densify.max_splats=100")
    plan = json.loads((trial / "report" / "plan.json").read_text())
    (note,) = [part["note"] for part in plan["builds"] if part["name"] == "densification"]
    assert "removing only" in note and f"{len(statue):,} editable splats, max_splats 100" in note
