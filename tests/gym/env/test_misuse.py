"""Misuse raises an error that says what to do, and leaves a usable environment."""

import numpy as np
import pytest
from gymnasium import spaces

from physx_core import PhysxError
from physx_core.errors import (
    ActionError,
    ComponentNotFoundError,
    ConfigError,
    EpisodeError,
    UnknownOptionError,
)
from physx_gym import RobotEnv
from physx_sim import Encoder, Motor, Wrench
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes


def cart(**options):
    options = {"motors": [Motor(joint="slider")], "period": 0.01, **options}
    return RobotEnv("cartpole", 0.02, **options)


def test_step_before_reset_after_stop_and_after_the_end():
    env = cart()
    with pytest.raises(EpisodeError, match=r"Call reset\(\) before step"):
        env.step([0.0])
    env.reset()
    env.stop()
    with pytest.raises(EpisodeError, match="stopped: call reset"):
        env.step([0.0])
    env.simulation_duration_max = 0.02
    env.reset()
    assert env.step([0.0])[3]
    with pytest.raises(EpisodeError, match="truncated: call reset"):
        env.step([0.0])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(2), r"shape \(2,\) but needs \(1,\)"),
        (0.0, r"shape \(\)"),
        ([[0.0]], r"shape \(1, 1\)"),
        ([np.nan], r"at \[0\] is nan"),
        (np.array([np.nan], np.float32), r"at \[0\] is nan"),
        (["fast"], "type"),
        ([1j], "complex"),
        ([True], "bool"),
        ([None], "type object"),
        (None, "shape"),
        ({}, "shape"),
    ],
)
def test_wrong_actions(action, message):
    env = cart()
    env.reset()
    env.step([3.0])
    with pytest.raises(ActionError, match=message):
        env.step(action)
    assert env.action == [3.0] and env.num_steps == 1
    env.step([1.0])


def test_the_entry_of_a_wrong_action():
    class Nested(RobotEnv):
        def _initialize_action_space(self):
            arm = spaces.Box(-1.0, np.inf, (2,), np.float64)
            parts = spaces.Tuple([spaces.Discrete(2), spaces.MultiBinary(2)])
            self.action_space = spaces.Dict({"arm": arm, "parts": parts})

        def compute_command(self, action, command):
            command[:] = 0.0

    env = Nested("cartpole", 0.02, motors=[Motor(joint="slider")])
    env.reset()
    good = {"arm": np.zeros(2), "parts": (1, np.zeros(2, np.int8))}
    env.step(good)
    for change, entry in (
        ({"arm": [0.0, np.nan]}, '["arm"][1]'),
        ({"arm": [np.inf, 0.0]}, '["arm"][0]'),
        ({"arm": 3}, '["arm"]'),
        ({"parts": (2, np.zeros(2, np.int8))}, '["parts"][0]'),
        ({"parts": (1, [5, 5])}, '["parts"][1]'),
        ({"parts": 1}, '["parts"]'),
        ({"leg": 1}, ""),
    ):
        with pytest.raises(ActionError) as error:
            env.step({**good, **change})
        assert error.value.entry == entry
        assert "action_space" in str(error.value)
    env.step({**good, "arm": [-np.inf, 0.0]})
    assert env.action["arm"].tolist() == [-1.0, 0.0]


def test_changes_while_an_episode_runs():
    env = cart()
    env.reset()
    for call in (
        lambda: env.simulator.set_options({"world": {"period": 0.02}}),
        lambda: env.simulator.register_force(Wrench("pole")),
        env.simulator.remove_all_forces,
        lambda: env.simulator.start(np.zeros(2), np.zeros(2)),
        env.eval,
    ):
        with pytest.raises(EpisodeError, match="stop"):
            call()
    env.step([0.0])


def test_unknown_names():
    with pytest.raises(ComponentNotFoundError, match='no joint "slidr".*Did you mean "slider"'):
        cart(motors=[Motor(joint="slidr")])
    with pytest.raises(ComponentNotFoundError, match='no joint "hing"'):
        cart(sensors=[Encoder(name="angle", joint="hing")])
    env = cart()
    for options, message in (
        ({"sensors": {"slidr": {}}}, 'sensors has no option "slidr"'),
        ({"motors": {"slider": {"max_torqe": 1.0}}}, 'Did you mean "max_torque"'),
        ({"wrld": {}}, 'Did you mean "world"'),
        ({"world": {"gravty": 1}}, 'Did you mean "gravity"'),
        ({"stepper": {"control": 1}}, 'no option "control"'),
    ):
        with pytest.raises(UnknownOptionError, match=message):
            env.simulator.set_options(options)
    with pytest.raises(ComponentNotFoundError, match='no body "poll"'):
        env.simulator.register_force(Wrench("poll"))
    with pytest.raises(ComponentNotFoundError, match="robot"):
        cart_world = env.simulator.world
        RobotEnv(cart_world, 0.02, robot="other")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step_dt": 0.025}, "step_dt is 0.025 s but must be a multiple of the physics"),
        ({"step_dt": -1.0}, "step_dt"),
        ({"step_dt": 0.04, "control_period": 0.03}, "multiple of control_period, 0.03 s"),
        ({"step_dt": 0.04, "control_period": 0.015}, "control_period is 0.015 s"),
        ({"step_dt": 0.04, "observe_period": 0.03}, "multiple of observe_period"),
        ({"step_dt": 0.04, "simulation_duration_max": 0.0}, "simulation_duration_max"),
    ],
)
def test_periods_that_do_not_fit(options, message):
    with pytest.raises(ConfigError, match=message):
        RobotEnv("cartpole", period=0.01, **options)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (([0.0], [0.0, 0.0]), r"positions have the shape \(1,\), but need \(2,\)"),
        (([0.0, 0.0], [0.0]), "velocities"),
        (([0.0, np.nan], [0.0, 0.0]), "finite"),
    ],
)
def test_invalid_first_states(state, message):
    class Wrong(RobotEnv):
        def _sample_state(self):
            return tuple(np.array(each) for each in state)

    env = Wrong("cartpole", 0.02)
    with pytest.raises(SimulationError, match=message):
        env.reset()
    assert not env.is_simulation_running


@pytest.mark.parametrize("broken", ["shape", "type", "missing"])
def test_observations_of_the_wrong_form(broken):
    class Wrong(RobotEnv):
        def refresh_observation(self, measurement):
            super().refresh_observation(measurement)
            if broken == "shape":
                self.observation["t"] = np.zeros(2)
            elif broken == "type":
                self.observation["t"] = np.zeros((), np.float32)
            else:
                del self.observation["t"]

    with pytest.raises(SimulationError, match=r'"t"'):
        Wrong("cartpole", 0.02).reset()


def test_a_command_that_is_not_a_number():
    class Wrong(RobotEnv):
        def compute_command(self, action, command):
            command[:] = np.nan

    env = Wrong("cartpole", 0.02)
    env.reset()
    with pytest.raises(SimulationError, match="finite"):
        env.step(np.zeros(2))


def test_snapshots_of_other_environments():
    env = cart()
    env.reset()
    for wrong in (None, {}, {"layers": ["RobotEnv"]}, env.simulator.snapshot()):
        with pytest.raises(SimulationError, match="snapshot"):
            env.restore(wrong)
    other = RobotEnv("ant", 0.02)
    other.reset()
    with pytest.raises(SimulationError, match="snapshot"):
        env.restore(other.snapshot())
    env.step([0.0])


@pytest.mark.parametrize("count", [1000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_random_calls(backend, count):
    """Whatever is called in whatever order: a result, or an error of physx."""
    env = cart(backend=backend, sensors=[Encoder(name="a", joint="hinge", noise=1e-3)])
    env.simulation_duration_max = 0.2
    rng = np.random.default_rng(0)
    actions = [np.zeros(1), np.array([50.0]), np.array([np.nan]), np.zeros(2), [0.1], "go", None]
    kept = [None]
    calls = (
        *[lambda: env.step(actions[rng.integers(len(actions))])] * 8,
        lambda: env.step(env.action),
        lambda: env.reset(seed=int(rng.integers(3))),
        env.reset,
        lambda: env.reset(options={"a": 1}),
        env.stop,
        lambda: env.train(bool(rng.integers(2))),
        lambda: kept.__setitem__(0, env.snapshot()),
        lambda: env.restore(kept[0]),
        lambda: env.simulator.set_options({"stepper": {"control_period": 0.01}}),
        lambda: env.simulator.register_force(Wrench("pole", (1.0, 0.0, 0.0), duration=0.01)),
        lambda: env.has_terminated({}),
        lambda: (env.log_data, env.training, env.np_random_seed, env.robot_state.a),
    )
    errors, steps = set(), 0
    for _ in range(count):
        call = calls[rng.integers(len(calls))]
        before = bool(env.is_simulation_running)
        try:
            result = call()
        except PhysxError as error:
            errors.add(type(error).__name__)
            continue
        if isinstance(result, tuple) and len(result) == 5:
            steps += 1
            assert before and result[0] in env.observation_space
    assert steps > count / 10 and {"EpisodeError", "ActionError"} <= errors
    env.close()
