"""Error against run time: a table that grows with the run, and its picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..files import replacing


class Curve:
    """Rows of numbers by column name, one row per report. `seconds` counts the run without the reports themselves."""

    def __init__(self, rows: Sequence[Mapping[str, float]] = ()):
        self.rows: list[dict[str, float]] = [dict(row) for row in rows]

    def add(self, **row: float) -> None:
        """Append one row; a row of the same step replaces the former."""
        if self.rows and self.rows[-1].get("step") == row.get("step"):
            self.rows.pop()
        self.rows.append(row)

    @property
    def columns(self) -> list[str]:
        """All column names, in the order of their first appearance."""
        return list(dict.fromkeys(name for row in self.rows for name in row))

    def write_csv(self, path: Path) -> None:
        """Write the table; a value that a row lacks is left empty. Raises FileError."""
        with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns, restval="")
            writer.writeheader()
            writer.writerows(self.rows)


def draw_curves(
    path: Path,
    curves: Mapping[str, Curve],
    groups: Mapping[str, Sequence[str]],
    lines: Mapping[str, float] | None = None,
) -> None:
    """Draw the same columns of several curves, one panel per group, each against seconds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * len(groups), 3.6), layout="constrained")
    for axis, (label, columns) in zip(figure.subplots(1, len(groups), squeeze=False)[0], groups.items(), strict=True):
        for title, curve in curves.items():
            for column in columns:
                points = [(r["seconds"], r[column]) for r in curve.rows if math.isfinite(r.get(column, math.nan))]
                if points:
                    axis.plot(*zip(*points, strict=True), marker=".", label=" ".join(filter(None, (title, column))))
        axis.set(xlabel="seconds", ylabel=label)
        axis.grid(alpha=0.3)
        if axis is figure.axes[0]:
            for name, level in (lines or {}).items():
                axis.axhline(level, linestyle="--", linewidth=1, color="gray")
                axis.annotate(name, (1, level), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
