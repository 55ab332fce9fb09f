"""Streams that are restarted go on from their last state, with the same rows."""

from __future__ import annotations

import errno
import hashlib
import io
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated import ROOM, Simulation, drawn
from sizes import size

from physx_core import EnvironmentConfig
from physx_core.errors import ConnectionRefusedByPeerError, StateError
from physx_core.net import Kind, encode, pack
from physx_core.sources import ClientSource
from physx_core.workers.journal import Journal
from physx_core.workers.pasts import Past
from physx_core.workers.server.validation import parse_state

ENVS = Path(__file__).parents[1] / "programs" / "state_envs.py"
STREAM = f"{ENVS}:Stream"
SIZES = [3, 7, 1, 9, 12]


def digest(batches):
    """Return a hash of rows by field, whatever the sizes of the batches."""
    found = hashlib.sha256()
    for name in sorted(batches[0]):
        for batch in batches:
            found.update(np.ascontiguousarray(batch[name]).tobytes())
    return found.hexdigest()


def run(source, *, applies=True, stored=False):
    """Return the digests of all rows, and of those that were rejected."""
    batches, rejected = [], []
    with source:
        for number, size in enumerate(SIZES):
            given = {"position": np.arange(2.0 * size).reshape(size, 2) * number}
            batch = source.batch(size, given) if stored else source.batch(size)
            batches.append({name: values.copy() for name, values in batch.items()})
            rejected.append(source.pop_rejected())
            if applies:
                source.apply({"y": batch["position"][:, :1]})
    rejected = [batch for batch in rejected if batch]
    return digest(batches), digest(rejected) if rejected else ""


@pytest.fixture
def states(simulated, services, said):
    """Return a function that makes a source of two streams with states."""

    def make(every, environment=STREAM, *, run_ahead=0, **options):
        services.kept.clear()
        kwargs = {"env_kwargs": options.pop("env_kwargs", {}), "num_clients": 2, **options}
        return simulated(environment, run_ahead=run_ahead, state_every=every, **kwargs)

    yield make
    assert [text for text in said("gives none") if "Opaque" not in text] == []


PLACES = [f"{what} {row}" for row in range(20) for what in ("step", "prediction", "apply")]


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 3, 7])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"env_kwargs": {"parameters": True}},
        {"record_wrong_samples": True},
        {"visualizer": "rerun"},
    ],
)
def test_rows_do_not_depend_on_kills_at_every_row(states, every, options):
    kwargs = options.pop("env_kwargs", {})
    expected = run(states(every, env_kwargs=kwargs, **options))
    kwargs = {**kwargs, "kills": ["create", *PLACES]}
    assert run(states(every, env_kwargs=kwargs, retries=100, **options)) == expected
    assert len([*Path().glob("*-1")]) > 30


@pytest.mark.slow
@pytest.mark.parametrize("place", ["create", *PLACES[:48:5], *PLACES[1:48:7], *PLACES[2:48:7]])
def test_rows_do_not_depend_on_a_kill(states, place):
    options = {"record_wrong_samples": True}
    expected = run(states(4, env_kwargs={"parameters": True}, **options))
    kwargs = {"parameters": True, "kills": [place]}
    assert run(states(4, env_kwargs=kwargs, retries=1, **options)) == expected


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 4])
def test_stored_rows_do_not_depend_on_kills(states, every):
    expected = run(states(every), stored=True)
    kwargs = {"kills": PLACES}
    assert run(states(every, env_kwargs=kwargs, retries=100), stored=True) == expected


@pytest.mark.slow
def test_rows_that_run_ahead_do_not_depend_on_kills(states):
    options = {"run_ahead": 30, "record_wrong_samples": True}
    expected = run(states(3, env_kwargs={"asks": False}, **options), applies=False)
    kwargs = {"asks": False, "kills": PLACES, "pace": 0.003}
    source = states(3, env_kwargs=kwargs, retries=100, **options)
    assert run(source, applies=False) == expected


def test_rows_depend_on_where_states_are_but_not_on_where_the_environment_runs(
    states, local, services
):
    """The engine of these streams forgets something when it gives a snapshot."""
    found = {every: run(states(every)) for every in (0, 3, 4)}
    assert len(set(found.values())) == 3
    for every, rows in found.items():
        services.kept.clear()
        assert run(local(STREAM, num_clients=2, state_every=every)) == rows


def test_drawings_and_saved_parameters_are_not_repeated(states, services):
    seen = []
    for kills in ([], PLACES[:40:3]):
        services.shown.clear()
        run(states(3, env_kwargs={"kills": kills}, visualizer="rerun", retries=100))
        drawn = sorted((i, step, str(events)) for i, step, events in services.shown)
        seen.append((drawn, dict(services.kept)))
    assert seen[0] == seen[1]


@pytest.mark.slow
@pytest.mark.parametrize("every", [0, 5])
def test_only_rows_after_the_state_are_repeated(states, simulation, every):
    kwargs = {"asks": False, "refuse": 0, "kills": [f"step {row}" for row in range(1, 200)]}
    with states(every, env_kwargs=kwargs, retries=400, num_clients=1) as source:
        for _ in range(200):
            source.batch(1)
    assert simulation.steps < 200 + 200 * 6 if every else simulation.steps > 10_000


@pytest.fixture(scope="module")
def undisturbed():
    """The rows of two streams with states, computed once."""
    with Simulation() as simulation:
        return run(drawn_source(simulation))


def drawn_source(simulation, **options):
    config = EnvironmentConfig(
        STREAM,
        num_clients=2,
        launcher="simulated:SimulatedLauncher",
        record_wrong_samples=True,
        state_every=3,
        **options,
    )
    return ClientSource(config, NoNetwork(), [5, 0, 7], run_ahead=0, transport=simulation)


class NoNetwork:
    """Predictions of several samples at once; the fields are doubled."""

    def predict(self, fields):
        return {"y": 2 * np.asarray(fields["x"])}

    def predict_batch(self, batch):
        return {"y": 2 * batch["x"]}

    def save_parameters(self, instance_id, values):
        """Keep nothing."""

    def load_parameters(self, instance_id):
        return {}


@pytest.mark.slow
@settings(max_examples=size(40, 6), deadline=None)
@given(drawn, st.sampled_from([100, 3000, ROOM]), st.lists(st.integers(1, 600), max_size=5))
def test_rows_are_the_same_in_any_order_of_events_and_kills(undisturbed, choose, room, events):
    with Simulation(choose, room) as simulation:

        def kill():
            if simulation.alive:
                [*simulation.alive.values()][choose(len(simulation.alive))].kill()

        simulation.plan.update(dict.fromkeys(events, kill))
        source = drawn_source(simulation, retries=10)
        assert run(source) == undisturbed


@pytest.mark.parametrize("every", [0, 2])
def test_a_long_past_that_is_repeated_is_said(states, said, every):
    kwargs = {"pace": 30.0, "kills": ["step 4"]}
    with states(every, env_kwargs=kwargs, retries=1, timeout=100.0) as source:
        source.batch(10)
    hints = said("It repeats 3 rows first; with EnvironmentConfig.state_every")
    assert len(hints) == (0 if every else 2)


# What cannot be captured -------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "lock"), [("Opaque", "lock"), ("LaterOpaque", "lock")])
def test_streams_without_states_repeat_their_rows_with_one_warning(states, said, name, lock):
    environment = f"{ENVS}:{name}"
    expected = run(states(3, environment))
    (warning,) = said("repeat all rows")
    assert f".{lock}" in warning
    source = states(3, environment, env_kwargs={"kills": PLACES[:40:7]}, retries=20)
    assert run(source) == expected
    assert len(said("repeat all rows")) == 2


def test_a_state_of_another_environment_is_an_error_that_names_what_differs(states):
    environment = f"{ENVS}:Changing"
    kwargs = {"kills": ["step 9"]}
    with pytest.raises(StateError, match=r"differ: marker\b"):
        run(states(3, environment, env_kwargs=kwargs, retries=3))


# The journal -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_journal_is_bounded_by_the_rows_between_states(states, said, simulation):
    """Without states it has 100 kB for these rows."""
    source = states(10, env_kwargs={"refuse": 0}, retries=1, journal_size=15e-6)
    batches = []
    with source:
        for _ in range(60):
            batch = source.batch(20)
            batches.append({name: values.copy() for name, values in batch.items()})
            source.apply({"y": batch["position"][:, :1]})
        simulation.alive[2].kill()
        source.batch(20)
    assert said("Restart 1 of 1")
    assert not said("can no longer be restarted")


def test_journal_forgets_what_comes_before_a_state():
    journal = Journal(1, 1e9, None, None)
    orders = [pack(Kind.APPLY, b"%d" % number, 1) for number in range(5)]
    answers = {number: pack(Kind.ANSWER, b"a%d" % number, number) for number in range(1, 8)}
    for number in (1, 2):
        journal.record(answers[number])
    journal.end_creation()
    for number, order in enumerate(orders):
        journal.record(pack(Kind.CREDIT, number=number + 1))
        journal.record(order)
    for number in (3, 4, 5):
        journal.record(answers[number])
    assert journal.newest.describe() is None
    journal.keep_state(Past(9, b"state"), obeyed=3, requests=4)
    assert journal.newest.past.state == b"state"
    assert (journal.newest.obeyed, journal.newest.requests) == (3, 4)
    credits = [pack(Kind.CREDIT, number=number) for number in (4, 5)]
    found = [journal.order(index) for index in range(3, 6)]
    assert found == [credits[0] + orders[3], credits[1] + orders[4], None]
    journal.record(answers[7])
    found = [journal.answer(number) for number in (1, 2, 5, 6, 7, 8)]
    assert found == [answers[1], answers[2], None, None, answers[7], None]
    assert journal.answers == 7
    journal.keep_state(Past(12, b"next"), obeyed=5, requests=7)
    assert [journal.answer(number) for number in (1, 2, 7)] == [answers[1], answers[2], None]
    assert journal.order(5) is None
    journal.close()


def test_a_journal_that_cannot_keep_a_state_stays_as_it_is(monkeypatch):
    journal = Journal(1, 1e9, None, None)
    journal.keep_state(Past(1, b"first"))
    order = pack(Kind.APPLY, b"order", 1)
    journal.record(order)

    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "SpooledTemporaryFile", lambda *_: Full())
    journal.keep_state(Past(2, b"second"))
    assert journal.newest.past.state == b"first"
    assert journal.order(0) == order
    journal.close()


@pytest.mark.parametrize(
    "plain",
    [
        [],
        {"orders": 1, "shown": 0, "rejected": 0},
        {"orders": 1, "shown": 0, "rejected": -1, "state": b""},
        {"orders": 1.0, "shown": 0, "rejected": 0, "state": b""},
        {"orders": 1, "shown": 0, "rejected": 0, "state": "text"},
    ],
)
def test_a_message_that_is_no_state_is_refused(plain):
    with pytest.raises(ConnectionRefusedByPeerError, match="state"):
        parse_state(encode(plain))
