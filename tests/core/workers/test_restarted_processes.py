"""Restarts of client processes; what restarted clients do is in `test_restarts`."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig

pytestmark = pytest.mark.processes

WANDERER = f"{Path(__file__).parents[1] / 'programs' / 'restart_envs.py'}:Wanderer"
MORTAL = f"{Path(__file__).parents[1] / 'programs' / 'state_envs.py'}:Mortal"
ASKS = {"num_clients": 2, "env_kwargs": {"asks": True}}


@pytest.fixture
def batch_services(services):
    """The services, predicting several samples at once."""
    services.predict_batch = lambda batch: {"y": 2 * batch["x"]}
    return services


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "place"), [("kill", "step"), ("stop", "step"), ("disconnect", "prediction")]
)
def test_a_process_that_breaks_is_started_again(
    local, clients, batch_services, fault, place, unhurried
):
    settings = {"num_clients": 2, "env_kwargs": {"asks": True}}
    with local(WANDERER, **settings) as source:
        expected = digest([source.batch(19)])
    settings["env_kwargs"] |= {"fault": fault, "place": place, "at": 7}
    timeout = unhurried(2.0) if fault == "stop" else 60.0
    with clients(WANDERER, run_ahead=0, retries=1, timeout=timeout, **settings) as source:
        assert digest([source.batch(19)]) == expected
    assert len([*Path().glob("started-*")]) == 2 + 3


@pytest.mark.slow
def test_a_pipeline_stores_the_same_rows_whatever_happens(nothing_stays_behind):
    """With three clients and delays by chance, one of them killed in the last run."""
    sums = set()
    for fault in ("", "", "kill"):
        config = EnvironmentConfig(
            WANDERER,
            env_kwargs={"fault": fault, "at": 30, "delay": 0.004},
            num_clients=3,
            retries=1,
            seed=3,
        )
        generation = DataGeneration(config, batch_nb=10, batch_size=20)
        generation.execute()
        with Dataset.open(generation.session.path) as dataset:
            assert dataset.num_samples("training") == 200
            fields = dataset.fields("training")
            sums.add(digest([{name: dataset["training"][name][:] for name in fields}]))
        notes = [*Path().glob("started-*")]
        assert len(notes) == 3 + bool(fault)
        for note in notes:
            note.unlink()
    assert len(sums) == 1


@pytest.mark.slow
def test_a_stream_ends_though_each_of_its_processes_makes_few_rows(nothing_stays_behind):
    found = []
    for life in (0, 12):
        config = EnvironmentConfig(
            MORTAL,
            env_kwargs={"life": life},
            num_clients=2,
            retries=20,
            state_every=5,
            seed=3,
        )
        generation = DataGeneration(config, batch_nb=8, batch_size=10)
        generation.execute()
        with Dataset.open(generation.session.path) as dataset:
            assert dataset.num_samples("training") == 80
            fields = dataset.fields("training")
            found.append(digest([{name: dataset["training"][name][:] for name in fields}]))
    assert found[0] == found[1]


def digest(batches):
    """Return a hash of rows by field, whatever the sizes of the batches."""
    found = hashlib.sha256()
    for name in sorted(batches[0]):
        for batch in batches:
            found.update(np.ascontiguousarray(batch[name]).tobytes())
    return found.hexdigest()
