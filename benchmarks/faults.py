"""Bad input and faults: what a user is told, with which exit status, and what is left on disk.

Every case is one entry of a table in benchmarks/faulty/. A case fails if there is a traceback, if something that was
there is lost, if an error is due and none comes, if the line does not name what is to blame, or if it comes late.
Almost all run in this process, or in --jobs of them; kills, signals and full disks in processes of their own. Takes a
few minutes; the exit status is 1 if one fails.

python benchmarks/faults.py [--only words ...] [--write faults.md]
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "custom"), str(ROOT)]
os.environ.setdefault("HF_HUB_OFFLINE", "1")  # a model that is not there is not there: no case asks the network

from benchmarks.faulty import (  # noqa: E402
    additions,
    captures,
    commands,
    deletions,
    fits,
    folders,
    formats,
    masks,
    pairs,
    photographs,
    priors,
    processes,
    resumes,
    splats,
    values,
)
from benchmarks.faulty.cases import Case, Outcome, Place  # noqa: E402

GROUPS = [commands, values, captures, photographs, splats, formats, masks, fits, deletions, additions]
GROUPS += [priors, pairs, resumes, folders, processes]
CASES: list[Case] = [case for group in GROUPS for case in group.CASES]
SHOWN = 240  # characters of a message in the table
INTRODUCTION = """# Bad input and faults

What was given, what came of it, the exit status, and what was left on disk. Written by `python benchmarks/faults.py
--write faults.md`, which runs all cases (`benchmarks/faulty/`) and fails where there is a traceback, where
something is lost, where an error is due and none comes, where the message does not name what is to blame, or where it
comes late. `--only resume` runs the cases whose group or name holds the word.

Status 2 is an error of the user's, told in one line. Paths are relative to the folder of the run.

"""


def run(index: int, number: int, root: Path) -> tuple[Outcome, list[str]]:
    """Run a case in a folder of its own; what came, and what is wrong with it. What cases share is made by each process
    for itself."""
    outcome = CASES[index].run(Place(root / f"{number:03d}", root / f"things-{os.getpid()}"))
    return outcome, CASES[index].faults(outcome)


def brief(text: str, root: Path) -> str:
    """A message for a cell of the table: without what differs from run to run and from machine to machine."""
    text = re.sub(re.escape(str(root)) + r"/\d+/(work/)?", "", text).replace(f"{ROOT}/", "")
    text = re.sub(r"@\d{8}-\d{6}(-\d+)?", "@<time>", text)
    text = " ".join(text.split())
    text = text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."
    return text.replace("|", "\\|").replace("<", "&lt;").replace("$", "\\$")


def told(case: Case, outcome: Outcome) -> str:
    """The line that came: the error, or of a run that goes on the line that says what is asked for, or the last."""
    lines = [line for line in outcome.text.splitlines() if line.strip()] or ["nothing"]
    if case.status == 2 and outcome.errors:
        return outcome.errors[-1]
    return next((line for line in lines if case.says and case.says[0] in line), lines[-1])


def leavings(outcome: Outcome) -> str:
    """What is new on disk, in a few words."""
    kinds = {"*.ckpt": "checkpoint", "last.ply": "PLY", "index.html": "report", "parsed.yaml": "config"}
    names = [Path(name) for name in outcome.left]
    known = [word for pattern, word in kinds.items() if any(name.match(pattern) for name in names)]
    if not names:
        return "nothing new"
    return ", ".join(known) or ", ".join(sorted({name.name for name in names})[:3])


def row(case: Case, outcome: Outcome, faults: Sequence[str], root: Path) -> str:
    """One row of the table."""
    verdict = "pass" if not faults else f"FAIL: {brief('; '.join(faults), root)}"
    status = "none" if outcome.status is None else outcome.status
    line = brief(told(case, outcome), root)
    return f"| {case.group} | {brief(case.name, root)} | {line} | {status} | {leavings(outcome)} | {verdict} |"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="WORD", help="cases whose group or name holds one of these words")
    parser.add_argument("--write", type=Path, metavar="MD", help="write the table there, too")
    parser.add_argument("--failed", action="store_true", help="print only the rows of cases that fail")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the cases")
    args = parser.parse_args(argv)
    words = args.only or [""]
    chosen = [i for i, c in enumerate(CASES) if any(word in f"{c.group}: {c.name}" for word in words)]
    head = "| what | given | what came | status | left on disk | verdict |\n|---|---|---|---:|---|---|"
    print(head)
    began, rows, failed = time.perf_counter(), [head], []
    with contextlib.ExitStack() as stack:
        root = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="faults-"))).resolve()
        os.environ["DREAMCATALYST_CACHE"] = str(root / "kept")  # never the user's own
        each = map
        if args.jobs > 1:
            context = multiprocessing.get_context("spawn")
            each = stack.enter_context(ProcessPoolExecutor(args.jobs, context)).map
        came = each(run, chosen, itertools.count(1), itertools.repeat(root))
        for case, (outcome, faults) in zip((CASES[i] for i in chosen), came, strict=True):
            rows.append(row(case, outcome, faults, root))
            failed += [case.name] if faults else []
            if faults or not args.failed:
                print(rows[-1], flush=True)
    summary = f"{len(chosen)} cases: {len(chosen) - len(failed)} pass, {len(failed)} fail"
    print(f"\n{summary}; {time.perf_counter() - began:.0f} s")
    if args.write:
        args.write.write_text(INTRODUCTION + "\n".join(rows) + f"\n\n{summary}.\n", encoding="utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
