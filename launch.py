"""The launcher: parse, choose the device, build, run. It takes threestudio's flags and leaves threestudio's folders.

python launch.py --config configs/closed-form.yaml system.prompt_processor.prompt="Make it sunset"
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import shlex
import signal
import sys
import traceback
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
FIT = ROOT / "configs" / "fit.yaml"  # how splats are fitted to photographs
# Threads that wait soon sleep instead of spinning on (GNU OpenMP spins six times as long), unless the user says
# otherwise: where something else wants the cores, spinning takes them from the very thread that is waited for.
os.environ.setdefault("GOMP_SPINCOUNT", "50000")


def arguments(argv: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The flags, and the `key=value` arguments that are left."""
    parser = argparse.ArgumentParser(
        prog="launch.py",
        allow_abbrev=False,
        description="Fit Gaussian splats to photographs and edit them by text. Without a mode it trains, then tests.",
        epilog='Any key of the YAML may follow as key=value: system.prompt_processor.prompt="Make it sunset", '
        "trainer.max_steps=500, trainer.accelerator=cpu, resume=outputs/.../ckpts/last.ckpt.",
    )
    parser.add_argument(
        "--config", metavar="YAML", action="append", help="what to run: a file such as configs/dc-ge.yaml"
    )
    mode = parser.add_mutually_exclusive_group()
    for name, text in {
        "train": "train, then test (the default)",
        "validate": "render and score the held-out views of a checkpoint (resume=) or splat file (system.gs_source=)",
        "test": "write the test-time pictures, video and tables of a checkpoint or splat file",
        "export": "write splats (export.format=ply, spz, sog, gltf ...) and a video from a checkpoint or splat file",
        "print": "print the config, whole: with what it is laid over (base:) and all key=value; for threestudio, say",
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
    if args.config and len(args.config) > 1:
        parser.error(f"--config is given {len(args.config)} times, expected one file")
    args.config = args.config[0] if args.config else None
    return args, overrides


def entry() -> Path:
    """The extension's folder, from extension.yaml."""
    import yaml

    return ROOT / yaml.safe_load((ROOT / "extension.yaml").read_text(encoding="utf-8"))["entry"]


def main(argv: list[str] | None = None) -> int:
    """Run; the exit status is 0, 2 for an error of the user's, 128 + n after signal n (Ctrl-C is 2, SIGTERM 15, SIGHUP
    1). Other errors keep their traceback."""
    args, overrides = arguments(sys.argv[1:] if argv is None else argv)
    sys.path.insert(0, str(entry().parent))
    importlib.import_module(entry().name)
    from dreamcatalyst.errors import DreamCatalystError
    from dreamcatalyst.signals import Stop, Stopped, lasting_streams

    with Stop().installed() as stop, lasting_streams():
        try:
            return link_into(args.link) if args.link else run(args, overrides, stop)
        except Stopped as stopped:
            print(f"stopped by {stopped}", file=sys.stderr)
            return stop.status
        except (DreamCatalystError, OSError) as error:
            message = str(error)
            if isinstance(error, OSError):
                if error.errno is None:  # not the file system's
                    raise
                message = f"{error.filename or 'a file cannot be read or written'}: {error.strerror}"
            if args.verbose:
                traceback.print_exc()
            print(f"error: {' '.join(message.splitlines())}", file=sys.stderr)
            return 2


def link_into(host: Path) -> int:
    """Make the extension and its configs known to the threestudio in the folder `host`."""
    from dreamcatalyst.link import link

    link(entry(), host / "custom" / entry().name, host)
    link(ROOT / "configs", host / "configs" / entry().name, host)
    print(f"cd {host} && python launch.py --config configs/{entry().name}/dc-ge.yaml --train")
    return 0


def run(args: argparse.Namespace, overrides: list[str], stop: Any) -> int:
    """Load the config, build data and system, and hand them to Lightning. stop: the Stop that takes the signals."""
    from dreamcatalyst.config import merge_config, merge_open, read_config
    from dreamcatalyst.imports import import_parts
    from dreamcatalyst.trainer import keys_below

    if args.gpu is not None:
        os.environ.setdefault("CUDA_VISIBLE_DEVICES", str(args.gpu))  # read by torch, which is not imported yet
    if args.mode == "print":
        from omegaconf import OmegaConf

        print(OmegaConf.to_yaml(merge_open(args.config, cli_args=overrides)), end="")
        return 0
    merged = merge_config(args.config, cli_args=overrides)
    config = read_config(merged, lambda: keys_below(merged))
    import_parts(config.imports)
    mode = args.mode or "train"

    from dreamcatalyst.runs import claimed, told
    from dreamcatalyst.signals import Stopped

    numbered = config.use_timestamp and merged.get("timestamp") is None
    with claimed(config, numbered=numbered, writes=mode in ("train", "test")) as config:
        folder = Path(config.trial_dir)
        try:
            carry_out(args, config, merged, mode, stop)
        except Stopped as stopped:
            print(f"stopped by {stopped}; {told(folder)}", file=sys.stderr)
            return stop.status
    return 0


def carry_out(args: argparse.Namespace, config: Any, merged: Any, mode: str, stop: Any) -> None:
    """Do in the run's folder, which is there, what `mode` says."""
    from dreamcatalyst.errors import ConfigError
    from dreamcatalyst.resume import compare, contents, read_checkpoint, recipe
    from dreamcatalyst.runs import told
    from dreamcatalyst.train.first_fit import FirstFit
    from dreamcatalyst.train.keeper import Checkpoints, Keeper
    from dreamcatalyst.train.progress import Progress
    from dreamcatalyst.trainer import checkpoint_minutes, make_trainer, misconfiguration, quiet

    if not args.verbose:
        quiet()
    progress = Progress()
    log = listen(progress, args.verbose)

    minutes, training = checkpoint_minutes(config), mode == "train"
    parts = classes(config)
    first = FirstFit.of(config, parts, FIT)
    if first is not None:  # as if it had been given
        config.system["gs_source"] = str(first.result)
    made_by = recipe(config, parts)
    saved = read_checkpoint(config.resume, to_train=training) if config.resume else None
    if saved and training:
        compare(saved, made_by, config.resume)
    checkpoints = Checkpoints({"recipe": made_by})
    keeper = Keeper(stop, checkpoints, Path(config.trial_dir) / "ckpts", minutes)
    trainer = make_trainer(config, [progress, keeper], checkpoints, training)
    data, system = build(config, parts, first.data if first else None)
    if first is not None:
        if not (went := first.told):
            system.to(trainer.strategy.root_device).look_ahead(data)
            went = fit_first(first, args, stop)
            listen(progress, args.verbose)
        log.info(first.text(went))
    checkpoints.made_by["contents"] = contents(made_by) if training else {}
    log.info(f"{mode}: {config.trial_dir}")
    try:
        if training:
            snapshot(config, merged, args.config)
            if not trainer.fast_dev_run:
                trainer.loggers = [*trainer.loggers, *system.get_loggers()]
            if getattr(system, "takes_steps", True):
                trainer.fit(system, datamodule=data, ckpt_path=config.resume)
                if keeper.began is None or trainer.global_step <= keeper.began:
                    ended = "an option ended the run before (max_epochs, max_time?)."
                    raise ConfigError(f"trainer: no step was taken: {ended}")
            trainer.test(system, datamodule=data, verbose=args.verbose)
        elif mode == "preview":
            preview(system, data, trainer)
        else:
            if saved:
                system.set_resume_status(saved["epoch"], saved["global_step"])
            stage = {"validate": trainer.validate, "test": trainer.test, "export": trainer.predict}[mode]
            table = {} if mode == "export" else {"verbose": args.verbose}  # Lightning's own table of scores
            stage(system, datamodule=data, ckpt_path=config.resume, **table)
    except misconfiguration() as error:  # an option that this system's kind of training cannot have
        raise ConfigError(f"trainer: {error}") from error
    except Exception:
        if keeper.began is not None:
            log.info(f"stopped by an error; {told(Path(config.trial_dir))}")
        raise


def fit_first(first: Any, args: argparse.Namespace, stop: Any) -> dict[str, Any]:
    """Carry out the fit that an edit begins with, or go on with it, or wait for the process that is at it; how it
    went."""
    from dreamcatalyst import plugin
    from dreamcatalyst.config import read_config
    from dreamcatalyst.kept import alone
    from dreamcatalyst.runs import claimed
    from dreamcatalyst.signals import Stopped

    with alone(first.folder, lambda: plugin.info("another process fits these photographs: waiting for it")):
        if told := first.told:
            return told
        step = first.begin()
        where = f"goes on from step {step:,} of {first.steps:,}" if step else "comes first: no splats are given"
        plugin.info(f"the fit of splats to the photographs of {first.source} {where}")
        mode = "train" if step < first.steps else "test"
        with claimed(read_config(first.merged), numbered=False, writes=True) as config:
            try:
                carry_out(argparse.Namespace(config=FIT, verbose=args.verbose), config, first.merged, mode, stop)
            except Stopped:
                plugin.info("the fit so far is kept: the same command goes on with it")
                raise
        first.finish()
    return first.told


def classes(config: Any) -> dict[str, type]:
    """The classes of data module and system, by their registered names; both sections are validated."""
    from dreamcatalyst import plugin
    from dreamcatalyst.config import check
    from dreamcatalyst.errors import ConfigError, choose

    found = {}
    for key, base in (("data", plugin.pl.LightningDataModule), ("system", plugin.BaseSystem)):
        name, names = getattr(config, f"{key}_type"), plugin.names()
        if name not in names:
            choose(key, name, [other for other in names if other.endswith(f"-{key}")], f"{key}_type")
        found[key] = plugin.find(name)
        if not issubclass(found[key], base):
            raise ConfigError(f"{key}_type: '{name}' is registered, but is no {base.__name__}.")
        check(found[key], getattr(config, key), key)
    exported(config)
    return found


def exported(config: Any) -> Any:
    """The parsed section `export`."""
    from dreamcatalyst.train.export import read_export

    return read_export(config.export)


def listen(progress: Any, verbose: bool) -> logging.Logger:
    """What is logged, above the line of `progress`."""
    from dreamcatalyst.train.progress import AboveTheLine

    log = logging.getLogger("dreamcatalyst")
    log.handlers = [AboveTheLine(progress)]
    log.setLevel(logging.DEBUG if verbose else logging.INFO)
    return log


def build(config: Any, parts: dict[str, type], data: Any = None) -> tuple[Any, Any]:
    """The data module, where it is not there already, and the system. parts: their classes."""
    from dreamcatalyst import plugin
    from dreamcatalyst.errors import ConfigError

    try:
        plugin.pl.seed_everything(config.seed, workers=True)
    except ValueError as error:
        raise ConfigError(f"seed: {error}.") from error
    data = data or parts["data"](config.data)
    system = parts["system"](config.system, resumed=config.resume is not None)
    system.set_save_dir(str(Path(config.trial_dir) / "save"))
    system.exported_as = exported(config)
    return data, system


def preview(system: Any, data: Any, trainer: Any) -> None:
    """Let the system show one edit, on the device that the trainer chose."""
    from dreamcatalyst.errors import ConfigError

    if not hasattr(system, "preview"):
        raise ConfigError(f"--preview: {type(system).__name__} has none; it is there for systems that edit.")
    for path in system.to(trainer.strategy.root_device).preview(data):
        print(path)


def snapshot(config: Any, merged: Any, source: str) -> None:
    """Leave in the trial's folder what made it: the config as parsed and as written (an overlay whole: its base is
    named from where it lies), and the commands."""
    from dreamcatalyst.config import merge_open, save_config
    from dreamcatalyst.files import write_bytes, write_text
    from omegaconf import OmegaConf

    folder = Path(config.trial_dir)
    raw, commands = folder / "configs" / "raw.yaml", folder / "cmd.txt"
    if not raw.exists() or not raw.samefile(source):
        overlay = "base" in OmegaConf.load(source)
        write_bytes(raw, OmegaConf.to_yaml(merge_open(source)).encode() if overlay else Path(source).read_bytes())
    save_config(config, folder / "configs" / "parsed.yaml", merged)
    before = commands.read_text(encoding="utf-8") if commands.exists() else ""
    write_text(commands, f"{before}{shlex.join(['python', *sys.argv])}\n")


def end_by_ctrl_c() -> None:
    """Have Ctrl-C end this process without a traceback wherever `main` does not take it: while Python starts and ends.
    Where whoever started us has us ignore it, it stays ignored."""
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    end_by_ctrl_c()
    sys.exit(main())
