"""The small InstructPix2Pix: its vocabulary, its losses, its folder, and that training resumes to the bit."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.demo.edits import EDITS
from dreamcatalyst.diffusion.freeu import FreeU, FreeUConfig, freeu_sites
from dreamcatalyst.diffusion.hub import SHIPPED
from dreamcatalyst.diffusion.ip2p import InstructPix2Pix, Ip2pConfig
from dreamcatalyst.diffusion.noise import add_noise, stable_diffusion_schedule
from dreamcatalyst.train.prior.folder import write_prior
from dreamcatalyst.train.prior.judge import sampled_edits, scores
from dreamcatalyst.train.prior.losses import noised, reconstruction_loss
from dreamcatalyst.train.prior.models import AutoencoderConfig, TextConfig, UnetConfig, make_networks
from dreamcatalyst.train.prior.stages import Progress
from dreamcatalyst.train.prior.system import PriorSystem
from dreamcatalyst.train.prior.vocabulary import WORD, learn_merges, vocabulary, write_tokenizer
from hypothesis import given, settings
from hypothesis import strategies as st

pytestmark = pytest.mark.usefixtures("one_thread")
ROOT = Path(__file__).resolve().parents[2]
WORDINGS = ["Turn the bear statue into a panda", "make it sunset", "Make it look like just snowed.", ""]
SIZE = 32
SMALL = {
    "autoencoder": {"channels": [8, 8, 16], "crop": 16, "steps": 3, "minutes": None, "warm_up": 1},
    "text": {"width": 16, "layers": 1, "heads": 2, "tokens": 12},
    "unet": {"channels": [8, 16], "attention": [False, True], "steps": 3, "minutes": None, "batch_size": 4},
    "samples": {"steps": 2, "pictures": 2, "every": 0},
}


@pytest.fixture(scope="module")
def pairs(tmp_path_factory) -> Path:
    """Shards of one's own: coloured squares, whose instruction says the colour that they turn to."""
    folder, rng = tmp_path_factory.mktemp("pairs"), np.random.default_rng(0)
    n = 24
    source = rng.integers(0, 255, (n, 1, 1, 3), dtype=np.uint8).repeat(SIZE, 1).repeat(SIZE, 2)
    edited, mask = source.copy(), np.zeros((n, SIZE, SIZE), np.uint8)
    edited[:, 8:24, 8:24], mask[:, 8:24, 8:24] = (255, 0, 0), 255
    words = np.array([WORDINGS[i % 3] for i in range(n)])
    np.savez(folder / "pairs-00000.npz", source=source, edited=edited, mask=mask, instruction=words, edit=words,
             world=np.arange(n) // 2)  # fmt: skip
    return folder


@pytest.fixture
def train(pairs, tmp_path, monkeypatch):
    """Run the launcher on the squares; returns the trial's folder."""
    monkeypatch.syspath_prepend(str(ROOT))
    import launch as launcher

    def run(*overrides: str, name: str = "run", mode: str = "--train", status: int = 0) -> Path:
        parts = [
            f"system.{part}.{key}={json.dumps(value)}" for part, keys in SMALL.items() for key, value in keys.items()
        ]
        arguments = ["--config", str(ROOT / "configs/prior.yaml"), mode, f"data.pairs={pairs}", f"data.size={SIZE}"]
        arguments += ["data.held_out=2", "trainer.accelerator=cpu", *parts, f"exp_root_dir={tmp_path}", f"name={name}"]
        arguments += ["tag=trial", "use_timestamp=false", "checkpoint.save_top_k=-1", *overrides]
        monkeypatch.setattr(sys, "argv", ["launch.py", *arguments])
        assert launcher.main(arguments) == status
        return tmp_path / name / "trial"

    return run


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A model folder with random weights."""
    merges = learn_merges(WORDINGS)
    configs = [parse(cls, SMALL[name]) for name, cls in
               (("autoencoder", AutoencoderConfig), ("text", TextConfig), ("unet", UnetConfig))]  # fmt: skip
    networks = make_networks(*configs, SIZE, len(vocabulary(merges)), seed=0)
    card = {"pairs": 24, "origin": "Squares.", "autoencoder": 0, "unet": 0}
    return write_prior(tmp_path_factory.mktemp("prior"), networks, merges, 2.0, {"panda": WORDINGS[:1]}, card)


# --- words


def test_words_that_were_learned_are_single_tokens_and_others_decompose(tmp_path):
    from transformers import CLIPTokenizer

    tokenizer = CLIPTokenizer.from_pretrained(write_tokenizer(tmp_path, learn_merges(WORDINGS), 32))
    for text in WORDINGS:
        words = WORD.findall(text.lower())
        assert tokenizer.tokenize(text) == [f"{word}</w>" for word in words]
        assert tokenizer(text).input_ids[0] == tokenizer.bos_token_id
        assert tokenizer(text).input_ids[-1] == tokenizer.eos_token_id
    assert tokenizer.tokenize("stated") != [] and tokenizer.unk_token not in tokenizer.tokenize("zebra, Äpfel 日本 42")


def test_the_shipped_tokenizer_numbers_words_as_its_vocabulary_does():
    """Its files are those that its weights were trained with: of instructions that it was taught, each word is one
    token, and any other of the demo's edits comes out as pieces that spell it."""
    from transformers import CLIPTokenizer

    folder = SHIPPED / "tokenizer"
    tokenizer, numbers = CLIPTokenizer.from_pretrained(folder), json.loads((folder / "vocab.json").read_text())
    taught = {text for texts in json.loads((SHIPPED / "instructions.json").read_text()).values() for text in texts}
    assert len(taught) > 300 and len(numbers) == 699
    first, last = numbers["<|startoftext|>"], numbers["<|endoftext|>"]
    for text in taught:
        words = WORD.findall(text.lower())
        assert tokenizer(text).input_ids == [first, *(numbers[f"{word}</w>"] for word in words), last]
    for text in {phrase for edit in EDITS.values() for phrase in edit.phrases}:
        pieces = tokenizer.convert_ids_to_tokens(tokenizer(text).input_ids[1:-1])
        assert "".join(pieces).replace("</w>", " ").split() == WORD.findall(text.lower())
    digest = hashlib.sha256(b"".join((folder / name).read_bytes() for name in ("vocab.json", "merges.txt"))).hexdigest()
    assert digest == "ae47b6ff276d46292f24f2fd8affb247cc437edd5979977d78ff08085859c95f"


@settings(max_examples=30, deadline=None)
@given(texts=st.lists(st.text(alphabet="abcdé 1,", max_size=12), max_size=4))
def test_merges_leave_every_word_one_token(texts):
    tokens = vocabulary(learn_merges(texts))
    assert list(tokens.values()) == list(range(len(tokens)))
    for word in {word for text in texts for word in WORD.findall(text.lower())}:
        assert any(len(token.removesuffix("</w>")) == len(word.encode()) for token in tokens)


# --- losses


def test_v_and_noisy_latents_give_back_the_clean_ones():
    """x_0 = sqrt(abar) x_t - sqrt(1 - abar) v and eps = sqrt(1 - abar) x_t + sqrt(abar) v (Salimans & Ho 2022)."""
    clean, noise = torch.randn(3, 4, 5, 5, dtype=torch.float64), torch.randn(3, 4, 5, 5, dtype=torch.float64)
    abar = stable_diffusion_schedule()[[5, 400, 999]]
    x, v = noised(clean, noise, abar)
    for i, a in enumerate(abar.tolist()):
        assert torch.allclose(x[i], add_noise(clean[i], noise[i], a))
        assert torch.allclose(a**0.5 * x[i] - (1 - a) ** 0.5 * v[i], clean[i])
        assert torch.allclose((1 - a) ** 0.5 * x[i] + a**0.5 * v[i], noise[i])


def test_threads_that_take_parts_of_a_batch_leave_the_gradients_of_the_whole(train, monkeypatch):
    whole, differences = PriorSystem._unet_gradients, []

    def both(self, number):
        gradients = []
        for threads in (1, 3):  # of a batch of 4
            torch.set_num_threads(threads)
            self.optimizers()[1].zero_grad()
            value = whole(self, number)
            gradients.append(torch.cat([p.grad.flatten() for p in self.trained("unet") if p.grad is not None]))
        torch.set_num_threads(1)
        differences.append(float((gradients[1] - gradients[0]).norm() / gradients[0].norm()))
        return value

    monkeypatch.setattr(PriorSystem, "_unet_gradients", both)
    train("system.autoencoder.steps=1", "system.unet.steps=2")
    assert len(differences) == 2 and max(differences) < 1e-5


def test_a_wrong_colour_counts_at_every_scale_and_grain_only_at_the_finest():
    target = torch.zeros(1, 3, 32, 32)
    checks = torch.ones(32, 32)
    checks[::2, ::2] = checks[1::2, 1::2] = -1
    grain = (0.1 * checks).expand(1, 3, 32, 32)
    assert reconstruction_loss(target + 0.1, target, 0.0) == pytest.approx(0.5)
    assert reconstruction_loss(grain, target, 0.0) == pytest.approx(0.1)
    assert reconstruction_loss(grain, target, 1.0) == pytest.approx(0.1 + 0.2 + 0.2)
    assert reconstruction_loss(target, target, 1.0) == 0


def test_scores_are_taken_inside_and_outside():
    truth, mask = torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4)
    mask[..., :2] = 1
    made = scores({"a": truth + 0.1 * mask + 0.01 * (1 - mask), "b": truth}, truth, torch.cat([mask]))
    assert float(made["a_inside"]) == pytest.approx(20, abs=1e-3)
    assert float(made["a_outside"]) == pytest.approx(40, abs=1e-2)
    assert made["b_inside"].isinf().all()
    assert scores({"a": truth}, truth, mask * 0)["a_inside"].isnan().all()


# --- the folder


def test_diffusers_pipeline_loads_the_folder_as_it_is(folder):
    from diffusers import StableDiffusionInstructPix2PixPipeline

    pipeline = StableDiffusionInstructPix2PixPipeline.from_pretrained(str(folder))
    pipeline.set_progress_bar_config(disable=True)
    assert pipeline.unet.config.in_channels == 8 and pipeline.scheduler.config.prediction_type == "v_prediction"
    image = torch.rand(1, 3, SIZE, SIZE)
    (made,) = pipeline(WORDINGS[0], image=image, num_inference_steps=2, output_type="np").images
    assert made.shape == (SIZE, SIZE, 3) and np.isfinite(made).all()
    assert sum(file.stat().st_size for file in folder.rglob("*.safetensors")) <= 24e6
    assert (folder / "LICENSE").is_file() and "license: mit" in (folder / "README.md").read_text()
    assert json.loads((folder / "instructions.json").read_text()) == {"panda": WORDINGS[:1]}


def test_it_is_a_prior_on_which_freeu_has_both_kinds_of_sites(folder):
    prior = InstructPix2Pix(Ip2pConfig(path=str(folder)))
    assert {site.stage for site in freeu_sites(prior.unet)} >= {1, 2}
    FreeU(prior.unet, FreeUConfig(mode="paper")).install().remove()
    assert prior.autoencoder.scale == 0.5
    assert torch.equal(prior.alphas_cumprod[[0, -1]].round(decimals=5),
                       stable_diffusion_schedule()[[0, -1]].round(decimals=5))  # fmt: skip
    made = sampled_edits(prior, torch.rand(2, 3, SIZE, SIZE), WORDINGS[:2], steps=2)
    assert made.shape == (2, 3, SIZE, SIZE) and made.isfinite().all()


def test_the_default_model_is_small_enough_and_has_freeus_sites():
    networks = make_networks(AutoencoderConfig(), TextConfig(), UnetConfig(), 128, 1500, seed=0)
    assert sum(p.numel() for p in networks.parameters()) * 2 <= 24e6
    assert {site.stage for site in freeu_sites(networks["unet"])} >= {1, 2}


# --- training


def weights(trial: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    files = sorted((trial / "save/prior").rglob("*.safetensors"))
    return {f"{file.parent.name}.{name}": value for file in files for name, value in load_file(file).items()}


@pytest.mark.parametrize("at", [2, 4])
def test_a_run_resumed_in_either_stage_has_the_bits_of_an_uninterrupted_one(train, at):
    whole = train("checkpoint.every_n_train_steps=1", name="whole")
    (checkpoint,) = (whole / "ckpts").glob(f"*step={at}.ckpt")
    kept = whole.parents[1] / "resumed/trial/ckpts" / checkpoint.name
    kept.parent.mkdir(parents=True)
    kept.write_bytes(checkpoint.read_bytes())
    resumed = train(f"resume={kept}", name="resumed")
    one, other = weights(whole), weights(resumed)
    assert {name.split(".")[0] for name in one} == {"vae", "text_encoder", "unet"}
    for name in one:
        assert torch.equal(one[name], other[name]), name
    assert list((whole / "save").glob("it3-autoencoder.png")) and list((whole / "save").glob("it6-*.png"))
    assert json.loads((whole / "save/prior/vae/config.json").read_text())["scaling_factor"] != 1


def test_a_checkpoint_brings_its_own_vocabulary(train, monkeypatch):
    """Versions of the vocabulary's training number words otherwise; what was trained goes on with its own numbers."""
    from dreamcatalyst.train.prior import system

    monkeypatch.setattr(system, "learn_merges", lambda texts: [*learn_merges(texts)[::-1], ("z", "z</w>")])
    trial = train("checkpoint.every_n_train_steps=4", name="older")
    (checkpoint,) = (trial / "ckpts").glob("*step=4.ckpt")
    merges = (trial / "save/prior/tokenizer/merges.txt").read_text()
    monkeypatch.undo()
    resumed = train(f"resume={checkpoint}", name="older")
    assert (resumed / "save/prior/tokenizer/merges.txt").read_text() == merges and "z z</w>" in merges
    one, other = weights(trial), weights(resumed)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_what_is_done_is_not_done_again(train, monkeypatch, pairs):
    from dreamcatalyst.train.prior import data, latents

    monkeypatch.setattr(data, "make_pairs", lambda *a, **k: pytest.fail("the pairs are there"))
    trial = train("checkpoint.every_n_train_steps=4")
    monkeypatch.setattr(latents, "encode_pairs", lambda *a: pytest.fail("the latents are there"))
    (checkpoint,) = (trial / "ckpts").glob("*step=4.ckpt")
    train(f"resume={checkpoint}")


def test_a_stage_ends_at_its_steps_or_its_minutes():
    stage = UnetConfig(steps=10, minutes=2.0)
    assert Progress().at(5, stage) == 0
    assert Progress(first=100).at(105, stage) == 0.5
    assert Progress(first=100, seconds=90).at(105, stage) == 0.75
    assert Progress(first=100, seconds=900).at(105, stage) == 1


def test_a_stage_out_of_minutes_hands_over_to_the_next(train):
    trial = train("system.autoencoder.steps=500", "system.autoencoder.minutes=1e-6")
    assert list((trial / "save").glob("it1-autoencoder.png"))
    (last,) = (trial / "save").glob("it*-unet.png")
    assert last.name == "it4-unet.png"


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("system.unet.channels=[48,80]", "one of half its width"),
        ("system.unet.channels=[256,512]", "MB of weights in half precision"),
        ("system.unet.attention=[true]", "expected 2"),
        ("system.autoencoder.groups=3", "multiples of groups=3"),
        ("system.autoencoder.crop=18", "a multiple of 4"),
        ("system.unet.step=3", "Did you mean 'steps'?"),
        ("system.unet.minutes=0", "more than 0"),
        ("data.size=36", "Set data.size=32"),
        ("data.held_out=9000", "held_out: got 9000"),
    ],
)
def test_wrong_configs_are_refused_in_one_line(train, capsys, option, words):
    train(option, status=2)
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error
