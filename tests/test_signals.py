"""Signals that are noted or raised, and streams that outlast their readers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from dreamcatalyst.signals import CAUGHT, Lasting, Stop, Stopped

ROOT = Path(__file__).resolve().parents[1]


def test_the_first_signal_waits_where_it_is_asked_to_and_the_second_does_not(capfd):
    with Stop().installed() as stop:
        stop.waits = True
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.asked == signal.SIGTERM and not stop.at_once
        assert "SIGTERM: stopping after this step" in capfd.readouterr().err
        with pytest.raises(Stopped, match="Ctrl-C"):
            os.kill(os.getpid(), signal.SIGINT)
            signal.sigtimedwait([], 0)
        assert stop.at_once and stop.status == 130


def test_where_nothing_is_to_be_protected_the_first_one_stops():
    with Stop().installed() as stop:
        with pytest.raises(Stopped, match="SIGHUP"):
            os.kill(os.getpid(), signal.SIGHUP)
        assert stop.status == 129 and not stop.at_once


def test_a_signal_on_the_way_out_raises_nothing():
    """It would come out of the middle of what takes care of the first one."""
    with Stop().installed() as stop:
        for begin in (lambda: os.kill(os.getpid(), signal.SIGINT), stop.end):
            stop.__init__()
            stop.asked = signal.SIGINT if begin == stop.end else None
            with pytest.raises(Stopped, match="Ctrl-C"):
                begin()
            os.kill(os.getpid(), signal.SIGINT)
            assert stop.asked == signal.SIGINT


def test_a_process_that_does_not_get_out_is_ended_by_one_more():
    code = """
import os, signal
from dreamcatalyst.signals import Stop, Stopped
with Stop().installed():
    for _ in range(9):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except Stopped:
            print("stopped", flush=True)
        print("on", flush=True)
"""
    done = alone(code)
    assert done.returncode == -signal.SIGINT and done.stdout.split() == ["stopped", "on", "on"] and not done.stderr


@pytest.mark.parametrize("ignored", [False, True])
def test_ctrl_c_before_and_after_the_run_is_no_traceback(ignored):
    """And where it is ignored, as by nohup, it stays so."""
    before = "signal.signal(signal.SIGINT, signal.SIG_IGN)" if ignored else ""
    code = f"import os, signal; {before}\nimport launch; launch.end_by_ctrl_c(); os.kill(os.getpid(), signal.SIGINT)"
    done = alone(code)
    assert done.returncode == (0 if ignored else -signal.SIGINT) and not done.stderr


def alone(code: str) -> subprocess.CompletedProcess:
    """The code in a Python of its own."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "custom")])
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True)


def test_handlers_are_put_back_and_what_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        handlers = [signal.getsignal(signum) for signum in CAUGHT]
        with Stop().installed():
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGHUP)
        assert [signal.getsignal(signum) for signum in CAUGHT] == handlers
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_stream_outlasts_its_reader():
    reader, writer = os.pipe()
    with open(writer, "w") as stream:  # noqa: PTH123 - of a file descriptor
        lasting = Lasting(stream)
        lasting.write("heard\n")
        lasting.flush()
        assert os.read(reader, 100) == b"heard\n"
        os.close(reader)
        for _ in range(3):
            lasting.write("unheard\n" * 10_000)
            lasting.flush()
        assert lasting.writable() and not lasting.isatty()
