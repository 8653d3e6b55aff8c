"""The launcher: flags, trial folders, devices, resume, Ctrl-C, errors. The run is a toy that learns one number."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
import yaml
from dreamcatalyst import plugin
from dreamcatalyst.config import Scalar

import launch
from tests import processes

ROOT = Path(launch.__file__).parent


@plugin.register("toy-data")
class ToyData(plugin.pl.LightningDataModule):
    """Eight times the number 3."""

    @dataclass
    class Config:
        target: float = 3.0

    def __init__(self, cfg):
        super().__init__()
        self.cfg = plugin.parse_structured(self.Config, cfg)

    def _loader(self):
        return torch.utils.data.DataLoader(torch.full((8,), self.cfg.target), batch_size=1)

    train_dataloader = val_dataloader = test_dataloader = predict_dataloader = _loader


@plugin.register("toy-system")
class ToySystem(plugin.BaseSystem):
    """x <- x + rate (target - x) by gradient descent on half the squared distance."""

    @dataclass
    class Config(plugin.BaseSystem.Config):
        rate: Scalar = 0.5
        interrupt_at: int = -1
        mode: str = field(default="plain", metadata={"choices": ["plain", "fancy"]})

    def configure(self):
        self.x = torch.nn.Parameter(torch.zeros(1))

    def configure_optimizers(self):
        return torch.optim.SGD([self.x], lr=self.C(self.cfg.rate))

    def training_step(self, batch, batch_idx):
        if self.true_global_step == self.cfg.interrupt_at:
            os.kill(os.getpid(), signal.SIGINT)
        loss = 0.5 * (self.x - batch).square().sum()
        self.log("loss", loss)
        return loss

    def write(self, name):
        path = Path(self.get_save_path(f"it{self.true_global_step}-{name}.txt"))
        path.write_text(f"{self.x.item()}")
        return str(path)

    def validation_step(self, batch, batch_idx):
        self.write("val")

    def test_step(self, batch, batch_idx):
        self.write("test")

    def predict_step(self, batch, batch_idx):
        self.write("export")

    def progress_metrics(self):
        return {"splats": 12345, "x": self.x.item()}

    def savers(self):
        return [*super().savers(), lambda: self.write("now")]


@pytest.fixture(autouse=True)
def undisturbed():
    """A launch sets the process up for one run: log handlers, the handler of Ctrl-C."""
    log, handler = logging.getLogger("dreamcatalyst"), signal.getsignal(signal.SIGINT)
    yield
    log.handlers.clear()
    signal.signal(signal.SIGINT, handler)


@pytest.fixture
def toy(tmp_path):
    """A config file of the toy run: 4 steps, a checkpoint after every second."""
    path = tmp_path / "toy.yaml"
    path.write_text(
        yaml.safe_dump(
            {
                "name": "toy",
                "tag": "trial",
                "exp_root_dir": str(tmp_path / "outputs"),
                "data_type": "toy-data",
                "data": {"target": 3.0},
                "system_type": "toy-system",
                "system": {"rate": 0.5},
                "trainer": {"max_steps": 4, "log_every_n_steps": 1, "num_sanity_val_steps": 0},
                "checkpoint": {"save_last": True, "save_top_k": -1, "every_n_train_steps": 2},
            }
        )
    )
    return path


def trial(toy: Path) -> Path:
    (folder,) = (toy.parent / "outputs" / "toy").iterdir()
    return folder


def test_help_answers_in_under_a_second_and_imports_nothing_heavy():
    code = (
        "import sys, time; t = time.perf_counter(); import launch\n"
        "try: launch.main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert time.perf_counter() - t < 1\n"
        "assert not {'torch', 'lightning', 'omegaconf', 'numpy', 'dreamcatalyst'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(f"--{flag}" in done.stdout for flag in ("config", "train", "validate", "test", "export", "preview"))


def test_training_is_followed_by_a_test_and_leaves_threestudios_tree(toy):
    assert launch.main(["--config", str(toy), "trainer.accelerator=cpu"]) == 0
    folder = trial(toy)
    assert folder.name.startswith("trial@")
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert {"cmd.txt", "configs/raw.yaml", "configs/parsed.yaml", "csv_logs/version_0/metrics.csv"} <= files
    assert {"ckpts/last.ckpt", "ckpts/epoch=0-step=2.ckpt", "ckpts/epoch=0-step=4.ckpt", "save/it4-test.txt"} <= files
    # Four halvings of the distance 3.
    assert float((folder / "save/it4-test.txt").read_text()) == pytest.approx(3 * (1 - 0.5**4))
    assert yaml.safe_load((folder / "configs/parsed.yaml").read_text())["trainer"]["accelerator"] == "cpu"


@pytest.mark.parametrize("same_config", ["as written", "as parsed"])
def test_resuming_goes_on_in_the_same_trial(toy, same_config):
    launch.main(["--config", str(toy)])
    folder = trial(toy)
    config = toy if same_config == "as written" else folder / "configs" / "parsed.yaml"
    resume = f"resume={folder}/ckpts/epoch=0-step=2.ckpt"
    assert launch.main(["--config", str(config), resume, "trainer.max_steps=6"]) == 0
    assert trial(toy) == folder  # still the only one
    assert torch.load(folder / "ckpts/last.ckpt", weights_only=True)["global_step"] == 6
    assert float((folder / "save/it6-test.txt").read_text()) == pytest.approx(3 * (1 - 0.5**6))


@pytest.mark.parametrize(("flag", "name"), [("validate", "val"), ("test", "test"), ("export", "export")])
def test_other_modes_take_place_at_the_checkpoints_step(toy, flag, name):
    launch.main(["--config", str(toy)])
    folder = trial(toy)
    assert launch.main(["--config", str(toy), f"--{flag}", f"resume={folder}/ckpts/epoch=0-step=2.ckpt"]) == 0
    assert float((folder / f"save/it2-{name}.txt").read_text()) == pytest.approx(3 * (1 - 0.5**2))


def test_without_a_checkpoint_the_other_modes_show_the_start(toy):
    assert launch.main(["--config", str(toy), "--validate"]) == 0
    assert (trial(toy) / "save/it0-val.txt").read_text() == "0.0"


def test_any_trainer_option_works(toy):
    assert launch.main(["--config", str(toy), "trainer.fast_dev_run=true"]) == 0
    assert (trial(toy) / "save/it1-test.txt").exists()


def test_ctrl_c_leaves_a_checkpoint_and_the_splats_of_the_moment_and_says_where(toy, capsys):
    assert launch.main(["--config", str(toy), "system.interrupt_at=2"]) == 130
    folder = trial(toy)
    checkpoint, now = folder / "ckpts/last.ckpt", folder / "save/it3-now.txt"
    # The step in which it came is finished: three halvings, in the checkpoint as in what save_now wrote.
    assert float(now.read_text()) == pytest.approx(3 * (1 - 0.5**3))
    assert torch.load(checkpoint, weights_only=True)["state_dict"]["x"].item() == pytest.approx(3 * (1 - 0.5**3))
    told = capsys.readouterr().err
    assert f"stopped by Ctrl-C; on disk: {checkpoint} (go on: resume={checkpoint})" in told
    assert not list(folder.glob("save/*test*"))


def test_an_interrupted_run_resumed_ends_where_an_uninterrupted_one_does(toy):
    launch.main(["--config", str(toy), "system.interrupt_at=1"])
    resume = f"resume={trial(toy)}/ckpts/last.ckpt"
    assert launch.main(["--config", str(toy), "system.interrupt_at=1", resume]) == 0
    assert float((trial(toy) / "save/it4-test.txt").read_text()) == pytest.approx(3 * (1 - 0.5**4))


def test_the_progress_line_shows_step_metrics_pace_and_time_left(toy, capsys):
    launch.main(["--config", str(toy)])
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("train 4/4")]
    assert "splats 12,345" in line and "s/step" in line and "left" in line


def test_lightnings_own_talk_is_left_out_unless_asked_for(toy):
    # In a process of its own, where Lightning is imported by the launch and sets up its loggers.
    code = "import sys; sys.path[:0] = ['.', 'custom', 'tests']; import launch, test_launch; launch.main(sys.argv[1:])"
    command = ["-c", code, "--config", str(toy)]
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=True)
    assert [line.split()[0] for line in done.stderr.splitlines()] == ["train:", "train", "test"]
    assert done.stdout == ""
    done = processes.python([*command, "--verbose"], ROOT)
    assert done.returncode == 0 and "GPU available" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["system.ratee=1"], "system: unknown key 'ratee'. Did you mean 'rate'?"),
        (["system.rate=fast"], "system.rate: got 'fast' (str), expected a number or a schedule"),
        (["system.mode=fanzy"], "Did you mean 'fancy'?"),
        (["data.taget=1"], "data: unknown key 'taget'. Did you mean 'target'?"),
        (["system_type=toy-sytem"], "Did you mean 'toy-system'?"),
        (["system_type=toy-data"], "is registered, but is no BaseSystem"),
        (["trainer.max_stps=1"], "trainer: unknown key 'max_stps'. Did you mean 'max_steps'?"),
        (["trainer.accelerator=abacus"], "trainer: "),
        (["trainer.accelerator=tpu"], "trainer: "),
        (["checkpoint.save_las=true"], "checkpoint: unknown key 'save_las'. Did you mean 'save_last'?"),
        (["trainer.max_steps=0"], "trainer.max_steps: got 0 (int), expected a whole number, 1 or more"),
        (["trainer.max_steps=-1"], "trainer.max_steps: got -1 (int), expected a whole number, 1 or more"),
        (["trainer.devices=2", "trainer.accelerator=cpu"], "trainer: asks for 2 processes, expected one"),
        (["trainer.limit_train_batches=1"], "trainer.limit_train_batches: leave it out"),
        (["trainer.val_check_interval=0"], "trainer.val_check_interval: got 0"),
        (["trainer.devices=-1", "trainer.accelerator=cpu"], "trainer: `devices` selected"),
        (["checkpoint.every_n_train_steps=often"], "checkpoint: "),
        (["seed=-1"], "seed: got -1"),
        (["resume=nowhere.ckpt"], "resume: there is no checkpoint 'nowhere.ckpt'"),
        (["--trian"], "'--trian' on the command line is neither a flag nor key=value"),
        (["--preview"], "--preview: ToySystem has none"),
    ],
)
def test_an_error_of_the_users_is_one_line(toy, capsys, arguments, said):
    assert launch.main(["--config", str(toy), *arguments]) == 2
    *before, told = capsys.readouterr().err.strip().splitlines()
    assert told.startswith("error: ") and said in told
    assert not any("Traceback" in line for line in before)


def test_one_config_is_run_and_not_the_last_of_several(toy, capsys):
    with pytest.raises(SystemExit) as ended:
        launch.main(["--config", str(toy), "--config", str(toy)])
    assert ended.value.code == 2 and "--config is given 2 times" in capsys.readouterr().err


def test_verbose_errors_keep_their_traceback(toy, capsys):
    assert launch.main(["--config", str(toy), "--verbose", "system.ratee=1"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("mode", ["--train", "--test"])
def test_a_file_that_is_no_checkpoint_is_an_error(toy, capsys, mode, tmp_path):
    torch.save({"something": "else"}, tmp_path / "other.pt")
    for path in (toy, tmp_path / "other.pt"):
        assert launch.main(["--config", str(toy), mode, f"resume={path}"]) == 2
        (told,) = capsys.readouterr().err.splitlines()
        assert f"resume: no checkpoint of a run: {path}" in told or f"resume: {path} is no checkpoint of a run" in told


def test_an_option_that_a_system_cannot_have_is_an_error(toy, capsys, monkeypatch):
    monkeypatch.setattr(ToySystem, "automatic_optimization", False)
    assert launch.main(["--config", str(toy), "trainer.accumulate_grad_batches=2"]) == 2
    assert "error: trainer: Automatic gradient accumulation" in capsys.readouterr().err


def test_an_error_while_training_leaves_the_moment_before_it(toy, capsys, monkeypatch):
    step = ToySystem.training_step

    def fail(self, batch, batch_idx):
        if self.true_global_step == 3:
            raise RuntimeError("out of luck")
        return step(self, batch, batch_idx)

    monkeypatch.setattr(ToySystem, "training_step", fail)
    with pytest.raises(RuntimeError, match="out of luck"):
        launch.main(["--config", str(toy)])
    assert float((trial(toy) / "save/it3-now.txt").read_text()) == pytest.approx(3 * (1 - 0.5**3))
    assert str(trial(toy) / "ckpts/last.ckpt") in capsys.readouterr().err


def make_host(folder: Path) -> Path:
    for name in ("threestudio", "custom"):
        (folder / name).mkdir(parents=True)
    (folder / "launch.py").touch()
    return folder


def test_linking_into_a_threestudio_can_be_repeated(tmp_path, capsys):
    host = make_host(tmp_path / "host")
    assert launch.main(["--link", str(host)]) == 0
    assert (host / "custom/dreamcatalyst").resolve() == ROOT / "custom/dreamcatalyst"
    assert (host / "configs/dreamcatalyst").resolve() == ROOT / "configs"
    assert "python launch.py --config configs/dreamcatalyst/" in capsys.readouterr().out
    assert launch.main(["--link", str(host)]) == 0
    assert "linked already" in capsys.readouterr().out


def test_linking_elsewhere_is_refused(tmp_path, capsys):
    (tmp_path / "launch.py").touch()
    assert launch.main(["--link", str(tmp_path)]) == 2
    assert "no threestudio and no custom" in capsys.readouterr().err
    host = make_host(tmp_path / "host")
    (host / "custom/dreamcatalyst").mkdir()
    assert launch.main(["--link", str(host)]) == 2
    assert "is there already and is something else" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["custom/dreamcatalyst", "configs"])
def test_linking_onto_a_loop_of_links_is_refused(tmp_path, capsys, name):
    host = make_host(tmp_path / "host")
    (host / name).symlink_to(Path(name).name)
    assert launch.main(["--link", str(host)]) == 2
    assert "error: --link: " in capsys.readouterr().err


def test_linking_where_configs_is_a_file_is_refused(tmp_path, capsys):
    host = make_host(tmp_path / "host")
    (host / "configs").touch()
    assert launch.main(["--link", str(host)]) == 2
    assert "error: --link: " in capsys.readouterr().err


def test_an_error_is_one_line_whatever_a_library_says(toy, capsys):
    toy.write_bytes(b"PK\x03\x04\0")
    assert launch.main(["--config", str(toy)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_where_links_cannot_be_made_a_copy_takes_their_place(tmp_path, capsys, monkeypatch):
    def refuse(*arguments, **options):
        raise OSError("no links here")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    host = make_host(tmp_path / "host")
    assert launch.main(["--link", str(host)]) == 0
    assert "is a copy, since no link can be made there" in capsys.readouterr().out
    assert (host / "custom/dreamcatalyst/plugin.py").is_file()
    assert launch.main(["--link", str(host)]) == 0  # the same contents: nothing to do


def test_a_config_is_printed_whole(tmp_path, capsys):
    """What threestudio can read: no base, all that the base has, and what is left to the user still open."""
    assert launch.main(["--config", str(ROOT / "configs/rules/pds.yaml"), "--print", "system.guidance.gap=1"]) == 0
    whole = tmp_path / "whole.yaml"
    whole.write_text(capsys.readouterr().out)
    config = yaml.safe_load(whole.read_text())
    assert "base" not in config and config["system"]["guidance"]["gap"] == 1 and config["data"]["source"] == "???"
    assert config["trainer"]["max_steps"] == "${system.steps.${system.mode}}"  # not resolved: keys can still be given
