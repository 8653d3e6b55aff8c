"""The seam: the same folder registers and runs in a host that loads it, and alone."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from dreamcatalyst import OFFERS, plugin
from dreamcatalyst.config import Scalar
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.scene.ply import write_ply
from omegaconf import OmegaConf

import launch
from tests import processes

ROOT = Path(__file__).resolve().parent.parent
STEPS = 2


def python(code: str, folder: Path = ROOT, bare: bool = False) -> str:
    """What `code` prints in a process of its own, run in `folder`. bare: in which no library is imported yet."""
    if bare:
        done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
    else:
        done = processes.python(["-c", code], folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


# --- alone


def test_registering_alone_imports_nothing_heavy():
    python(
        "import sys; sys.path.insert(0, 'custom'); import dreamcatalyst\n"
        "heavy = {'torch', 'lightning', 'numba', 'diffusers', 'transformers', 'pycolmap', 'cv2', 'omegaconf'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)",
        bare=True,
    )


@pytest.mark.parametrize("name", sorted(OFFERS))
def test_every_name_on_offer_is_found(name):
    found = plugin.find(name)
    assert found.__module__ == f"dreamcatalyst{OFFERS[name]}"
    assert plugin.find(name) is found


def test_a_name_can_be_registered_once():
    plugin.register("test-once")(int)
    with pytest.raises(ValueError, match="'test-once' is registered twice: by int and float"):
        plugin.register("test-once")(float)
    with pytest.raises(KeyError):
        plugin.find("test-never")


class Walker(plugin.BaseSystem):
    """Writes down what is called."""

    @dataclass
    class Config(plugin.BaseSystem.Config):
        rate: Scalar = 0.1

    def configure(self):
        self.calls = ["configure"]

    def post_configure(self):
        self.calls.append("post_configure")


def test_a_system_alone_keeps_the_hosts_contract(tmp_path):
    system = Walker(
        OmegaConf.create({"rate": [0, 1.0, 0.0, 10], "loggers": {"wandb": {"enable": False}}}), resumed=True
    )
    assert system.calls == ["configure", "post_configure"] and system.resumed
    with pytest.raises(ValueError, match="Save dir is not set"):
        system.get_save_path("a.txt")
    system.set_save_dir(str(tmp_path))
    assert system.get_save_path("it0/a.txt") == str(tmp_path / "it0/a.txt") and (tmp_path / "it0").is_dir()
    assert (system.true_current_epoch, system.true_global_step, system.C(system.cfg.rate)) == (0, 0, 1.0)
    system.set_resume_status(0, 5)
    assert (system.true_global_step, system.C(system.cfg.rate)) == (5, 0.5)
    assert system.get_loggers() == []


def test_an_object_is_configured_with_its_further_arguments():
    class Part(plugin.BaseObject):
        @dataclass
        class Config:
            size: int = 1

        def configure(self, neighbour):
            self.seen = (self.cfg.size, neighbour)

    assert Part({"size": 2}, "renderer").seen == (2, "renderer")
    with pytest.raises(TypeError, match="colour"):
        Part({"colour": 2}, "renderer")


# --- in a host

CHECK = """
import json, sys
sys.argv = ["launch.py"]
import threestudio
from launch import load_custom_modules
before = set(sys.modules)
load_custom_modules()
"""


def new_host(folder: Path) -> Path:
    """The stand-in host, with nothing in its custom/."""
    pytest.importorskip("pytorch_lightning", reason="the host runs on pytorch_lightning")
    shutil.copytree(ROOT / "tests/host", folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "custom").mkdir()
    return folder


def link(host: Path) -> None:
    assert launch.main(["--link", str(host)]) == 0


def clone(host: Path, name: str) -> Path:
    """This repository under `name` in the custom/ of the host."""
    folder = host / "custom" / name
    folder.mkdir()
    for part in ("__init__.py", "extension.yaml", "launch.py"):
        shutil.copy(ROOT / part, folder)
    for part in ("custom", "configs"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    """The stand-in host with this extension linked by the launcher, and beside it one that cannot be imported."""
    folder = new_host(tmp_path_factory.mktemp("host") / "threestudio")
    broken = folder / "custom" / "broken"
    broken.mkdir()
    (broken / "__init__.py").write_text("import a_package_that_nobody_has\n")
    link(folder)
    return folder


def test_the_host_finds_every_name_beside_an_extension_that_fails(host):
    told = python(
        f"{CHECK}\n"
        "from dreamcatalyst import OFFERS, plugin\n"
        "import pytorch_lightning as pl\n"
        "assert plugin.HOSTED and plugin.pl is pl\n"
        "for name in OFFERS:\n"
        "    assert threestudio.find(name) is threestudio.__modules__[name] is plugin.find(name), name\n"
        # What the host has not imported itself (cv2 it has) must not be able to make registering fail.
        "heavy = {'lightning', 'numba', 'diffusers', 'transformers', 'pycolmap', 'gsplat', 'matplotlib', 'scipy'}\n"
        "heavy &= set(sys.modules) - before\n"
        "assert not heavy, heavy\n",
        host,
        bare=True,
    )
    assert "custom: dreamcatalyst\n" in told and "custom: broken (IMPORT FAILED)" in told


def test_in_the_host_systems_and_their_configs_are_the_hosts(host):
    python(
        f"{CHECK}\n"
        "import pytorch_lightning as pl\n"
        "from threestudio.systems.base import BaseSystem\n"
        "for name, cls in threestudio.__modules__.items():\n"
        "    if name.endswith('-system'):\n"
        "        assert issubclass(cls, BaseSystem) and issubclass(cls.Config, BaseSystem.Config), name\n"
        "    if name.endswith('-data'):\n"
        "        assert issubclass(cls, pl.LightningDataModule), name\n",
        host,
    )


def test_a_host_that_is_too_old_is_told_so(host):
    told = python(
        "import sys, threestudio\n"
        "threestudio.__version__ = '0.1.9'\n"
        "sys.path.insert(0, 'custom')\n"
        "try: import dreamcatalyst\n"
        "except ImportError as error: print(error)\n",
        host,
    )
    assert "dreamcatalyst needs threestudio >= 0.2.1, this is 0.1.9" in told


# --- cloned into custom/, instead of linked

NAMES = (
    "from dreamcatalyst import OFFERS, plugin\n"
    "for name in OFFERS:\n"
    "    assert plugin.find(name).__module__ == f'dreamcatalyst{OFFERS[name]}', name\n"
)


@pytest.mark.parametrize("name", ["threestudio-dreamcatalyst", "DreamCatalyst-0.1", "dreamcatalyst"])
def test_a_clone_in_custom_offers_names_and_configs_whatever_it_is_called(tmp_path, name):
    folder = clone(new_host(tmp_path / "threestudio"), name)
    told = python(
        f"{CHECK}\n{NAMES}\n"
        "import dreamcatalyst; print(dreamcatalyst.__file__)\n"
        "from threestudio.utils.config import load_config\n"
        f"cfg = load_config('custom/{name}/configs/dc-ge.yaml', n_gpus=1)\n"
        "data, system = plugin.find(cfg.data_type)(cfg.data), plugin.find(cfg.system_type)(cfg.system)\n"
        "print(type(data).__name__, type(system).__name__)\n",
        tmp_path / "threestudio",
    )
    assert f"custom: {name}\n" in told and str(folder / "custom/dreamcatalyst/__init__.py") in told
    assert "SplatData EditSystem" in told


@pytest.mark.parametrize("first", ["clone", "link"])
def test_a_clone_and_a_link_register_once_and_the_second_says_which_to_remove(tmp_path, first):
    """The host imports in any order."""
    host = new_host(tmp_path / "threestudio")
    link(host), clone(host, "cloned")
    names = ["cloned", "dreamcatalyst"] if first == "clone" else ["dreamcatalyst", "cloned"]
    listing = f"Path.iterdir = lambda self, names={names}: iter([self / name for name in names])"
    told = python(
        f"from pathlib import Path\n{listing}\n{CHECK}\n{NAMES}\n"
        "import dreamcatalyst, traceback; from dreamcatalyst.guidance import rules\n"
        "print('used:', Path(dreamcatalyst.__file__).parent, Path(rules.__file__).parent.parent)",
        host,
    )
    homes = {"dreamcatalyst": host / "custom/dreamcatalyst", "cloned": host / "custom/cloned/custom/dreamcatalyst"}
    used, other = (homes[name] for name in names)
    assert f"used: {used} {used}" in told
    assert f"custom: {names[0]}\n" in told and f"custom: {names[1]} (IMPORT FAILED)" in told
    assert f"dreamcatalyst is in custom/ twice: {used}, which is used, and {other}. Remove one" in told


def test_where_a_clone_is_nothing_is_linked(tmp_path, capsys):
    folder = clone(new_host(tmp_path / "threestudio"), "threestudio-dreamcatalyst")
    assert launch.main(["--link", str(tmp_path / "threestudio")]) == 2
    assert f"--link: '{folder}' is a clone of this extension" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "threestudio" / "custom").iterdir()] == [folder.name]


# --- runs in a host

COUNTING = """
import atexit, sys
opened = []
sys.addaudithook(lambda event, values: opened.append(str(values[0])) if event == "open" else None)
atexit.register(lambda: print("opened", sum(name.endswith("given.ply") for name in opened), "times"))
"""


def in_host(host: Path, *arguments: str, bare: bool = False) -> subprocess.CompletedProcess:
    command = ["launch.py", "--config", "configs/dreamcatalyst/closed-form.yaml", *arguments]
    if bare:
        return subprocess.run([sys.executable, *command], cwd=host, capture_output=True, text=True)
    return processes.python(command, host)


def test_the_edit_runs_in_the_host_and_is_validated_and_exported_from_its_checkpoint(host):
    """The host reads every public attribute of the system before and after each batch, `origin` for one: what it costs
    may be paid once."""
    write_ply(host / "given.ply", make_world("statue").scene)
    counting = host / "custom" / "counting"
    counting.mkdir()
    (counting / "__init__.py").write_text(COUNTING)
    short = [f"trainer.max_steps={STEPS}", f"checkpoint.every_n_train_steps={STEPS}", "name=seam", "tag=edit"]
    short += ["data.width=64", "data.height=64", "system.report.every=0", "system.report.video_frames=4"]
    short += ["data.source=null", "system.gs_source=given.ply"]
    done = in_host(host, "--train", *short, bare=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert "opened 6 times" in done.stdout  # where it lies, how it was fitted, the splats; its format before each
    (trial,) = (host / "outputs/seam").iterdir()
    assert list(trial.glob("save/**/*.ply")), sorted(trial.rglob("*"))
    (checkpoint,) = trial.glob(f"ckpts/*step={STEPS}.ckpt")
    for mode in ("--validate", "--export"):
        done = in_host(host, mode, *short, f"resume={checkpoint}")
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert list(trial.glob(f"save/it{STEPS}-*.png")) and list(trial.glob(f"save/it{STEPS}-export/*.ply"))


@pytest.mark.parametrize(
    "wrong, line",
    [
        ("data.max_sied=64", "data: unknown key 'max_sied'. Did you mean 'max_side'?"),
        ("system.gs_sorce=x", "system: unknown key 'gs_sorce'. Did you mean 'gs_source'?"),
        ("system.guidance.prior.s_imge=1", "system.guidance.prior: unknown key 's_imge'. Did you mean 's_image'?"),
        ("system.densify.evry=1", "system.densify: unknown key 'evry'. Did you mean 'every'?"),
    ],
)
def test_the_last_line_of_the_host_is_ours_where_a_key_is_wrong(host, wrong, line):
    done = in_host(host, "--train", wrong, "name=wrong", "tag=t")
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and last.startswith("dreamcatalyst.errors.ConfigError: ") and line in last, done.stderr
