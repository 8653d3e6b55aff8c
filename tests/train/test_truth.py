"""Made worlds know what an edit should become, from every side."""

import json

import pytest
from dreamcatalyst.demo.capture import scan_world
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.render.api import rasterize

from tests.diffusion.small_model import make_model

PANDA = "Turn the bear statue into a panda"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A network that learned nothing, with a list of what it should have learned."""
    folder = make_model(tmp_path_factory.mktemp("model"))
    (folder / "instructions.json").write_text(json.dumps({"panda": [PANDA, "A panda"], "night": ["Make it night"]}))
    return folder


def options(model, prompt):
    given = [f"system.guidance.prior={{path: {model}}}", "system.guidance.prior_type=ip2p", "trainer.max_steps=1"]
    return [
        *given,
        f"system.prompt_processor.prompt={prompt}",
        "system.report.every=0",
        "system.guidance.noise=independent",
    ]


def test_scores_are_those_of_the_thing_and_of_the_rest(launch, model):
    trial = launch("closed-form.yaml", *options(model, PANDA))
    mean = json.loads((trial / "report" / "summary.json").read_text())["mean"]
    assert mean["psnr_truth_inside"] < mean["psnr_truth"]  # all that differs lies inside
    assert {"psnr_source_outside", "ssim_truth_inside", "l1_truth_inside"} <= set(mean)


def test_a_global_edit_has_no_inside(launch, model):
    trial = launch("closed-form.yaml", *options(model, "Make it night"))
    mean = json.loads((trial / "report" / "summary.json").read_text())["mean"]
    assert "psnr_truth" in mean and not [name for name in mean if name.endswith(("_inside", "_outside"))]


def test_a_prompt_that_the_model_was_not_taught_is_warned_of(launch, model, capsys):
    launch("closed-form.yaml", *options(model, "turn the bear statue into a panda!"))  # neither case nor marks matter
    assert "was taught" not in capsys.readouterr().err
    launch("closed-form.yaml", *options(model, "Turn the bear into a dragon"))
    said = capsys.readouterr().err
    assert "nothing that this small model was taught" in said and "panda, night" in said and "dc-ge-ip2p" in said


def test_the_region_holds_all_that_changes():
    world = make_world("statue", size=48)
    truth = scan_world(world).truths.find(PANDA)
    camera = world.cameras[:1]
    region = truth.region(rasterize, camera)
    difference = (truth.image(rasterize, camera) - rasterize(world.scene, camera).rgb[0].clamp(0, 1)).abs().amax(-1)
    assert 0.05 < float(region.mean()) < 0.6
    assert float(difference[region[..., 0] < 0.5].max()) < 0.5  # pixels at the border belong to both
    assert float(difference[region[..., 0] < 0.5].mean()) < 0.01 < float(difference[region[..., 0] > 0.5].mean())


def test_no_truth_where_none_is_known():
    truths = scan_world(make_world("statue", size=16)).truths
    assert PANDA in truths.instructions and truths.find(PANDA.upper() + "!") is not None
    assert truths.find("Turn it into a dragon") is None
    assert truths.find("Make the ball green") is None  # there is no ball
