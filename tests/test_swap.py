"""The host's own systems with our guidance in place of theirs, in the stand-in host, each in a process of its own."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

import launch
from tests import processes
from tests.diffusion.small_model import make_model

ROOT = Path(__file__).resolve().parent.parent
SWAP = "configs/dreamcatalyst/swap"


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    pytest.importorskip("pytorch_lightning", reason="the host runs on pytorch_lightning")
    folder = tmp_path_factory.mktemp("swap") / "threestudio"
    shutil.copytree(ROOT / "tests/host", folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "custom").mkdir()
    assert launch.main(["--link", str(folder)]) == 0
    make_model(folder / "ip2p")
    make_model(folder / "sd", channels=4)
    return folder


def run(host: Path, config: str, *arguments: str) -> subprocess.CompletedProcess:
    command = ["launch.py", "--train", "--config", config, *arguments]
    short = ["trainer.max_steps=2", "trainer.precision=32", "checkpoint.every_n_train_steps=2", "name=swap", "tag=t"]
    return processes.python([*command, *short], host)


def losses(done: subprocess.CompletedProcess) -> list[float]:
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return [float(line.rpartition(" ")[2]) for line in done.stdout.splitlines() if line.startswith("step ")]


def test_instruct_nerf2nerf_gets_its_edits_from_us(host):
    done = run(
        host,
        f"{SWAP}/in2n.yaml",
        "data.dataroot=none",
        "system.start_editing_step=-1",
        "system.per_editing_step=1",
        "system.guidance.diffusion_steps=2",
        "system.guidance.prior.path=ip2p",
        "system.guidance.prior.dtype=fp32",
        "system.prompt_processor.pretrained_model_name_or_path=ip2p",
    )
    assert len(losses(done)) == 2
    assert done.stdout.count("edited 1 20 28 3") == 2


def test_dreamfusion_gets_its_loss_from_us(host):
    small = ["system.prompt_processor.prompt=a bear", "system.guidance.fixed_size=64", "system.guidance.prior.path=sd"]
    small += ["system.guidance.prior.dtype=fp32"]
    small += ["system.prompt_processor.pretrained_model_name_or_path=sd"]
    done = losses(run(host, f"{SWAP}/dreamfusion-sd.yaml", *small))
    assert len(done) == 2 and all(loss > 0 for loss in done)


@pytest.mark.parametrize(
    "arguments, line",
    [
        (["system.guidance.max_steps=2"], "system.guidance_type: this system asks for edit_images, got loss_sds"),
        ([], "dreamcatalyst-edit-guidance gives edit_images"),
        (
            ["system.guidance.guidence_scale=2"],
            "system.guidance: unknown key 'guidence_scale'. Did you mean 'guidance_",
        ),
    ],
)
def test_the_last_line_of_the_host_is_ours_where_another_guidance_is_meant(host, arguments, line):
    options = ["data.dataroot=none", "system.start_editing_step=-1", "system.guidance_type=dreamcatalyst-guidance"]
    options += ["system.guidance.prior.path=ip2p", "system.guidance.prior.dtype=fp32"]
    options += ["system.prompt_processor.pretrained_model_name_or_path=ip2p"]
    done = run(host, f"{SWAP}/in2n.yaml", *options, *arguments)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and last.startswith("dreamcatalyst.errors.ConfigError: ") and line in last, done.stderr


# What the host's own YAMLs have where its own guidance stands.
GUIDANCE_OF_THE_HOST = {
    "in2n": {"min_step_percent": 0.02, "max_step_percent": 0.98},
    "dreamfusion-sd": {
        "pretrained_model_name_or_path": "stabilityai/stable-diffusion-2-1-base",
        "guidance_scale": 100.0,
        "weighting_strategy": "sds",
        "min_step_percent": 0.02,
        "max_step_percent": 0.98,
    },
}


@pytest.mark.parametrize(
    "name, arguments",
    [
        ("in2n", ["system.guidance_type=dreamcatalyst-edit-guidance", "data.dataroot=none"]),
        (
            "dreamfusion-sd",
            [
                "system.guidance_type=dreamcatalyst-guidance",
                "system.prompt_processor.prompt=a bear",
                "system.guidance.prior_type=sd",
                "system.guidance.rule=sds",
            ],
        ),
    ],
)
def test_a_config_of_the_host_is_swapped_on_the_command_line(host, name, arguments):
    config = yaml.safe_load((ROOT / f"configs/swap/{name}.yaml").read_text())
    config["system"]["guidance"] = GUIDANCE_OF_THE_HOST[name]
    config["system"]["guidance_type"] = "the-hosts-own"
    (host / f"{name}.yaml").write_text(yaml.safe_dump(config))
    model = "sd" if name == "dreamfusion-sd" else "ip2p"
    done = run(
        host,
        f"{name}.yaml",
        *arguments,
        f"system.guidance.prior.path={model}",
        f"system.prompt_processor.pretrained_model_name_or_path={model}",
        *(["system.start_editing_step=-1", "system.guidance.diffusion_steps=2"] if name == "in2n" else []),
    )
    assert len(losses(done)) == 2
