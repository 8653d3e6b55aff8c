"""A run's report/ folder: the table and its plot, the summary, and everything on one page."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..files import write_bytes, write_text
from .chart import line_chart, picture_file
from .curve import Curve
from .machine import machine, versions
from .metrics import METRICS
from .page import Page, Table
from .record import Record
from .run import RunFacts
from .scores import mean_scores

PICTURES = 4  # views on the page
FIT = "fit.json"  # in the folder of a fit that an edit began with: how that went
LABELS = {  # of the tiles, the best first, by score
    "psnr_truth_inside": "PSNR to the truth, where it is edited, dB",
    "psnr_truth": "PSNR to the truth, dB",
    "psnr_edit_inside": "PSNR to the known edit, inside, dB",
    "psnr_edit": "PSNR to the known edit, dB",
    "psnr_photo_inside": "PSNR to the photographs, where masks count them, dB",
    "psnr_photo": "PSNR to the photographs, dB",
    "ssim_photo": "SSIM to the photographs",
    "l1_source_outside": "drift outside of the mask, L1",
    "l1_source": "identity distance: L1 to the source",
    "consistency_short": "consistency of near views, RMSE",
    "clip_direction": "CLIP direction",
    "clip_similarity": "CLIP image similarity",
    "aesthetic": "aesthetic score",
}
CHARTS = (  # those after the metrics': title, how its columns begin, logarithmic
    ("convergence: change of the pictures per second, L1", "change_per_second", True),
    ("the rule's residual: root mean square of its gradient", "residual", True),
    ("loss", "loss", True),
    ("norms of the parameters' gradients", "norm_", True),
    ("share of each term of the loss in the gradient", "share_", False),
    ("timestep", "t", False),
    ("splats", "splats", False),
)


def plain(values: Mapping[str, float]) -> dict[str, float | None]:
    """Numbers as JSON can have them: it knows no infinity."""
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def fit_before(run: RunFacts) -> dict:
    """How the fit went that made the splats with which the run began (steps, seconds, scores), where it was made for
    such runs; else empty."""
    path = Path(str(run.settings.get("gs_source") or "")).parent.parent / FIT
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def write_report(run: RunFacts, record: Record, scores: Mapping[int, Mapping[str, float]]) -> list[Path]:
    """Write error.csv and error.svg (where there was training), index.html and summary.json, and copy how cameras were
    found (where they were: cameras.json, cameras.png); return their folder.

    The summary's "overhead" says what reports took: rows, this function, and the share of both in the whole.
    """
    began, folder = time.perf_counter(), run.report
    mean, seconds = mean_scores(list(scores.values())), record.clock.seconds
    if record.curve.rows:
        record.curve.write_csv(folder / "error.csv")
        errors = [f"{measure.name}_" for measure in METRICS.parts()]
        plots = [chart for start, chart in charts(record.curve).items() if start in errors]
        write_text(folder / "error.svg", picture_file(plots))
    if run.capture.found is not None:
        for name, copy in (("report.json", "cameras.json"), ("cameras.png", "cameras.png")):
            write_bytes(folder / copy, (run.capture.found / name).read_bytes())
    summary = {
        "step": run.step,
        "seconds": round(seconds, 2),
        "splats": run.splats,
        "skipped": record.skipped,
        **({"fit": fit} if (fit := fit_before(run)) else {}),
        **({"counts": dict(run.counts)} if run.counts else {}),
        "held_out": [run.capture.views[i].name for i in scores],
        "mean": plain(mean),
        "stages": {name: round(value, 3) for name, value in record.clock.stages.items()},
        "machine": machine(run.device),
        "versions": versions(),
    }
    make_page(run, record, summary, scores).write(folder / "index.html")
    rows, files = record.clock.reporting, time.perf_counter() - began
    share = (rows + files) / (seconds + rows + files)
    summary["overhead"] = {"rows": round(rows, 3), "files": round(files, 3), "share": round(share, 4)}
    write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    return [folder]


def charts(curve: Curve) -> dict[str, str]:
    """What the rows tell against seconds, by how the columns begin. Of an edit that is confined, errors where it is and
    where it is not."""
    confined, drawn = any(c.endswith("_inside") for c in curve.columns), {}
    errors = [(m, f"{m.name}_") for m in METRICS.parts()]
    titles = [(m.label(f"{m.title} at held-out views"), start, m.better == "lower") for m, start in errors]
    for title, start, log in (*titles, *CHARTS):
        columns = [c for c in curve.columns if c.startswith(start) and (start.endswith("_") or c == start)]
        if confined and start in [start for _, start in errors]:
            columns = [c for c in columns if c.endswith(("_inside", "_outside"))]
        if columns == ["splats"] and len({row["splats"] for row in curve.rows}) == 1:
            continue
        series = {c.removeprefix(start) or c: [(r["seconds"], r[c]) for r in curve.rows if c in r] for c in columns}
        drawn[start] = line_chart(title, series, log=log)
    return drawn


def score_rows(names: Sequence[str], scores: Sequence[Mapping[str, float]]) -> Table:
    """One row for each view and one for the mean."""
    columns = list(mean_scores(scores))
    rows = [*zip(names, scores, strict=True), ("mean", mean_scores(scores))]
    cells = [[name, *(f"{row[c]:.4g}" if c in row else "" for c in columns)] for name, row in rows]
    return Table(["view", *(c.replace("_", " ") for c in columns)], cells)


def unmeasured(columns: Iterable[str]) -> str:
    """What a reader must know where the scores with these names compare with the source alone; else nothing."""
    known = set(columns)
    if not any(c.startswith("psnr_source") for c in known):
        return ""
    if "clip_direction" in known or any(c.startswith(("psnr_truth", "psnr_edit", "psnr_photo")) for c in known):
        return ""
    return (
        "No figure here measures the edit: what it should have become is not known, and all errors are distances from "
        "the source, in which a run that changes nothing is the best. The pictures are the judge, or CLIP's direction "
        "(system.report.clip, clip_source, clip_target)."
    )


def tile_labels(mean: Mapping[str, float]) -> dict[str, str]:
    """The scores that are shown large, by name: those of LABELS, of PSNR only the first, and of each other metric that
    is registered its first column."""
    best = next((name for name in LABELS if name in mean), None)
    labels = {name: label for name, label in LABELS.items() if name in mean and (name == best or name[:5] != "psnr_")}
    for measure in METRICS.parts():
        if not any(name.startswith(f"{measure.name}_") for name in LABELS):
            first = [name for name in mean if name.startswith(f"{measure.name}_")][:1]
            labels |= {name: measure.label(name.replace("_", " ")) for name in first}
    return labels


def make_page(run: RunFacts, record: Record, summary: Mapping, scores: Mapping[int, Mapping[str, float]]) -> Page:
    """The page of a run."""
    mean, views, folder = mean_scores(list(scores.values())), run.capture.views, run.folder
    tiles = {label: f"{mean[name]:.4g}" for name, label in tile_labels(mean).items()}
    tiles |= {"steps": f"{summary['step']:,}", "seconds in training": f"{summary['seconds']:,.1f}"}
    tiles |= {"splats": f"{summary['splats']:,}"} | ({"steps left out": f"{record.skipped}"} if record.skipped else {})
    if fit := summary.get("fit"):
        tiles |= {"seconds of the fit before": f"{fit['seconds']:,.1f}"}
        tiles |= {"PSNR of that fit, dB": f"{fit['psnr_photo']:.4g}"} if fit.get("psnr_photo") is not None else {}
    tiles |= {what: f"{count:,}" for what, count in run.counts.items()}
    shown = list(scores)[:: max(1, len(scores) // PICTURES)][:PICTURES]
    given = {
        name: "\n".join(f"{key}: {value}" for key, value in summary[name].items()) for name in ("machine", "versions")
    }
    found = {"Cameras": "\n".join(run.capture.notices)} if run.capture.found is not None else {}
    texts = {"The plan": run.plan} if run.plan and (run.report / "plan.json").is_file() else {}
    return Page(
        title=run.title,
        subtitle=f"{folder.parent.name}/{folder.name} · {run.capture.source} · {summary['machine']['processor']}",
        tiles=tiles,
        pictures=[run.panels(index) for index in shown],
        charts=list(charts(record.curve).values()),
        stages=summary["stages"],
        tables={"Scores": score_rows([views[i].name for i in scores], list(scores.values()))} if scores else {},
        notice=unmeasured([*mean, *record.curve.columns]),
        texts={**found, **texts, "Config": run.config_text, "Machine": given["machine"], "Versions": given["versions"]},
    )
