"""The tables of docs/error-vs-time.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median

from .cells import ABLATIONS, Bench, Cell, Row, Settings, planned, searched
from .curves import Ratio, Track, levels, middle, ratio, reach, times, track
from .search import RATE, SCALE, best

FAST, HIGH = "dreamcatalyst fast", "dreamcatalyst"
CLAIMS = (  # the paper's times: what is compared, its steps and DreamCatalyst's (appendix), its ratio (section 4.3)
    (FAST, "pds", 30000, 1000, "23"),
    (HIGH, "pds", 30000, 3000, "8"),
    (HIGH, "in2n", 15000, 3000, "1.85"),
)
Tracks = Mapping[str, Mapping[str, Track | None]]  # by edit, then by method or ablation


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; all columns but the first are aligned to the right."""
    lines = [f"| {' | '.join(head)} |", f"|---{'|---:' * (len(head) - 1)}|"]
    return "\n".join(lines + [f"| {' | '.join(map(str, row))} |" for row in rows])


def tracks_of(entries: Sequence[tuple[Cell, Row]], group: str, bench: str) -> dict[str, dict[str, Track | None]]:
    """The curves of a group on one bench, by edit and by label, in the order in which they were run."""
    rows: dict[str, dict[str, list[Row]]] = {}
    for cell, row in entries:
        if (cell.group, cell.bench) == (group, bench):
            rows.setdefault(cell.case, {}).setdefault(cell.label, []).append(row)
    return {case: {label: track(found) for label, found in labels.items()} for case, labels in rows.items()}


def spread(curve: Track) -> str:
    """What a method ends with, with the lowest and highest seed where there are several."""
    last = f"{curve.error[-1]:.2f}"
    return last if curve.runs == 1 else f"{last} ({curve.low[-1]:.2f} to {curve.high[-1]:.2f})"


def case_table(tracks: Mapping[str, Track | None]) -> str:
    """Methods on one edit, the best first: where they end, what it takes, and when they reach given errors."""
    there = {name: curve for name, curve in tracks.items() if curve is not None}
    goals = levels(list(there.values()))
    head = ["method", "ends at, dB", "outside, dB", "s per step", "s", *(f"s to {goal:.1f} dB" for goal in goals)]
    rows = []
    for name, curve in sorted(there.items(), key=lambda item: -item[1].error[-1]):
        arrivals = [reach(curve, goal) for goal in goals]
        cells = [f"{name}{f' ({curve.failed} failed)' if curve.failed else ''}", spread(curve)]
        cells += ["-" if curve.outside is None else f"{curve.outside:.1f}"]
        cells += [f"{curve.per_step:.3f}", f"{curve.seconds[-1]:.1f}"]
        rows.append([*cells, *("-" if time is None else f"{time:.1f}" for time in arrivals)])
    rows += [[name, "failed", *["-"] * (len(head) - 2)] for name, curve in tracks.items() if curve is None]
    return markdown(head, rows)


def lengths(tracks: Mapping[str, Track | None], name: str) -> list[Track]:
    """The curves of a method at all its lengths, the longest last."""
    return [curve for each in (f"{name} fast", name, f"{name} long") if (curve := tracks.get(each)) is not None]


def ratios(tracks: Tracks, reference: str, other: str) -> dict[str, Ratio]:
    """By edit, how many times as long `other` takes to come to what `reference` ends with."""
    found = {}
    for case, methods in tracks.items():
        mine, others = methods.get(reference), lengths(methods, other)
        if mine is not None and others and (value := ratio(mine, others)) is not None:
            found[case] = value
    return found


def ratio_table(tracks: Tracks, names: Sequence[str]) -> str:
    """Times to the end of DreamCatalyst's fast and high-quality runs, in units of DreamCatalyst's own."""
    rows = []
    for reference in (FAST, HIGH):
        for name in names:
            if found := ratios(tracks, reference, name):
                cells = [str(found[case]) if case in found else "-" for case in tracks]
                rows.append([f"{name} to the end of {reference}", *cells, middle(list(found.values()))])
    return markdown(["time of", *tracks, "median"], rows)


def claims_table(tracks: Tracks) -> str:
    """The paper's ratios beside what is measured: at the paper's numbers of steps, and to the same error."""
    rows = []
    for reference, other, steps, own, claim in CLAIMS:
        costs = []
        for methods in tracks.values():
            mine, others = methods.get(reference), lengths(methods, other)
            costs += [others[-1].per_step / mine.per_step] if mine is not None and others else []
        if costs:
            found = ratios(tracks, reference, other).values()
            came = f"{sum(r.reached for r in found)} of {len(found)}"
            scaled = times(median(costs) * steps / own)
            rows.append([f"{reference} against {other}", claim, scaled, middle(list(found)) or "-", came])
    head = ["claim: times as fast", "paper", "at its numbers of steps", "to the same error", "edits that come there"]
    return markdown(head, rows)


def ablation_table(tracks: Tracks) -> str:
    """What each ablation ends with, inside and outside, and the seconds of its run, by edit."""
    head = ["of dreamcatalyst"]
    for case in tracks:
        head += [f"{case}: ends at, dB", "outside, dB", "s"]
    rows = []
    for name in ABLATIONS:
        cells: list[str] = []
        for methods in tracks.values():
            curve = methods.get(name)
            if curve is None:
                cells += ["failed" if name in methods else "-", "-", "-"]
            else:
                outside = "-" if curve.outside is None else f"{curve.outside:.1f}"
                cells += [spread(curve), outside, f"{curve.seconds[-1]:.1f}"]
        rows.append([name, *cells])
    return markdown(head, rows)


def tuning_table(settings: Settings, bench: Bench, lookup) -> str:
    """What each family's search came to, with its score as configured and at its best."""
    rows = []
    for family in bench.families:
        tried, missing = searched(settings, bench, family, lookup)
        rate, power = best(tried)
        scale = bench.values["system"]["guidance"]["guidance_scale"] * SCALE**power if bench.learned else None
        scale = bench.scales[family] if scale is None else scale
        first, last = (f"{value:.2f}" for value in (next(iter(tried.values())), max(tried.values()))) if tried else "--"
        state = len(tried) if missing is None else f"{len(tried)}, goes on"
        rows.append([family, f"{RATE**rate:.2g}", f"{scale:.3g}", first, last, state])
    return markdown(["rule", "rates times", "guidance scale", "as configured, dB", "tuned, dB", "trials"], rows)


def run_table(settings: Settings, entries: Sequence[tuple[Cell, Row]]) -> str:
    """How much of the plan was run. A run that serves two purposes counts for both, its time once."""
    rows, counted = [], set()
    for group, total in planned(settings).items():
        found = {(cell.label, cell.bench, cell.case, cell.seed): row for cell, row in entries if cell.group == group}
        failed = sum(bool(row.get("failed")) for row in found.values())
        wall = sum(row["wall"] for row in found.values() if row["key"] not in counted)
        counted |= {row["key"] for row in found.values()}
        rows.append([group, total, len(found), failed, f"{wall / 60:.1f}"])
    return markdown(["cells", "planned", "run", "failed", "minutes"], rows)
