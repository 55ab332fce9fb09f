"""Samplers that learn from losses: the same simulations in every run, and where losses are high."""

from __future__ import annotations

import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from sizes import seed, trials

from physx_core import (
    DataGeneration,
    Dataset,
    EnvironmentConfig,
    NetworkConfig,
    Training,
    checkpoint,
)
from physx_core.components import LearningSampler
from physx_core.errors import ConfigError, UsageError
from physx_core.toy import LeastSquares

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "parameter_envs.py"
PROGRAM = ENVS.with_name("online_run.py")
SWING, HARD = f"{ENVS}:Swing", f"{ENVS}:Hard"


class Recording(LearningSampler):
    """Chooses what it was told last, and notes how many batches each choice depends on."""

    def __init__(self, delay=1, memory=512):
        self.delay, self.memory = delay, memory
        self.told = {0: 0.0}
        self.asked = {}

    def ask_after(self, number, batches):
        self.asked[number] = batches
        share = self.told[batches] % 1
        return self.values(np.full(self.size, share))

    def state(self, batches):
        return np.array([[n, told] for n, told in self.told.items() if n <= batches]).ravel()

    def restore(self, batches, state):
        self.told = {int(n): told for n, told in state.reshape(-1, 2)}

    def tell(self, batches, numbers, values, losses):
        assert batches - 1 in self.told
        assert (np.diff(numbers) > 0).all()
        assert len(numbers) == len(values) == len(losses)
        self.told[batches] = self.told[batches - 1] + float(losses.sum()) + numbers[-1] / 7


def train(folder, *, clients, environment=SWING, kwargs=None, sampler, online=None, **options):
    config = EnvironmentConfig(
        environment, env_kwargs=kwargs or {}, num_clients=2, seed=3, as_tcp_ip_client=clients,
        sampler=sampler, sampler_kwargs=options.pop("sampler_kwargs", {}),
    )  # fmt: skip
    network = options.pop("network", None) or NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"}
    )
    online = online or {}
    settings = {"epoch_nb": 1, "batch_nb": 8, "batch_size": 6, "seed": 5, **online, **options}
    run = Training(network, None, config, session_dir=str(folder), quiet=True, **settings)
    run.execute()
    with Dataset.open(run.session.dataset_dir) as dataset:
        found = {
            f"{mode}/{name}": dataset[mode][name][:]
            for mode in ("training", "parameters")
            for name in dataset.fields(mode)
        }
    found["weights"] = run.learner.network.weights
    return run, found


RESERVOIR = {
    "online": "physx/reservoir",
    "online_kwargs": {"capacity": 16, "watermark": 10, "views": 2},
}


@pytest.mark.parametrize("online", [{}, RESERVOIR], ids=["stream", "reservoir"])
@pytest.mark.parametrize("delay", [0, pytest.param(1, marks=pytest.mark.faults), 3])
def test_active_sampler_is_independent_of_clients_and_delays(tmp_path, delay, online):
    options = {"sampler": Recording, "sampler_kwargs": {"delay": delay}, "online": online}
    _, expected = train(tmp_path, clients=False, **options)
    for kwargs in ({}, {"how": "slow"}):
        _, found = train(tmp_path, clients=True, kwargs=kwargs, **options)
        for name, values in expected.items():
            assert found[name].tobytes() == values.tobytes(), name
    assert len(np.unique(expected["parameters/stiffness"])) >= 2


def test_what_a_set_may_depend_on_is_counted_in_batches(tmp_path):
    """Row r is one of batch r // 6; a set is asked for with the first row of its episode."""
    run, found = train(tmp_path, clients=True, sampler=Recording, sampler_kwargs={"delay": 2})
    asked = run.data.source.sets._sampler.asked
    numbers = found["training/episode"] * 2 + found["training/env_id"] - 1
    firsts = [numbers.tolist().index(number) for number in found["parameters/set"]]
    assert [asked[n] for n in found["parameters/set"].tolist()] == [
        max(0, first // 6 - 2) for first in firsts
    ]


def test_active_draws_where_the_loss_is_high_and_everywhere_a_little(tmp_path):
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
    options = {
        "environment": HARD, "network": network, "batch_nb": 40, "batch_size": 10, "clients": False,
    }  # fmt: skip
    shares = []
    for sampler in ("physx/uniform", "physx/active"):
        _, found = train(tmp_path, sampler=sampler, **options)
        points = np.c_[found["parameters/a"], found["parameters/b"]][200:]
        shares.append(np.mean(np.linalg.norm(points - 0.8, axis=1) < 0.2))
        cells = {*map(tuple, np.floor(points * 3).astype(int).tolist())}
        assert len(cells) == 9
    assert shares[1] > 2.5 * shares[0]


def test_active_runs_in_clients_and_from_the_command_line(tmp_path):
    from physx_core.cli import main

    words = f"train {tmp_path}/run {HARD} --epoch-nb 1 --batch-nb 6 --batch-size 8 --seed 1"
    words += f" --session-dir {tmp_path} --session-name run --network.network toy/linear"
    words += " --network.network-kwargs net_fields=x opt_fields=y --environment.num-clients 2"
    words += " --environment.sampler physx/active --environment.sampler-kwargs uniform=0.5 delay=2"
    words = words.replace(f"train {tmp_path}/run {HARD}", f"train --environment.environment {HARD}")
    assert main(words.split()) == 0
    with Dataset.open(tmp_path / "run" / "dataset") as dataset:
        assert dataset.num_samples("parameters") == 48


# Resumed ------------------------------------------------------------------------------------------


def kept(folder, name):
    """Return all rows and sets, and the files of the last checkpoint."""
    with Dataset.open(folder / "sessions" / name / "dataset") as dataset:
        found = {
            f"{mode}/{field}": dataset[mode][field][:].tobytes()
            for mode in ("training", "parameters")
            for field in dataset.fields(mode)
        }
    last = checkpoint.find(folder / "sessions" / name, None, -1)
    with zipfile.ZipFile(last.path / "parameters.npz") as file:
        found["weights"] = file.read("weights.npy")
    return found


def survives(run_killed, folder, seed, kills, words):
    where, buffer = words

    def killed(name, moments):
        return run_killed(str(PROGRAM), folder, moments, name, where, "once", buffer, "active")

    random, (_, whole) = np.random.default_rng(seed), killed("whole", [])
    count, _ = killed("killed", (whole * random.uniform(0.15, 0.6, kills)).tolist())
    expected, found = kept(folder, "whole"), kept(folder, "killed")
    assert expected.keys() == found.keys()
    assert [name for name in expected if expected[name] != found[name]] == []
    return count


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("clients", "stream"), marks=pytest.mark.faults),
        ("clients", "reservoir"),
        pytest.param(("local", "reservoir"), marks=pytest.mark.faults),
    ],
    ids=str,
)
def test_kill_and_resume_with_active_sampler_is_bit_identical(tmp_path, words, run_killed):
    assert survives(run_killed, tmp_path, 2, 3, words)


@pytest.mark.faults
@pytest.mark.parametrize("words", [("clients", "stream"), ("clients", "reservoir")], ids=str)
def test_kills_at_random_moments_with_active_sampler(tmp_path, words, run_killed):
    assert survives(run_killed, tmp_path, seed(), trials(10, 4), words)


def test_resume_after_failed_parameters_is_refused_with_recorded_rejections(tmp_path):
    environment = EnvironmentConfig(
        SWING,
        env_kwargs={"fails_above": 25.0},
        seed=3,
        redraw=99,
        as_tcp_ip_client=False,
        record_wrong_samples=True,
    )
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"})
    options = {"session_dir": str(tmp_path), "session_name": "run", "quiet": True, "batch_size": 5}
    options |= {"epoch_nb": 2, "batch_nb": 6, "seed": 5, "checkpoint_every": 2}

    class Stopped(Training):
        def batch_end(self):
            if self.batch_id == 4:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Stopped(network, None, environment, **options).execute()
    with pytest.raises(ConfigError, match="simulations failed.*network_dir"):
        Training(network, None, environment, resume=True, **options).execute()


@pytest.mark.parametrize("delay", [0, 1])
def test_error_ends_run_whose_clients_wait_for_losses(tmp_path, delay, nothing_stays_behind):
    class Failing(Training):
        def batch_begin(self):
            super().batch_begin()
            if self.batch_id == 3:
                time.sleep(0.5)  # the clients wait for parameters by now
                raise RuntimeError("on purpose")

    environment = EnvironmentConfig(
        SWING, num_clients=2, seed=3, sampler="physx/active", sampler_kwargs={"delay": delay}
    )
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"})
    began = time.monotonic()
    with pytest.raises(RuntimeError, match="on purpose"):
        Failing(
            network, None, environment, session_dir=str(tmp_path), epoch_nb=1, batch_nb=9,
            batch_size=6, quiet=True,
        ).execute()  # fmt: skip
    assert time.monotonic() - began < 50


class Silent(LeastSquares):
    """Does not tell the losses of rows."""

    def compute_row_losses(self, batch):
        return super(LeastSquares, self).compute_row_losses(batch)


class Short(LeastSquares):
    """Tells the loss of one row only."""

    def compute_row_losses(self, batch):
        return np.zeros(1)


@pytest.mark.parametrize(
    ("optimization", "error", "message"),
    [(Silent, ConfigError, "loss of each row"), (Short, UsageError, r"shape \(1,\) for 6")],
)
@pytest.mark.parametrize("clients", [False, True])
def test_an_optimization_without_losses_of_rows_is_an_error(
    tmp_path, optimization, error, message, clients
):
    network = NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"},
        optimization=optimization,
    )  # fmt: skip
    with pytest.raises(error, match=message):
        train(tmp_path, clients=clients, sampler="physx/active", network=network)


@pytest.mark.parametrize("clients", [False, True])
def test_a_sampler_that_learns_needs_a_training(tmp_path, clients):
    config = EnvironmentConfig(SWING, as_tcp_ip_client=clients, sampler="physx/active")
    with pytest.raises(UsageError, match="learns from training losses"):
        DataGeneration(
            config, session_dir=str(tmp_path), batch_nb=1, batch_size=2, quiet=True
        ).execute()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uniform": 0.0}, "uniform is 0.0"),
        ({"width": 0.6}, "width is 0.6"),
        ({"memory": 0}, "memory is 0"),
        ({"delay": -1}, "delay is -1"),
    ],
)
def test_options_out_of_range_are_errors(tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        train(tmp_path, clients=False, sampler="physx/active", sampler_kwargs=options)
