"""Samples of a campaign that `check_sample` rejects are stored with their episodes, by number."""

from __future__ import annotations

import numpy as np
import pytest
from campaigns import stream

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.cli import main

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

PROGRAM = """
from physx_core import Environment, Field, Parameter

class Case(Environment):
    def create(self):
        self.define_parameters(Parameter("p", 1.0, 2.0))

    def init_database(self):
        self.define_training_fields(Field("x", ()))

    def reset_parameters(self, p):
        self.p = p

    def step(self):
        self.x = self.rng.normal()
        self.set_training_data(x=self.x)

    def check_sample(self):
        return self.x > (5 if self.episode_index == 3 else 0)
"""
EPISODES, STEPS, MOST = 12, 3, 10


@pytest.fixture(autouse=True)
def case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "case.py").write_text(PROGRAM)


def generate(name, steps=STEPS, **options):
    config = EnvironmentConfig("case.py:Case", seed=1, episode_steps=steps,
                               record_wrong_samples=True, max_wrong_samples_per_step=MOST,
                               **options)  # fmt: skip
    run = DataGeneration(config, session_name=name, episodes=EPISODES, max_failed=1, quiet=True)
    run.execute()


def rows(name, mode):
    """Return each row of a mode: the episode, its step, and the number."""
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        assert not dataset[mode]["env_id"][:].any()
        columns = (dataset[mode][field][:].tolist() for field in ("episode", "step", "x"))
        return list(zip(*columns, strict=True))


def expected(seed, steps):
    """Return the rows and the rejected ones."""
    kept, wrong = [], []
    for number in range(EPISODES):
        rng, mine, rejected = stream(number, seed), [], []
        while len(mine) < steps and len(rejected) <= MOST:
            x = rng.normal()
            if x > (5 if number == 3 else 0):
                mine.append((number, len(mine), x))
            else:
                rejected.append((number, len(mine) + len(rejected), x))
        kept += mine if number != 3 else []
        wrong += rejected
    return kept, wrong


@pytest.mark.parametrize("steps", [1, STEPS])
@pytest.mark.parametrize("clients", [0, 1, 3])
def test_rejected_samples_are_stored_by_number(clients, steps):
    generate("run", steps, as_tcp_ip_client=clients > 0, num_clients=max(1, clients))
    with Dataset.open("sessions/run") as dataset:
        seed = dataset.info["campaigns"][0]["seed"]
        assert [each.episode for each in dataset.failed_episodes("training")] == [3]
    kept, wrong = expected(seed, steps)
    assert rows("run", "training") == kept
    assert rows("run", "wrong") == wrong
    assert len(wrong) > MOST


def test_samples_of_another_mode_are_other_episodes():
    generate("run", as_tcp_ip_client=False)
    first = rows("run", "wrong")
    config = EnvironmentConfig("case.py:Case", seed=2, episode_steps=STEPS, num_clients=2,
                               record_wrong_samples=True)  # fmt: skip
    DataGeneration(config, session_name="run", new_session=False, episodes=5, mode="validation",
                   max_failed=1, quiet=True).execute()  # fmt: skip
    found = rows("run", "wrong")
    assert found[: len(first)] == first
    assert 3 in {number for number, _, _ in found[len(first) :]}


@pytest.mark.slow
def test_samples_of_an_episode_that_is_simulated_again_replace_the_former():
    generate("run", num_clients=2)
    before = rows("run", "wrong")
    for _ in range(2):
        assert main(["generate", "sessions/run", "--resume", "--retry-failed"]) == 0
    assert rows("run", "wrong") == before


@pytest.mark.parametrize("clients", [0, 2])
def test_first_thousand_rejected_samples_of_an_episode_are_kept(clients, tmp_path):
    late = PROGRAM.replace("self.x > (5 if self.episode_index == 3 else 0)",
                           "self.step_index % 700 == 699")  # fmt: skip
    (tmp_path / "case.py").write_text(late)
    config = EnvironmentConfig("case.py:Case", seed=1, episode_steps=2, record_wrong_samples=True,
                               max_wrong_samples_per_step=699, num_clients=max(1, clients),
                               as_tcp_ip_client=clients > 0)  # fmt: skip
    DataGeneration(config, session_name="run", episodes=5, quiet=True).execute()
    steps = [step for step in range(1400) if step % 700 != 699][:1000]
    found = [(number, step) for number, step, _ in rows("run", "wrong")]
    assert found == [(number, step) for number in range(5) for step in steps]
    assert len(rows("run", "training")) == 10


def test_compacted_dataset_has_the_same_rejected_samples():
    generate("run", num_clients=3)
    before = rows("run", "wrong")
    assert main(["compact", "sessions/run"]) == 0
    assert rows("run", "wrong") == before


def test_batches_keep_rejected_samples_too():
    config = EnvironmentConfig("case.py:Case", seed=1, episode_steps=STEPS, num_clients=2,
                               record_wrong_samples=True)  # fmt: skip
    DataGeneration(config, session_name="run", batch_nb=2, batch_size=10, max_failed=1,
                   quiet=True).execute()  # fmt: skip
    kept, wrong = rows("run", "training"), rows("run", "wrong")
    assert len(kept) == 20
    assert {number for number, _, _ in wrong} >= {3}
    assert np.all(np.array([x for _, _, x in wrong]) <= 5)
