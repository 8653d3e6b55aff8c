"""A thing put into a scene: what was there keeps its bits, the thing stands where it should, and may be edited."""

import json

import pytest
import torch
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.light import plain_colors
from dreamcatalyst.scene.ply import read_ply, write_ply

from tests.train.test_runs import rows

CONFIG = "add.yaml"
LEVEL = -0.12  # of the statue's lawn
ADD = "system.add"
FEW = ["data.test_every=16", "system.report.views=1", "system.report.pictures=1"]
NOWHERE = [f"{ADD}.{key}=null" for key in ("view", "pixel", "size")]


@pytest.fixture(scope="module")
def statue():
    return make_world("statue").scene


@pytest.fixture(scope="module")
def bear():
    """The bear of another world, alone."""
    world = make_world("random:1")
    first, last = world.thing("bear statue").rows
    return world.scene[first:last]


def parts(trial):
    """What was there and what was put in, by the mask that the latter carries."""
    last = read_ply(trial / "save" / "last.ply")
    return last[last.extra["mask"] < 0.5], last[last.extra["mask"] >= 0.5]


def truth_psnr(trial) -> float:
    return json.loads((trial / "report" / "summary.json").read_text())["mean"]["psnr_truth_inside"]


def same(one, other) -> bool:
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in PARAMETERS)


def test_one_command_and_then_edits_of_what_was_put_in(launch, statue):
    """The files are there; what was there has its bits; the light comes nearer to the truth by the 2 dB that the
    benchmark asks for; an edit by the same command, and a later one by the mask in the PLY, change the thing alone."""
    trial = launch(CONFIG, *FEW, "system.report.video_frames=2")
    there, thing = parts(trial)
    assert same(there, statue) and len(thing) > 500
    assert same(read_ply(trial / "save" / "source.ply"), statue)  # undo is a copy
    assert float(thing.means[:, 2].min()) == pytest.approx(LEVEL, abs=0.005)
    for name in ("save/it0-comparison.png", "save/it0-test.mp4", "report/index.html", "configs/parsed.yaml", "cmd.txt"):
        assert (trial / name).stat().st_size > 0, name
    assert f"{len(thing):,} splats of demo:random:3" in (trial / "report" / "index.html").read_text()
    assert not list((trial / "ckpts").glob("*"))
    assert truth_psnr(trial) > truth_psnr(launch(CONFIG, *FEW, f"{ADD}.light=off", name="off")) + 2

    edit = launch(CONFIG, *FEW, "system.prompt_processor.prompt=Make it night", "trainer.max_steps=4", name="edit")
    given = f"system.gs_source={trial / 'save' / 'last.ply'}"
    later = launch("closed-form.yaml", *FEW, given, "system.mask.kind=kept", "trainer.max_steps=2", name="later")
    for each in (edit, later):
        outside, inside = parts(each)
        assert same(outside, statue) and len(inside) == len(thing) and not torch.equal(inside.sh0, thing.sh0)
    assert same(read_ply(edit / "save" / "source.ply"), statue)
    assert rows(edit)[-1]["psnr_source_outside"] > 30


def test_splats_at_their_own_coordinates_are_as_they_were(launch, tmp_path, statue, bear):
    """Neither a position nor a pixel: files of one world fit together; and light: off changes no colour."""
    given = write_ply(tmp_path / "bear.ply", bear)
    trial = launch(CONFIG, *FEW, f"{ADD}.path={given}", *NOWHERE, f"{ADD}.light=off")
    there, thing = parts(trial)
    assert same(there, statue) and same(thing, bear)


def test_a_position_a_turn_and_a_height(launch, bear):
    place = [*NOWHERE, f"{ADD}.position=[0.2, 1.5, {LEVEL}]", f"{ADD}.rotation=[0, 0, 90]", f"{ADD}.height=0.7"]
    trial = launch(CONFIG, *FEW, f"{ADD}.path=demo:random:1", *place, f"{ADD}.light=gain")
    _, thing = parts(trial)
    assert torch.equal(thing.logit_opacities, bear.logit_opacities)
    high = thing.means[:, 2].max() - thing.means[:, 2].min()
    assert float(high) == pytest.approx(0.7, rel=0.01)
    middle = (thing.means.amax(0) + thing.means.amin(0)) / 2
    torch.testing.assert_close(middle[:2], torch.tensor([0.2, 1.5]), atol=0.01, rtol=0)
    before, after = (m - m.mean(0) for m in (bear.means, thing.means))
    turned = torch.stack([-before[:, 1], before[:, 0], before[:, 2]], dim=1)
    torch.testing.assert_close(after, turned * (after.norm() / before.norm()), atol=1e-4, rtol=0)
    assert torch.equal(thing.sh0, bear.sh0)  # both worlds are in daylight


def test_a_pixel_says_where(launch):
    """Of any view, in pixels or fractions: the foot is where that pixel's ray meets the lawn."""
    trial = launch(CONFIG, *FEW, f"{ADD}.view='0005'", f"{ADD}.pixel=[20, 21]")
    _, thing = parts(trial)
    camera = make_world("statue", size=24).cameras[5]
    ray = camera.viewmats[0, :3, :3].T @ torch.linalg.inv(camera.Ks[0]) @ torch.tensor([20.0, 21.0, 1.0])
    exact = camera.centers[0] + ray * (LEVEL - camera.centers[0, 2]) / ray[2]
    middle = (thing.means.amax(0) + thing.means.amin(0)) / 2
    torch.testing.assert_close(middle[:2], exact[:2], atol=0.05, rtol=0)


def test_a_preview_shows_it_in_one_view(launch):
    trial = launch(CONFIG, mode="--preview")
    assert (trial / "save" / "preview.png").stat().st_size > 0 and not (trial / "save" / "last.ply").exists()


def test_a_mesh_stands_in_the_scene(launch, tmp_path, statue):
    import trimesh

    cone = trimesh.creation.cone(radius=0.3, height=1.0)  # along z, its tip up
    cone.visual.vertex_colors = [200, 60, 40, 255]
    path = tmp_path / "Kegel ä.ply"
    cone.export(path)
    trial = launch(CONFIG, *FEW, f"{ADD}.path={path}", f"{ADD}.splats=2000", f"{ADD}.height=0.5", f"{ADD}.size=null")
    there, thing = parts(trial)
    assert same(there, statue) and len(thing) == pytest.approx(2000, abs=5)
    assert float(thing.means[:, 2].min()) == pytest.approx(LEVEL, abs=0.005)
    widths = thing.means[:, 2].sort().indices
    low, high = thing.means[widths[:400], :2].std(0).mean(), thing.means[widths[-100:], :2].std(0).mean()
    assert float(low) > 3 * float(high)  # the tip is up
    painted, shown = torch.tensor([200.0, 60, 40]) / 255, plain_colors(thing)
    assert bool((shown <= 1.05 * painted).all()) and float((shown / painted).amin()) < 0.8  # lit, and not over-exposed
