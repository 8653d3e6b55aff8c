"""Typed configs: what a YAML may say, and the run that it describes."""

from .experiment import ExperimentConfig
from .merge import merge_config, merge_open, missing_keys, read_yaml
from .parse import check, known_keys, parse
from .read import load_config, read_config, save_config
from .schedules import corners, largest, value
from .types import (
    AtLeastOne,
    BelowOne,
    Between,
    Colour,
    Count,
    DdimSteps,
    Fraction,
    Integer,
    NonNegative,
    Number,
    Positive,
    PositiveFraction,
    Range,
    Rate,
    Scalar,
    Seed,
    Side,
)

__all__ = [
    "AtLeastOne",
    "BelowOne",
    "Between",
    "Colour",
    "Count",
    "DdimSteps",
    "ExperimentConfig",
    "Fraction",
    "Integer",
    "NonNegative",
    "Number",
    "Positive",
    "PositiveFraction",
    "Range",
    "Rate",
    "Scalar",
    "Seed",
    "Side",
    "check",
    "corners",
    "known_keys",
    "largest",
    "load_config",
    "merge_config",
    "merge_open",
    "missing_keys",
    "parse",
    "read_config",
    "read_yaml",
    "save_config",
    "value",
]
