"""The latent priors on small random models in the real folder layout: what goes in, comes out, and is refused."""

from __future__ import annotations

import json
import shutil
import warnings

import pytest
import torch
import torch.nn.functional as F
from dreamcatalyst.config import parse
from dreamcatalyst.diffusion import folder as folder_module
from dreamcatalyst.diffusion import ip2p as ip2p_module
from dreamcatalyst.diffusion.api import PRIORS, Row
from dreamcatalyst.diffusion.freeu import FreeUConfig
from dreamcatalyst.diffusion.ip2p import InstructPix2Pix, Ip2pConfig, StableDiffusion
from dreamcatalyst.errors import ConfigError, PriorError

from tests.diffusion.small_model import SMALL, make_model, make_tiny_autoencoder

SCALE = 0.18215  # of Stable Diffusion's latents (Rombach et al. 2022)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    made = {
        "ip2p": make_model(root / "ip2p"),
        "sd": make_model(root / "sd", channels=4),
        "wide-text": make_model(root / "wide-text", text_width=48),
        "taesd": make_tiny_autoencoder(root / "taesd"),
    }
    for kind in ("v_prediction", "sample"):
        made[kind] = shutil.copytree(made["ip2p"], root / kind)
        edit_json(made[kind] / "scheduler" / "scheduler_config.json", prediction_type=kind)
    return made


def edit_json(path, **values):
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.fixture(scope="module")
def prior(models):
    return InstructPix2Pix(Ip2pConfig(str(models["ip2p"])))


def images(*shape, seed=0, **kwargs):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)).requires_grad_(**kwargs)


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def five_rows(prior, batch=2):
    """The rows of a two-branch rule with an empty source text."""
    edit, source = noise(batch, 4, 8, 8), noise(batch, 4, 8, 8, seed=1)
    text, image = prior.embed(["turn him into a clown"])[0], prior.condition(images(batch, 3, 64, 64))
    return [Row(edit, text, image), Row(edit, None, image), Row(edit), Row(source, None, image), Row(source)]


# -- the folder --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name, channels", [("ip2p", 8), ("sd", 4)])
def test_the_layout_loads_with_the_pipelines_of_diffusers(models, name, channels):
    from diffusers import StableDiffusionInstructPix2PixPipeline, StableDiffusionPipeline

    kind = {8: StableDiffusionInstructPix2PixPipeline, 4: StableDiffusionPipeline}[channels]
    pipeline = kind.from_pretrained(models[name])
    assert pipeline.unet.config.in_channels == channels


def test_edit_by_our_calls_is_the_pipelines_edit(models, prior):
    """Four DDIM steps of InstructPix2Pix from diffusers and from encode, condition, embed, predict_noise, decode."""
    from diffusers import DDIMScheduler, StableDiffusionInstructPix2PixPipeline

    pipeline = StableDiffusionInstructPix2PixPipeline.from_pretrained(models["ip2p"])
    pipeline.scheduler = DDIMScheduler.from_config(pipeline.scheduler.config)
    pipeline.set_progress_bar_config(disable=True)
    image, start, prompt = images(1, 3, 64, 64), noise(1, 4, 8, 8), "make it snow"
    expected = pipeline(prompt, image, 4, 7.5, 1.5, latents=start, output_type="pt").images

    scheduler = DDIMScheduler.from_config(pipeline.scheduler.config)
    scheduler.set_timesteps(4)
    x, text, cond = start * scheduler.init_noise_sigma, prior.embed([prompt])[0], prior.condition(image)
    for t in scheduler.timesteps:
        full, img, null = prior.predict_noise([Row(x, text, cond), Row(x, None, cond), Row(x)], int(t))
        x = scheduler.step(null + 7.5 * (full - img) + 1.5 * (img - null), t, x).prev_sample
    torch.testing.assert_close(prior.decode(x), expected, rtol=0, atol=1e-4)


def test_priors_are_registered_by_name():
    assert PRIORS.get("ip2p") is InstructPix2Pix and PRIORS.get("sd") is StableDiffusion


def test_noise_levels_are_the_folders(prior):
    """scaled_linear: the square roots of the betas are evenly spaced."""
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    assert prior.alphas_cumprod.dtype == torch.float64 and prior.alphas_cumprod.device.type == "cpu"
    torch.testing.assert_close(prior.alphas_cumprod, torch.cumprod(1 - betas, 0), rtol=1e-5, atol=0)
    q = prior.alphas_cumprod[1:] / prior.alphas_cumprod[:-1]
    torch.testing.assert_close(1 - q, betas[1:], rtol=2e-6, atol=0)  # a float32 product would be off by 1e-4


def break_folder(models, tmp_path, name, edit):
    path = shutil.copytree(models[name], tmp_path / "broken")
    edit(path)
    return path


@pytest.mark.parametrize(
    "kind, name, edit, message",
    [
        ("ip2p", "sd", None, "takes 4 channels.*expected 8.*use prior 'sd'"),
        ("sd", "ip2p", None, "takes 8 channels.*expected 4.*use prior 'ip2p'"),
        ("ip2p", "wide-text", None, "embeddings of width 48.*takes 32.*same model"),
        ("ip2p", "taesd", None, r"'unet/config.json' is missing.*folders found: none.*model_index.json"),
        ("ip2p", "ip2p", lambda p: shutil.rmtree(p / "vae"), "'vae/config.json' is missing.*found: scheduler, text"),
        ("ip2p", "ip2p", lambda p: (p / "unet/config.json").write_text("{"), "not valid JSON.*Download the folder"),
        (
            "ip2p",
            "ip2p",
            lambda p: edit_json(p / "unet/config.json", addition_embed_type="text_time"),
            "addition_embed_type=text_time asks for a condition beyond",
        ),
        (
            "ip2p",
            "ip2p",
            lambda p: edit_json(p / "unet/config.json", _class_name="SD3Transformer2DModel"),
            "is a SD3Transformer2DModel, expected UNet2DConditionModel",
        ),
        (
            "ip2p",
            "ip2p",
            lambda p: edit_json(p / "text_encoder/config.json", model_type="t5"),
            "is a 't5', expected 'clip_text_model'",
        ),
        (
            "ip2p",
            "ip2p",
            lambda p: edit_json(p / "scheduler/scheduler_config.json", prediction_type="flow"),
            "prediction_type 'flow', expected one of epsilon",
        ),
        (
            "ip2p",
            "ip2p",
            lambda p: (p / "scheduler/scheduler_config.json").write_text('{"shift": 3.0}'),
            "states no betas",
        ),
        (
            "ip2p",
            "ip2p",
            lambda p: [f.unlink() for f in (p / "unet").glob("*.safetensors")],
            "cannot be loaded as UNet2DConditionModel",
        ),
        (
            "ip2p",
            "ip2p",
            lambda p: edit_json(p / "vae/config.json", layers_per_block=2),
            "weights of AutoencoderKL are missing, the first 'decoder",
        ),
    ],
)
def test_a_wrong_folder_is_refused_with_the_remedy(models, tmp_path, kind, name, edit, message):
    path = models[name] if edit is None else break_folder(models, tmp_path, name, edit)
    with pytest.raises(PriorError, match=message):
        PRIORS.get(kind)(Ip2pConfig(str(path)))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("unet/config.json", "[]", "holds a list, expected an object"),
        ("text_encoder/config.json", "[]", "holds a list, expected an object"),
        ("unet/config.json", "\xe9", "not valid JSON"),
        ("tokenizer/vocab.json", "[]", "tokenizer: cannot be loaded"),
        ("tokenizer/vocab.json", '{"a', "tokenizer: cannot be loaded"),
        ("tokenizer/merges.txt", "", "merges.txt: is empty"),
        ("text_encoder/model.safetensors", "half", "text_encoder: cannot be loaded as CLIPTextModel"),
        ("instructions.json", '{"snow": ["make', "instructions.json: not valid JSON"),
        ("instructions.json", '["snow"]', "instructions.json: holds a list"),
        ("instructions.json", '{"snow": [1]}', "instructions.json: expected a list of wordings"),
    ],
)
def test_a_damaged_file_of_a_folder_is_named(models, tmp_path, file, content, message):
    path = break_folder(models, tmp_path, "ip2p", lambda p: (p / file).write_text(content, encoding="latin-1"))
    with pytest.raises(PriorError, match=message):
        InstructPix2Pix(Ip2pConfig(str(path)))


@pytest.mark.parametrize(
    ("file", "values"),
    [
        ("vae", {"block_out_channels": 64}),
        ("scheduler", {"beta_start": "low"}),
        ("text_encoder", {"num_attention_heads": "many"}),
    ],
)
def test_a_config_of_which_no_model_can_be_made_is_named(models, tmp_path, file, values):
    name = "scheduler_config.json" if file == "scheduler" else "config.json"
    path = break_folder(models, tmp_path, "ip2p", lambda p: edit_json(p / file / name, **values))
    with pytest.raises(PriorError, match=f"{file}: its config cannot be used"):
        InstructPix2Pix(Ip2pConfig(str(path)))


def test_a_path_that_is_nowhere_is_refused(tmp_path):
    with pytest.raises(PriorError, match="no such folder. Give a folder with unet.*Hugging Face id"):
        InstructPix2Pix(Ip2pConfig(str(tmp_path / "nowhere")))


def test_no_network_is_refused_with_the_remedy(monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(PriorError, match="no-one/has-this: no such folder here.*hf download no-one/has-this"):
        InstructPix2Pix(Ip2pConfig("no-one/has-this"))


def test_too_little_memory_is_refused_before_weights_are_read(models, monkeypatch):
    monkeypatch.setattr(folder_module, "free_memory", lambda device: 2**20)
    monkeypatch.setattr(ip2p_module, "load", lambda *args: pytest.fail("weights were read"))
    with pytest.raises(PriorError, match="weights need 0.* GiB.*Set dtype=fp16.*offload=true.*taesd"):
        InstructPix2Pix(Ip2pConfig(str(models["ip2p"])))


@pytest.mark.parametrize(
    "values, message",
    [
        ({"dtype": "fp61"}, "prior.dtype.*Did you mean 'fp16'"),
        ({"latents": "mean"}, "prior.latents: unknown kind of latents 'mean'"),
        ({"latents": "sample", "autoencoder": "taesd"}, "has no posterior"),
        ({"latents": "independent", "autoencoder": "taesd"}, "has no posterior"),
        ({"max_rows": 0}, "prior.max_rows: got 0"),
    ],
)
def test_bad_settings_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        parse(Ip2pConfig, values, "prior")


# -- images and latents ------------------------------------------------------------------------------------------------


def test_latents_are_scaled_and_the_condition_is_not(prior):
    """Noised latents: mode * 0.18215. Image condition: the mode itself, of the image in [-1,1]."""
    image = images(2, 3, 64, 64)
    mode = prior.autoencoder.vae.encode(image * 2 - 1).latent_dist.mode()
    torch.testing.assert_close(prior.encode(image), mode * SCALE)
    torch.testing.assert_close(prior.condition(image), mode)
    assert not torch.allclose(prior.autoencoder.vae.encode(image).latent_dist.mode(), mode, rtol=0.01)


def test_decoding_undoes_the_scale_and_clamps(prior):
    latents = noise(1, 4, 8, 8)
    expected = (prior.autoencoder.vae.decode(latents / SCALE).sample / 2 + 0.5).clamp(0, 1)
    torch.testing.assert_close(prior.decode(latents), expected)


def test_shift_factor_of_the_folder_is_used(models, tmp_path, prior):
    shifted = break_folder(models, tmp_path, "ip2p", lambda p: edit_json(p / "vae/config.json", shift_factor=0.1))
    other, image, latents = InstructPix2Pix(Ip2pConfig(str(shifted))), images(1, 3, 64, 64), noise(1, 4, 8, 8)
    torch.testing.assert_close(other.encode(image), prior.encode(image) - 0.1 * SCALE)
    torch.testing.assert_close(other.condition(image), prior.condition(image))
    torch.testing.assert_close(other.decode(latents - 0.1 * SCALE), prior.decode(latents))


def test_sampled_latents_share_their_noise(models, prior):
    sampler = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), latents="sample", seed=3))
    source, edit = images(1, 3, 64, 64), images(1, 3, 64, 64, seed=1)
    posterior = sampler.autoencoder.vae.encode(torch.cat([source, edit]) * 2 - 1).latent_dist
    draws = (torch.cat([sampler.encode(source), sampler.encode(edit)]) / SCALE - posterior.mode()) / posterior.std
    torch.testing.assert_close(draws[0], draws[1], rtol=1e-3, atol=1e-3)
    assert torch.equal(sampler.encode(source), sampler.encode(source))
    given = noise(1, 4, 8, 8, seed=5)
    torch.testing.assert_close(prior.encode(source, given), (posterior.mode() + posterior.std * given)[:1] * SCALE)


def test_draws_of_a_posterior_have_its_deviation(prior):
    image = images(2, 3, 61, 50)
    posterior = prior.autoencoder.vae.encode(prior.autoencoder._pixels(image)).latent_dist
    torch.testing.assert_close(prior.deviation(image), posterior.std * SCALE)
    shape = prior.latent_shape(image)
    assert shape == (4, 8, 7) == tuple(prior.encode(image).shape[1:])
    given = noise(2, *shape)
    torch.testing.assert_close(prior.encode(image, given) - prior.encode(image), prior.deviation(image) * given)


def test_the_condition_of_the_published_nerf_release_is_of_the_image_as_it_is(models, prior):
    image = images(1, 3, 64, 64)
    other = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), condition_unit_range=True))
    torch.testing.assert_close(other.condition(image), prior.autoencoder.vae.encode(image).latent_dist.mode())
    torch.testing.assert_close(other.encode(image), prior.encode(image))  # latents are not concerned


@pytest.mark.parametrize("h, w", [(64, 64), (61, 64), (64, 57), (75, 99), (3, 5)])
def test_sides_that_are_no_multiple_of_eight_shift_no_pixel(prior, h, w):
    image = images(1, 3, h, w)
    tall, wide = -(-h // 8), -(-w // 8)
    rows, columns = torch.arange(8 * tall).clamp(max=h - 1), torch.arange(8 * wide).clamp(max=w - 1)
    padded = image[:, :, rows][..., columns]  # the last pixel is repeated on the right and at the bottom
    latents = prior.encode(image)
    assert latents.shape == (1, 4, tall, wide) == prior.condition(image).shape
    assert torch.equal(latents, prior.encode(padded))
    assert torch.equal(prior.decode(latents, (h, w)), prior.decode(latents)[..., :h, :w])
    assert prior.predict_noise([Row(latents)], 100)[0].shape == latents.shape


def test_a_pixel_is_encoded_where_it_is(models):
    """The tiny autoencoder is local: what one pixel changes lies around its own latent, in a padded image as well."""
    prior = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), autoencoder=str(models["taesd"])))
    image = torch.full((1, 3, 317, 301), 0.5)
    poked = image.clone()
    poked[..., 200, 104] = 1
    change = (prior.encode(poked) - prior.encode(image)).abs().sum((0, 1))
    y, x = (change.sum(dim) / change.sum() @ (torch.arange(n) * 8 + 3.5) for dim, n in ((1, 40), (0, 38)))
    assert abs(y - 200) < 12 and abs(x - 104) < 12


def test_tiny_autoencoder_gives_scaled_latents_and_an_unscaled_condition(models):
    prior = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), autoencoder=str(models["taesd"])))
    image = images(2, 3, 64, 64)
    latents = prior.autoencoder.vae.encode(image * 2 - 1).latents
    torch.testing.assert_close(prior.encode(image), latents)
    torch.testing.assert_close(prior.condition(image), latents / SCALE)
    expected = (prior.autoencoder.vae.decode(latents).sample / 2 + 0.5).clamp(0, 1)
    torch.testing.assert_close(prior.decode(latents), expected)


def test_tiny_autoencoder_of_another_model_is_refused(models, tmp_path):
    path = make_tiny_autoencoder(tmp_path / "wide")
    edit_json(path / "config.json", latent_channels=16)
    for f in path.glob("*.safetensors"):
        f.unlink()
    from diffusers import AutoencoderTiny

    AutoencoderTiny.from_config(AutoencoderTiny.load_config(path)).save_pretrained(path)
    with pytest.raises(PriorError, match="16 latent channels at 1/8.*takes 4 at 1/8.*madebyollin/taesd"):
        InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), autoencoder=str(path)))


@pytest.mark.usefixtures("unchecked")
def test_images_of_another_layout_are_refused(prior):
    with pytest.raises(PriorError, match=r"shape \(1, 64, 64, 3\) cannot be encoded; expected \[B,3,H,W\]"):
        prior.encode(torch.rand(1, 64, 64, 3))


# -- gradients ---------------------------------------------------------------------------------------------------------


def encoder_gradient(prior, image, cotangent):
    image = image.detach().requires_grad_()
    prior.encode(image).backward(cotangent)
    return image.grad


def test_the_gradient_returns_through_the_encoder(models, prior):
    """Against finite differences in float64."""
    double = InstructPix2Pix(Ip2pConfig(str(models["ip2p"])))
    double.autoencoder.vae.double()
    image, cotangent = images(1, 3, 24, 24).double(), noise(1, 4, 3, 3).double()
    direction, h = noise(1, 3, 24, 24, seed=7).double(), 1e-6
    ahead, behind = ((double.encode(image + s * h * direction) * cotangent).sum() for s in (1, -1))
    slope = (encoder_gradient(double, image, cotangent) * direction).sum()
    torch.testing.assert_close(slope, (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("tiny", [False, True])
def test_checkpointing_gives_the_same_gradient_and_keeps_less(models, tiny):
    kept, gradients = [], []
    for checkpointing in (False, True):
        autoencoder = str(models["taesd"]) if tiny else None
        prior = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), autoencoder=autoencoder, checkpointing=checkpointing))
        saved: dict[int, int] = {}
        image, cotangent = images(1, 3, 64, 64, requires_grad=True), noise(1, 4, 8, 8)

        def pack(x, saved=saved):
            saved[x.data_ptr()] = x.nbytes
            return x

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            latents = prior.encode(image)
        kept.append(sum(saved.values()))
        latents.backward(cotangent)
        gradients.append(image.grad)
    torch.testing.assert_close(gradients[0], gradients[1])
    assert kept[1] < 0.5 * kept[0]


@pytest.mark.parametrize("magnitude", [1e-12, 1.0, 1e12])
def test_half_precision_keeps_the_gradient_at_any_magnitude(models, prior, magnitude):
    """A mean over a megapixel's latents would underflow in float16, a large sum overflow: neither may."""
    half = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), dtype="fp16"))
    image, cotangent = images(1, 3, 64, 64), noise(1, 4, 8, 8)
    expected = encoder_gradient(prior, image, cotangent)
    got = encoder_gradient(half, image, cotangent * magnitude) / magnitude
    assert F.cosine_similarity(got.flatten(), expected.flatten(), dim=0) > 0.999
    torch.testing.assert_close(got.norm(), expected.norm(), rtol=0.02, atol=0)


def test_a_zero_gradient_stays_zero_in_half_precision(models):
    half = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), dtype="bf16"))
    assert encoder_gradient(half, images(1, 3, 64, 64), torch.zeros(1, 4, 8, 8)).abs().max() == 0


def test_no_graph_reaches_the_unet_or_leaves_the_condition(prior):
    """Even where the latents and the images carry one."""
    image = images(1, 3, 64, 64, requires_grad=True)
    latents, modes = prior.encode(image), []
    handle = prior.unet.register_forward_hook(lambda *_: modes.append(torch.is_grad_enabled()))
    condition, text = prior.condition(image), prior.embed(["make it snow"])[0]
    results = prior.predict_noise([Row(latents, text, condition), Row(latents)], 500)
    handle.remove()
    assert latents.requires_grad and modes == [False]
    assert not any(x.requires_grad for x in (condition, text, *results, prior.decode(latents)))
    models = (prior.unet, prior.text_encoder, prior.autoencoder.vae)
    assert not any(p.requires_grad for model in models for p in model.parameters())
    (0.5 * (latents * results[0]).mean()).backward()  # the results may stand in a graph of the caller
    assert image.grad.abs().sum() > 0


# -- text --------------------------------------------------------------------------------------------------------------


def test_the_text_encoder_runs_once_per_prompt(models):
    prior, calls = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]))), []
    prior.text_encoder.register_forward_hook(lambda *_: calls.append(1))
    first = prior.embed(["make it snow", "red fox", "make it snow"])
    assert len(calls) == 2 and torch.equal(first[0], first[2]) and not torch.equal(first[0], first[1])
    latents = noise(1, 4, 8, 8)
    for _ in range(2):
        prior.predict_noise([Row(latents), Row(latents, prior.embed(["make it snow"])[0])], 3)
    assert len(calls) == 3, "the empty prompt is the only new one"


def test_embedding_is_the_text_encoders_last_hidden_state(prior):
    ids = prior.tokenizer("make it snow", padding="max_length", max_length=77, return_tensors="pt").input_ids
    expected = prior.text_encoder(ids).last_hidden_state[0]
    assert expected.shape == (77, SMALL["text"])
    torch.testing.assert_close(prior.embed(["make it snow"])[0], expected)


def test_a_long_prompt_warns_with_the_lost_words(prior):
    with pytest.warns(UserWarning, match="cut after 75 tokens; these words are lost: 'make it snow'"):
        long = prior.embed(["fox " * 75 + "make it snow"])[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torch.testing.assert_close(long, prior.embed(["fox " * 75])[0])


@pytest.mark.usefixtures("unchecked")
def test_a_prompt_that_is_no_text_is_refused(prior):
    with pytest.raises(PriorError, match="prompt None is of type NoneType, expected text"):
        prior.embed([None])


# -- noise -------------------------------------------------------------------------------------------------------------


def transcription(prior, row, t):
    """InstructPix2Pix's U-Net call, one image at a time."""
    noises = []
    for i in range(len(row.noisy)):
        image = torch.zeros(1, 4, 8, 8) if row.image is None else row.image[i : i + 1]
        text = prior.embed([""])[0] if row.text is None else row.text
        with torch.no_grad():
            x = torch.cat([row.noisy[i : i + 1], image], dim=1)
            noises.append(prior.unet(x, t, encoder_hidden_states=text[None]).sample)
    return torch.cat(noises)


@pytest.mark.parametrize("max_rows", [None, 1, 3, 4, 100])
def test_one_call_for_all_rows_is_the_row_by_row_result(models, max_rows):
    prior, calls = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), max_rows=max_rows)), []
    rows = five_rows(prior)
    handle = prior.unet.register_forward_hook(lambda _, args, __: calls.append(len(args[0])))
    got = prior.predict_noise(rows, 321)
    handle.remove()
    assert calls == {None: [10], 1: [1] * 10, 3: [3, 3, 3, 1], 4: [4, 4, 2], 100: [10]}[max_rows]
    for row, result in zip(rows, got, strict=True):
        torch.testing.assert_close(result, transcription(prior, row, 321), rtol=1e-4, atol=1e-5)


def test_rows_may_differ_in_batch_and_bring_their_own_text(prior):
    a, b = noise(1, 4, 8, 8), noise(3, 4, 8, 8, seed=1)
    text = prior.embed(["red fox"])[0]
    got = prior.predict_noise([Row(a, text[None]), Row(b, text.expand(3, -1, -1))], 5)
    assert [len(x) for x in got] == [1, 3]
    torch.testing.assert_close(got[1], transcription(prior, Row(b, text), 5), rtol=1e-4, atol=1e-5)
    assert prior.predict_noise([], 5) == []


def test_out_of_memory_asks_for_fewer_rows_and_says_so_once(models):
    prior = InstructPix2Pix(Ip2pConfig(str(models["ip2p"])))
    rows, sizes = five_rows(prior), []
    expected = prior.predict_noise(rows, 321)

    def limit(_, args):
        sizes.append(len(args[0]))
        if len(args[0]) > 3:
            raise RuntimeError("accelerator out of memory. Tried to allocate 1 GiB")

    prior.unet.register_forward_pre_hook(limit)
    with pytest.warns(UserWarning, match="memory ran out at 10 rows") as said:
        got = prior.predict_noise(rows, 321)
    assert len(said) == 1 and sizes == [10, 5, 3, 3, 3, 1]
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prior.predict_noise(rows, 321)
    assert sizes[6:] == [3, 3, 3, 1], "what was learnt is kept"


def test_a_device_too_small_for_one_row_is_an_error_and_other_errors_stay(models):
    prior = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), max_rows=1))

    def fail(message):
        def hook(*_):
            raise RuntimeError(message)

        return prior.unet.register_forward_pre_hook(hook)

    handle = fail("not enough memory: you tried to allocate 9 bytes")
    with pytest.raises(PriorError, match="not enough memory for one row.*Set dtype=fp16"):
        prior.predict_noise([Row(noise(1, 4, 8, 8))], 0)
    handle.remove()
    fail("an illegal memory access was encountered")
    with pytest.raises(RuntimeError, match="illegal memory access"):
        prior.predict_noise([Row(noise(1, 4, 8, 8))], 0)


@pytest.mark.parametrize("kind", ["v_prediction", "sample"])
def test_other_predictions_come_back_as_noise(models, prior, kind):
    """A network that is given the true v (or x_0) of known x_0 and eps must give that eps."""
    other, t = InstructPix2Pix(Ip2pConfig(str(models[kind]))), 400
    abar = other.alphas_cumprod[t]
    clean, eps = noise(2, 4, 8, 8), noise(2, 4, 8, 8, seed=1)
    noisy = (abar.sqrt() * clean + (1 - abar).sqrt() * eps).float()
    truth = (abar.sqrt() * eps - (1 - abar).sqrt() * clean).float() if kind == "v_prediction" else clean
    other.unet.register_forward_hook(lambda *_: (truth,))
    torch.testing.assert_close(other.predict_noise([Row(noisy)], t)[0], eps, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "row, t, message",
    [
        (Row(torch.zeros(1, 4, 8, 8)), 1000, "timestep 1000 is outside this prior's 0..999"),
        (Row(torch.zeros(1, 4, 8, 8)), -1, "timestep -1 is outside"),
        (Row(torch.zeros(1, 3, 8, 8)), 0, r"row 0: noisy latents of shape \(1, 3, 8, 8\), expected \[B,4,h,w\]"),
        (Row(torch.zeros(2, 4, 8, 8), None, torch.zeros(1, 4, 8, 8)), 0, r"row 0: image condition \(1, 4, 8, 8\)"),
        (Row(torch.zeros(1, 4, 8, 8), torch.zeros(77, 768)), 0, "text embedding of width 768, this U-Net takes 32"),
    ],
)
def test_rows_that_cannot_be_are_refused(prior, row, t, message):
    with pytest.raises(PriorError, match=message):
        prior.predict_noise([row], t)


def test_callers_autocast_and_precision_do_not_reach_the_models(prior):
    row = Row(noise(1, 4, 8, 8).double())
    plain = prior.predict_noise([row], 7)[0]
    with torch.autocast("cpu", torch.bfloat16):
        under = prior.predict_noise([row], 7)[0]
        latents = prior.encode(images(1, 3, 64, 64))
    assert plain.dtype == torch.float64 and torch.equal(plain, under)
    assert torch.equal(latents, prior.encode(images(1, 3, 64, 64)))


# -- options -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["slicing", "channels_last", "offload"])
def test_exact_options_give_the_same_results(models, prior, option):
    other = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), **{option: True}))
    image, cotangent = images(2, 3, 64, 64), noise(2, 4, 8, 8)
    torch.testing.assert_close(other.encode(image), prior.encode(image), rtol=1e-4, atol=1e-5)
    expected = encoder_gradient(prior, image, cotangent)
    torch.testing.assert_close(encoder_gradient(other, image, cotangent), expected, rtol=1e-3, atol=1e-5)
    got, expected = (p.predict_noise(five_rows(p), 9) for p in (other, prior))
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_tiling_is_an_approximation_with_a_gradient(models, prior):
    tiled = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), tiling=True))
    image = images(1, 3, 96, 96)
    assert tiled.encode(image).shape == prior.encode(image).shape
    assert not torch.allclose(tiled.encode(image), prior.encode(image), rtol=1e-3)
    assert encoder_gradient(tiled, image, noise(1, 4, 12, 12)).abs().sum() > 0
    small = images(1, 3, 64, 64)
    torch.testing.assert_close(tiled.encode(small), prior.encode(small))


def test_compile_is_asked_of_the_unet(models, monkeypatch):
    asked = []
    monkeypatch.setattr(torch.nn.Module, "compile", lambda self, *a, **k: asked.append(type(self).__name__))
    InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), compile=True))
    assert asked == ["UNet2DConditionModel"]


@pytest.mark.parametrize("dtype", ["fp16", "bf16"])
def test_half_precision_is_near_full_precision(models, prior, dtype):
    half = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), dtype=dtype))
    for got, expected in zip(*(p.predict_noise(five_rows(p), 9) for p in (half, prior)), strict=True):
        assert got.dtype == torch.float32
        assert (got - expected).norm() < 0.03 * expected.norm()


def test_freeu_is_installed_by_the_config(models, prior):
    freed = InstructPix2Pix(Ip2pConfig(str(models["ip2p"]), freeu=FreeUConfig("paper")))
    rows = five_rows(prior)
    plain = prior.predict_noise(rows, 9)
    assert not torch.allclose(freed.predict_noise(rows, 9)[0], plain[0], rtol=1e-3)
    freed.freeu.remove()
    torch.testing.assert_close(freed.predict_noise(rows, 9), plain, rtol=0, atol=0)


# -- text-to-image -----------------------------------------------------------------------------------------------------


def test_a_text_to_image_folder_is_a_prior_without_image(models):
    prior = StableDiffusion(Ip2pConfig(str(models["sd"])))
    assert not prior.takes_image and prior.condition(images(1, 3, 64, 64)) is None
    latents, text = noise(2, 4, 8, 8), prior.embed(["a photo of a fox"])[0]
    got = prior.predict_noise([Row(latents, text), Row(latents)], 50)
    for result, embedding in zip(got, (text, prior.embed([""])[0]), strict=True):
        expected = prior.unet(latents, 50, encoder_hidden_states=embedding.expand(2, -1, -1)).sample
        torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)
    with pytest.raises(PriorError, match="image condition.*takes none .a text-to-image model."):
        prior.predict_noise([Row(latents, None, latents)], 50)
