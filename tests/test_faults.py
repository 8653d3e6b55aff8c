"""The benchmark of bad input and faults judges what comes: its own cases are run by the command."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import faults
from benchmarks.faulty.cases import Case, Outcome, Place, case, launched

NAMES = [f"{case.group}: {case.name}" for case in faults.CASES]
DUE = Case("value", "seed=-1", lambda place: Outcome(2, ""), says=("seed",))
RUNS = Case("names", "a tag", lambda place: Outcome(0, ""), says=("wrote",), status=0)
TRACE = "Traceback (most recent call last):\nValueError: seed\n"


def test_each_case_has_a_name_of_its_own():
    assert len(set(NAMES)) == len(NAMES) >= 500


@pytest.mark.parametrize(
    ("case", "outcome", "found"),
    [
        (DUE, Outcome(2, "train: x\nerror: seed: got -1\n"), ""),
        (DUE, Outcome(2, "launch.py: error: seed\n"), ""),
        (DUE, Outcome(2, "error: sed: got -1\n"), "does not say 'seed'"),
        (DUE, Outcome(0, "wrote seed\n"), "exit status 0, due is 2"),
        (DUE, Outcome(2, "seed\n"), "0 error lines"),
        (DUE, Outcome(2, "error: seed\nmore of it\n"), "not one line"),
        (DUE, Outcome(2, "error: a\nerror: seed\n"), "2 error lines"),
        (DUE, Outcome(None, TRACE), "a traceback"),
        (DUE, Outcome(2, "error: seed\n", seconds=99), "99 s"),
        (DUE, Outcome(2, "error: seed\n", lost=["work/scene.ply"]), "lost or changed: work/scene.ply"),
        (RUNS, Outcome(0, "wrote a.ply\n"), ""),
        (RUNS, Outcome(2, "error: tag\n"), "exit status 2, due is 0"),
        (RUNS, Outcome(0, "wrote a.ply\n", faults=["no report was written"]), "no report was written"),
    ],
)
def test_what_came_is_judged(case, outcome, found):
    said = "; ".join(case.faults(outcome))
    assert found in said if found else said == ""


def test_a_launch_is_told_with_what_it_left_and_leaves_the_process_as_it_was(tmp_path):
    place, here = Place(tmp_path / "001", tmp_path / "things"), Path.cwd()
    outcome = launched(place, ["--config", str(place.write("my.yaml", "- a\n"))])
    assert outcome.status == 2 and "expected keys" in outcome.errors[0] and not outcome.left and not outcome.lost
    assert Path.cwd() == here


@pytest.mark.parametrize(("given", "status"), [("seed=-1", 0), ("system.report.every=2", 1)])
def test_the_exit_status_is_1_where_an_error_is_due_and_none_comes(monkeypatch, capsys, tmp_path, given, status):
    monkeypatch.setattr(faults, "CASES", [case("value", given, [given], "every" if status else "seed")])
    table = tmp_path / "faults.md"
    assert faults.main(["--write", str(table)]) == status
    row = next(line for line in table.read_text().splitlines() if f"| {given} |" in line)
    assert row.endswith("| pass |") != bool(status) and ("FAIL" in row) == bool(status)
    assert f"1 cases: {1 - status} pass, {status} fail" in capsys.readouterr().out
