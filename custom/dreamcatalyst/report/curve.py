"""Error against run time: a table that grows with the run."""

from __future__ import annotations

import csv
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
