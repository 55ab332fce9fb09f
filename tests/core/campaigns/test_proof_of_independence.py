"""One episode is simulated again at the end of a campaign, and must have the same rows."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from campaigns import TROUBLED
from hypothesis import given
from hypothesis import strategies as st

from physx_core import DataGeneration, Dataset, Environment, EnvironmentConfig
from physx_core.errors import DependentEpisodeError
from physx_core.pipelines.independence import compare

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

HERE = Path(__file__)


class Leaking(Environment):
    """Its rows depend on how many episodes the same environment has simulated before."""

    episode_steps = 3
    count = 0

    def create(self):
        """Do nothing."""

    def init_database(self):
        self.define_training_fields(("x", np.ndarray))

    def reset_parameters(self):
        self.count += 1

    def step(self):
        self.set_training_data(x=self.rng.normal(size=2) + (self.count if self.step_index else 0))


class SlowLeaking(Leaking):
    """Takes its time."""

    def step(self):
        time.sleep(0.01)
        super().step()


def generate(environment, clients=0, episodes=300, **options):
    config = EnvironmentConfig(
        environment, seed=1, as_tcp_ip_client=clients > 0, num_clients=max(1, clients)
    )
    run = DataGeneration(config, session_name="run", episodes=episodes, **options)
    run.execute()


@pytest.mark.parametrize("clients", [0, 2])
def test_episode_that_depends_on_earlier_ones_is_found(clients):
    with pytest.raises(
        DependentEpisodeError, match=r'another "x" in row 1.*samples are stored'
    ) as e:
        generate(f"{HERE}:Leaking", clients)
    assert (e.value.field, e.value.row) == ("x", 1)
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == 900


def test_proof_can_be_left_out():
    generate(f"{HERE}:Leaking", prove_independence=False)


def test_proof_that_costs_much_is_left_out():
    generate(f"{HERE}:SlowLeaking", episodes=4)


@pytest.mark.parametrize("clients", [0, 1, 2])
def test_independent_episodes_pass(clients):
    generate(TROUBLED, clients)


@given(st.integers(1, 4), st.integers(0, 3), st.integers(0, 1), st.booleans())
def test_first_difference_is_named(rows, row, column, has_nan):
    stored = {"a": np.zeros((rows, 2)), "b": np.arange(rows)}
    if has_nan:
        stored["a"][0] = np.nan
    compare(5, stored, {name: values.copy() for name, values in stored.items()})
    again = {name: values.copy() for name, values in stored.items()}
    again["a"][min(row, rows - 1), column] = 7
    with pytest.raises(DependentEpisodeError, match=r'Episode 5 had another "a".*7') as found:
        compare(5, stored, again)
    assert found.value.row == min(row, rows - 1)
    fewer = {name: values[1:] for name, values in stored.items()}
    with pytest.raises(DependentEpisodeError, match=f"had {rows - 1} rows instead of {rows}"):
        compare(5, stored, fewer)
    with pytest.raises(DependentEpisodeError, match="had 0 rows"):
        compare(5, stored, {})
