"""Signals that are noted or raised, and streams that outlast their readers."""

from __future__ import annotations

import os
import signal

import pytest
from dreamcatalyst.signals import CAUGHT, Lasting, Stop, Stopped


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
