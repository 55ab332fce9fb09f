"""Elastic runs: clients come and go, and the rows are those of a run in this process."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset, EnvironmentConfig
from physx_core.errors import ConfigError, TooFewClientsError

pytestmark = pytest.mark.processes

PROGRAMS = Path(__file__).parents[1] / "programs"
WANDERER = f"{PROGRAMS / 'restart_envs.py'}:Wanderer"
SWING = f"{PROGRAMS / 'parameter_envs.py'}:Swing"
HOST = socket.gethostname()


@pytest.mark.parametrize("asks", [False, True])
def test_elastic_run_with_fewer_clients_gives_same_rows(local, clients, services, taking, asks):
    if asks:
        services.predict_batch = lambda batch: {"y": 2 * batch["x"]}
    settings = {"num_clients": 5, "env_kwargs": {"asks": asks, "refuse": 4}}
    with clients(WANDERER, min_clients=2, max_clients=2, **settings) as source:
        rows = taking(source)
        rows.take(1, 7, 12, 20)
    rows.check(local(WANDERER, **settings))


def test_stored_rows_and_predictions_reach_the_instances(local, clients):
    stored = {"position": np.arange(12.0).reshape(6, 2)}
    found = []
    for make, extra in ((local, {}), (clients, {"run_ahead": 0, "max_clients": 1})):
        with make(WANDERER, num_clients=3, **extra) as source:
            first = source.batch(6, stored)["position"].copy()
            source.apply({"y": first[:, :1]})
            found.append((first.tobytes(), source.batch(9)["position"].tobytes()))
    assert found[0] == found[1]


def test_parameters_that_fail_are_replaced_as_in_other_runs(local, clients, taking):
    settings = {
        "num_clients": 3,
        "env_kwargs": {"fails_above": 35.0},
        "sampler": "physx/sobol",
        "redraw": 20,
    }
    with clients(SWING, max_clients=2, **settings) as source:
        rows = taking(source)
        rows.take(20, 20)
    rows.check(local(SWING, **settings))


def test_spare_elastic_client_takes_over(local, clients, process_ids, taking, said):
    settings = {"num_clients": 1, "env_kwargs": {"pace": 0.003}}
    with clients(WANDERER, min_clients=1, max_clients=2, run_ahead=2, **settings) as source:
        rows = taking(source)
        rows.take(20)
        busy = next(pid for pid in process_ids().values() if process_ids(pid))
        rows.take_until(lambda: len(process_ids()) == 2)
        os.kill(busy, signal.SIGKILL)
        rows.take(20)
    rows.check(local(WANDERER, **settings))
    (text,) = said("another client takes over")
    assert text.endswith("It is not restarted: restarts is 0.")


# Coming and going -------------------------------------------------------------------------------


def test_late_elastic_client_takes_over_instances(local, by_hand, join, taking, said, caplog):
    caplog.set_level("INFO", "physx")
    settings = {"num_clients": 4, "env_kwargs": {"pace": 0.002}}
    ours = [join()]
    source = by_hand(WANDERER, min_clients=1, max_clients=2, run_ahead=2, total=10_000, **settings)
    with source:
        rows = taking(source)
        rows.take(8)
        ours.append(join())
        rows.take_until(lambda: len(said("moves from client 1")) == 2)
        rows.take(20)
    rows.check(local(WANDERER, **settings))
    texts = [process.communicate(timeout=60)[0] for process in ours]
    assert [process.returncode for process in ours] == [0, 0]
    assert "waiting for instances to run" in texts[0]
    assert len(re.findall(r"instance \d moves to another client", texts[0])) == 2
    assert len(re.findall(r"running instance \d", texts[1])) == 2
    assert "the run has ended" in texts[1]
    assert said()[0].startswith("The run waits for 1 client (at most 2 may join). Start each")


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_leaving_elastic_client_does_not_end_run(local, by_hand, join, taking, said, how):
    settings = {"num_clients": 3, "env_kwargs": {"pace": 0.002, "asks": True}}
    leaver, _ = join(), join()
    with by_hand(WANDERER, min_clients=1, run_ahead=2, **settings) as source:
        rows = taking(source)
        rows.take(9)
        leaver.send_signal(how)
        rows.take_until(lambda: said("another client takes over|left"))
        rows.take(15)
    rows.check(local(WANDERER, **settings))
    (text,) = said("left")
    assert re.match(rf"Client \d on {HOST} left\.", text)


def test_elastic_run_below_min_clients_waits_with_message(
    local, by_hand, join, taking, said, monkeypatch
):
    monkeypatch.setattr("physx_core.workers.server.client_pool._SAY_EVERY", 0.2)
    settings = {"num_clients": 2, "env_kwargs": {"pace": 0.002}}
    ours = [join(), join()]

    def come_late():
        deadline = time.monotonic() + 60
        while not said("1 client and has been waiting for others for [^1]"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        ours.append(join())

    late = threading.Thread(target=come_late)
    with by_hand(WANDERER, min_clients=2, run_ahead=2, **settings) as source:
        rows = taking(source)
        rows.take(9)
        ours[0].kill()
        late.start()
        rows.take(60)
        late.join()
    rows.check(local(WANDERER, **settings))
    assert (
        "It needs 2 (min_clients), and waits no longer than 20 s" in said("waiting for others")[0]
    )


def test_elastic_run_below_min_clients_ends_after_timeout(by_hand, join, unhurried):
    join()
    with (
        pytest.raises(
            TooFewClientsError,
            match=r"has 1 client, but needs 2 \(min_clients\), and no other joined for \d+ s",
        ) as caught,
        by_hand(WANDERER, num_clients=2, min_clients=2, timeout=unhurried(1.0)),
    ):
        pass
    assert (caught.value.clients, caught.value.needed) == (1, 2)


def test_client_beyond_max_clients_is_refused(by_hand, join):
    join("--instance", "1")
    with by_hand(WANDERER, num_clients=2, max_clients=1) as source:
        rest = [join(), join("--instance", "2")]
        while any(process.poll() is None for process in rest):
            source.batch(2)
            time.sleep(0.01)
    for process in rest:
        assert "at most 1 may join (max_clients), and 1 already joined" in process.stderr.read()
        assert process.returncode == 1


# Configurations ---------------------------------------------------------------------------------


def test_invalid_elastic_options_are_refused(clients, local):
    with pytest.raises(ConfigError, match=r"min_clients is 3, but max_clients lets only 2"):
        clients(min_clients=3, max_clients=2)
    with pytest.raises(ConfigError, match=r"runs in this process.*leave them out"):
        local("Plain", min_clients=1)
    with pytest.raises(ConfigError, match="max_clients is 0 but must be at least 1"):
        EnvironmentConfig("toy/spring", max_clients=0)


def test_elastic_run_from_command_line(nothing_stays_behind):
    for options in ([], ["--environment.max-clients", "2", "--environment.min-clients", "1"]):
        command = [sys.executable, "-m", "physx_core", "generate", "toy/spring"]
        command += ["--environment.num-clients", "3", "--environment.seed", "4", *options]
        command += ["--batch-nb", "5", "--batch-size", "20", "--quiet"]
        subprocess.run(command, check=True)
    found = []
    for path in sorted(Path("sessions").iterdir()):
        with Dataset.open(path) as dataset:
            fields = sorted(dataset.fields("training"))
            found.append([dataset["training"][name][:].tobytes() for name in fields])
    assert len(found) == 2
    assert found[0] == found[1]
