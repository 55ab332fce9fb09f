"""Bit-for-bit repeatability: seeds, instances, processes, snapshots, pickles and copies."""

import copy
import pickle
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from physx_core.simulation import Encoder, Imu, Motor
from physx_gym import Layer, RobotEnv
from physx_gym.spaces import copy_tree

PROGRAM = Path(__file__).parents[1] / "programs" / "noisy_ant.py"
program = runpy.run_path(str(PROGRAM))
make, run = program["make"], program["run"]


def unpickled(value):
    """Return a value that was pickled and read again."""
    return pickle.loads(pickle.dumps(value))  # noqa: S301 - own data


def test_the_same_seed(backend):
    env = make(backend)
    first = run(env, 7)
    assert run(make(backend), 7) == first  # a new instance
    assert run(env, 8) != first
    for steps in (0, 2, 5):
        run(env, steps, steps)
        assert run(env, 7) == first  # after earlier episodes
    env.close()
    assert run(env, 7) == first  # with a new engine
    command = [sys.executable, str(PROGRAM), backend]
    assert subprocess.check_output(command, text=True).strip() == first  # a new process


def test_episodes_of_one_seed_differ(backend):
    env = make(backend)
    env.reset(seed=7)
    values = {env.reset()[0]["measurements"]["Imu"].tobytes() for _ in range(3)}
    assert len(values) == 3


def leaves(tree):
    if isinstance(tree, dict):
        return b"".join(leaves(each) for each in tree.values())
    return np.asarray(tree).tobytes()


def onward(env, actions):
    """Return all that comes of actions, and of the episode after."""
    found = [env.step(action) for action in actions]
    later = [env.reset()[0], env.step(actions[0])[0]]
    return [(leaves(each[0]), *each[1:]) for each in found], [leaves(each) for each in later]


class Counting(Layer):
    """A layer with memory, whose reward counts its own steps and depends on a shared array."""

    def _setup(self):
        self.count = 0
        self.base_q = self.robot_state.q
        self.table = {"heights": [self.base_q[2:3]]}

    def compute_reward(self, terminated, info):
        self.count += 1
        return self.count + float(self.table["heights"][0][0]) + float(self.base_q[2])

    def _memory(self):
        return {"count": self.count}

    def _recall(self, memory):
        self.count = memory["count"]


def test_snapshots(backend):
    env = Counting(make(backend))
    env.reset(seed=3, options={"a": 1})
    actions = [env.action_space.sample() for _ in range(3)]
    for action in actions:
        env.step(action)
    state = env.snapshot()
    reward = env.step(actions[0])[1]
    env.restore(state)
    first = onward(env, actions)
    assert first[0][0][1] == reward and env.count == 1
    for where in (env, Counting(make(backend))):
        where.restore(unpickled(state))
        assert where.num_steps == 3 and where.reset_options == {"a": 1}
        assert onward(where, actions) == first
    env.stop()
    env.restore(state)
    assert env.is_simulation_running and onward(env, actions) == first


@pytest.mark.parametrize("way", [copy.deepcopy, unpickled])
def test_copies_of_a_running_environment(backend, way):
    env = Counting(make(backend))
    env.reset(seed=3)
    actions = [env.action_space.sample() for _ in range(2)]
    env.step(actions[0])
    other = way(env)
    assert type(other) is Counting and other.derived is other and other.unwrapped is other.env
    assert other.is_simulation_running and other.num_steps == 1 and other.training
    assert np.shares_memory(other.robot_state.q, other.simulator.values)
    assert np.shares_memory(other.base_q, other.robot_state.q)
    assert np.shares_memory(other.table["heights"][0], other.robot_state.q)
    assert other.env.action is other.action
    assert not np.shares_memory(other.robot_state.q, env.robot_state.q)
    other.action_space.sample()
    assert onward(other, actions) == onward(env, actions)


def test_copies_of_an_environment_that_never_ran(backend):
    env = make(backend)
    other = unpickled(env)
    assert other.num_steps == -1 and not other.is_simulation_running
    assert run(other, 5) == run(env, 5)


def test_copies_with_motors_that_have_a_state(backend):
    motor = Motor(joint="hinge", inertia=1e-3, stiffness=50.0, damping=0.1, dry=0.1, period=0.01)
    options = {"backend": backend, "motors": [motor], "period": 1e-3, "control_period": 0.005}
    env = RobotEnv("cartpole", 0.02, **options)
    env.reset(seed=0)
    for _ in range(3):
        env.step([5.0])
    other, state = unpickled(env), env.snapshot()
    first = [leaves(env.step([-3.0])[0]) for _ in range(3)]
    assert [leaves(other.step([-3.0])[0]) for _ in range(3)] == first
    torques = env.robot_state.torques.copy()
    env.restore(state)
    assert [leaves(env.step([-3.0])[0]) for _ in range(3)] == first
    assert torques.any() and np.array_equal(env.robot_state.torques, torques)


def test_copied_trees():
    tree = {"a": np.zeros(2), "b": (np.ones(()), [np.int64(3), "text"]), "c": 4}
    other = copy_tree(tree)
    assert leaves(other["a"]) == leaves(tree["a"]) and other["b"][1] == tree["b"][1]
    assert not np.shares_memory(other["a"], tree["a"]) and other["c"] == 4


def test_an_encoder_is_the_same_with_and_without_the_short_way(backend):
    """Exact encoders are read from the state; with another sensor beside them they are not."""
    found = []
    for extra in ([], [Imu(name="imu", body="pole")]):
        sensors = [Encoder(name=name, joint=name) for name in ("hinge", "slider")]
        options = {"backend": backend, "sensors": [*sensors, *extra], "period": 5e-3}
        env = RobotEnv("cartpole", 0.02, **options)
        env.reset(seed=0)
        for _ in range(3):
            observation = env.step([10.0, -1.0])[0]
        found.append(observation["measurements"]["Encoder"].tobytes())
    assert found[0] == found[1]
