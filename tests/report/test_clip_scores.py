"""CLIP's scores on a small CLIP in the real layout."""

import pytest
import torch
from dreamcatalyst.errors import ConfigError, PriorError
from dreamcatalyst.report.clip import Aesthetic, Clip, ClipJudge

from tests.report.small_clip import MEAN, SIDE, STD, WIDTH, make_clip, make_predictor
from tests.segment.small_models import make_clipseg

WORDS = "a photo of a fox", "a photo of a clown"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_clip(tmp_path_factory.mktemp("clip") / "model")


@pytest.fixture(scope="module")
def images():
    return torch.rand(3, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0))


def test_embeddings_are_those_of_the_model_itself(folder, images):
    from transformers import CLIPModel, CLIPTokenizer

    model, tokenizer = CLIPModel.from_pretrained(folder).eval(), CLIPTokenizer.from_pretrained(folder)
    pixels = ((images - torch.tensor(MEAN)) / torch.tensor(STD)).permute(0, 3, 1, 2)
    given = tokenizer(list(WORDS), padding=True, return_tensors="pt")
    with torch.no_grad():
        whole = model(input_ids=given.input_ids, attention_mask=given.attention_mask, pixel_values=pixels)
    clip = Clip(str(folder))
    torch.testing.assert_close(clip.images(images), whole.image_embeds, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(clip.texts(WORDS), whole.text_embeds, rtol=1e-4, atol=1e-5)
    assert clip.width == WIDTH and clip.side == SIDE


def test_a_picture_of_any_shape_is_stretched(folder, images):
    wide = images.repeat_interleave(3, dim=2).repeat_interleave(2, dim=1)
    assert Clip(str(folder)).images(wide).shape == (3, WIDTH)
    grey = torch.full((1, 5, 9, 3), 0.3)
    torch.testing.assert_close(
        Clip(str(folder)).images(grey), Clip(str(folder)).images(torch.full((1, SIDE, SIDE, 3), 0.3)), atol=1e-5, rtol=0
    )


def test_scores_have_their_sign_and_their_known_values(folder, images):
    judge, other = ClipJudge(str(folder), *WORDS, ""), ClipJudge(str(folder), *WORDS[::-1], "")
    source, edited = images, images.flip(0)
    there, back, turned = judge(source, edited), judge(edited, source), other(source, edited)
    for a, b, c in zip(there, back, turned, strict=True):
        assert a["clip_direction"] == pytest.approx(-b["clip_direction"], abs=1e-5)
        assert a["clip_direction"] == pytest.approx(-c["clip_direction"], abs=1e-5)
        assert a["clip_similarity"] == pytest.approx(b["clip_similarity"], abs=1e-6)
    assert abs(there[0]["clip_direction"]) > 1e-3
    same = judge(source, source)[0]
    assert same["clip_similarity"] == pytest.approx(1.0, abs=1e-5) and same["clip_direction"] == 0
    assert set(ClipJudge(str(folder), "", "", "")(source, edited)[0]) == {"clip_similarity"}


def test_the_predictor_is_its_layers_one_after_the_other(tmp_path):
    file = make_predictor(tmp_path / "linear.pth")
    weights = {name: value.double() for name, value in torch.load(file).items()}
    x = torch.randn(4, WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    want = x / x.norm(dim=-1, keepdim=True)
    for number in (0, 2, 4):
        want = want @ weights[f"layers.{number}.weight"].T + weights[f"layers.{number}.bias"]
    got = Aesthetic(str(file), WIDTH)(x)
    torch.testing.assert_close(got.double(), want[:, 0], rtol=1e-5, atol=1e-5)


def test_what_does_not_fit_is_said_before_weights_are_read(folder, tmp_path):
    with pytest.raises(PriorError, match="no such folder"):
        Clip("./nowhere")
    with pytest.raises(PriorError, match="'clipseg', expected clip"):
        Clip(str(make_clipseg(tmp_path / "other")))
    with pytest.raises(ConfigError, match="belong together"):
        ClipJudge(str(folder), "a photo of a fox", "", "")
    with pytest.raises(ConfigError, match="there is no file"):
        ClipJudge(str(folder), "", "", str(tmp_path / "none.pth"))
    with pytest.raises(ConfigError, match=f"width 768, the CLIP gives {WIDTH}"):
        ClipJudge(str(folder), "", "", str(make_predictor(tmp_path / "l14.pth", (768, 16, 1))))
    with pytest.raises(ConfigError, match="ends in 1"):
        ClipJudge(str(folder), "", "", str(make_predictor(tmp_path / "two.pth", (WIDTH, 2))))
    torch.save({"something": torch.ones(1)}, tmp_path / "else.pth")
    with pytest.raises(ConfigError, match="chain"):
        ClipJudge(str(folder), "", "", str(tmp_path / "else.pth"))


def test_layers_by_number_not_by_name(tmp_path):
    """Ten and more layers: layers.10 comes after layers.2."""
    file = make_predictor(tmp_path / "deep.pth", (WIDTH, 9, 8, 7, 6, 5, 4, 1))
    assert [weight.shape[0] for weight, _ in Aesthetic(str(file), WIDTH).layers] == [9, 8, 7, 6, 5, 4, 1]
