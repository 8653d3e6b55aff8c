"""Lightning's Trainer as our launcher uses it, and what it says about wrong options in our words."""

from __future__ import annotations

import inspect
import logging
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from . import plugin
from .config import ExperimentConfig, known_keys
from .errors import ConfigError, unknown

MINUTES = 3  # of training between two checkpoints, where checkpoint.minutes says nothing else
SINGLE = ("auto", "single_device")  # strategies of one process


def keys_below(merged: Any) -> list[str]:
    """The dotted keys that the sections of a config take, whatever is wrong with it otherwise."""
    names = {section: merged.get(f"{section}_type") for section in ("data", "system")}
    known = plugin.names()
    found = [key for where, name in names.items() if name in known for key in known_keys(plugin.find(name), where)]
    options = {"trainer": plugin.pl.Trainer, "checkpoint": plugin.pl.callbacks.ModelCheckpoint}
    return found + [f"{where}.{key}" for where, cls in options.items() for key in inspect.signature(cls).parameters]


def checkpoint_minutes(config: ExperimentConfig) -> float:
    """Minutes of training between two checkpoints, 0 for none but those at the steps that the config names."""
    minutes = config.checkpoint.get("minutes", MINUTES)
    if isinstance(minutes, bool) or not isinstance(minutes, (int, float)) or not 0 <= minutes < float("inf"):
        raise ConfigError(f"checkpoint.minutes: got {minutes!r}, expected minutes between two checkpoints; 0: none.")
    return minutes


def make_trainer(config: ExperimentConfig, callbacks: list[Any], checkpoints: Any, training: bool) -> Any:
    """Lightning's Trainer, on one GPU where there is one and else on the CPU; `trainer` in the YAML overrides.
    callbacks: the progress bar first. checkpoints: the CheckpointIO. Raises ConfigError."""
    pl = plugin.pl
    options = {
        "accelerator": "gpu" if pl.accelerators.CUDAAccelerator.is_available() else "cpu",
        "devices": 1,
        "inference_mode": False,
        "logger": training,
        "enable_model_summary": False,
        "enable_checkpointing": training,
        "default_root_dir": config.trial_dir,
        **known_options(pl.Trainer, config.trainer, "trainer"),
    }
    if not options.get("enable_progress_bar", True):
        callbacks = callbacks[1:]
    if training and options["logger"] is True:
        options["logger"] = pl.loggers.CSVLogger(config.trial_dir, name="csv_logs")
    options["plugins"] = [*(options.get("plugins") or []), checkpoints]
    _check(options, training)
    where = "trainer"  # the section that is to blame
    try:
        if training and options["enable_checkpointing"]:
            checkpoint = known_options(pl.callbacks.ModelCheckpoint, config.checkpoint, "checkpoint", {"minutes"})
            # Without a counter, last.ckpt is the last one in a resumed run too.
            ours = {"dirpath": Path(config.trial_dir) / "ckpts", "enable_version_counter": False}
            where = "checkpoint"
            callbacks = [*callbacks, pl.callbacks.ModelCheckpoint(**ours | checkpoint)]
            where = "trainer"
        trainer = pl.Trainer(callbacks=callbacks, **options)
    except (misconfiguration(), ValueError, TypeError, ImportError) as error:
        raise ConfigError(f"{where}: {' '.join(str(error).split())}") from error
    if trainer.world_size > 1:
        raise ConfigError(f"trainer: asks for {trainer.world_size} processes, expected one: set trainer.devices=1.")
    return trainer


def _check(options: dict[str, Any], training: bool) -> None:
    """Raise ConfigError for options of the Trainer that Lightning takes and no run here can have."""
    if options.get("strategy", "auto") not in SINGLE:
        raise ConfigError(f"trainer.strategy: got '{options['strategy']}', expected auto: a run is one process.")
    ends = {"limit_train_batches": (None, 1.0), "overfit_batches": (None, 0, 0.0)}  # 1 is one batch, 1.0 is all of them
    for name, whole in ends.items() if training else ():
        if not any(options.get(name) == value and type(options.get(name)) is type(value) for value in whole):
            raise ConfigError(f"trainer.{name}: leave it out: what ends a run is trainer.max_steps alone.")
    interval = options.get("val_check_interval")
    if isinstance(interval, (int, float)) and not interval > 0:
        raise ConfigError(
            f"trainer.val_check_interval: got {interval}, expected steps between two validations, over 0."
        )


def known_options(cls: type, section: Any, where: str, ours: Collection[str] = ()) -> dict[str, Any]:
    """A section of the YAML as keyword arguments for `cls`, without keys that are `ours`. Raises ConfigError for one
    that it does not take."""
    known = [name for name in inspect.signature(cls).parameters if name not in ("callbacks", "kwargs")]
    for key in section:
        if key not in known and key not in ours:
            raise ConfigError(unknown("key", key, {*known, *ours}, where))
    plain: Any = OmegaConf.to_container(OmegaConf.create(section))
    return {key: value for key, value in plain.items() if key not in ours}


def misconfiguration() -> type[Exception]:
    """What Lightning raises for an option that a system's kind of training cannot have."""
    return plugin.pl.utilities.exceptions.MisconfigurationException


def quiet() -> None:
    """Silence what Lightning says about itself and its user cannot act on."""
    _ = plugin.pl  # whose import sets its loggers up
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module=r"lightning\.")
