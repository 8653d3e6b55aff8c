"""Model folders: half downloaded, of another model, damaged; and names that lead nowhere."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from .cases import Case, Place, case
from .things import link_files, make

prior = partial(case, "prior", seconds=15)
IP2P = ["system.guidance.prior_type=ip2p", "system.guidance.prior={path: model}", "system.guidance.noise=independent"]
UNET, VAE, TEXT = "unet/config.json", "vae/config.json", "text_encoder/config.json"
WEIGHTS = "diffusion_pytorch_model.safetensors"


def folder(change: Callable[[Path], object], *more: str) -> Callable[[Place], Sequence[str]]:
    """An edit by a model folder that `change` has changed."""

    def given(place: Place) -> Sequence[str]:
        change(link_files(make(place.shop, "model"), place / "model"))
        return [*IP2P, *more]

    return given


def removed(*names: str) -> Callable[[Place], Sequence[str]]:
    return folder(lambda root: [(root / name).unlink() for name in names])


def replaced(name: str, content: str | bytes) -> Callable[[Place], Sequence[str]]:
    """A file with other content. The links are cut first, so that the original stays as it is."""

    def change(root: Path) -> None:
        (root / name).unlink(missing_ok=True)
        (root / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return folder(change)


def keys(name: str, **values: object) -> Callable[[Place], Sequence[str]]:
    """A config with other values."""

    def given(place: Place) -> Sequence[str]:
        config = json.loads((make(place.shop, "model") / name).read_text())
        return replaced(name, json.dumps({**config, **values}))(place)

    return given


def half(name: str) -> Callable[[Place], Sequence[str]]:
    """A file that was downloaded to its half."""

    def given(place: Place) -> Sequence[str]:
        data = (make(place.shop, "model") / name).read_bytes()
        return replaced(name, data[: len(data) // 2])(place)

    return given


def path(text: str) -> Sequence[str]:
    return [*IP2P, f"system.guidance.prior.path={text}"]


CASES: list[Case] = [
    prior("no such folder", path("./models/ip2p"), "./models/ip2p", "no such folder"),
    prior("an id of the hub with a typo, without network", path("timbrooks/instruct-pix2pixx"), "instruct-pix2pixx"),
    prior("a word", path("instructpix2pix"), "instructpix2pix", "no such folder"),
    prior(
        "a single file", lambda p: p.write("ip2p.safetensors", b"") and path("./ip2p.safetensors"), "ip2p.safetensors"
    ),
    prior("an empty folder", lambda p: (p / "model").mkdir() or IP2P, "unet/config.json"),
    prior(
        "the unet folder itself", folder(lambda r: None, "system.guidance.prior.path=model/unet"), "model_index.json"
    ),
    prior("an empty path", path(""), "path"),
    *(
        prior(f"without {name}", removed(name), name.rpartition("/")[0] or name)
        for name in [
            UNET,
            VAE,
            TEXT,
            f"unet/{WEIGHTS}",
            f"vae/{WEIGHTS}",
            "text_encoder/model.safetensors",
            "tokenizer/vocab.json",
            "tokenizer/merges.txt",
            "tokenizer/tokenizer_config.json",
            "scheduler/scheduler_config.json",
        ]
    ),
    *(
        prior(f"half of {name}", half(name), name.rpartition("/")[0])
        for name in [
            UNET,
            f"unet/{WEIGHTS}",
            f"vae/{WEIGHTS}",
            "text_encoder/model.safetensors",
            "tokenizer/vocab.json",
            "scheduler/scheduler_config.json",
        ]
    ),
    *(
        prior(f"{name} empty", replaced(name, b""), name.rpartition("/")[0])
        for name in [TEXT, f"unet/{WEIGHTS}", "tokenizer/vocab.json", "tokenizer/merges.txt"]
    ),
    *(
        prior(f"{name} is a list", replaced(name, "[]"), name.rpartition("/")[0])
        for name in [
            UNET,
            VAE,
            TEXT,
            "tokenizer/vocab.json",
            "tokenizer/tokenizer_config.json",
            "scheduler/scheduler_config.json",
        ]
    ),
    prior("half of merges.txt", half("tokenizer/merges.txt"), "tokenizer"),
    prior("instructions.json cut off", replaced("instructions.json", '{"snow": ["make'), "instructions.json"),
    prior("instructions.json a list", replaced("instructions.json", "[1, 2]"), "instructions.json"),
    prior("instructions.json with numbers", replaced("instructions.json", '{"snow": [1]}'), "instructions.json"),
    prior("configs in Latin-1", replaced(UNET, '{"_class_name": "café"}'.encode("latin-1")), "unet"),
    prior(
        "a pointer of Git LFS for weights",
        replaced(f"unet/{WEIGHTS}", "version https://git-lfs\noid sha256:0\n"),
        "unet",
    ),
    prior("a text-to-image model", keys(UNET, in_channels=4), "unet", "channels"),
    prior("of Stable Diffusion XL", keys(UNET, addition_embed_type="text_time"), "addition_embed_type"),
    prior("a flow model", replaced("scheduler/scheduler_config.json", '{"_class_name": "FlowMatch"}'), "flow"),
    prior("another U-Net class", keys(UNET, _class_name="UNet3DConditionModel"), "UNet3DConditionModel"),
    prior("another text encoder", keys(TEXT, model_type="t5"), "t5"),
    prior("a text encoder of another width", keys(TEXT, hidden_size=99), "99"),
    prior("a text encoder whose width is no number", keys(TEXT, hidden_size="wide"), "text_encoder"),
    prior(
        "a prediction of another kind",
        keys("scheduler/scheduler_config.json", prediction_type="flow"),
        "prediction_type",
    ),
    prior("betas that are no numbers", keys("scheduler/scheduler_config.json", beta_start="low"), "scheduler"),
    prior("channels that are text", keys(UNET, in_channels="eight"), "unet"),
    prior("block_out_channels of a number", keys(VAE, block_out_channels=64), "vae"),
    prior("weights of other channels", keys(UNET, block_out_channels=[32, 64, 128]), "unet"),
    prior("dtype fp8", folder(lambda r: None, "system.guidance.prior.dtype=fp8"), "dtype", "fp16"),
    prior(
        "FreeU of an unknown mode", folder(lambda r: None, "system.guidance.prior.freeu={mode: papr}"), "freeu", "paper"
    ),
    prior("FreeU with NaN", folder(lambda r: None, "system.guidance.prior.freeu={mode: paper, b1: .nan}"), "b1"),
    prior(
        "an autoencoder that is not there",
        folder(lambda r: None, "system.guidance.prior.autoencoder=no/such"),
        "no/such",
    ),
    prior("its kind called sd", folder(lambda r: None, "system.guidance.prior_type=sd"), "unet", "ip2p"),
    case("prior", "a CLIP that is not there", ["system.report.clip=./clip"], "clip"),
]
