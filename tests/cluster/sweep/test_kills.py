"""Whatever is killed, the table and the networks are those of an undisturbed sweep."""

import random
import signal
import time
from pathlib import Path

import pytest
from sweep_kills import processes, start, sweep_with_kills

from physx_cluster.sweep import Definition, Study
from physx_cluster.sweep.plan import Plan
from physx_core import DataGeneration, EnvironmentConfig, read_scalars

pytestmark = [
    pytest.mark.usefixtures("nothing_stays_behind"),
    pytest.mark.slow,
    pytest.mark.processes,
]
EPOCHS, BATCHES = 4, 8


@pytest.fixture
def slow(training):
    """A training whose batches take 10 ms at least, so that kills meet it."""
    training["network"]["optimization_kwargs"] = {"pause": 0.01}
    return training


def check(parameters_of, whole="studies/whole", killed="studies/killed"):
    assert (Path(killed) / "trials.csv").read_bytes() == (Path(whole) / "trials.csv").read_bytes()
    assert parameters_of(killed) == parameters_of(whole)
    for trial in parameters_of(whole):
        assert read_scalars(Path(killed) / trial) == read_scalars(Path(whole) / trial)


def test_killed_trials_resume_bit_identically(write, slow, whole, parameters_of):
    whole()
    write(run={"parallel": 2})
    chance = random.Random(1)
    moments = {
        f"trial_{number:04}": sorted(chance.sample(range(1, EPOCHS * BATCHES), 2))
        for number in (1, 2)
    }
    lost, kills = sweep_with_kills("sweep.toml", "studies/killed", moments, BATCHES)
    check(parameters_of)
    spent = sum(place.stat().st_size for place in Path("studies/killed").glob("*.batches"))
    assert kills == 4
    assert spent - 2 * EPOCHS * BATCHES <= lost <= kills * BATCHES


@pytest.mark.faults
def test_killed_sweep_resumes_by_same_command(write, slow, whole, parameters_of):
    whole(seeds=[0, 1])
    write(run={"parallel": 2}, seeds=[0, 1])
    _, kills = sweep_with_kills("sweep.toml", "studies/killed", {}, BATCHES, whole=[20, 70])
    assert kills == 2
    check(parameters_of)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_to_sweep_writes_checkpoints(write, slow, whole, physx, parameters_of, number):
    slow["network"]["optimization_kwargs"] = {"pause": 0.05}
    one = {"training.network.lr": [0.1]}
    whole(parameters=one)
    write(parameters=one)
    sweep = start("sweep.toml", "studies/killed")
    place = Path("studies/killed/trial_0001.batches")
    deadline = time.monotonic() + 60
    while not place.exists() or place.stat().st_size < BATCHES + 2:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    sweep.send_signal(number)
    assert sweep.wait(60) == 128 + number
    assert not processes("studies/killed")
    physx("sweep", "studies/killed", PHYSX_TEST_BATCHES="1")
    assert place.stat().st_size == EPOCHS * BATCHES  # nothing was trained twice
    check(parameters_of)


def test_trial_beyond_restart_limit_is_given_up(write, slow, physx):
    slow["network"]["optimization"] = f"{Path(__file__).parents[1]}/programs/descent.py:Doomed"
    write(run={"restarts": 1})
    said = physx("sweep", "sweep.toml", status=1)
    assert said.count("was killed by signal 9 (SIGKILL); resuming it") == 2
    assert said.count("was killed by signal 9 (SIGKILL); giving it up") == 2
    assert "Trial 1 (linear, lr 0.1, seed 0) has no result" in said
    assert "2 trials were given up in total" in said
    assert len(Path("studies/sweep/trials.csv").read_text().splitlines()) == 1


@pytest.mark.faults
def test_incomplete_data_of_killed_trial_are_regenerated(write, slow, physx, parameters_of):
    del slow["dataset"]["existing_dir"]
    spring = {"environment": "toy/spring", "as_tcp_ip_client": False}
    generation = {"batch_nb": 5, "batch_size": 20, "environment": spring}
    write(
        pipelines={"own": {"data_generation": generation, "training": slow}},
        parameters={"training.network.lr": [0.1]},
    )
    physx("sweep", "sweep.toml", "--study", "studies/whole")
    definition = Definition.read(Path("sweep.toml"))
    with Study.open(Path("studies/killed"), definition) as study:
        for trial in Plan(definition).next_batch():
            study.prepare(trial)
    DataGeneration(  # what a process leaves that is killed after two of five batches
        EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0),
        session_dir="studies/killed",
        session_name="trial_0001",
        new_session=False,
        batch_nb=2,
        batch_size=20,
        quiet=True,
    ).execute()
    physx("sweep", "sweep.toml", "--study", "studies/killed")
    check(parameters_of)


@pytest.mark.faults
def test_killed_online_trials_resume(write, slow, physx, parameters_of):
    slow["dataset"] = {}
    slow["batch_nb"] = BATCHES
    slow["environment"] = {"environment": "toy/spring", "num_clients": 2}
    write(parameters={"training.network.lr": [0.1]}, result="loss/training")
    physx("sweep", "sweep.toml", "--study", "studies/whole")
    moments = {"trial_0001": [5, 12]}
    _, kills = sweep_with_kills("sweep.toml", "studies/killed", moments, BATCHES)
    assert kills == 2
    assert (Path("studies/killed/trials.csv")).read_bytes() == (
        Path("studies/whole/trials.csv")
    ).read_bytes()
    assert parameters_of("studies/killed") == parameters_of("studies/whole")


@pytest.mark.faults
@pytest.mark.parametrize("seed", range(2))
def test_sweep_killed_at_random_moments_gives_same_table(write, slow, physx, parameters_of, seed):
    chance = random.Random(seed)
    write(
        sampler="optuna/tpe",
        trials=6,
        batch=2,
        pruner="optuna/median",
        pruner_kwargs={"n_startup_trials": 2},
        seed=seed,
        parameters={"training.network.lr": {"low": 0.01, "high": 0.5, "log": True}},
        run={"parallel": 1},
    )
    pytest.importorskip("optuna")
    physx("sweep", "sweep.toml", "--study", "studies/whole")
    write_parallel = Path("sweep.toml").read_text().replace("parallel = 1", "parallel = 2")
    Path("sweep.toml").write_text(write_parallel)
    moments = {
        f"trial_{number:04}": sorted(chance.sample(range(1, EPOCHS * BATCHES), 2))
        for number in range(1, 7)
    }
    whole = sorted(chance.sample(range(1, 5 * EPOCHS * BATCHES), 2))
    sweep_with_kills("sweep.toml", "studies/killed", moments, BATCHES, whole)
    check(parameters_of)
