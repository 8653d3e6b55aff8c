"""Every config of the manifest runs one step: as it is, but for a small model, a synthetic scene and small pictures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from dreamcatalyst.config import load_config, read_yaml
from dreamcatalyst.errors import ConfigError
from omegaconf import OmegaConf

import launch
from tests.diffusion.small_model import make_model
from tests.segment.small_models import make_clipseg

ROOT = Path(launch.__file__).parent
MANIFEST = yaml.safe_load((ROOT / "extension.yaml").read_text(encoding="utf-8"))
CONFIGS = {entry["path"]: entry["needs"] for entry in MANIFEST["configs"] if "host" not in entry["needs"]}
SMALL = ("data.width=48", "data.height=48", "system.report.video_frames=0", "system.report.views=1")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    finder = make_clipseg(root / "clipseg")
    return {"ip2p": make_model(root / "ip2p"), "sd": make_model(root / "sd", channels=4), "text": finder}


def overrides(path: str, models: dict[str, Path], folder: Path) -> list[str]:
    """What stands in for photographs, downloads and a GPU."""
    config = OmegaConf.to_container(read_yaml(ROOT / path))
    if config["data_type"] == "dreamcatalyst-prior-data":
        return [f"data.pairs={folder / 'pairs'}", "data.size=32", "system.autoencoder.crop=16"]
    words = config["system"].get("prompt_processor", {})
    given = [f"system.prompt_processor.{key}=make it snow" for key in words if words[key] == "???"]
    if "gs_source" in config["system"] and config["data"]["source"] == "???":
        given += ["data.source=demo:statue", "system.gs_source=''"]
    if config["data"]["source"] == "":
        given.append("data.source=demo:statue")
    guidance = config["system"].get("guidance", {})
    if guidance.get("prior_type") in models:
        given.append(f"system.guidance.prior.path={models[guidance['prior_type']]}")
    mask = config["system"].get("mask", {})
    if mask.get("kind") == "text":  # a network that learned nothing finds all of the picture or nothing
        given += ["system.mask.options.text=statue", f"system.mask.options.path={models['text']}"]
        given += ["system.mask.options.threshold=0.001", "system.mask.threshold=0.1", "system.mask.views=1"]
    if mask.get("kind") == "relevance":
        given += ["system.mask.threshold=0.001", "system.mask.views=1"]
    return [*given, *SMALL]


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("path", sorted(CONFIGS))
def test_every_config_runs_a_step(path, models, tmp_path):
    options = [f"exp_root_dir={tmp_path}", "trainer.fast_dev_run=true", "trainer.accelerator=cpu"]
    assert launch.main(["--config", str(ROOT / path), *overrides(path, models, tmp_path), *options]) == 0
    assert list(tmp_path.rglob("*.ply")) or list(tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize("psi", ["psi2", "psi3"])
def test_a_config_that_restated_another_is_refused_with_what_says_the_same(psi):
    with pytest.raises(ConfigError) as caught:
        load_config(ROOT / f"configs/rules/dreamcatalyst-{psi}.yaml")
    said = re.search("use (.*)\\.$", str(caught.value))[1].split()
    words = ["data.source=x", "system.gs_source=x", "system.prompt_processor.prompt=x"]
    config = load_config(ROOT / said[0], cli_args=[*said[1:], *words])
    assert config.system["guidance"]["rule"] == f"dreamcatalyst-{psi}"


@pytest.mark.parametrize("path, fast, high", [("dc-ge-ip2p", 1200, 1500), ("rules/pds", 1000, 3000)])
def test_the_mode_sets_the_steps_and_what_follows_from_them(path, fast, high):
    words = ["data.source=x", "system.gs_source=x", "system.prompt_processor.prompt=x"]
    words += ["system.prompt_processor.source_prompt=x"]
    for mode, steps in (("fast", fast), ("high-quality", high)):
        config = load_config(ROOT / f"configs/{path}.yaml", cli_args=[*words, f"system.mode={mode}"])
        assert config.trainer["max_steps"] == config.checkpoint["every_n_train_steps"] == steps
    with pytest.raises(ConfigError, match="system.mode: unknown value 'quick'. Known: fast, high-quality"):
        load_config(ROOT / f"configs/{path}.yaml", cli_args=[*words, "system.mode=quick"])
