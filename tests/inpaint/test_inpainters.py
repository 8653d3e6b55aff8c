"""What fills holes in pictures: one colour stays one colour, the rest stays to the bit, errors name the remedy."""

import json
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.errors import ConfigError, PriorError
from dreamcatalyst.inpaint.api import INPAINTERS, InpaintConfig, inpaint
from dreamcatalyst.inpaint.stable_diffusion import StableDiffusionInpainting

from tests.diffusion.small_model import make_model

MODELS = ("stable-diffusion",)
WITHOUT = [name for name in INPAINTERS.names() if name not in MODELS]


@pytest.fixture(scope="module")
def model(tmp_path_factory, one_thread):
    return make_model(tmp_path_factory.mktemp("models") / "inpainting", channels=9)


def picture(height=48, width=64, seed=0):
    """Smooth colours, and a hole in their middle."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    hole = torch.zeros(height, width, dtype=torch.bool)
    hole[16:28, 20:40] = True
    return torch.stack([0.2 + 0.5 * x, 0.3 + 0.4 * y, 0.5 + 0 * x], dim=-1), hole


@pytest.mark.parametrize("kind", WITHOUT)
def test_a_hole_in_one_colour_takes_that_colour(kind):
    image, hole = torch.full((48, 64, 3), 0.4), picture()[1]
    spoiled = torch.where(hole[..., None], torch.tensor([1.0, 0.0, 1.0]), image)
    assert (inpaint(InpaintConfig(kind).inpainter(), None, spoiled, hole) - image).abs().max() < 0.02


@pytest.mark.parametrize("kind", WITHOUT)
def test_what_is_not_in_the_hole_stays_to_the_bit_and_nothing_of_the_hole_remains(kind):
    image, hole = picture()
    spoiled = torch.where(hole[..., None], torch.tensor([1.0, 0.0, 1.0]), image)
    filled = inpaint(InpaintConfig(kind).inpainter(), None, spoiled, hole)
    assert torch.equal(filled[~hole], image[~hole])
    assert (filled[hole] - image[hole]).abs().mean() < 0.1  # colours of the surroundings, none of the thing's


def test_without_a_hole_or_surroundings_a_picture_is_left_alone():
    image, hole = picture()
    for none in (hole & False, hole | True):
        assert torch.equal(inpaint(InpaintConfig().inpainter(), None, image, none), image)


# --- Stable Diffusion, on a small model of its layout


def test_stable_diffusion_fills_the_hole_alone_and_by_its_seed(model):
    inpainter = StableDiffusionInpainting(str(model), prompt="a photo of snow", steps=2, size=64)
    loaded, (image, hole) = inpainter.load(torch.device("cpu")), picture()
    filled = inpaint(inpainter, loaded, image, hole)
    assert torch.equal(filled[~hole], image[~hole]) and not torch.equal(filled[hole], image[hole])
    assert filled.shape == image.shape and bool(((filled >= 0) & (filled <= 1)).all())
    assert torch.equal(filled, inpaint(inpainter, loaded, image, hole))
    assert not torch.equal(filled, inpaint(replace(inpainter, seed=1), loaded, image, hole))


def test_the_model_sees_what_is_around_the_hole(model):
    inpainter = StableDiffusionInpainting(str(model), steps=2, size=64)
    loaded, (image, hole) = inpainter.load(torch.device("cpu")), picture()
    first = inpaint(inpainter, loaded, image, hole)
    inside = torch.where(hole[..., None], 1 - image, image)
    assert torch.equal(inpaint(inpainter, loaded, inside, hole)[hole], first[hole])  # and nothing of what is in it
    assert not torch.equal(inpaint(inpainter, loaded, 1 - image, hole)[hole], first[hole])


@pytest.mark.parametrize("channels, remedy", [(4, "for inpainting"), (8, "for inpainting")])
def test_a_model_of_another_kind_is_refused(tmp_path, channels, remedy):
    folder = make_model(tmp_path / "model", channels=channels)
    with pytest.raises(PriorError, match=f"takes {channels} channels.*expected 9.*{remedy}"):
        StableDiffusionInpainting(str(folder)).load(torch.device("cpu"))


def test_an_inpainting_model_is_no_prior(model):
    from dreamcatalyst.diffusion.folder import open_folder

    with pytest.raises(PriorError, match=r"is a model for inpainting.*configs/delete\.yaml"):
        open_folder(str(model), conditioned=True)


def test_a_folder_that_lacks_a_part_or_is_not_there_is_named(model, tmp_path):
    with pytest.raises(PriorError, match=r"no such folder"):
        StableDiffusionInpainting(str(tmp_path / "none")).load(torch.device("cpu"))
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "model_index.json").write_text(json.dumps({}))
    with pytest.raises(PriorError, match=r"'unet/config.json' is missing"):
        StableDiffusionInpainting(str(broken)).load(torch.device("cpu"))


def test_options_are_checked_by_the_kind():
    with pytest.raises(ConfigError, match=r"telia.*telea"):
        InpaintConfig("telia")
    with pytest.raises(ConfigError, match=r"quality.*best"):
        InpaintConfig("fsr", {"quality": "bets"}).inpainter()
    with pytest.raises(ConfigError, match=r"radius"):
        InpaintConfig("telea", {"radus": 0.1}).inpainter()
