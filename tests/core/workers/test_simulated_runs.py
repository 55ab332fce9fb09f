"""Runs of clients within one thread: no process, no socket; the order of all events is drawn."""

from __future__ import annotations

import math
import signal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated import HOST, ROOM, Deadlock, Simulation, drawn
from sizes import size

from physx_core import EnvironmentConfig
from physx_core.errors import ClientError
from physx_core.sources import ClientSource, LocalSource

SEED = [5, 0, 7]
SIZES = [3, 40, 1, 16]

rooms = st.sampled_from([100, 3000, ROOM])


class Services:
    """Predictions of several samples at once; the fields are doubled."""

    def predict(self, fields):
        return {"y": 2 * np.asarray(fields["x"])}

    def predict_batch(self, batch):
        return {"y": 2 * batch["x"]}

    def save_parameters(self, instance_id, values):
        """Keep nothing."""

    def load_parameters(self, instance_id):
        return {}


@pytest.fixture(scope="module")
def program():
    """Return a function: the reference of an environment in worker_envs.py."""
    folder = __file__.rpartition("/workers/")[0]
    return lambda name: f"{folder}/programs/worker_envs.py:{name}"


def run(source, sizes=SIZES, begun=None):
    """Return the bytes of all rows by field; `begun` is called after the first batch."""
    batches = []
    with source:
        for size in sizes:
            batches.append({name: rows.copy() for name, rows in source.batch(size).items()})
            if begun is not None:
                begun, _ = None, begun()
    return {name: b"".join(batch[name].tobytes() for batch in batches) for name in batches[0]}


def simulate(simulation, environment, *, run_ahead=30, **options):
    config = EnvironmentConfig(
        environment, num_clients=2, launcher="simulated:SimulatedLauncher", **options
    )
    return ClientSource(config, Services(), SEED, run_ahead=run_ahead, transport=simulation)


def local(environment, **options):
    return LocalSource(EnvironmentConfig(environment, num_clients=2, **options), Services(), SEED)


@pytest.mark.slow
@settings(max_examples=size(30, 4))
@given(drawn, rooms)
def test_rows_are_the_same_in_any_order_of_events(program, choose, room):
    kwargs = {"refuse": 5, "delay": 1e-3}
    expected = run(local(program("Walk"), env_kwargs=kwargs))
    with Simulation(choose, room) as simulation:
        assert run(simulate(simulation, program("Walk"), env_kwargs=kwargs)) == expected
        assert [client.exit_status() for client in simulation.clients] == [0, 0]


@settings(max_examples=size(30, 4))
@given(drawn)
def test_predictions_are_the_same_in_any_order_of_events(program, choose):
    expected = run(local(program("Asking")))
    with Simulation(choose) as simulation:
        source = simulate(simulation, program("Asking"), run_ahead=0)
        assert run(source) == expected


@pytest.mark.slow
@settings(max_examples=size(30, 4))
@given(drawn, rooms, st.integers(1, 100), st.booleans(), st.sampled_from([1, 2]))
def test_rows_are_the_same_whenever_a_client_is_lost(program, choose, room, event, begun, victim):
    kwargs = {"delay": 10e-3}  # so that there are some rows in each message
    expected = run(local(program("Walk"), env_kwargs=kwargs))
    with Simulation(choose, room) as simulation:
        source = simulate(simulation, program("Walk"), retries=1, env_kwargs=kwargs)

        def lose():
            simulation.plan[simulation.events + event] = simulation.clients[victim - 1].kill

        if not begun:
            simulation.plan[1] = lose
        assert run(source, begun=lose if begun else None) == expected
        ended = [client.exit_status() for client in simulation.clients]
        assert ended.count(0) == 2 or ended.count(-signal.SIGKILL) == 1


@settings(max_examples=size(30, 4))
@given(drawn, st.integers(30, 60))
def test_a_lost_client_that_is_not_replaced_is_named(program, choose, event):
    with Simulation(choose) as simulation:
        simulation.plan[event] = lambda: simulation.clients[1].kill()
        began = simulation.monotonic()
        with pytest.raises(ClientError, match=r"Client 2 was killed by signal 9 \(SIGKILL\)"):
            run(simulate(simulation, program("Walk")), [2000] * 20)
        assert simulation.monotonic() - began < 2.0
        assert all(client.exit_status() is not None for client in simulation.clients)


@settings(max_examples=size(30, 4))
@given(drawn, st.floats(0.5, 10.0))
def test_a_client_that_hangs_is_named_after_its_time(program, choose, timeout):
    kwargs = {"what": "hang", "who": 2}
    with Simulation(choose) as simulation:
        began = simulation.monotonic()
        with pytest.raises(ClientError, match=f"Client 2 sent nothing for {timeout:g} s"):
            run(simulate(simulation, program("Trouble"), env_kwargs=kwargs, timeout=timeout))
        assert timeout <= simulation.monotonic() - began < timeout + 3.0


def test_a_client_whose_machine_is_gone_is_replaced(program, caplog):
    expected = run(local(program("Walk")))
    with Simulation() as simulation:
        source = simulate(simulation, program("Walk"), retries=1, run_ahead=2)
        simulation.plan[60] = lambda: simulation.clients[1].vanish()
        began = simulation.monotonic()
        assert run(source) == expected
        assert 12.0 < simulation.monotonic() - began < 20.0
    assert "its machine no longer answers" in caplog.text


# Connections that are no clients -----------------------------------------------------------------


def test_a_silent_connection_is_dropped_after_a_while(simulated, simulation, caplog):
    with simulated(port=1) as source:
        silent = simulation.connect((HOST, 1), 60)
        silent.sendall(b"\0")
        source.batch(1)
        simulation.sleep(4.9)
        source.batch(1)
        assert not silent.has_ended
        simulation.sleep(0.2)
        source.batch(1)
        assert silent.recv(10) == b""


def test_many_silent_connections_do_not_keep_clients_out(simulated, simulation):
    with simulated(port=1, num_clients=1, retries=1, run_ahead=2) as source:
        crowd = []
        for _ in range(200):
            crowd.append(simulation.connect((HOST, 1), 60))
            source.batch(1)
        assert sum(connection.has_ended for connection in crowd) > 50
        simulation.alive[1].kill()
        source.batch(5)


# The simulation itself ---------------------------------------------------------------------------


def test_whoever_waits_for_nobody_is_noticed():
    with Simulation() as simulation, pytest.raises(Deadlock):
        simulation.wait(lambda: False)


def test_time_passes_only_while_everybody_waits():
    with Simulation() as simulation:
        began, seen = simulation.monotonic(), []

        def wake(seconds):
            simulation.sleep(seconds)
            seen.append((seconds, simulation.monotonic() - began))

        for seconds in (3.0, 1e9, 0.5):
            simulation.start(lambda seconds=seconds: wake(seconds))
        simulation.sleep(10.0)
        assert seen == [(0.5, 0.5), (3.0, 3.0)]
        assert math.isclose(simulation.monotonic(), began + 10.0)
