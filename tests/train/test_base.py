"""What every system does before it builds anything, alone as in the host: its config checked, and what is refused."""

from __future__ import annotations

import re
from datetime import timedelta

import pytest
from dreamcatalyst import OFFERS, plugin
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.errors import ConfigError, DataError
from dreamcatalyst.scene.ply import write_ply
from omegaconf import OmegaConf

SYSTEMS = [name for name in OFFERS if name.endswith("-system")]
PROMPT = {"prompt_processor": {"prompt": "Make it sunset"}}


LEAST = {  # what a system cannot do without
    "edit-system": PROMPT,
    "delete-system": {"mask": {"kind": "box", "options": {"center": [0, 0, 0], "radius": 1}}},
    "add-system": {"add": {"path": "demo:random:3"}},
}


def config(name: str, **keys) -> OmegaConf:
    least = next((given for end, given in LEAST.items() if name.endswith(end)), {})
    return OmegaConf.create({**least, **keys})


@pytest.mark.parametrize("name", sorted(OFFERS))
def test_a_wrong_key_is_one_line_wherever_it_stands(name):
    """As the host builds them: by their constructors, with nobody before them who looks at the config."""
    cls, place = plugin.find(name), "data" if name.endswith("-data") else "system"
    place = "system.guidance" if name.endswith("-guidance") else place
    with pytest.raises(ConfigError, match=rf"^{place}: unknown key 'seeed'. Did you mean 'seed'\? Known: "):
        cls(config(name, seeed=1))
    for section in getattr(cls, "parts", {}):
        with pytest.raises(ConfigError, match=rf"^{place}.{section}: unknown key 'no_such_key'.* Known: "):
            cls(config(name, **{section: {"no_such_key": 1}}))


@pytest.mark.parametrize(
    "section, line",
    [
        (
            {"guidance": {"prior": {"s_imge": 1}}},
            "system.guidance.prior: unknown key 's_imge'. Did you mean 's_image'?",
        ),
        (
            {"guidance": {"prior_type": "ip2"}},
            "system.guidance.prior_type: unknown diffusion prior 'ip2'. Did you mean",
        ),
        ({"mask": {"kind": "boxx"}}, "system.mask: kind: unknown kind of mask 'boxx'. Did you mean 'box'?"),
        ({"mask": {"kind": "box", "options": {"centre": [0, 0, 0]}}}, "system.mask.options: unknown key 'centre'."),
        ({"mask": {"kind": "box", "options": {"radius": 1}}}, "system.mask.options: got radius, expected one of"),
    ],
)
def test_what_a_kind_of_part_takes_is_looked_at_before_anything_is_made(section, line):
    with pytest.raises(ConfigError, match=re.escape(line)):
        plugin.find("dreamcatalyst-edit-system")(config("edit-system", **section))


@pytest.mark.parametrize("name", SYSTEMS)
def test_weights_that_would_load_nothing_are_refused_with_the_remedy(name):
    with pytest.raises(ConfigError, match=r"system.weights: got 'a.ckpt'.*resume=.*system.gs_source="):
        plugin.find(name)(config(name, weights="a.ckpt"))


def trainer(**options) -> plugin.pl.Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    return plugin.pl.Trainer(**quiet, enable_model_summary=False, max_steps=1, accelerator="cpu", **options)


@pytest.mark.parametrize("name", SYSTEMS)
def test_several_processes_are_refused_before_anything_is_loaded(name):
    """One on each of two machines, of which there is one: Lightning would wait for the other."""
    from lightning.pytorch.strategies import DDPStrategy

    data = plugin.find("dreamcatalyst-data")({"source": "nowhere"})
    strategy = DDPStrategy(process_group_backend="gloo", timeout=timedelta(seconds=5))
    with pytest.raises(ConfigError, match="trainer: asks for 2 processes.*--gpu 0"):
        trainer(num_nodes=2, strategy=strategy).fit(plugin.find(name)(config(name)), datamodule=data)


@pytest.mark.parametrize("name", ["dreamcatalyst-edit-system", "dreamcatalyst-fit-system"])
def test_a_source_that_is_not_there_is_named_before_splats_are_missed(name, tmp_path):
    data = plugin.find("dreamcatalyst-data")({"source": str(tmp_path / "nowhere")})
    system = plugin.find(name)(config(name))
    system.set_save_dir(str(tmp_path))
    with pytest.raises(DataError, match=re.escape(f"data.source: {tmp_path / 'nowhere'}: no such file or folder")):
        trainer().fit(system, datamodule=data)


def test_where_a_file_lies_is_read_from_it_once(tmp_path):
    write_ply(tmp_path / "given.ply", make_world("statue").scene)
    data = plugin.find("dreamcatalyst-data")({})
    assert data.origin(str(tmp_path / "given.ply")) == (0.0, 0.0, 0.0)
    (tmp_path / "given.ply").unlink()
    assert data.origin(str(tmp_path / "given.ply")) == (0.0, 0.0, 0.0)
