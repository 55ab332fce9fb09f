"""Elastic runs, against the simplest model: whoever comes and goes, the rows are those of one run.

The model knows how many clients are there, so who must be let in.
"""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from sizes import trials

pytestmark = pytest.mark.processes

WANDERER = f"{Path(__file__).parents[1] / 'programs' / 'restart_envs.py'}:Wanderer"
MOST = 3
JOINED = "joined the run"

NUMBER = st.integers(0, 99)
ACTION = st.one_of(
    st.tuples(st.just("take"), st.integers(1, 25)),
    st.tuples(st.sampled_from(["come", "leave", "kill", "kill worker"]), NUMBER),
)


class Model:
    """A run and its clients; which of them are there is known here, not asked.

    Attributes:
        present: The clients that are there.
    """

    def __init__(self, first, join, process_ids, rows, said):
        self._join, self._find, self._rows, self._said = join, process_ids, rows, said
        self.present = [first]

    def take(self, count):
        if not self.present:
            self.come(0)
        self._rows.take(count)

    def come(self, number):
        """Have another client join, which is refused if there are enough."""
        before = len(self._said(JOINED))
        client = self._join()
        if len(self.present) < MOST:
            self.present.append(client)
            self._rows.take_until(lambda: len(self._said(JOINED)) > before)
            return
        self._rows.take_until(lambda: client.poll() is not None)
        assert client.returncode == 1
        assert "The server has no place for another client" in client.stderr.read()

    def leave(self, number):
        self._end(number, signal.SIGINT)

    def kill(self, number):
        self._end(number, signal.SIGKILL)

    def kill_worker(self, number):
        if not self.present:
            return
        found = list(self._find(self.present[number % len(self.present)].pid).values())
        if found:
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                os.kill(found[number % len(found)], signal.SIGKILL)

    def _end(self, number, how):
        if self.present:
            client = self.present.pop(number % len(self.present))
            client.send_signal(how)
            client.wait(60)


def check(history, asks, local, by_hand, join, process_ids, taking, said):
    configured = {"num_clients": 4, "env_kwargs": {"asks": asks, "pace": 0.001, "refuse": 5}}
    options = {"max_clients": MOST, "restarts": 99, "timeout": 60.0, "run_ahead": 3}
    first = join()
    with by_hand(WANDERER, **options, **configured) as source:
        rows = taking(source)
        model = Model(first, join, process_ids, rows, said)
        for action, number in history:
            getattr(model, action.replace(" ", "_"))(number)
        model.take(8)
    rows.check(local(WANDERER, **configured))
    assert [client.wait(60) for client in model.present] == [0] * len(model.present)


OPTIONS = {
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    "phases": [Phase.generate],  # a shorter history may take another course each time
}


@settings(max_examples=trials(3, 2), **OPTIONS)
@given(st.lists(ACTION, min_size=2, max_size=6), st.booleans())
def test_any_elastic_history_gives_same_rows(
    local, by_hand, join, process_ids, taking, said, caplog, history, asks
):
    caplog.set_level("INFO", "physx")
    check(history, asks, local, by_hand, join, process_ids, taking, said)


@pytest.mark.slow
@pytest.mark.faults
@settings(max_examples=trials(5, 2), **OPTIONS)
@given(st.lists(ACTION, min_size=5, max_size=12), st.booleans())
def test_any_long_elastic_history_gives_same_rows(
    local, by_hand, join, process_ids, taking, said, caplog, history, asks
):
    caplog.set_level("INFO", "physx")
    check(history, asks, local, by_hand, join, process_ids, taking, said)
