"""Text masks on small models of the real classes: what is found is what the library's own post-processing finds."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.errors import ConfigError, PriorError, SceneError
from dreamcatalyst.segment.api import MaskConfig, make_mask
from dreamcatalyst.segment.text import ClipSeg, GroundedSam, Text

from tests.segment.conftest import GREEN
from tests.segment.small_models import make_grounding_dino, make_sam

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def grounded(tmp_path_factory):
    root = tmp_path_factory.mktemp("grounded")
    return {"path": str(make_grounding_dino(root / "dino")), "sam": str(make_sam(root / "sam"))}


@pytest.fixture
def image():
    return torch.rand(40, 56, 3, generator=torch.Generator().manual_seed(0))


def test_all_instances_are_found(clipseg):
    """Two discs in one picture."""
    y, x = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    discs = ((x - 16) ** 2 + (y - 16) ** 2 < 100) | ((x - 46) ** 2 + (y - 44) ** 2 < 100)
    image = torch.where(discs[..., None], torch.tensor(GREEN), torch.full((3,), 0.45))
    mask = ClipSeg(Text(text="green disc", path=str(clipseg)), CPU)(image)
    for corner in (mask[:32, :32], mask[32:, 32:]):
        assert corner.sum() > 100
    assert float((mask.bool() & discs).sum() / (mask.bool() | discs).sum()) > 0.6


def test_phrases_are_merged(clipseg, image):
    def mask(text):
        return ClipSeg(Text(text=text, path=str(clipseg)), CPU)(image)

    assert torch.equal(mask("Green disc. fox"), torch.maximum(mask("green disc"), mask("fox")))


def test_boxes_are_those_of_the_library(grounded, image):
    finder = GroundedSam(Text(text="green disc", threshold=0.6, **grounded), CPU)
    pixels = (image * 255).round().byte().numpy()
    inputs = finder.processor(images=pixels, text="green disc.", return_tensors="pt")
    with torch.no_grad():
        output = finder.detector(**inputs)
    (theirs,) = finder.processor.image_processor.post_process_object_detection(output, 0.6, [(40, 56)])
    boxes = finder.boxes(pixels)
    assert 0 < len(boxes) < 6
    torch.testing.assert_close(boxes, theirs["boxes"].clamp(min=0).minimum(torch.tensor([56.0, 40, 56, 40])))


def test_the_mask_is_the_union_of_the_boxes(grounded, image):
    finder = GroundedSam(Text(text="green disc", threshold=0.01, **grounded), CPU)
    pixels, boxes = (image * 255).round().byte().numpy(), torch.tensor([[2.0, 3, 20, 22], [30.0, 10, 50, 38]])
    both = finder.cut_out(pixels, boxes)
    assert both.shape == (40, 56) and set(both.unique().tolist()) <= {0.0, 1.0}
    assert torch.equal(both, torch.maximum(finder.cut_out(pixels, boxes[:1]), finder.cut_out(pixels, boxes[1:])))


def test_nothing_found_in_any_view_is_an_error(disc_world, clipseg, grounded):
    for options in ({"path": str(clipseg)}, grounded):
        config = MaskConfig(kind="text", options={"text": "disc", "threshold": 0.999999, **options}, views=2)
        with pytest.raises(
            SceneError, match=r"'disc' was found in none of 2 views \(best score [01]\.\d\d, threshold 0.999999"
        ):
            make_mask(config, disc_world.request)


def test_wrong_models_are_refused(clipseg, grounded, tmp_path, disc_world, monkeypatch):
    def refused(match, **options):
        with pytest.raises(PriorError, match=match):
            make_mask(MaskConfig(kind="text", options={"text": "disc", **options}), disc_world.request)

    refused(r"is a 'sam', expected clipseg \(such as CIDAS/.*\) or grounding-dino", path=grounded["sam"])
    refused("is a 'clipseg', expected sam", path=grounded["path"], sam=str(clipseg))
    refused("nowhere: no such folder. Give a folder with config.json", path=str(tmp_path / "nowhere"))
    refused("has no config.json of a model that is known", path=str(tmp_path))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    refused("and the hub did not give it .* run `hf download nobody/nothing`", path="nobody/nothing")


@pytest.mark.parametrize("options", [{}, {"text": " . "}, {"text": "fox", "threshold": 1.5}])
def test_options_that_cannot_be(options):
    with pytest.raises(ConfigError):
        parse(Text, options)
