"""A list of edits over scenes, the methods of the paper's table, and the table of what came of them in its columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from ..errors import ConfigError

PAPER_PAIRS = Path(__file__).with_name("paper_pairs.yaml")
COLUMNS = {"clip_direction": "CLIP-dir", "clip_similarity": "CLIP-img", "aesthetic": "aesthetic", "minutes": "minutes"}
EVERYTHING = "everything"


@dataclass(frozen=True)
class Method:
    """One row of the table. name: of its folder and in the table; config: a YAML; options: further key=value. row: the
    row of the paper's table on 3DGS that it stands for."""

    name: str
    config: str
    options: tuple[str, ...] = ()
    row: str = ""


# Kim et al. 2025, table 2, without DGE; then GaussianEditor with PDS and what we recommend, which it has not.
METHODS = (
    Method("pds", "configs/rules/pds.yaml", row="PDS"),
    Method("dc-splat", "configs/dc-splat.yaml", row="DreamCatalyst"),
    Method("ge-dds", "configs/ge-dds.yaml", row="GaussianEditor, DDS"),
    Method("ge-in2n", "configs/ge-in2n.yaml", row="GaussianEditor, IN2N"),
    Method("dc-ge-published", "configs/dc-ge-published.yaml", row="GaussianEditor, DreamCatalyst"),
    Method(
        "dc-ge-published-fast",
        "configs/dc-ge-published.yaml",
        ("system.mode=fast",),
        row="GaussianEditor, DreamCatalyst fast",
    ),
    Method("ge-pds", "configs/ge-pds.yaml"),
    Method("dc-ge-ip2p", "configs/dc-ge-ip2p.yaml"),
    Method("dc-ge-ip2p-fast", "configs/dc-ge-ip2p.yaml", ("system.mode=fast",)),
)


@dataclass(frozen=True)
class Pair:
    """One edit. scene: the name of its folder. source, target: descriptions of the scene before and after;
    instruction: what is to be done. region: what may change, in words for a mask by text, or everything."""

    scene: str
    source: str
    target: str
    instruction: str
    region: str = EVERYTHING

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
        raise ConfigError(f"{path}: expected scenes by name, each with source, region and edits, as in {PAPER_PAIRS}.")
    pairs = []
    for scene, entry in given.items():
        edits = entry.get("edits") if isinstance(entry, dict) else None
        if not isinstance(edits, dict) or not isinstance(entry.get("source"), str):
            raise ConfigError(f"{path}: {scene}: expected source (text) and edits (target: instruction).")
        region = entry.get("region")
        if not isinstance(region, str) or not region.strip():
            raise ConfigError(
                f"{path}: {scene}.region: got {region!r}, expected what may change, in words, or {EVERYTHING}: methods "
                "are compared on one mask."
            )
        for target, instruction in edits.items():
            if not isinstance(target, str) or not isinstance(instruction, str):
                raise ConfigError(f"{path}: {scene}.edits: '{target}: {instruction}', expected text: text.")
            pairs.append(Pair(scene, entry["source"], target, instruction, region))
    return pairs


def means(results: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean over pairs of each column that any of them has."""
    found = {}
    for name in COLUMNS:
        values = [result[name] for result in results if result.get(name) is not None]
        if values:
            found[name] = float(np.mean(values))
    return found


def table(results: Mapping[str, Mapping[Pair, Mapping[str, float]]], unmasked: Sequence[str] = ()) -> str:
    """The table, as Markdown: a row of means over pairs for each method, and below it what must be known to read it.

    results: by method and pair, the scores. unmasked: methods that know no mask. Figures of papers do not stand here:
    the CLIP direction of one method differs threefold between papers.
    """
    rows = {method.name: method.row for method in METHODS}
    lines = [
        f"| method | row of the paper | pairs | mask | {' | '.join(COLUMNS.values())} |",
        f"|{'---|' * (len(COLUMNS) + 4)}",
    ]
    for method, by_pair in results.items():
        found = means(list(by_pair.values()))
        cells = [f"{found[c]:.{1 if c == 'minutes' else 3}f}" if c in found else "-" for c in COLUMNS]
        mask = "none" if method in unmasked else "the list's"
        lines.append(f"| {' | '.join([method, rows.get(method) or '-', str(len(by_pair)), mask, *cells])} |")
    uneven = len({frozenset(by_pair) for by_pair in results.values()}) > 1
    return "\n".join([*lines, "", *NOTES, *([UNEVEN] if uneven else [])])


NOTES = (
    "Compare rows of this table with each other alone. CLIP's direction depends on which CLIP it is, on the size of "
    "the pictures, on views and words: figures of one method differ threefold between papers.",
    "",
    "Methods with a mask share one for each scene, by the list's words; what they were published with may differ.",
)
UNEVEN = "\nRows are means over different pairs, since some runs are missing: what they have in common tells more."


def views_note(test_every: int) -> str:
    """What is scored."""
    if test_every:
        return (
            f"Scored are the views that were held out, every {test_every}th: no method has seen them. The published "
            "codes train on the views that they score, and so does --test-every 0."
        )
    return "Scored are the views that were trained on, as the published codes do; --test-every 8 holds some out."
