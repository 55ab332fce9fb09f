"""Robots go back to a stored row on three engines, and on with a push, or other masses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import sizes

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.errors import (
    DatasetError,
    PhysxError,
    UnknownOptionError,
    UntrustedReferenceError,
)
from physx_core.pipelines import Branch
from physx_core.plugins import resolve
from physx_gym import make_env, read_log

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


OWN = """
import numpy as np
from physx_gym import RobotEnv

class Own(RobotEnv):
    def __init__(self, **options):
        super().__init__("cartpole", step_dt=0.02, simulation_duration_max=0.2, **options)

    def _sample_state(self):
        return self.np_random.uniform(-0.1, 0.1, 2), np.zeros(2)

def make(**options):
    return Own(**options)
"""


def test_an_own_robot_is_branched_if_its_class_is_trusted():
    Path("own.py").write_text(OWN)
    for name in ("Own", "make"):
        environment = EnvironmentConfig(
            f"gym/own.py:{name}", as_tcp_ip_client=False, seed=0, independent_episodes=True
        )
        with DataGeneration(environment, episodes=2, session_name=name, quiet=True) as run:
            run.execute()
    change = {"gravity": [0.0, 0.0, -3.0]}
    branch = Branch("sessions/Own", 3, change, trust=True, quiet=True)
    branch.execute()
    assert branch.rows_equal == (4, 6) and len(branch.futures[1]["reward"]) == 6
    with pytest.raises(UntrustedReferenceError, match="--trust"):
        Branch("sessions/Own", 3, change, quiet=True).execute()
    with pytest.raises(UntrustedReferenceError, match="which is not a class"):
        Branch("sessions/make", 3, change, trust=True, quiet=True).execute()


@pytest.fixture
def log():
    """Record an episode of an ant in ant.h5."""
    env = make_env("physx/Ant-v0", {})
    env.unwrapped.eval()
    env.reset(seed=7, options={"log_path": "ant.h5"})
    env.action_space.seed(1)
    for _ in range(12):
        env.step(env.action_space.sample())
    env.close()


@pytest.mark.usefixtures("log")
def test_a_log_is_simulated_again_and_branched():
    environment = EnvironmentConfig(
        "gym/physx/Ant-v0", {"policy": "ant.h5"}, as_tcp_ip_client=False, seed=0
    )
    with DataGeneration(environment, episodes=1, session_name="again", quiet=True) as run:
        run.execute()
    with Dataset.open("sessions/again") as dataset:
        assert dataset.num_samples("training") == 12
    branch = Branch("sessions/again", 5, {"push": {"torso": [200.0, 0.0, 0.0]}}, quiet=True)
    branch.execute()
    was, changed = branch.futures
    assert branch.rows_equal == (6, 6)
    assert np.array_equal(was["action"], changed["action"])
    assert not np.array_equal(was["next_observation"], changed["next_observation"])


@pytest.mark.usefixtures("log")
def test_the_log_itself_is_branched_off():
    push = {"push": {"torso": [200.0, 0.0, 0.0]}}
    branch = Branch("ant.h5", 5, push, quiet=True)
    branch.execute()
    was, changed = branch.futures
    assert branch.rows_equal == (6, 6)
    assert np.array_equal(was["action"], changed["action"])
    assert not np.array_equal(was["next_observation"], changed["next_observation"])
    Branch("ant.h5", 5, {"policy": "random"}, quiet=True, step_nb=20).execute()
    with pytest.raises(DatasetError, match="no row 12 in the mode training: it has 12 rows"):
        Branch("ant.h5", 12, push, quiet=True).execute()
    with pytest.raises(UnknownOptionError, match="wind"):
        Branch("ant.h5", 5, {"wind": 1}, quiet=True).execute()


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"spec": None}, "does not say how its environment was made"),
        ({"spec": {"id": "No/Ant-v0", "kwargs": {}}}, '"No/Ant-v0", which is not registered'),
        ({"backend": "own.py:Engine"}, "arguments of physx/Ant-v0 that may name code"),
        ({"backend": "pinocchio"}, "has another state after .* steps"),
        ({"leg_nb": 5}, "unexpected keyword argument 'leg_nb'"),
    ],
)
@pytest.mark.usefixtures("log")
def test_a_log_that_cannot_be_branched_says_why(constants, message):
    known = read_log("ant.h5")
    if "spec" not in constants:
        constants = {"spec": {"id": "physx/Ant-v0", "kwargs": constants}}
    replace(known, constants={**known.constants, **constants}).write("other.h5")
    with pytest.raises(PhysxError, match=message):
        Branch("other.h5", 5, {"gravity": [0, 0, -1]}, quiet=True).execute()
    assert not Path("sessions").exists()


def test_only_plain_arguments_are_in_a_log():
    backend = type(resolve("backend", "dart"))
    env = gymnasium.make("physx/Cartpole-v0", render_mode="rgb_array", backend=backend)
    env.unwrapped.eval()
    env.reset(options={"log_path": "pole.h5"})
    env.step(env.action_space.sample())
    env.close()
    assert read_log("pole.h5").constants["spec"] is None


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize(
    ("policy", "backend", "message"),
    [
        ("ant.csv", "dart", "lacks the seed, the actions and the states"),
        ("none.h5", "dart", "There is no log"),
        ("ant.h5", "pinocchio", "has another state after .* steps"),
    ],
)
def test_a_log_that_cannot_be_simulated_again_says_why(policy, backend, message):
    environment = EnvironmentConfig(
        "gym/physx/Ant-v0", {"policy": policy, "backend": backend}, as_tcp_ip_client=False
    )
    with pytest.raises(PhysxError, match=message):
        DataGeneration(environment, episodes=1, quiet=True).execute()


def test_what_a_robot_cannot_be_told_is_named():
    env = make_env("physx/Ant-v0", {})
    env.reset(seed=0)
    with pytest.raises(UnknownOptionError, match="wind"):
        env.unwrapped.perturb(wind=1.0)
    env.close()
