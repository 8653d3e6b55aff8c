"""What stands in for threestudio's base classes where this project runs alone, on `lightning`. Only plugin.py, which
chooses between the host and this file, imports it.

The classes keep the host's contract: constructor, order of calls, names. Parts that nothing of ours uses are left out.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.loggers import Logger, WandbLogger
from omegaconf import DictConfig, OmegaConf

from .config import value
from .errors import ConfigError
from .files import try_each

logger = logging.getLogger("dreamcatalyst")
info, warn = logger.info, logger.warning


def parse_structured(cls: type, cfg: Any) -> DictConfig:
    """`cfg` as a typed DictConfig of the dataclass `cls`. As in the host, containers of a DictConfig pass unchecked
    (so a schedule may stand in a float field); `config.check` is the thorough test, and names the place."""
    return OmegaConf.structured(cls(**cfg))


class BaseObject:
    """A configured part that is no torch module, so that its weights stay out of checkpoints."""

    @dataclass
    class Config:
        pass

    cfg: Any

    def __init__(self, cfg: Any = None, *args: Any, **kwargs: Any):
        self.cfg = parse_structured(self.Config, cfg or {})
        self.device = torch.get_default_device()
        self.configure(*args, **kwargs)

    def configure(self, *args: Any, **kwargs: Any) -> None:
        """Build what the part needs; gets the constructor's remaining arguments."""


class BaseSystem(LightningModule):
    """A LightningModule with a config and a save folder.

    Order: configure, post_configure | set_save_dir | Lightning's hooks. The host's update hooks (preprocess_data,
    update_step) are left out: no system of ours has any.
    """

    @dataclass
    class Config:
        loggers: dict = field(default_factory=dict)
        loss: dict = field(default_factory=dict)
        optimizer: dict = field(default_factory=dict)
        scheduler: dict | None = None
        weights: str | None = None  # keys of the host's that nothing of ours can follow; train/base.py refuses them
        weights_ignore_modules: list[str] | None = None
        cleanup_after_validation_step: bool = False
        cleanup_after_test_step: bool = False

    cfg: Any

    def __init__(self, cfg: Any, resumed: bool = False):
        super().__init__()
        self.cfg = parse_structured(self.Config, cfg)
        self._save_dir: str | None = None
        self._resumed, self._resumed_at = resumed, None
        self._loggers = self._make_loggers()
        self.configure()
        self.post_configure()

    def configure(self) -> None:
        """Build the parts. There is no save folder yet."""

    def post_configure(self) -> None:
        """Called when the parts are built and hold their first weights."""

    # --- where the run stands

    @property
    def resumed(self) -> bool:
        return self._resumed

    def set_resume_status(self, current_epoch: int, global_step: int) -> None:
        """Validation, test and export count as taking place at the checkpoint's epoch and step."""
        self._resumed_at = (current_epoch, global_step)

    @property
    def true_current_epoch(self) -> int:
        return self._resumed_at[0] if self._resumed_at else self.current_epoch

    @property
    def true_global_step(self) -> int:
        return self._resumed_at[1] if self._resumed_at else self.global_step

    def C(self, scalar: Any, interpolation: str = "linear") -> float:
        """The value of a number or schedule at this moment."""
        return value(scalar, self.true_current_epoch, self.true_global_step, interpolation)

    # --- files

    def set_save_dir(self, save_dir: str) -> None:
        self._save_dir = save_dir

    def get_save_dir(self) -> str:
        if self._save_dir is None:
            raise ValueError("Save dir is not set")
        return self._save_dir

    def get_save_path(self, filename: str) -> str:
        """The path of a file under the save folder; its folders are made."""
        path = Path(self.get_save_dir()) / filename
        path.parent.mkdir(parents=True, exist_ok=True)
        return str(path)

    def _make_loggers(self) -> list[Logger]:
        wandb = self.cfg.loggers.get("wandb") or {}
        if not wandb.get("enable"):
            return []
        try:
            return [WandbLogger(project=wandb.get("project"), name=wandb.get("name"))]
        except ModuleNotFoundError as error:
            raise ConfigError("system.loggers.wandb.enable: wandb is not installed: pip install wandb.") from error

    def get_loggers(self) -> list[Logger]:
        return self._loggers

    # --- what our launcher asks for, and the host does not

    def progress_metrics(self) -> dict[str, float]:
        """What the progress line shows of the last step, such as {"loss": 0.1, "splats": 20000}."""
        return {}

    def cost(self, step: int) -> float:
        """What a step costs, as a multiple of what others do; the time that is left is told by it."""
        return 1.0

    def keep_result(self) -> None:
        """Write, after the last step, what would be missed most; the checkpoint comes after it."""

    def savers(self) -> list[Callable[[], Any]]:
        """What writes the state of the moment, what would be missed most first: here a checkpoint to resume from."""
        checkpoint = Path(self.get_save_dir()).parent / "ckpts" / "last.ckpt"
        return [lambda: self.trainer.save_checkpoint(checkpoint)]

    def save_now(self) -> None:
        """Write what an interrupted run should leave. Raises FileError where a part of it cannot be written; all others
        have been tried then."""
        try_each(self.savers())

    # --- after a batch

    def on_validation_batch_end(self, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        if self.cfg.cleanup_after_validation_step:
            gc.collect()

    def on_test_batch_end(self, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        if self.cfg.cleanup_after_test_step:
            gc.collect()
