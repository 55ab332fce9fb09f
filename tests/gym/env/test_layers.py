"""Layers with blocks: what they observe, when they run, and what they remember."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core.errors import ConfigError
from physx_gym import (
    BodyObserver,
    ControlledEnv,
    ControllerBlock,
    Layer,
    MahonyFilter,
    MotorSafetyLimit,
    ObservedEnv,
    ObserverBlock,
    PDAdapter,
    PDController,
    RobotEnv,
    Simulator,
)
from physx_sim.errors import SimulationError

DT = 0.005


def base(robot="ant", *, step_dt=0.02, **options):
    options = {"fixed_base": False, "control_period": DT, **options}
    return RobotEnv(Simulator.build(robot, **options), step_dt)


def pipeline(env=None, *, backend="dart"):
    """Return all blocks on a robot."""
    env = base(backend=backend) if env is None else env
    env = ObservedEnv(env, MahonyFilter("mahony", env, compute_rpy=True))
    env = ObservedEnv(env, BodyObserver("bodies", env))
    env = ControlledEnv(env, MotorSafetyLimit("safety", env, kp=20.0, kd=2.0))
    env = ControlledEnv(
        env, PDController("pd", env, kp=30.0, kd=0.02, joint_acceleration_limit=200.0), True
    )
    return ControlledEnv(env, PDAdapter("adapter", env, order=1))


def actions(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        yield 0.2 * rng.uniform(env.action_space.low, env.action_space.high)


def flat(tree):
    if isinstance(tree, dict):
        return np.concatenate([flat(tree[key]) for key in sorted(tree)])
    return np.ravel(np.asarray(tree, np.float64))


class Counting(ObserverBlock):
    """Notes when it runs."""

    memory = ("times", "observation")

    def connect(self):
        self.times = []
        self._set_observation_space(spaces.Box(0.0, np.inf, (), np.float64))

    def refresh_observation(self, measurement):
        self.times.append(round(float(measurement["t"]), 9))
        self.observation += 1


class Passing(ControllerBlock):
    """Passes its action on, and notes when."""

    memory = ("times",)

    def connect(self):
        self.times = []
        self.action_space = self.env.action_space

    def compute_command(self, action, command):
        self.times.append(round(self.env.stepper_state.t, 9))
        np.copyto(command, action)


def counting(env, **options):
    return ObservedEnv(env, Counting("count", env, **options))


def passing(env, name="pass", **options):
    return ControlledEnv(env, Passing(name, env, **options))


# What is observed ----------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_observation_has_a_part_for_each_block(backend):
    env = pipeline(backend=backend)
    observed, _ = env.reset(seed=0)
    assert observed in env.observation_space
    assert set(observed) == {"t", "states", "measurements", "features", "actions"}
    assert set(observed["states"]) == {"agent", "mahony", "pd"}
    assert set(observed["features"]) == {"mahony", "bodies"}
    assert set(observed["actions"]) == {"pd"}
    for action in actions(env, 5):
        observed, *_ = env.step(action)
        assert observed in env.observation_space
    np.testing.assert_array_equal(observed["actions"]["pd"], env.env.action)
    np.testing.assert_array_equal(observed["states"]["pd"], env.env.controller.get_state())
    assert np.abs(observed["actions"]["pd"]).max() > 0
    held = copy.deepcopy(observed)
    env.step(action)
    np.testing.assert_array_equal(flat(observed), flat(held))  # copies


def test_check_env():
    check_env(pipeline(), skip_render_check=True)


def test_an_observation_that_is_not_a_dictionary_moves():
    class Flat(RobotEnv):
        def _initialize_observation_space(self):
            self.observation_space = spaces.Box(-np.inf, np.inf, (15,), np.float64)

        def refresh_observation(self, measurement):
            self.observation[:] = measurement["states"]["agent"]["q"]

    env = counting(Flat(base().simulator, 0.02))
    observed, _ = env.reset(seed=0)
    assert set(observed) == {"measurement", "features"}
    observed, *_ = env.step(np.zeros(8))
    np.testing.assert_array_equal(observed["measurement"], env.robot_state.q)


def test_everything_is_recorded():
    env = pipeline()
    names = env.log_fieldnames
    assert {"mahony.feature", "mahony.state", "bodies.feature"} <= set(names)
    assert {"safety.action", "pd.action", "pd.state", "adapter.action"} <= set(names)
    joint = env.simulator.motors[0].joint
    assert names["pd.action"][0] == f"pd.action.targetAcceleration.{joint}"


# When blocks run -----------------------------------------------------------------------------


def test_command_changes_every_second_tick_at_ratio_2():
    env = base(step_dt=DT * 2, control_period=DT)
    commands = []

    class Watching(RobotEnv):
        def compute_command(self, action, command):
            super().compute_command(action, command)
            commands.append(command.copy())

    env = Watching(env.simulator, DT * 2)
    pd = PDController("pd", env, update_ratio=2, kp=30.0, kd=0.02, joint_acceleration_limit=50.0)
    env = ControlledEnv(env, pd)
    assert env.control_dt == DT  # known from the first reset on
    env.reset(seed=0)
    assert (pd.every, env.control_dt) == (10, 2 * DT)
    for action in actions(env, 30):
        env.step(action)
    changed = np.any(np.diff(commands, axis=0) != 0, axis=1)
    np.testing.assert_array_equal(changed, np.arange(1, len(commands)) % 2 == 0)


@pytest.mark.parametrize(("ratio", "ticks"), [(1, 1), (2, 2), (-1, 4)])
def test_blocks_run_at_their_own_periods(ratio, ticks):
    env = passing(counting(base(), update_ratio=ratio), update_ratio=ratio)
    env.reset(seed=0)
    assert env.env.observer.times == [0.0]
    for _ in range(3):
        env.step(np.zeros(8))
    every = ticks * DT
    due = np.round(np.arange(0.0, 0.06 + 1e-9, every), 9)
    assert env.env.observer.times == due.tolist()
    assert env.controller.times == due[:-1].tolist()
    assert env.observation["features"]["count"] == len(due)


def test_ratios_multiply():
    env = passing(passing(base(), "low", update_ratio=2), "high", update_ratio=2)
    env.reset(seed=0)
    env.step(np.zeros(8))
    env.step(np.zeros(8))
    assert env.env.controller.times == [0.0, 0.01, 0.02, 0.03]
    assert env.controller.times == [0.0, 0.02]
    assert (env.control_dt, env.env.control_dt) == (0.02, 0.01)


def test_periods_that_do_not_fit():
    env = passing(base(), update_ratio=3)
    with pytest.raises(ConfigError, match=r'"pass": its period of 0\.015 s does not divide a step'):
        env.reset(seed=0)
    for ratio in (0, -2, 1.5, True):
        with pytest.raises(ConfigError, match="update_ratio"):
            Passing("pass", base(), update_ratio=ratio)


def test_action_of_the_last_tick_is_held():
    env = passing(base(), update_ratio=-1)
    env.reset(seed=0)
    action = np.linspace(-1.0, 1.0, 8)
    env.step(action)
    np.testing.assert_array_equal(env.robot_state.command, action)


# Names and order -----------------------------------------------------------------------------


def test_names_are_unique():
    env = passing(base())
    with pytest.raises(ConfigError, match='already has a block "pass"'):
        passing(env)
    for name in ("", "a.b", 3):
        with pytest.raises(ConfigError, match="name of a block"):
            Passing(name, env)


def test_a_block_belongs_to_one_environment():
    first, second = base(), base()
    block = Passing("pass", first)
    with pytest.raises(ConfigError, match="was created for"):
        ControlledEnv(second, block)
    with pytest.raises(ConfigError, match="needs a ControllerBlock"):
        ControlledEnv(first, MahonyFilter("mahony", first))
    with pytest.raises(ConfigError, match="needs an ObserverBlock"):
        ObservedEnv(first, block)


def test_other_layers_fit_in_between():
    class Doubled(Layer):
        def compute_command(self, action, command):
            np.multiply(action, 2.0, self.env.action)
            self.env.compute_command(self.env.action, command)

    env = passing(Doubled(passing(base(), "low")), "high")
    env.reset(seed=0)
    env.step(np.full(8, 0.5))
    np.testing.assert_array_equal(env.robot_state.command, np.full(8, 1.0))


# Options -------------------------------------------------------------------------------------


def test_options_that_change_reach_the_blocks():
    class Weaker(RobotEnv):
        def _setup(self):
            super()._setup()
            if "torque" in self.reset_options:
                options = self.simulator.get_options()
                for motor in options["motors"].values():
                    motor["max_torque"] = self.reset_options["torque"]
                self.simulator.set_options({"motors": options["motors"]})

    env = pipeline(Weaker(base().simulator, 0.02))
    env.reset(seed=0)
    pd = env.env.controller
    assert (pd.joints.max_torque == 60.0).all()
    env.reset(seed=0, options={"torque": 0.5})
    assert (pd.joints.max_torque == 0.5).all()
    for action in actions(env, 5):
        observed, *_ = env.step(10 * action)
        assert observed in env.observation_space
    assert np.abs(env.robot_state.command).max() <= 0.5
    np.testing.assert_array_equal(observed["states"]["pd"], pd.get_state())
    np.testing.assert_array_equal(observed["measurements"]["Encoder"], pd.joints.encoders.values)


def test_spaces_stay_the_same_objects():
    env = pipeline()
    env.reset(seed=0)
    before = env.observation_space, env.action_space, env.action, env.observation
    env.reset()
    after = env.observation_space, env.action_space, env.action, env.observation
    assert all(a is b for a, b in zip(before, after, strict=True))


# State ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_snapshot_and_restore_bit_for_bit(backend):
    env = pipeline(backend=backend)
    env.reset(seed=0)
    for action in actions(env, 7):
        env.step(action)
    state = pickle.loads(pickle.dumps(env.snapshot()))  # noqa: S301 - our own
    first = [flat(env.step(action)[0]) for action in actions(env, 10, seed=1)]
    env.restore(state)
    again = [flat(env.step(action)[0]) for action in actions(env, 10, seed=1)]
    np.testing.assert_array_equal(first, again)
    other = pipeline(backend=backend)
    other.reset(seed=5)
    other.restore(state)
    elsewhere = [flat(other.step(action)[0]) for action in actions(env, 10, seed=1)]
    np.testing.assert_array_equal(first, elsewhere)


def test_pickled_in_the_middle_of_an_episode():
    env = pipeline()
    env.reset(seed=0)
    for action in actions(env, 7):
        env.step(action)
    other = pickle.loads(pickle.dumps(env))  # noqa: S301 - our own
    for action in actions(env, 10, seed=1):
        np.testing.assert_array_equal(flat(env.step(action)[0]), flat(other.step(action)[0]))


def test_same_seed_same_episode():
    env = pipeline()

    def run(env):
        found = [flat(env.reset(seed=3)[0])]
        return [*found, *(flat(env.step(action)[0]) for action in actions(env, 10))]

    first = run(env)
    np.testing.assert_array_equal(first, run(env))
    np.testing.assert_array_equal(first, run(pipeline()))


def test_snapshots_of_other_blocks():
    env = base()
    pd = PDController("pd", env, kp=1.0, kd=0.0)
    with pytest.raises(SimulationError, match="not of the block"):
        pd.restore({"other": 1})
    with pytest.raises(SimulationError, match="has the shape"):
        pd.restore({"target_state": np.zeros((3, 2))})


@pytest.mark.slow
def test_environments_are_freed():
    env = pipeline()
    env.reset(seed=0)
    env.step(np.zeros(8))
    parts = [weakref.ref(each) for each in (env, env.unwrapped, env.env.controller)]
    del env
    gc.collect()
    assert [part() for part in parts] == [None] * 3
