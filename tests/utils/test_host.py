"""Signals while a run is being saved (utils/host.py)."""

from __future__ import annotations

import os
import signal

from mmpi_ns.utils import host


def test_a_hang_up_is_never_deadly_again_once_it_was_taken(monkeypatch):
    """The shell sends it twice, the second one at any moment."""
    set_to, taken, real = [], [], signal.signal
    usual = real(signal.SIGHUP, signal.SIG_DFL)
    monkeypatch.setattr(host, "discard", lambda output: None)
    try:
        with host.signals_go_to(taken.append):
            monkeypatch.setattr(signal, "signal", lambda n, how: (set_to.append((n, how)), real(n, how))[1])
            os.kill(os.getpid(), signal.SIGHUP)
        assert taken == [signal.SIGHUP]
        assert [how for number, how in set_to if number == signal.SIGHUP] == [signal.SIG_IGN]
    finally:
        real(signal.SIGHUP, usual)
