"""A thing put into a scene: what was there keeps its bits, the thing stands where it should, and may be edited."""

import json

import pytest
import torch
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.ply import read_ply, write_ply

from tests.train.test_runs import rows

CONFIG = "add.yaml"
LEVEL = -0.12  # of the statue's lawn
ADD = "system.add"
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


def same(one, other) -> bool:
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in PARAMETERS)


def test_one_command_and_the_files_are_there(launch, statue):
    trial = launch(CONFIG, "system.report.video_frames=4")
    there, thing = parts(trial)
    assert same(there, statue) and len(thing) > 500
    assert same(read_ply(trial / "save" / "source.ply"), statue)  # undo is a copy
    assert float(thing.means[:, 2].min()) == pytest.approx(LEVEL, abs=0.005)
    for name in ("save/it0-comparison.png", "save/it0-test.mp4", "report/index.html", "configs/parsed.yaml", "cmd.txt"):
        assert (trial / name).stat().st_size > 0, name
    summary = json.loads((trial / "report" / "summary.json").read_text())
    assert summary["step"] == 0 and summary["mean"]["psnr_truth_inside"] > 20
    page = (trial / "report" / "index.html").read_text()
    assert f"{len(thing):,} splats of demo:random:3" in page
    assert not list((trial / "ckpts").glob("*"))


def test_splats_at_their_own_coordinates_are_as_they_were(launch, tmp_path, statue, bear):
    """Neither a position nor a pixel: files of one world fit together; and light: off changes no colour."""
    given = write_ply(tmp_path / "bear.ply", bear)
    trial = launch(CONFIG, f"{ADD}.path={given}", *NOWHERE, f"{ADD}.light=off")
    there, thing = parts(trial)
    assert same(there, statue) and same(thing, bear)


@pytest.mark.parametrize("light", ["shading", "gain"])
def test_light_changes_colours_alone(launch, bear, light):
    place = [*NOWHERE, f"{ADD}.position=[0.2, 1.5, {LEVEL}]", f"{ADD}.rotation=[0, 0, 90]", f"{ADD}.height=0.7"]
    trial = launch(CONFIG, f"{ADD}.path=demo:random:1", *place, f"{ADD}.light={light}")
    _, thing = parts(trial)
    assert torch.equal(thing.logit_opacities, bear.logit_opacities)
    high = thing.means[:, 2].max() - thing.means[:, 2].min()
    assert float(high) == pytest.approx(0.7, rel=0.01)
    middle = (thing.means.amax(0) + thing.means.amin(0)) / 2
    torch.testing.assert_close(middle[:2], torch.tensor([0.2, 1.5]), atol=0.01, rtol=0)
    before, after = (m - m.mean(0) for m in (bear.means, thing.means))
    turned = torch.stack([-before[:, 1], before[:, 0], before[:, 2]], dim=1)
    torch.testing.assert_close(after, turned * (after.norm() / before.norm()), atol=1e-4, rtol=0)
    assert torch.equal(thing.sh0, bear.sh0) == (light == "gain")  # both worlds are in daylight


def test_a_pixel_says_where(launch):
    """Of any view, in pixels or fractions: the foot is where that pixel's ray meets the lawn."""
    trial = launch(CONFIG, f"{ADD}.view='0005'", f"{ADD}.pixel=[20, 21]")
    _, thing = parts(trial)
    camera = make_world("statue", size=24).cameras[5]
    ray = camera.viewmats[0, :3, :3].T @ torch.linalg.inv(camera.Ks[0]) @ torch.tensor([20.0, 21.0, 1.0])
    exact = camera.centers[0] + ray * (LEVEL - camera.centers[0, 2]) / ray[2]
    middle = (thing.means.amax(0) + thing.means.amin(0)) / 2
    torch.testing.assert_close(middle[:2], exact[:2], atol=0.05, rtol=0)


def test_matching_the_light_comes_nearer_to_the_truth(launch):
    """A thing lit from elsewhere, in this world's light: at least the 2 dB that the benchmark asks of all pairs."""
    got = {}
    for light in ("off", "shading"):
        trial = launch(CONFIG, f"{ADD}.path=demo:random:17", f"{ADD}.light={light}", name=light)
        got[light] = json.loads((trial / "report" / "summary.json").read_text())["mean"]["psnr_truth_inside"]
    assert got["shading"] > got["off"] + 2


def test_an_edit_of_what_was_put_in_changes_nothing_else(launch, statue):
    words = "system.prompt_processor.prompt=Make it night"
    trial = launch(CONFIG, words, "trainer.max_steps=6")
    there, thing = parts(trial)
    assert same(there, statue)
    assert same(read_ply(trial / "save" / "source.ply"), statue)
    _, plain = parts(launch(CONFIG, name="plain"))
    assert len(thing) == len(plain) and not torch.equal(thing.sh0, plain.sh0)
    assert rows(trial)[-1]["psnr_source_outside"] > 30


def test_a_later_edit_finds_it(launch, statue):
    """By its mask, in the PLY that the run left."""
    first = launch(CONFIG, name="first")
    given = f"system.gs_source={first / 'save' / 'last.ply'}"
    second = launch("closed-form.yaml", given, "system.mask.kind=kept", "trainer.max_steps=3", name="second")
    there, thing = parts(second)
    assert same(there, statue) and not same(thing, parts(first)[1])


def test_a_preview_shows_it_in_one_view(launch):
    trial = launch(CONFIG, mode="--preview")
    assert (trial / "save" / "preview.png").stat().st_size > 0 and not (trial / "save" / "last.ply").exists()


def test_a_mesh_stands_in_the_scene(launch, tmp_path, statue):
    import trimesh

    cone = trimesh.creation.cone(radius=0.3, height=1.0)  # along z, its tip up
    cone.visual.vertex_colors = [200, 60, 40, 255]
    path = tmp_path / "Kegel ä.ply"
    cone.export(path)
    trial = launch(CONFIG, f"{ADD}.path={path}", f"{ADD}.splats=2000", f"{ADD}.height=0.5", f"{ADD}.size=null")
    there, thing = parts(trial)
    assert same(there, statue) and len(thing) == pytest.approx(2000, abs=5)
    assert float(thing.means[:, 2].min()) == pytest.approx(LEVEL, abs=0.005)
    widths = thing.means[:, 2].sort().indices
    low, high = thing.means[widths[:400], :2].std(0).mean(), thing.means[widths[-100:], :2].std(0).mean()
    assert float(low) > 3 * float(high)  # the tip is up
