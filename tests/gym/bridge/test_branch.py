"""Robots go back to a stored row on three engines, and on with a push, or other masses."""

from __future__ import annotations

import numpy as np
import pytest
import sizes

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.errors import UnknownOptionError
from physx_core.pipelines import Branch
from physx_gym import make_env

pytestmark = pytest.mark.slow

CHANGES = [
    {"push": {"torso": [200.0, 0.0, 0.0]}},
    {"gravity": [0.0, 0.0, -3.0]},
    {"bodies": {"torso": {"mass": 3.0}}},
    {"policy": f"{__name__}:rest"},
]


def rest(observation):
    return np.zeros(8)


@pytest.fixture(autouse=True)
def sessions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("backend", ["dart", "pinocchio", "mujoco"])
def test_the_past_has_the_same_bits_at_random_moments(backend):
    if backend == "mujoco":
        pytest.importorskip("physx_mujoco")
    environment = EnvironmentConfig(
        "gym/physx/Ant-v0", {"backend": backend}, as_tcp_ip_client=False, seed=sizes.seed()
    )
    with DataGeneration(
        environment, episodes=sizes.trials(6, 2), session_name="data", quiet=True
    ) as run:
        run.execute()
    with Dataset.open("sessions/data") as dataset:
        rows = dataset["training"]
        ends = np.asarray(rows["terminated"][:]) | np.asarray(rows["truncated"][:])
        after = np.asarray(rows["next_observation"][:])
    random = np.random.default_rng(sizes.seed())
    for row in random.choice(np.flatnonzero(~ends), sizes.trials(34, 2)):
        change = CHANGES[random.integers(len(CHANGES))]
        branch = Branch("sessions/data", int(row), change, step_nb=10, quiet=True)
        branch.execute()
        was, changed = branch.futures
        left = len(was["action"])
        assert branch.rows_equal[1] == left > 0
        assert np.array_equal(was["next_observation"], after[row + 1 : row + 1 + left])
        assert not np.array_equal(changed["next_observation"][0], was["next_observation"][0])


def test_what_a_robot_cannot_be_told_is_named():
    env = make_env("physx/Ant-v0", {})
    env.reset(seed=0)
    with pytest.raises(UnknownOptionError, match="wind"):
        env.unwrapped.perturb(wind=1.0)
    env.close()
