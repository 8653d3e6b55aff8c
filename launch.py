"""The launcher: parse, choose the device, build, run. It takes threestudio's flags and leaves threestudio's folders.

python launch.py --config configs/closed-form.yaml system.prompt_processor.prompt="Make it sunset"
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import logging
import os
import pickle
import shlex
import shutil
import sys
import traceback
import warnings
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
# Threads that wait soon sleep instead of spinning on (GNU OpenMP spins six times as long), unless the user says
# otherwise: where something else wants the cores, spinning takes them from the very thread that is waited for.
os.environ.setdefault("GOMP_SPINCOUNT", "50000")
INTERRUPTED = 130  # the exit status of a shell command that Ctrl-C ended


def arguments(argv: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The flags, and the `key=value` arguments that are left."""
    parser = argparse.ArgumentParser(
        prog="launch.py",
        allow_abbrev=False,
        description="Fit Gaussian splats to photographs and edit them by text. Without a mode it trains, then tests.",
        epilog='Any key of the YAML may follow as key=value: system.prompt_processor.prompt="Make it sunset", '
        "trainer.max_steps=500, trainer.accelerator=cpu, resume=outputs/.../ckpts/last.ckpt.",
    )
    parser.add_argument("--config", metavar="YAML", help="what to run: a file such as configs/dc-ge.yaml")
    mode = parser.add_mutually_exclusive_group()
    for name, text in {
        "train": "train, then test (the default)",
        "validate": "render and score the held-out views of a checkpoint (resume=) or PLY (system.gs_source=)",
        "test": "write the test-time pictures, video and tables of a checkpoint or PLY",
        "export": "write PLY and video from a checkpoint or PLY",
        "preview": "the edit of a single view as the prior sees it, in seconds, before a long run is paid for",
    }.items():
        mode.add_argument(f"--{name}", dest="mode", action="store_const", const=name, help=text)
    parser.add_argument(
        "--gpu", metavar="N", help="the GPU to use, by its number; unused if CUDA_VISIBLE_DEVICES is set"
    )
    parser.add_argument("--verbose", action="store_true", help="Lightning's own messages, and errors with a traceback")
    parser.add_argument("--link", metavar="DIR", type=Path, help="link extension and configs into a threestudio folder")
    args, overrides = parser.parse_known_args(argv)
    if not args.config and not args.link:
        parser.error("--config is needed: a file of configs/, such as --config configs/dc-ge.yaml")
    return args, overrides


def entry() -> Path:
    """The extension's folder, from extension.yaml."""
    import yaml

    return ROOT / yaml.safe_load((ROOT / "extension.yaml").read_text(encoding="utf-8"))["entry"]


def main(argv: list[str] | None = None) -> int:
    """Run; the exit status is 0, 2 for an error of the user's, 130 after Ctrl-C. Other errors keep their traceback."""
    args, overrides = arguments(sys.argv[1:] if argv is None else argv)
    sys.path.insert(0, str(entry().parent))
    importlib.import_module(entry().name)
    from dreamcatalyst.errors import DreamCatalystError

    try:
        return link_into(args.link) if args.link else run(args, overrides)
    except DreamCatalystError as error:
        if args.verbose:
            traceback.print_exc()
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def link_into(host: Path) -> int:
    """Make the extension and its configs known to the threestudio in the folder `host`."""
    from dreamcatalyst.link import link

    link(entry(), host / "custom" / entry().name, host)
    link(ROOT / "configs", host / "configs" / entry().name, host)
    print(f"cd {host} && python launch.py --config configs/{entry().name}/dc-ge.yaml --train")
    return 0


def run(args: argparse.Namespace, overrides: list[str]) -> int:
    """Load the config, build data and system, and hand them to Lightning."""
    from dreamcatalyst.config import load_config
    from dreamcatalyst.errors import ConfigError

    if args.gpu is not None:
        os.environ.setdefault("CUDA_VISIBLE_DEVICES", str(args.gpu))  # read by torch, which is not imported yet
    config = load_config(args.config, cli_args=overrides)
    mode = args.mode or "train"

    from dreamcatalyst.train.interrupt import SaveOnInterrupt
    from dreamcatalyst.train.progress import AboveTheLine, Progress
    from lightning.pytorch.utilities.exceptions import MisconfigurationException

    if not args.verbose:
        quiet()
    progress, interrupt = Progress(), SaveOnInterrupt()
    log = logging.getLogger("dreamcatalyst")
    log.handlers = [AboveTheLine(progress)]
    log.setLevel(logging.DEBUG if args.verbose else logging.INFO)

    clock = checkpoint_clock(config.resume)
    trainer = make_trainer(config, [progress, interrupt], training=mode == "train")
    data, system = build(config)
    log.info(f"{mode}: {config.trial_dir}")
    try:
        if mode == "train":
            snapshot(config, args.config)
            if not trainer.fast_dev_run:
                trainer.loggers = [*trainer.loggers, *system.get_loggers()]
            trainer.fit(system, datamodule=data, ckpt_path=config.resume)
            if not interrupt.interrupted:
                trainer.test(system, datamodule=data, verbose=args.verbose)
        elif mode == "preview":
            preview(system, data, trainer)
        else:
            if clock:
                system.set_resume_status(*clock)
            stage = {"validate": trainer.validate, "test": trainer.test, "export": trainer.predict}[mode]
            table = {} if mode == "export" else {"verbose": args.verbose}  # Lightning's own table of scores
            stage(system, datamodule=data, ckpt_path=config.resume, **table)
    except MisconfigurationException as error:  # an option that this system's kind of training cannot have
        raise ConfigError(f"trainer: {error}") from error
    except Exception:
        if interrupt.left:
            log.info("stopped by an error" + left_behind(interrupt.left))
        raise
    except SystemExit:  # after Ctrl-C some versions of Lightning exit and some return; the callbacks have saved
        if not interrupt.interrupted:
            raise
    if interrupt.interrupted:
        log.info("interrupted" + left_behind(interrupt.left))
        return INTERRUPTED
    return 0


def left_behind(paths: list[Path]) -> str:
    """What an unfinished run left, for the end of a message."""
    return ("; left behind:" + "".join(f"\n  {path}" for path in paths)) if paths else ""


def build(config: Any) -> tuple[Any, Any]:
    """The data module and the system, by their registered names; both sections are validated before either is built."""
    from dreamcatalyst import plugin
    from dreamcatalyst.config import check
    from dreamcatalyst.errors import ConfigError, choose

    classes = []
    for key, base in (("data", plugin.pl.LightningDataModule), ("system", plugin.BaseSystem)):
        name = choose(key, getattr(config, f"{key}_type"), plugin.names(), f"{key}_type")
        classes.append(plugin.find(name))
        if not issubclass(classes[-1], base):
            raise ConfigError(f"{key}_type: '{name}' is registered, but is no {base.__name__}.")
        check(classes[-1], getattr(config, key), key)
    try:
        plugin.pl.seed_everything(config.seed, workers=True)
    except ValueError as error:
        raise ConfigError(f"seed: {error}.") from error
    data = classes[0](config.data)
    system = classes[1](config.system, resumed=config.resume is not None)
    system.set_save_dir(str(Path(config.trial_dir) / "save"))
    return data, system


def make_trainer(config: Any, callbacks: list[Any], training: bool) -> Any:
    """Lightning's Trainer, on one GPU where there is one and else on the CPU; `trainer` in the YAML overrides."""
    from dreamcatalyst.errors import ConfigError
    from lightning.pytorch import Trainer
    from lightning.pytorch.accelerators import CUDAAccelerator
    from lightning.pytorch.callbacks import ModelCheckpoint
    from lightning.pytorch.loggers import CSVLogger
    from lightning.pytorch.utilities.exceptions import MisconfigurationException

    options = {
        "accelerator": "gpu" if CUDAAccelerator.is_available() else "cpu",
        "devices": 1,
        "inference_mode": False,
        "logger": training,
        "enable_model_summary": False,
        "enable_checkpointing": training,
        "default_root_dir": config.trial_dir,
        **known_options(Trainer, config.trainer, "trainer"),
    }
    if not options.get("enable_progress_bar", True):
        callbacks = callbacks[1:]
    if training and options["logger"] is True:
        options["logger"] = CSVLogger(config.trial_dir, name="csv_logs")
    steps = options.get("max_steps", 1)
    if not isinstance(steps, int) or steps < 1:
        raise ConfigError(f"trainer.max_steps: got {steps}, expected 1 or more: schedules go over the run's length.")
    try:
        if training and options["enable_checkpointing"]:
            checkpoint = known_options(ModelCheckpoint, config.checkpoint, "checkpoint")
            # Without a counter, last.ckpt is the last one in a resumed run too.
            ours = {"dirpath": Path(config.trial_dir) / "ckpts", "enable_version_counter": False}
            callbacks = [*callbacks, ModelCheckpoint(**ours | checkpoint)]
        trainer = Trainer(callbacks=callbacks, **options)
    except (MisconfigurationException, ValueError, ImportError) as error:
        raise ConfigError(f"trainer: {error}") from error
    if trainer.world_size > 1:
        raise ConfigError(f"trainer: asks for {trainer.world_size} processes, expected one: set trainer.devices=1.")
    return trainer


def known_options(cls: type, section: Any, where: str) -> dict[str, Any]:
    """A section of the YAML as keyword arguments for `cls`. Raises ConfigError for one that it does not take."""
    from dreamcatalyst.errors import ConfigError, unknown
    from omegaconf import OmegaConf

    known = [name for name in inspect.signature(cls).parameters if name not in ("callbacks", "kwargs")]
    for key in section:
        if key not in known:
            raise ConfigError(unknown("key", key, known, where))
    return OmegaConf.to_container(OmegaConf.create(section))


def checkpoint_clock(path: str | None) -> tuple[int, int] | None:
    """Epoch and step of a checkpoint, at which its validation, test and export count as taking place.

    Raises ConfigError for a file that is no checkpoint, before anything else is done.
    """
    if path is None:
        return None
    import torch
    from dreamcatalyst.errors import ConfigError

    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ConfigError(f"resume: '{path}' is no checkpoint of a run, or a damaged one.") from error
    if not isinstance(saved, dict) or not {"epoch", "global_step", "pytorch-lightning_version"} <= set(saved):
        raise ConfigError(f"resume: '{path}' is no checkpoint of a run: it does not say epoch and step.")
    return saved["epoch"], saved["global_step"]


def preview(system: Any, data: Any, trainer: Any) -> None:
    """Let the system show one edit, on the device that the trainer chose."""
    from dreamcatalyst.errors import ConfigError

    if not hasattr(system, "preview"):
        raise ConfigError(f"--preview: {type(system).__name__} has none; it is there for systems that edit.")
    for path in system.to(trainer.strategy.root_device).preview(data):
        print(path)


def snapshot(config: Any, source: str) -> None:
    """Leave in the trial's folder what made it: the config as parsed and as written, and the command."""
    from dreamcatalyst.config import save_config

    folder = Path(config.trial_dir) / "configs"
    folder.mkdir(parents=True, exist_ok=True)
    raw = folder / "raw.yaml"
    if not raw.exists() or not raw.samefile(source):
        shutil.copyfile(source, raw)
    save_config(config, folder / "parsed.yaml")
    command = shlex.join(["python", *sys.argv])
    (Path(config.trial_dir) / "cmd.txt").write_text(f"{command}\n", encoding="utf-8")


def quiet() -> None:
    """Silence what Lightning, which must have been imported, says about itself and its user cannot act on."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module=r"lightning\.")


if __name__ == "__main__":
    sys.exit(main())
