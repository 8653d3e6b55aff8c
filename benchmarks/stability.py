"""Stiff and extreme cases: what stays finite, and how far it is from a float64 reference.

Every case is one entry of a table in benchmarks/stiff/: noise levels, splats, anchors, training. An error is counted
in units of 1 + the largest true number. The tolerance is ten times the change that the float64 reference itself shows
when its inputs are rounded to float32 (or to the half precision that a case is about), plus 1e-5, so that ill-posed
cases are judged fairly. The exit status is 1 if one fails. Takes a few minutes.

python benchmarks/stability.py [words of the cases' names ...]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "custom"), str(ROOT)]

from benchmarks.stiff import anchors, noise, splats, training  # noqa: E402
from benchmarks.stiff.cases import Case, Check  # noqa: E402

CASES: list[Case] = [*noise.CASES, *splats.CASES, *anchors.CASES, *training.CASES]


def line(case: Case, check: Check) -> str:
    """One row of the table."""
    finite = {True: "yes", False: "NO", None: "-"}[check.finite]
    verdict = "pass" if check.passed else "FAIL"
    return (
        f"| {case.group} | {case.name} | {check.quantity} | {finite} | {check.error:.1e} | {check.tolerance:.1e} | "
        f"{verdict} |"
    )


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="only cases whose group and name hold all of these words")
    words = parser.parse_args(argv).words
    chosen = [case for case in CASES if all(word in f"{case.group} {case.name}" for word in words)]
    print("| group | case | quantity | finite | error | tolerance | verdict |\n|---|---|---|---|---:|---:|---|")
    started, failed, lines = time.perf_counter(), [], 0
    for case in chosen:
        checks = list(case.run())
        lines += len(checks)
        failed += [case.name] if not all(check.passed for check in checks) else []
        for check in checks:
            print(line(case, check), flush=True)
    seconds = time.perf_counter() - started
    print(f"\n{len(chosen)} cases, {lines} quantities, {seconds:.0f} s")
    print(f"{len(chosen) - len(failed)} cases pass, {len(failed)} fail{': ' if failed else ''}{'; '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
