"""Time by stage, on a clock that moves when it is told to."""

import pytest
from dreamcatalyst.report import clock as module
from dreamcatalyst.report.clock import LOGGING, STAGES, Clock


@pytest.fixture
def later(monkeypatch):
    """Lets so many seconds pass."""
    now = [100.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def test_each_moment_is_booked_once_on_the_innermost_stage(later):
    clock = Clock()
    later(9)  # not started
    clock.start()
    later(1)
    with clock.stage("unet"):
        later(2)
        with clock.stage("encode"):
            later(4)
        later(8)
    clock.stop()
    later(9)
    with clock.stage("render"):
        later(9)
    assert {name: value for name, value in clock.stages.items() if value} == {"other": 1, "unet": 10, "encode": 4}
    assert clock.seconds == 15 and set(clock.stages) == set(STAGES)


def test_what_a_report_does_is_the_report_s(later):
    clock = Clock()
    clock.start()
    with clock.stage(LOGGING):
        later(1)
        with clock.stage("render"):
            later(2)
    assert clock.reporting == 3 and clock.seconds == 0


def test_an_error_closes_its_stages(later):
    clock = Clock()
    clock.start()
    with pytest.raises(ValueError, match="x"), clock.stage("backward"):
        later(1)
        raise ValueError("x")
    later(2)
    assert clock.seconds == 3 and clock.stages["backward"] == 1


def test_a_resumed_run_counts_on(later):
    clock, again = Clock(), Clock()
    clock.start()
    with clock.stage("render"):
        later(3)
    again.load_state_dict(clock.state_dict())
    again.start()
    later(1)
    assert again.seconds == 4 and again.stages["render"] == 3


def test_it_waits_for_a_device_where_it_is_asked_to(later):
    clock = Clock(wait=lambda: later(5))  # work that is still under way
    clock.start()
    with clock.stage("backward"):
        later(1)
    assert clock.stages["backward"] == 6
