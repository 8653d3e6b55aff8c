"""docs/error-vs-time.md: what is generated is written anew between two marks, and all around it is left alone."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dreamcatalyst.report.chart import line_chart, picture_file

from .cells import Bench, Cell, Lookup, Row, Settings, finished
from .curves import Track
from .tables import (
    FAST,
    HIGH,
    ablation_table,
    case_table,
    claims_table,
    ratio_table,
    run_table,
    tracks_of,
    tuning_table,
)

BEGIN, END = (
    "<!-- generated: --write replaces everything down to the next mark -->",
    "<!-- end of what is generated -->",
)
NEW = f"""# Error against run time

`python benchmarks/error_vs_time.py --write` runs what its budget allows (90 minutes; a further call goes on) and writes
tables and plots here, between two marks.

## What holds of the paper's claims here

## How it is measured

A run is one call of the launcher on `configs/dc-ge.yaml` (edits of a synthetic scene, by the small model shipped)
or `configs/closed-form.yaml` (a real capture, on a prior that is exact). All rules share scene, mask, anchors,
densification and length, and begin their search at the same rates (of colours on synthetic scenes: from 0.15 down to
0.01); decreasing noise goes from 0.98 to 0.35 of T there. FreeU is DreamCatalyst's and CSD-like's. "fast" and the
others are the config's modes, "long" is three times as long as high quality.

- **Error**: PSNR at held-out views to the truth (of an object's edit: where the object is, before or after), on the
  closed form to the known edit T(I). "outside": PSNR to the source where nothing should change.
- **Seconds**: of training, without loading, the mask, and the reports themselves.
- **Time to an error**: when the median over the seeds first reaches it. The three errors of a table lie a half, three
  quarters and nine tenths of the way from the unedited scene to the best end of all.
- **Time to the same error**: how long a method takes to come within 0.1 dB of what DreamCatalyst ends with, in units of
  the time that DreamCatalyst takes to come there; the fastest of a method's lengths counts. "> 4": it never did, in a
  run that was four times as long.
- **No straw men**: each rule's learning rates (times one factor) and guidance scale come from a pattern search of as
  many trials on other edits of other worlds, in runs of half the length. On the closed form the scale is the one whose
  fixed point is T(I), on one prior for all (its spread lets DreamCatalyst rest there at the paper's 7.5), so that only
  convergence is compared; rates are searched there, too.
- **At the paper's numbers of steps**: its steps times the cost of a step here, in the second half of a run.

## Measured

{BEGIN}
{END}
"""
PANELS = {  # of an edit's plot: as many lines as there are colours
    "methods": (FAST, HIGH, "pds", "pds-decreasing", "dds", "in2n"),
    "variants": (HIGH, "dreamcatalyst-psi2", "dreamcatalyst-psi3", "csd-like", "sds", "known-edit"),
    "three times as long": (HIGH, "pds long", "in2n long"),
    "identity term explicit or implicit": ("pds", "pds-implicit"),
    "anchors": ("anchors and densification", "proximal anchors and densification", "no anchors, densification"),
}
PDS = ("pds", "pds-decreasing", "pds-implicit")
OTHERS = (*PDS, "dds", "sds", "csd-like", "in2n", "dreamcatalyst-psi2", "dreamcatalyst-psi3")


def plot(tracks: Mapping[str, Track | None]) -> str:
    """Error against seconds of methods and ablations on one edit as an SVG: medians, and bands from the lowest to the
    highest seed."""
    charts = []
    for name, labels in PANELS.items():
        there = {label: curve for label in labels if (curve := tracks.get(label)) is not None}
        bands = {
            label: tuple(list(zip(curve.seconds, edge, strict=True)) for edge in (curve.low, curve.high))
            for label, curve in there.items()
            if curve.runs > 1
        }
        if set(there) - {HIGH}:
            lines = {label: curve.points for label, curve in there.items()}
            charts.append(line_chart(f"{name}: PSNR at held-out views, dB", lines, bands=bands))
    return picture_file(charts)


def bench_parts(settings: Settings, bench: Bench, entries: Sequence[tuple[Cell, Row]], path: Path) -> list[str]:
    """The sections of one bench; its plots are written beside `path`."""
    tracks, ablations = (tracks_of(entries, group, bench.name) for group in ("methods", "ablations"))
    parts = [f"### {bench.title}"]
    instructions = {case.name: case.instruction for case in bench.cases}
    for case, methods in tracks.items():
        if any(methods.values()):
            file = path.with_name(f"{path.stem}-{bench.name}-{case}.svg")
            file.write_text(plot({**methods, **ablations.get(case, {})}), encoding="utf-8")
            parts += [f"**{instructions[case]}**", f"![PSNR against seconds]({file.name})", case_table(methods)]
    if any(set(methods) - {HIGH, FAST} for methods in tracks.values()):
        parts += ["**Time to the same error**, in units of DreamCatalyst's:", ratio_table(tracks, OTHERS)]
        parts += ["**The paper's claims:**", claims_table(tracks)]
    if ablations:
        parts += ["**Ablations:**", ablation_table(ablations)]
    return parts if len(parts) > 1 else []


def generated(settings: Settings, lookup: Lookup, left_out: Sequence[str], path: Path) -> str:
    """Everything between the marks."""
    entries = finished(settings, lookup)
    parts = [run_table(settings, entries)]
    parts += [f"Left out: {reason}." for reason in left_out]
    machines = {tuple(row["machine"].items()): row["versions"] for _, row in entries if "machine" in row}
    for machine, versions in machines.items():
        parts += [", ".join(f"{name} {value}" for name, value in (*machine, *versions.items())) + "."]
    for bench in settings.benches:
        parts += bench_parts(settings, bench, entries, path)
    if settings.trials:
        for bench in settings.benches:
            parts += [f"### What was tuned: {bench.title}", tuning_table(settings, bench, lookup)]
    return "\n\n".join(parts)


def write(path: Path, settings: Settings, lookup: Lookup, left_out: Sequence[str]) -> None:
    """Write the document; of one that is there, only what stands between the marks."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = path.read_text(encoding="utf-8") if path.exists() else NEW
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        sys.exit(f"{path}: the marks are missing. Put these two lines where tables belong:\n{BEGIN}\n{END}")
    made = generated(settings, lookup, left_out, path)
    path.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{after}", encoding="utf-8")
