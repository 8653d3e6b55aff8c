"""A list of edits over scenes, and the table of what came of them in the columns of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from ..errors import ConfigError

PAPER_PAIRS = Path(__file__).with_name("paper_pairs.yaml")
COLUMNS = {"clip_direction": "CLIP-dir", "clip_similarity": "CLIP-img", "aesthetic": "aesthetic", "minutes": "minutes"}
PAPER = {  # Kim et al. 2025, means over all 40 pairs; the paper does not say which CLIP, nor which views
    "NeRF": {  # table 1
        "IN2N": (0.157, 0.722, 5.399, 130),
        "PDS": (0.161, 0.687, 5.437, 580),
        "DreamCatalyst, fast": (0.165, 0.746, 5.557, 25),
        "DreamCatalyst": (0.180, 0.746, 5.688, 70),
        "DreamCatalyst, Psi 2": (0.178, 0.745, 5.659, 70),
        "DreamCatalyst, Psi 3": (0.178, 0.749, 5.659, 70),
    },
    "3DGS": {  # table 2
        "PDS": (0.108, 0.627, 4.977),
        "DreamCatalyst": (0.171, 0.724, 5.336),
        "GaussianEditor, DDS": (0.150, 0.593, 4.860),
        "GaussianEditor, IN2N": (0.138, 0.765, 5.508),
        "DGE": (0.154, 0.758, 5.517),
        "GaussianEditor, DreamCatalyst": (0.152, 0.773, 5.588),
        "GaussianEditor, DreamCatalyst fast": (0.143, 0.777, 5.541),
    },
}


@dataclass(frozen=True)
class Pair:
    """One edit. scene: the name of its folder. source, target: descriptions of the scene before and after;
    instruction: what is to be done."""

    scene: str
    source: str
    target: str
    instruction: str

    @property
    def name(self) -> str:
        """For a folder."""
        words = "".join(c if c.isalnum() else " " for c in f"{self.scene} {self.target}")
        return "_".join(words.split())


def read_pairs(path: Path = PAPER_PAIRS) -> list[Pair]:
    """The list in a YAML of the format of paper_pairs.yaml. Raises ConfigError, with the place, for any other."""
    if not path.is_file():
        raise ConfigError(f"pairs: there is no file '{path}'. Give a YAML of the format of {PAPER_PAIRS}.")
    try:
        given = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not valid YAML: {error}.") from error
    if not isinstance(given, dict) or not given:
        raise ConfigError(f"{path}: expected scenes by name, each with source and edits, as in {PAPER_PAIRS}.")
    pairs = []
    for scene, entry in given.items():
        edits = entry.get("edits") if isinstance(entry, dict) else None
        if not isinstance(edits, dict) or not isinstance(entry.get("source"), str):
            raise ConfigError(f"{path}: {scene}: expected source (text) and edits (target: instruction).")
        for target, instruction in edits.items():
            if not isinstance(target, str) or not isinstance(instruction, str):
                raise ConfigError(f"{path}: {scene}.edits: '{target}: {instruction}', expected text: text.")
            pairs.append(Pair(scene, entry["source"], target, instruction))
    return pairs


def means(results: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean over pairs of each column that any of them has."""
    found = {}
    for name in COLUMNS:
        values = [result[name] for result in results if result.get(name) is not None]
        if values:
            found[name] = float(np.mean(values))
    return found


def table(results: Mapping[str, Mapping[Pair, Mapping[str, float]]]) -> str:
    """The table, as Markdown: a row of means over pairs for each method.

    results: by method and pair, the scores. The paper's own figures stand below, marked as such, where all pairs are
    the paper's: they say nothing about other scenes.
    """
    lines = [f"| method | pairs | {' | '.join(COLUMNS.values())} |", f"|{'---|' * (len(COLUMNS) + 2)}"]
    for method, by_pair in results.items():
        lines.append(_row(method, str(len(by_pair)), list(means(list(by_pair.values())).items())))
    evaluated = {pair for by_pair in results.values() for pair in by_pair}
    if evaluated and evaluated <= set(read_pairs()):
        for kind, rows in PAPER.items():
            for method, figures in rows.items():
                found = list(zip(COLUMNS, figures, strict=False))
                lines.append(_row(f"{method} ({kind}, as the paper reports it)", "40", found))
    return "\n".join(lines)


def _row(method: str, count: str, found: Sequence[tuple[str, float]]) -> str:
    values = dict(found)
    digits = {"minutes": 1}
    cells = [f"{values[name]:.{digits.get(name, 3)}f}" if name in values else "-" for name in COLUMNS]
    return f"| {method} | {count} | {' | '.join(cells)} |"
