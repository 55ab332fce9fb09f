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

    def __init__(self, memory=512):
        self.memory = memory
        self.told = self.batches = 0
        self.asked = {}

    def ask(self, number):
        assert number == len(self.asked)
        self.asked[number] = self.batches
        return self.values(np.full(self.size, self.told % 1))

    def state(self):
        return np.array([self.told, self.batches])

    def restore(self, state):
        self.told, self.batches = state

    def tell(self, numbers, values, losses):
        assert (np.diff(numbers) > 0).all()
        assert len(numbers) == len(values) == len(losses)
        self.batches += 1
        self.told += float(losses.sum()) + numbers[-1] / 7


def train(folder, *, clients, environment=SWING, kwargs=None, sampler, online=None, **options):
    config = EnvironmentConfig(
        environment, env_kwargs=kwargs or {}, num_clients=options.pop("num_clients", 2), seed=3,
        as_tcp_ip_client=clients, episode_steps=3 if environment == SWING else 1,
        sampler=sampler, sampler_kwargs=options.pop("sampler_kwargs", {}),
    )  # fmt: skip
    network = options.pop("network", None) or NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"}
    )
    settings = {"epoch_nb": 1, "batch_nb": 8, "batch_size": 6, "seed": 5, "run_ahead": 4}
    settings |= {**(online or {}), **options}
    run = Training(network, None, config, session_dir=str(folder), quiet=True, **settings)
    run.execute()
    return run, stored(run.session.path) | {"weights": run.learner.network.weights}


def stored(session):
    """Return the rows of a session, and the parameters of its episodes in order."""
    with Dataset.open(session / "dataset") as dataset:
        assert dataset.verify() == []
        rows = {name: dataset["training"][name][:] for name in dataset.fields("training")}
        table = dataset.episode_table(["training"])
        counts = table["rows"] > 0  # others were begun, but no batch needed them
    names = table.keys() - {"seconds"}
    return rows | {f"episode/{name}": table[name][counts] for name in names}


RESERVOIR = {
    "online": "physx/reservoir",
    "online_kwargs": {"capacity": 16, "watermark": 10, "views": 2},
}


@pytest.mark.parametrize("online", [{}, RESERVOIR], ids=["stream", "reservoir"])
@pytest.mark.parametrize("run_ahead", [1, pytest.param(4, marks=pytest.mark.faults), 64])
def test_sampler_that_learns_is_independent_of_clients_and_speed(tmp_path, run_ahead, online):
    options = {"sampler": Recording, "online": online, "run_ahead": run_ahead}
    _, expected = train(tmp_path, clients=False, **options)
    for kwargs, clients in (({}, 1), ({"how": "slow"}, 3)):
        _, found = train(tmp_path, clients=True, num_clients=clients, kwargs=kwargs, **options)
        for name, values in expected.items():
            assert found[name].tobytes() == values.tobytes(), name
    assert len(np.unique(expected["x"])) >= (2 if run_ahead < 64 else 1)


def test_parameters_depend_on_batches_of_earlier_episodes_only(tmp_path):
    """Episodes have 3 rows and batches 6, so batch b needs episodes up to 2 b + 1."""
    run, _ = train(tmp_path, clients=True, sampler=Recording, run_ahead=4)
    asked = run.data.source.sets._sampler.asked
    assert [asked[number] for number in range(16)] == [max(0, n - 4) // 2 for n in range(16)]


def test_active_draws_where_the_loss_is_high_and_everywhere_a_little(tmp_path):
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
    options = {
        "environment": HARD, "network": network, "batch_nb": 40, "batch_size": 10, "clients": False,
    }  # fmt: skip
    shares = []
    for sampler in ("physx/uniform", "physx/active"):
        _, found = train(tmp_path, sampler=sampler, **options)
        points = found["x"][200:]
        shares.append(np.mean(np.linalg.norm(points - 0.8, axis=1) < 0.2))
        cells = {*map(tuple, np.floor(points * 3).astype(int).tolist())}
        assert len(cells) == 9
    assert shares[1] > 2.5 * shares[0]


def test_active_runs_in_clients_and_from_the_command_line(tmp_path):
    from physx_core.cli import main

    words = f"train {tmp_path}/run {HARD} --epoch-nb 1 --batch-nb 6 --batch-size 8 --seed 1"
    words += f" --session-dir {tmp_path} --session-name run --network.network toy/linear"
    words += " --network.network-kwargs net_fields=x opt_fields=y --environment.num-clients 2"
    words += " --environment.sampler physx/active --environment.sampler-kwargs uniform=0.5"
    words += " --environment.episode-steps 1 --run-ahead 2"
    words = words.replace(f"train {tmp_path}/run {HARD}", f"train --environment.environment {HARD}")
    assert main(words.split()) == 0
    with Dataset.open(tmp_path / "run" / "dataset") as dataset:
        assert dataset.num_samples("training") == 48
        assert len(np.unique(dataset["training"]["x"][:], axis=0)) == 48


# Resumed ------------------------------------------------------------------------------------------


def kept(folder, name):
    """Return all rows and parameters, and the weights of the last checkpoint."""
    session = folder / "sessions" / name
    found = {field: values.tobytes() for field, values in stored(session).items()}
    last = checkpoint.find(session, None, -1)
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


@pytest.mark.parametrize("run_ahead", [1, 3])
def test_error_ends_run_whose_clients_wait_for_losses(tmp_path, run_ahead, nothing_stays_behind):
    class Failing(Training):
        def batch_begin(self):
            super().batch_begin()
            if self.batch_id == 3:
                time.sleep(0.5)  # the clients wait for parameters by now
                raise RuntimeError("on purpose")

    environment = EnvironmentConfig(
        SWING, num_clients=2, seed=3, sampler="physx/active", episode_steps=3
    )
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"})
    began = time.monotonic()
    with pytest.raises(RuntimeError, match="on purpose"):
        Failing(
            network, None, environment, session_dir=str(tmp_path), epoch_nb=1, batch_nb=9,
            batch_size=6, run_ahead=run_ahead, quiet=True,
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
@pytest.mark.parametrize("episode_steps", [None, 3])
def test_sampler_that_learns_needs_a_training(tmp_path, clients, episode_steps):
    config = EnvironmentConfig(
        SWING, as_tcp_ip_client=clients, sampler="physx/active", episode_steps=episode_steps
    )
    with pytest.raises(UsageError, match="learns from training losses"):
        DataGeneration(
            config, session_dir=str(tmp_path), batch_nb=1, batch_size=2, quiet=True
        ).execute()


@pytest.mark.parametrize("clients", [False, True])
def test_sampler_that_learns_needs_independent_episodes(tmp_path, clients):
    config = EnvironmentConfig(SWING, as_tcp_ip_client=clients, sampler="physx/active")
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "noise"})
    with pytest.raises(UsageError, match="learns from training losses.*independent episodes"):
        Training(
            network, None, config, session_dir=str(tmp_path), epoch_nb=1, batch_nb=2, batch_size=2
        ).execute()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uniform": 0.0}, "uniform is 0.0"),
        ({"width": 0.6}, "width is 0.6"),
        ({"memory": 0}, "memory is 0"),
    ],
)
def test_options_out_of_range_are_errors(tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        train(tmp_path, clients=False, sampler="physx/active", sampler_kwargs=options)
