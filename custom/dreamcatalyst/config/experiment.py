"""The keys of a whole config."""

from __future__ import annotations

from dataclasses import dataclass, field

from .types import Count, Seed


@dataclass(frozen=True)
class ExperimentConfig:
    """One run. `exp_dir`, `trial_name` and `trial_dir` are computed, and only the launcher makes the folders."""

    name: str = "default"  # the experiment's folder under exp_root_dir
    description: str = ""
    tag: str = ""  # the trial's folder is tag + timestamp
    seed: Seed = 0
    use_timestamp: bool = True
    timestamp: str | None = None  # null: the time of the start, as TIMESTAMP
    exp_root_dir: str = "outputs"
    exp_dir: str = ""
    trial_name: str = ""
    trial_dir: str = ""
    n_gpus: Count = 1
    imports: tuple[str, ...] = ()  # Python files or modules that register parts of one's own, before anything is built
    resume: str | None = None  # a checkpoint to go on from, in the trial where it lies
    data_type: str = ""
    data: dict = field(default_factory=dict)
    system_type: str = ""
    system: dict = field(default_factory=dict)
    trainer: dict = field(default_factory=dict)  # any option of lightning's Trainer
    checkpoint: dict = field(default_factory=dict)  # any option of lightning's ModelCheckpoint
    export: dict = field(default_factory=dict)  # what --export writes: train/export.py
