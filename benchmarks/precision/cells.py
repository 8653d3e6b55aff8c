"""What is run, and in which order: a cell is one run of one method on one edit with one seed.

Nothing here runs anything. `lookup` says what is known of a cell, so that the same code plans, goes on and reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean
from typing import Any

from .search import RATE, SCALE, Point, best, propose

ROWS = 16  # rows of a run's error.csv, about
TUNING_LENGTH = 0.5  # of a high-quality run: what a trial takes
GUIDANCE, RATES = "system.guidance.", ("means", "quats", "scales", "opacities", "sh0", "shN")
Row = Mapping[str, Any]  # what is known of a finished cell (runner.py)


@dataclass(frozen=True)
class Family:
    """A rule as its authors publish it. settings: of the guidance. neural: further overrides on a learned prior."""

    settings: tuple[str, ...]
    neural: tuple[str, ...] = ()


# FreeU is DreamCatalyst's; the others are published without. Uniform levels have the limits of their papers.
PLAIN = "system.guidance.prior.freeu.mode=none"
UNIFORM = (PLAIN, "system.guidance.min_step_percent=0.02", "system.guidance.max_step_percent=0.98")
FAMILIES: dict[str, Family] = {
    "dreamcatalyst": Family(("rule=dreamcatalyst", "timesteps=decreasing")),
    "pds": Family(("rule=pds", "timesteps=uniform"), UNIFORM),
    "in2n": Family(
        ("rule=in2n",),  # its loss is an L1 of pictures, of weight 10 in GaussianEditor
        (PLAIN, "system.guidance.reduction=mean", "system.loss.lambda_guidance=10"),
    ),
    "dds": Family(("rule=dds", "timesteps=uniform"), UNIFORM),
    "dreamcatalyst-psi2": Family(("rule=dreamcatalyst-psi2", "timesteps=decreasing")),
    "dreamcatalyst-psi3": Family(("rule=dreamcatalyst-psi3", "timesteps=decreasing")),
    "csd-like": Family(("rule=csd-like", "timesteps=decreasing")),
    "pds-decreasing": Family(("rule=pds", "timesteps=decreasing"), (PLAIN,)),
    "pds-implicit": Family(("rule=pds", "timesteps=uniform", "implicit_step=10"), UNIFORM),  # docs/distillation.md
    "sds": Family(("rule=sds", "timesteps=uniform"), UNIFORM),
    "known-edit": Family(("rule=known-edit",)),  # no method: what could be reached
}


@dataclass(frozen=True)
class Method:
    """A family at a length. mode: whose steps the config says; length: times those; tier: the lower, the earlier."""

    name: str
    family: str
    mode: str = "high-quality"
    length: float = 1.0
    tier: int = 0


METHODS = (
    Method("dreamcatalyst fast", "dreamcatalyst", "fast"),
    Method("dreamcatalyst", "dreamcatalyst"),
    Method("pds", "pds"),
    Method("in2n", "in2n"),
    Method("dds", "dds"),
    Method("known-edit", "known-edit"),
    Method("pds long", "pds", length=3.0, tier=1),
    Method("in2n long", "in2n", length=3.0, tier=1),
    Method("pds-decreasing", "pds-decreasing", tier=2),
    Method("dreamcatalyst-psi2", "dreamcatalyst-psi2", tier=2),
    Method("dreamcatalyst-psi3", "dreamcatalyst-psi3", tier=2),
    Method("csd-like", "csd-like", tier=2),
    Method("pds-implicit", "pds-implicit", tier=2),
    Method("sds", "sds", tier=2),
    Method("dreamcatalyst-psi2 fast", "dreamcatalyst-psi2", "fast", tier=2),
    Method("dreamcatalyst-psi3 fast", "dreamcatalyst-psi3", "fast", tier=2),
)

FREEU, ANCHOR, DENSIFY, MASK = f"{GUIDANCE}prior.freeu", "system.anchor.kind", "system.densify.every", "system.mask"


def freeu(b: float, s1: float = 1.0, s2: float = 1.0) -> tuple[str, ...]:
    """FreeU with these factors: b of the backbone, s1 and s2 of the skips' low frequencies."""
    return (f"{FREEU}.mode=paper", f"{FREEU}.b1={b}", f"{FREEU}.b2={b}", f"{FREEU}.s1={s1}", f"{FREEU}.s2={s2}")


ABLATIONS: dict[str, tuple[str, ...]] = {  # of dreamcatalyst; all say what they are, whatever the config's own is
    "FreeU b = 1.0": (f"{FREEU}.mode=none",),
    "FreeU b = 1.1": freeu(1.1),
    "FreeU b = 1.3": freeu(1.3),
    "FreeU b = 1.1, skips 0.9, 0.2": freeu(1.1, 0.9, 0.2),  # the paper's factors
    "FreeU b = 1.3, skips 0.9, 0.2": freeu(1.3, 0.9, 0.2),
    "alternating noise": (f"{GUIDANCE}noise=alternating",),
    "anchors and densification": (f"{ANCHOR}=last-densify", "system.anchor.form=loss"),
    "proximal anchors and densification": (f"{ANCHOR}=last-densify", "system.anchor.form=proximal"),
    "no anchors, densification": (f"{ANCHOR}=none",),
    "anchors, no densification": (f"{ANCHOR}=last-densify", "system.anchor.form=loss", f"{DENSIFY}=0"),
    "no anchors, no densification": (f"{ANCHOR}=none", f"{DENSIFY}=0"),
    "mask by relevance": (f"{MASK}.kind=relevance",),
    "no mask": (f"{MASK}.kind=none",),
}


@dataclass(frozen=True)
class Case:
    """An edit. name: of its files. overrides: which scene, at what size."""

    name: str
    instruction: str
    overrides: tuple[str, ...]
    ablated: bool = False


@dataclass(frozen=True)
class Bench:
    """A prior with its edits. name: of its files; title: for readers; config: a YAML; values: what stands in it;
    length: of all runs, times the config's steps; scales: the guidance scale of each family where it is known
    beforehand, else it is searched."""

    name: str
    title: str
    config: str
    values: Mapping[str, Any]
    families: tuple[str, ...]
    cases: tuple[Case, ...]
    tuned_on: tuple[Case, ...]
    length: float = 1.0
    overrides: tuple[str, ...] = ()
    scales: Mapping[str, float] = field(default_factory=dict)

    @property
    def learned(self) -> bool:
        """Whether the prior is a network, which needs its scale searched and has a FreeU to take off."""
        return not self.scales


@dataclass(frozen=True)
class Settings:
    """The whole table. trials: of each family's search, two fewer where only the rates are searched."""

    benches: tuple[Bench, ...]
    methods: tuple[Method, ...] = METHODS
    seeds: tuple[int, ...] = (0, 1, 2)
    trials: int = 5
    ablations: bool = True


@dataclass(frozen=True)
class Cell:
    """One run. group: tuning | methods | ablations; label: method, ablation, or family with the point that is tried."""

    group: str
    bench: str
    case: str
    label: str
    seed: int
    config: str
    overrides: tuple[str, ...]


Lookup = Callable[[Cell], Row | None]


def number(value: float) -> str:
    """A number for the command line, without a tail of digits."""
    return f"{value:.6g}"


def scaled(rate: float | Sequence[float], factor: float, steps: int) -> str:
    """A learning rate times `factor`; a schedule [first step, from, to, last step] goes over a run of `steps`."""
    if isinstance(rate, Sequence):
        return f"[{rate[0]},{number(rate[1] * factor)},{number(rate[2] * factor)},{steps}]"
    return number(rate * factor)


def adjusted(bench: Bench, family: str, mode: str, length: float, point: Point) -> tuple[str, ...]:
    """The overrides of a family at one point of the search, for `length` times the mode's steps."""
    system, chosen = bench.values["system"], FAMILIES[family]
    steps = max(round(system["steps"][mode] * bench.length * length), 1)
    out = [f"{GUIDANCE}{setting}" for setting in chosen.settings] + list(chosen.neural if bench.learned else ())
    if bench.learned:
        scale = system["guidance"]["guidance_scale"] * SCALE ** point[1]
    else:
        scale = bench.scales[family]
    out += [f"{GUIDANCE}guidance_scale={number(scale)}"]
    out += [f"system.mode={mode}", f"trainer.max_steps={steps}", f"system.report.every={max(steps // ROWS, 1)}"]
    rates = system["learning_rates"]
    if point[0]:
        factor, known = RATE ** point[0], [key for key in RATES if key in rates]
        out += [f"system.learning_rates.{key}={scaled(rates[key], factor, steps)}" for key in known]
    if rates.get("warm_up_steps"):
        out.append(f"system.learning_rates.warm_up_steps={round(rates['warm_up_steps'] * bench.length)}")
    every = {key: system["densify"].get(key, 0) for key in ("every", "start", "stop")}
    out += [f"system.densify.{key}={max(round(value * bench.length), 1)}" for key, value in every.items() if value]
    return tuple(out)


def make_cell(group: str, bench: Bench, case: Case, label: str, seed: int, overrides: Sequence[str]) -> Cell:
    """A cell with everything that its command line says."""
    words = f"system.prompt_processor.prompt={case.instruction}"
    everything = (*bench.overrides, *case.overrides, words, *overrides, f"seed={seed}", f"data.seed={seed}")
    return Cell(group, bench.name, case.name, label, seed, bench.config, everything)


# --- the search


def trial_cells(bench: Bench, family: str, point: Point) -> list[Cell]:
    """The runs of one trial, one on each scene that methods are tuned on."""
    overrides = adjusted(bench, family, "high-quality", TUNING_LENGTH, point)
    label = f"{family} {point[0]:+d} {point[1]:+d}"
    return [make_cell("tuning", bench, case, label, 0, overrides) for case in bench.tuned_on]


def trials_of(settings: Settings, bench: Bench) -> int:
    """Trials per family."""
    return settings.trials if bench.learned else max(settings.trials - 2, 0)


def searched(settings: Settings, bench: Bench, family: str, lookup: Lookup) -> tuple[dict[Point, float], Point | None]:
    """The points whose runs are all there, with their scores, and the point to be tried next (None: done)."""
    tried: dict[Point, float] = {}
    while (point := propose(tried, trials_of(settings, bench), 2 if bench.learned else 1)) is not None:
        rows = [lookup(cell) for cell in trial_cells(bench, family, point)]
        if None in rows:
            return tried, point
        tried[point] = mean(score(row) for row in rows)
    return tried, None


def score(row: Row) -> float:
    """What a run ends with, dB; -inf for one that did not come to its end."""
    return -math.inf if row.get("failed") else row["error"][-1]


def tuning_cells(settings: Settings, families: Sequence[str], lookup: Lookup) -> Iterator[Cell]:
    """The trials of `families` that are still to be run, in turn."""
    for turn in range(settings.trials):
        for bench in settings.benches:
            for family in bench.families:
                tried, point = searched(settings, bench, family, lookup)
                if family in families and point is not None and len(tried) == turn:  # who is behind catches up first
                    yield from trial_cells(bench, family, point)


# --- the table


def method_cells(settings: Settings, methods: Sequence[Method], seed: int, lookup: Lookup) -> Iterator[Cell]:
    """Every one of `methods` that is tuned on every edit, once."""
    for bench, case in cases_in_turn(settings):
        for method in methods:
            if (point := tuned(settings, bench, method.family, lookup)) is not None:
                overrides = adjusted(bench, method.family, method.mode, method.length, point)
                yield make_cell("methods", bench, case, method.name, seed, overrides)


def ablation_cells(settings: Settings, seed: int, lookup: Lookup) -> Iterator[Cell]:
    """Every ablation, once."""
    for bench, case in cases_in_turn(settings) if settings.ablations else ():
        if case.ablated and (point := tuned(settings, bench, "dreamcatalyst", lookup)) is not None:
            base = adjusted(bench, "dreamcatalyst", "high-quality", 1.0, point)
            for name, overrides in ABLATIONS.items():
                yield make_cell("ablations", bench, case, name, seed, (*base, *overrides))


def tuned(settings: Settings, bench: Bench, family: str, lookup: Lookup) -> Point | None:
    """What the search of a family came to; None where it is not at its end, or the bench has no such family."""
    if family not in bench.families:
        return None
    tried, missing = searched(settings, bench, family, lookup)
    return best(tried) if missing is None else None


def cases_in_turn(settings: Settings) -> list[tuple[Bench, Case]]:
    """The edits, those of all benches in turn."""
    placed = [(number, bench, case) for bench in settings.benches for number, case in enumerate(bench.cases)]
    return [(bench, case) for _, bench, case in sorted(placed, key=lambda place: place[0])]


def remaining(settings: Settings, lookup: Lookup) -> Iterator[Cell]:
    """What is still to be run, in order: tier by tier, its tuning first; then ablations; then the same with the further
    seeds. Each cell is to be run before the next one is asked for: what follows depends on what came out."""

    def everything() -> Iterator[Cell]:
        for seed in settings.seeds:
            for tier in sorted({method.tier for method in settings.methods}):
                methods = [method for method in settings.methods if method.tier == tier]
                yield from tuning_cells(settings, [method.family for method in methods], lookup)
                yield from method_cells(settings, methods, seed, lookup)
            yield from ablation_cells(settings, seed, lookup)

    return (cell for cell in everything() if lookup(cell) is None)


def finished(settings: Settings, lookup: Lookup) -> list[tuple[Cell, Row]]:
    """Everything that was run."""
    cells = []
    for bench in settings.benches:
        for family in bench.families:
            for point in searched(settings, bench, family, lookup)[0]:
                cells += trial_cells(bench, family, point)
    for seed in settings.seeds:
        cells += method_cells(settings, settings.methods, seed, lookup)
        cells += ablation_cells(settings, seed, lookup)
    return [(cell, row) for cell in cells if (row := lookup(cell)) is not None]


def planned(settings: Settings) -> dict[str, int]:
    """How many cells there are in each group, of the tuning at most."""
    out = {"tuning": 0, "methods": 0, "ablations": 0}
    for bench in settings.benches:
        known = [method for method in settings.methods if method.family in bench.families]
        out["tuning"] += trials_of(settings, bench) * len(bench.families) * len(bench.tuned_on)
        out["methods"] += len(known) * len(bench.cases) * len(settings.seeds)
        if settings.ablations:
            out["ablations"] += len(ABLATIONS) * sum(case.ablated for case in bench.cases) * len(settings.seeds)
    return out


def affordable(elapsed: float, budget: float, earlier: Sequence[float]) -> bool:
    """Whether a run may begin `elapsed` seconds into a call. earlier: seconds of comparable runs, if any."""
    return elapsed + (mean(earlier) if earlier else 0.0) <= budget
