"""Threads whose start Ctrl-C interrupts."""

import signal
import threading

import pytest

from physx_core.processes import BackgroundThread


def test_a_thread_is_joined_although_its_start_was_interrupted(monkeypatch):
    done, go_on = threading.Event(), threading.Event()

    def run():
        go_on.wait(10)
        done.set()

    def interrupted(self, timeout=None):
        monkeypatch.undo()
        signal.raise_signal(signal.SIGINT)

    thread = BackgroundThread(run, "test")
    monkeypatch.setattr(threading.Event, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        thread.start()
    threading.Timer(0.2, go_on.set).start()
    thread.join()
    assert done.is_set() and not thread.is_alive()


@pytest.mark.slow
def test_joining_a_thread_without_a_start_returns():
    BackgroundThread(print, "test").join()


def test_joining_waits_for_a_limited_time():
    go_on = threading.Event()
    thread = BackgroundThread(lambda: go_on.wait(10), "test")
    thread.start()
    thread.join(0.01)
    assert thread.is_alive()
    go_on.set()
    thread.join()
