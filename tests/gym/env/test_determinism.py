"""Bit-for-bit repeatability: seeds, instances, processes, snapshots, pickles and copies."""

import copy
import pickle
import runpy
import subprocess
import sys
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core.net import decode, encode
from physx_core.states import Baseline
from physx_gym import Layer, RobotEnv
from physx_gym.spaces import copy_tree
from physx_sim import Encoder, Imu, Motor
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes

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


class Tally:
    """An object of a user's, without methods for copying."""

    def __init__(self):
        self.count, self.rows = 0, [np.zeros(2)]


class Wandering(RobotEnv):
    """Its future depends on attributes of every kind, which methods change in every way."""

    def __init__(self, backend, drawn, **options):
        self.changes, self.goal = list(drawn), np.zeros(2)
        super().__init__("cartpole", 0.04, backend=backend, **options)

    def _initialize_buffers(self):
        self.goal[:] = self.np_random.uniform(-1, 1, 2)
        self.part, self.positions = self.goal[1:], self.robot_state.q
        self.target = self.previous = self.goal.copy()
        self.random, self.shared = np.random.default_rng(5), self.np_random
        self.table = {"rows": [self.goal * 2, {"last": self.positions[:1]}], "n": 0}
        self.recent, self.names = deque(maxlen=3), {"start"}
        self.tally = Tally()
        self.alias = self.tally.rows
        self.mode = self.forward
        self.register_variable("goal", self.goal)

    def forward(self):
        return 1.0

    def backward(self):
        return -1.0

    def _refresh_buffers(self):
        if self.num_steps > 0:
            getattr(self, f"change_{self.changes[int(self.num_steps) % len(self.changes)]}")()

    def change_place(self):
        self.goal += self.random.uniform(-0.1, 0.1, 2)
        self.tally.rows[0][:] += self.goal

    def change_binding(self):
        self.previous, self.target = self.target, self.target + self.shared.uniform(-1, 1, 2)
        self.positions = self.positions.copy()

    def change_containers(self):
        self.table["n"] += 1
        self.table["rows"].append(self.target)
        self.recent.append(float(self.goal[0]))
        self.names = self.names | {str(self.table["n"])}

    def change_objects(self):
        self.tally.count += 1
        self.alias.append(self.target.copy())
        self.mode = self.backward if self.mode == self.forward else self.forward

    def change_members(self):
        if hasattr(self, "late"):
            del self.late
        else:
            self.late = Tally()
        self.positions = self.robot_state.q

    def compute_reward(self, terminated, info):
        rows = [np.ravel(each) for each in (*self.table["rows"][:1], *self.tally.rows[-2:])]
        last = self.table["rows"][1]["last"]
        parts = (*rows, self.goal, self.part, self.positions, self.target, self.previous, last)
        numbers = (self.table["n"], self.tally.count, len(self.names), sum(self.recent))
        own = sum(float(np.sum(np.sin(each))) for each in parts)
        return own + sum(numbers) + self.mode() + hasattr(self, "late")


WAYS = ("place", "binding", "containers", "objects", "members")


@settings(max_examples=size(25, 4), deadline=None)
@given(st.lists(st.sampled_from(WAYS), min_size=1, max_size=6), st.integers(0, 5))
def test_a_snapshot_has_the_future_of_a_copy(changes, steps):
    """Whatever attributes a subclass has, and however it changes them."""
    env = Wandering("dart", changes)
    env.reset(seed=3)
    actions = [env.action_space.sample() for _ in range(6)]
    for action in actions[:steps]:
        env.step(action)
    state = env.snapshot()
    copies = [copy.deepcopy(env), unpickled(env)]
    goal = env.goal
    first = onward(env, actions)
    assert [onward(each, actions) for each in copies] == [first, first]
    for each in (state, unpickled(state), copy.deepcopy(state)):
        env.restore(each)
        assert env.goal is goal and np.shares_memory(env.part, goal)
        assert env.alias is env.tally.rows and env.shared is env.np_random
        last = env.table["rows"][1]["last"]
        assert np.shares_memory(last, env.robot_state.q)
        assert onward(env, actions) == first
    other = Wandering("dart", changes)
    other.restore(unpickled(state))
    assert np.shares_memory(other.table["rows"][1]["last"], other.robot_state.q)
    assert onward(other, actions) == first


def test_a_layer_takes_its_attributes_along(backend):
    class Ramp(Layer):
        def _initialize_buffers(self):
            super()._initialize_buffers()
            self.height, self.below = np.zeros(1), self.env

        def compute_reward(self, terminated, info):
            self.height = self.height + 0.5
            return float(self.height[0])

    env = Ramp(make(backend))
    env.reset(seed=0)
    action = env.action_space.sample()
    state = env.snapshot()
    rewards = [env.step(action)[1] for _ in range(3)]
    env.restore(state)
    assert [env.step(action)[1] for _ in range(3)] == rewards == [0.5, 1.0, 1.5]
    assert env.below is env.env


def test_what_a_snapshot_cannot_take_along_is_named(backend, tmp_path):
    class Noting(RobotEnv):
        pass

    env = Noting("cartpole", 0.04, backend=backend)
    env.reset(seed=0)
    with (tmp_path / "notes").open("w") as env.notes:
        with pytest.raises(
            SimulationError, match=r"Noting\.notes along.*constants = \(\"notes\",\)"
        ):
            env.snapshot()

        class Silent(Noting):
            constants = ("notes",)

        env = Silent("cartpole", 0.04, backend=backend)
        env.reset(seed=0)
        env.notes = tmp_path
        env.restore(env.snapshot())
        assert env.notes == tmp_path


def test_registered_environments_have_no_attributes_to_take_along():
    """They say what changes, so that their snapshots are as fast as they can be."""
    for id in [id for id in gymnasium.registry if id.startswith("physx/")]:
        env = gymnasium.make(id).unwrapped
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert [own["attributes"] for own in env.snapshot()["own"]] == [{}], id


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


def captured(env, other):
    """Return another environment with the state of one, as a process would get it."""
    source, target = (Baseline(SimpleNamespace(env=each)) for each in (env, other))
    target.restore(decode(encode(source.capture(), "the state")))
    return other


def restored(env, other):
    """Return another environment with the snapshot of one."""
    other.restore(env.snapshot())
    return other


def test_all_ways_to_copy_have_the_same_future_in_the_middle_of_contacts(backend):
    def made():
        env = Counting(make(backend))
        env.reset(seed=3)
        return env

    env, other = made(), made()
    actions = [env.action_space.sample() for _ in range(3)]
    while not len(env.simulator.simulation.contacts()):
        env.step(actions[0])
        assert env.num_steps < 200
    env.restore(env.snapshot())  # an engine may forget what its solver starts from
    copies = [copy.deepcopy(env), unpickled(env), restored(env, made()), captured(env, other)]
    futures = [onward(each, actions) for each in (env, *copies)]
    assert futures == [futures[0]] * 5


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
