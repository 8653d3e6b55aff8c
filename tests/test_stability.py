"""Every stiff or extreme case of the stability benchmark, and that its command tells the truth about them."""

from __future__ import annotations

import pytest

from benchmarks import stability
from benchmarks.stiff.cases import Case, Check

NAMES = [f"{case.group}: {case.name}" for case in stability.CASES]


@pytest.mark.parametrize("case", stability.CASES, ids=NAMES)
def test_stays_finite_and_within_its_tolerance(case):
    failed = [stability.line(case, check) for check in case.run() if not check.passed]
    assert not failed, "\n".join(failed)


def test_there_are_cases_of_every_group_and_each_has_a_name_of_its_own():
    assert len(set(NAMES)) == len(NAMES) >= 60
    assert {case.group for case in stability.CASES} == {"noise", "splats", "anchors", "training"}


@pytest.mark.parametrize(
    ("check", "status"),
    [
        (Check("a number", True, 1e-6, 1e-5), 0),
        (Check("a number", True, 1e-4, 1e-5), 1),
        (Check("a number", False, 0.0, 1e-5), 1),
        (Check("a number", True, float("nan"), 1e-5), 1),
        (Check("an error", None, 0.0, 0.0), 0),
        (Check("an error", None, 1.0, 0.0), 1),
    ],
)
def test_the_exit_status_is_1_where_one_fails(monkeypatch, capsys, check, status):
    monkeypatch.setattr(stability, "CASES", [Case("splats", "one", lambda: [check])])
    assert stability.main([]) == status
    assert capsys.readouterr().out.strip().splitlines()[-1].startswith(f"{1 - status} cases pass, {status} fail")
