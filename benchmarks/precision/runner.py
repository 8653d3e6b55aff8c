"""Cells as subprocesses of the launcher, and what came of them as JSON lines that an interrupted call goes on from."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .cells import Cell

ROOT = Path(__file__).resolve().parents[2]
ERRORS = ("psnr_truth_inside", "psnr_truth", "psnr_edit_inside", "psnr_edit")  # the first that a run has is its error
USERS_ERROR = 2  # launch.py's exit status for errors that it has words for: a number that is not finite, among others
QUIET = (  # a run that only leaves its table; the clock stands still in reports, so that rows cost nothing
    "use_timestamp=false",
    "system.report.overhead=1",
    "system.report.video_frames=0",
    "system.report.pictures=0",
    "trainer.enable_checkpointing=false",
    "trainer.enable_progress_bar=false",
)


class Runner:
    """Results by key. file: JSON lines, one a cell; folder: where runs lie until they are read, and masks are kept."""

    def __init__(self, file: Path, folder: Path):
        self.file, self.folder = file, folder.resolve()
        lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        self.rows: dict[str, dict[str, Any]] = {row["key"]: row for row in map(json.loads, lines)}
        self.ran: list[dict[str, Any]] = []  # in this call
        self._keys: dict[Cell, str] = {}
        self._contents: dict[Path, str] = {}

    def lookup(self, cell: Cell) -> dict[str, Any] | None:
        """What is known of `cell`."""
        return self.rows.get(self.key(cell))

    def key(self, cell: Cell) -> str:
        """A digest of everything that defines a run: every value of its config, the prior's weights, the splats."""
        if cell not in self._keys:
            config = settings_of(cell)
            system = config["system"]
            files = [system.get("gs_source"), system["guidance"].get("prior", {}).get("path")]
            text = json.dumps([config, [self._content(path) for path in files]], sort_keys=True)
            self._keys[cell] = hashlib.blake2b(text.encode(), digest_size=10).hexdigest()
        return self._keys[cell]

    def _content(self, path: str | None) -> str | None:
        """A digest of a file, or of the weights in a folder; the name itself of what is not here."""
        from dreamcatalyst.diffusion.hub import SHIPPED, SHIPPED_NAME

        place = SHIPPED if path == SHIPPED_NAME else Path(path or "")
        if not path or not place.exists():
            return path
        if place not in self._contents:
            state = hashlib.blake2b(digest_size=10)
            for file in [place] if place.is_file() else sorted(place.rglob("*.safetensors")):
                state.update(file.read_bytes())
            self._contents[place] = state.hexdigest()
        return self._contents[place]

    def run(self, cell: Cell) -> dict[str, Any]:
        """Run a cell and keep what came of it. Exits with the launcher's message where it does not even begin."""
        key, home = self.key(cell), self.folder / f"{cell.bench}-{cell.case}"
        trial = home / key
        shutil.rmtree(trial, ignore_errors=True)
        given = [*cell.overrides, *QUIET, f"exp_root_dir={self.folder}", f"name={home.name}", f"tag={key}"]
        command = [sys.executable, str(ROOT / "launch.py"), "--config", cell.config, *given]
        began = time.perf_counter()
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, encoding="utf-8")
        row = {"key": key, "cell": describe(cell), "wall": round(time.perf_counter() - began, 1)}
        row["at"] = time.strftime("%Y-%m-%d %H:%M")
        table = trial / "report" / "error.csv"
        diverged = result.returncode == USERS_ERROR and table.is_file()  # the launcher's, after the first step
        if result.returncode and not diverged:
            sys.exit(f"{shlex.join(command)}\nexit status {result.returncode}\n{result.stderr or result.stdout}")
        if diverged:
            row["failed"] = result.stderr.strip().splitlines()[-1][:300]
        row |= read_table(table) | read_summary(trial / "report" / "summary.json") | {"config": settings_of(cell)}
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with self.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        self.rows[key] = row
        self.ran.append(row)
        shutil.rmtree(trial)
        return row

    def walls(self, cell: Cell) -> list[float]:
        """Seconds that runs like `cell` took: of the same label, else of any."""
        alike = [row["wall"] for row in self.rows.values() if row["cell"]["label"] == cell.label]
        return alike or [row["wall"] for row in self.rows.values()]


def describe(cell: Cell) -> dict[str, Any]:
    """The names of a cell, for whoever reads the file."""
    return {name: getattr(cell, name) for name in ("group", "bench", "case", "label", "seed")}


def settings_of(cell: Cell) -> dict[str, Any]:
    """Every value of a cell's config, but for the folders of the run."""
    from dreamcatalyst.config import load_config

    config = load_config(cell.config, cli_args=[*cell.overrides, *QUIET, "tag=cell"])
    parts = ("seed", "data_type", "data", "system_type", "system", "trainer")
    return json.loads(json.dumps({name: plain(getattr(config, name)) for name in parts}))


def plain(value: Any) -> Any:
    """OmegaConf's containers as ordinary ones."""
    from omegaconf import OmegaConf

    if isinstance(value, Mapping):
        return {key: plain(below) for key, below in value.items()}
    return OmegaConf.to_container(value) if OmegaConf.is_config(value) else value


def read_table(path: Path) -> dict[str, Any]:
    """The measured rows of a run's error.csv: step, seconds, splats, error; and at the end the PSNR outside."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    name = next(column for column in ERRORS if column in rows[0])
    rows = [row for row in rows if row[name]]
    out: dict[str, Any] = {"measure": name, "error": [float(row[name]) for row in rows]}
    out["seconds"] = [float(row["seconds"]) for row in rows]
    out |= {column: [int(row[column]) for row in rows] for column in ("step", "splats")}
    outside = float(rows[-1].get("psnr_source_outside") or "nan")
    return out | {"outside": outside if math.isfinite(outside) else None}


def read_summary(path: Path) -> dict[str, Any]:
    """Machine and versions; nothing of a run that was stopped."""
    if not path.is_file():
        return {}
    summary = json.loads(path.read_text(encoding="utf-8"))
    return {name: summary[name] for name in ("machine", "versions")}
