"""The published 3DGS run as a config: its numbers, and the page that says how our recommendation differs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import cast

import pytest
import yaml
from dreamcatalyst.config import load_config, merge_open, parse
from dreamcatalyst.diffusion.noise import stable_diffusion_schedule
from dreamcatalyst.guidance.config import GuidanceConfig, chosen_rule, chosen_schedule
from dreamcatalyst.scene.generations import Generations
from dreamcatalyst.train.edit import EditSystem
from omegaconf import OmegaConf

import launch
from tests.test_main_job import flat

ROOT = Path(launch.__file__).parent
# The script edit_dc_face.sh over configs/edit-dc.yaml, and what they leave to the code's defaults.
PUBLISHED = {
    "data.width": 512,
    "data.height": 512,
    "data.max_view_num": 96,
    "data.batch_size": 1,
    "data.test_every": 0,
    "system.steps.high-quality": 1500,
    "system.steps.fast": 1200,
    "system.guidance.prior.path": "timbrooks/instruct-pix2pix",
    "system.guidance.prior.dtype": "fp16",
    "system.guidance.prior.latents": "independent",
    "system.guidance.prior.freeu": {"mode": "paper", "b1": 1.1, "b2": 1.1, "s1": 0.9, "s2": 0.2},
    "system.guidance.rule": "csd-like",
    "system.guidance.guidance_scale": 7.5,
    "system.guidance.condition_scale": 1.5,
    "system.guidance.min_step_percent": 0.2,
    "system.guidance.max_step_percent": 0.9,
    "system.guidance.noise": "independent",
    "system.guidance.reduction": "sum",
    "system.mask.kind": "text",
    "system.mask.views": None,
    "system.mask.threshold": 0.5,
    "system.anchor.kind": "last-densify",
    "system.anchor.max_weight": 10,
    "system.anchor.lambda_color": 5,
    "system.anchor.lambda_geo": 5,
    "system.anchor.lambda_opacity": 5,
    "system.anchor.lambda_scale": 5,
    "system.loss.lambda_guidance": 1,
    "system.loss.region": "everywhere",
    "system.loss.lambda_outside": 0,
    "system.loss.lambda_perceptual": 0,
    "system.learning_rates": {
        "means": 1.6e-4,
        "means_decay": 0.1,
        "sh0": 0.0125,
        "shN": 0.0125 / 20,
        "opacities": 0.05,
        "scales": 0.005,
        "quats": 0.001,
        "warm_up_steps": 0,
    },
    "system.densify.top_fraction": 0.01,
    "system.densify.max_size": 0.1,
}
WORDS = ["data.source=x", "system.gs_source=x", "system.prompt_processor.prompt=x", "system.mask.options.text=x"]


def loaded(*options: str):
    return load_config(ROOT / "configs/dc-ge-published.yaml", cli_args=[*WORDS, *options])


def at(config, key: str):
    for name in key.split("."):
        config = config[name] if isinstance(config, dict) or hasattr(config, "keys") else getattr(config, name)
    return config


@pytest.mark.parametrize("key", PUBLISHED)
def test_a_setting_is_the_published_one(key):
    assert at(loaded(), key) == PUBLISHED[key]


@pytest.mark.parametrize(("mode", "steps", "times", "last"), [("high-quality", 1500, 12, 201), ("fast", 1200, 11, 341)])
def test_schedules_go_as_published(mode, steps, times, last):
    """Timesteps over 1500 steps whatever the mode; densification at 100, 200 ... as long as the run goes."""
    system = loaded(f"system.mode={mode}").system
    guidance = parse(GuidanceConfig, system["guidance"], "system.guidance")
    rule = chosen_rule(guidance)
    assert (rule.parameters.chi, rule.parameters.delta, rule.parameters.gamma) == (0.075, 0.05, 0.2)
    schedule, abar = chosen_schedule(guidance, rule), stable_diffusion_schedule()
    assert schedule.timestep(0, steps, abar) == 901 and schedule.timestep(steps - 1, steps, abar) == last
    densify = parse(EditSystem.parts["densify"], system["densify"], "system.densify")
    assert (densify.every, densify.start, densify.times(steps)) == (100, 100, times)


@pytest.mark.usefixtures("unchecked")  # no splats: weights alone
def test_the_first_generation_is_held_as_published():
    """0.05 * 1.3^12 = 1.165 after twelve densifications."""
    system = loaded().system
    anchor = parse(EditSystem.parts["anchor"], system["anchor"], "system.anchor")
    assert (anchor.weight_init_g0, anchor.weight_init, anchor.weight_multiplier) == (0.05, 0.1, 1.3)
    given = anchor.weight_init_g0, anchor.weight_init, anchor.weight_multiplier, anchor.max_weight
    generations = Generations(*given, anchor="source", anchored=())
    for _ in range(parse(EditSystem.parts["densify"], system["densify"]).times(1500)):
        generations.advance(None)
    assert generations.weights[0] == pytest.approx(1.165, abs=5e-4)


def as_text(values: dict, key: str) -> str:
    """As the page writes it."""
    if key not in values:
        return "default"
    return "null" if values[key] is None else str(values[key])


def test_the_page_names_every_difference_of_the_two_configs():
    published, ours = (
        flat(cast(dict, OmegaConf.to_container(merge_open(ROOT / f"configs/{name}.yaml"))))
        for name in ("dc-ge-published", "dc-ge-ip2p")
    )
    differing = {k for k in {**published, **ours} if as_text(published, k) != as_text(ours, k)} - {"name"}
    page = (ROOT / "docs/published.md").read_text(encoding="utf-8").split("\n## ")[1]
    rows = re.findall(r"^\| `([^`]+)` \| (.*?) \| (.*?) \| (.+) \|$", page, re.MULTILINE)
    assert {row[0] for row in rows} == differing and len(rows) == len(differing)
    for key, theirs, mine, why in rows:
        for said, values in ((theirs, published), (mine, ours)):
            wanted = as_text(values, key)
            assert said.startswith("default: ") if wanted == "default" else yaml.safe_load(said) == values[key], key
        assert why.strip()
