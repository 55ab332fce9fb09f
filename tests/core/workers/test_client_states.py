"""What a run does with a client that ends, hangs or is cut off: one table, for each of its states.

Runs with clients in one thread and in simulated time are compared with it: which client is named,
how, after how long, and whether another one takes its place with the same rows.
"""

from __future__ import annotations

import itertools
import re
from typing import NamedTuple

import pytest
from fated import Fate, Fates
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from simulated import Simulation, drawn
from sizes import size

from physx_core import EnvironmentConfig
from physx_core.errors import PhysxError
from physx_core.sources import ClientSource, LocalSource

FATED = "fated:Fated"
SEED = [5, 0, 7]
TIMEOUT = 30.0
TICK = 0.5  # s; a run looks at its clients more often
GRACE = 1.0  # s for a client that has failed to close its environment


class Row(NamedTuple):
    """What a run does if something happens to a client.

    Attributes:
        says: What it says of the client.
        after: How long it waits at least, in s.
        before: How long it waits at most, in s.
    """

    says: str
    after: float = 0.0
    before: float = 0.0


KILLED, EXITED = r"was killed by signal 9 \(SIGKILL\)", "ended with exit status 3"
SILENT = f"sent nothing for {TIMEOUT:g} s"
ABSENT = f"(did not connect|no other took its place) for {TIMEOUT:g} s"
GONE = "its machine no longer answers"
TABLE = {
    # It was started, and has not connected.
    ("starting", "is killed"): Row(f"{KILLED} before it connected"),
    ("starting", "exits"): Row(f"{EXITED} before it connected"),
    ("starting", "hangs"): Row(ABSENT, TIMEOUT, TIMEOUT),
    # It has connected, and its environment is being created.
    ("joining", "is killed"): Row(rf"{KILLED} after \d+ rows"),
    ("joining", "exits"): Row(rf"{EXITED} after \d+ rows"),
    ("joining", "fails"): Row("no more beans", 0.0, GRACE),
    ("joining", "hangs"): Row(SILENT, TIMEOUT - TICK, TIMEOUT),  # since its last message
    ("joining", "vanishes"): Row(GONE, 12.0, 20.0),
    # It has sent all rows that the run wants.
    ("idle", "is killed"): Row(rf"{KILLED} after \d+ rows"),
    ("idle", "exits"): Row(rf"{EXITED} after \d+ rows"),
    ("idle", "hangs"): Row(SILENT, TIMEOUT, TIMEOUT),
    ("idle", "vanishes"): Row(GONE, 0.0, 20.0),
    # It generates rows.
    ("busy", "is killed"): Row(rf"{KILLED} after \d+ rows"),
    ("busy", "exits"): Row(rf"{EXITED} after \d+ rows"),
    ("busy", "fails"): Row("no more beans", 0.0, GRACE),
    ("busy", "hangs"): Row(SILENT, TIMEOUT - TICK, TIMEOUT),
    ("busy", "vanishes"): Row(GONE, 12.0 - TICK, 20.0),
    # All rows have arrived, and it closes its environment: nobody takes its place.
    ("closing", "is killed"): Row(rf"{KILLED} after \d+ rows"),
    ("closing", "exits"): Row(rf"{EXITED} after \d+ rows"),
    ("closing", "fails"): Row("no more beans", 0.0, GRACE),
    ("closing", "hangs"): Row(SILENT, TIMEOUT, TIMEOUT),
    ("closing", "vanishes"): Row(GONE, 12.0, 20.0),
}


class Run:
    """A run with fates, whose clients are in a simulation.

    Attributes:
        error: How it ended; None: well.
        ended: When it ended, in simulated s.
        asked: When it began to wait for each batch, and for the end.
    """

    def __init__(
        self, simulation, fates, sizes, count, *, pauses=(), run_ahead=0, pace=0.01, **options
    ):
        self.simulation, self.count, self.sizes = simulation, count, sizes
        simulation.fates = self.fates = Fates(fates, count)
        self._pauses = pauses
        options |= {"launcher": "fated:FatedLauncher", "timeout": TIMEOUT}
        config = EnvironmentConfig(FATED, num_clients=count, env_kwargs={"pace": pace}, **options)
        self._source = ClientSource(config, None, SEED, run_ahead=run_ahead, transport=simulation)
        self.batches, self.asked, self.error = [], [], None
        try:
            with self._source:
                self._take()
                self.asked.append(simulation.monotonic())
        except PhysxError as error:
            self.error = error
        self.ended = simulation.monotonic()

    def _take(self):
        for count, pause in itertools.zip_longest(self.sizes, self._pauses, fillvalue=0):
            self.simulation.sleep(pause)
            for client in list(self.simulation.alive.values()):
                self.fates.strike(client, "idle", len(self.batches))
            self.asked.append(self.simulation.monotonic())
            batch = self._source.batch(count)
            self.batches.append({name: rows.copy() for name, rows in batch.items()})

    @property
    def launches(self):
        """Instance to the times at which its clients were started."""
        return self.fates.launches

    def since(self, fate):
        """Return when the run could first notice what happened: if it waits for the client."""
        times = [time for time in self.asked if time >= fate.began]
        return times[0] if fate.state == "idle" else fate.began

    def check_rows(self):
        """Check that the rows are those of a run in this process, to the last bit."""
        Simulation.current, current = None, Simulation.current
        with LocalSource(EnvironmentConfig(FATED, num_clients=self.count), None, SEED) as source:
            for count, found in zip(self.sizes, self.batches, strict=False):
                for name, rows in source.batch(count).items():
                    assert rows.tobytes() == found[name].tobytes()
        Simulation.current = current


@pytest.mark.parametrize("retries", [0, 1])
@pytest.mark.parametrize(("state", "event"), TABLE)
@settings(
    max_examples=size(4, 1),
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(choose=drawn, who=st.sampled_from([1, 2]))
def test_client_is_named_and_replaced_as_in_the_table(caplog, state, event, retries, choose, who):
    caplog.clear()
    fate, row = Fate(state, event, 2), TABLE[state, event]
    with Simulation(choose) as simulation:
        run = Run(simulation, {who: [fate]}, [6, 5, 4], 2, retries=retries)
    run.check_rows()
    is_replaced = retries == 1 and state != "closing"
    assert len(run.launches[who]) == 1 + is_replaced
    assert (run.error is None) == (retries == 1)
    assert is_named(who, fate, caplog.text if run.error is None else str(run.error))
    noticed = run.launches[who][1] if is_replaced else run.ended
    assert row.after <= noticed - run.since(fate) <= row.before + TICK


def test_replaced_client_waits_for_run_that_is_busy_between_batches():
    with Simulation() as simulation:
        fates = {1: [Fate("idle", "is killed", 1)]}
        options = {"pauses": [1, 1, 1, 300], "run_ahead": 30, "retries": 1}
        run = Run(simulation, fates, [2, 2, 2, 2], 2, **options)
    assert run.error is None
    run.check_rows()


def test_client_is_not_called_slow_because_the_run_was_busy(caplog):
    with Simulation() as simulation:
        fates = {2: [Fate("busy", "vanishes", 4)]}
        options = {"pauses": [1, 1, 300], "run_ahead": 30, "retries": 1}
        run = Run(simulation, fates, [6, 5, 13], 3, **options)
    assert run.error is None
    assert "for a row" not in caplog.text


FATES = st.lists(
    st.builds(
        lambda place, after: Fate(*place, after), st.sampled_from(list(TABLE)), st.integers(0, 8)
    ),
    max_size=3,
)


@pytest.mark.slow
@settings(max_examples=size(150, 10), phases=[Phase.generate])
@given(
    drawn,
    st.tuples(FATES, FATES, FATES),
    st.integers(0, 2),
    st.sampled_from([0, 3, 30]),
    st.sampled_from([0.01, 0.2]),
    st.lists(st.sampled_from([0, 1, 10 * TIMEOUT]), min_size=4, max_size=4),
)
def test_clients_of_any_history_are_named_and_replaced_as_in_the_table(
    choose, fates, retries, run_ahead, pace, pauses
):
    """An instance's clients meet their fates one after another, as long as it is restarted."""
    given = dict(enumerate(fates, 1))
    with Simulation(choose) as simulation:
        options = {"pauses": pauses, "run_ahead": run_ahead, "pace": pace, "retries": retries}
        run = Run(simulation, given, [6, 5, 13, 4], 3, **options)
    run.check_rows()
    final = []
    for number, each in given.items():
        met = [fate for fate in each if fate.began is not None]
        lost = [fate for fate in met[:retries] if fate.state != "closing"]
        missing = 1 + len(lost) - len(run.launches[number])  # the last one, as the run has ended
        had_all = "idle" in {fate.state for fate in lost[-2:]}  # rows, so nobody had to start
        assert missing == 0 or (missing == 1 and (run.error or had_all))
        for fate, noticed in zip(lost, run.launches[number][1:], strict=False):
            assert noticed - run.since(fate) >= TABLE[fate.state, fate.event].after
        final += [(number, fate) for fate in met[retries:]]
        if run.error is None and met[retries:]:  # the run had all rows of the instance
            assert "idle" in {fate.state for fate in met[-2:]}
    if run.error is not None:
        assert any(is_named(number, fate, str(run.error)) for number, fate in final)


def is_named(number, fate, text):
    """Return whether a text says what happened to an instance's client."""
    says = TABLE[fate.state, fate.event].says
    return re.search(rf"([Cc]lient|[Ii]nstance) {number}\b.*{says}", text, re.DOTALL) is not None
