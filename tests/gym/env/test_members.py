"""Members of the environment behave as documented, and in the documented order."""

import copy
import gc
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core.errors import EpisodeError, VisualizerError
from physx_gym import Layer, RobotEnv
from physx_gym.tasks.quantities import BodyPositions, Delta, JointPositions
from physx_sim import Encoder, Motor

pytestmark = pytest.mark.processes

MEMBERS = (
    "simulator", "render_mode", "stepper_state", "is_simulation_running", "robot", "robot_state",
    "derived", "log_fieldnames", "np_random", "np_random_seed", "num_steps", "quantities",
    "observation", "action", "measurements", "register_variable", "set_wrapper_attr",
    "get_wrapper_attr", "has_wrapper_attr", "viewer_kwargs", "step_dt", "control_dt", "observe_dt",
    "simulation_duration_max", "debug", "unwrapped", "training", "train", "eval", "reset", "close",
    "step", "stop", "render", "plot", "replay", "evaluate", "play_interactive", "log_data",
    "metadata", "spec", "action_space", "observation_space", "refresh_observation",
    "compute_command", "compute_reward", "has_terminated",
)  # fmt: skip
HOOKS = (
    "_setup", "_neutral", "_sample_state", "_initialize_action_space",
    "_initialize_observation_space", "_initialize_seed", "_initialize_buffers", "_refresh_buffers",
    "_key_to_action", "_update_pipeline",
)  # fmt: skip


def cart(kind=RobotEnv, **options):
    return kind("cartpole", 0.02, **{"motors": [Motor(joint="slider")], "period": 5e-3, **options})


def test_all_members_are_there():
    env = cart()
    layer = Layer(env)
    env.reset(seed=0)
    layer.reset(seed=0)
    for name in MEMBERS:
        assert env.has_wrapper_attr(name), name
        assert layer.has_wrapper_attr(name), name
    assert all(hasattr(env, name) for name in HOOKS)
    assert RobotEnv.metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["render_fps"] == layer.metadata["render_fps"] == 50
    assert env.spec is None
    assert gymnasium.make("physx/Cartpole-v0").unwrapped.spec.id == "physx/Cartpole-v0"


# Construction and seeds -------------------------------------------------------------------------


def test_construction_makes_the_action_space_first_and_runs_nothing():
    calls = []

    class Noting(RobotEnv):
        def _initialize_action_space(self):
            calls.append(("action", self.step_dt, self.control_dt))
            super()._initialize_action_space()

        def _initialize_observation_space(self):
            calls.append(("observation", self.action_space.shape))
            super()._initialize_observation_space()

        def _setup(self):
            calls.append("setup")

    env = cart(Noting)
    assert calls == [("action", 0.02, 0.02), ("observation", (1,))]
    assert env.num_steps == -1
    assert not env.is_simulation_running


def test_a_seed_reaches_states_sensors_and_spaces():
    env = cart(sensors=[Encoder(name="a", joint="hinge", noise=0.1)])

    def drawn():
        number = env.np_random.random()
        sampled = env.action_space.sample()[0], env.observation_space.sample()["t"][()]
        return number, *sampled, float(env.reset()[0]["measurements"]["Encoder"][0, 0])

    env._initialize_seed(5)
    first = drawn()
    assert env.np_random_seed == 5
    env._initialize_seed()
    assert env.np_random_seed != 5
    other = drawn()
    assert all(one != two for one, two in zip(first, other, strict=True))
    env._initialize_seed(5)
    assert drawn() == first


def test_samples_repeat_when_spaces_are_recreated():
    class Varied(RobotEnv):
        def _setup(self):
            torque = float(self.np_random.uniform(1.0, 20.0))
            self.simulator.set_options({"motors": {"slider": {"max_torque": torque}}})

    def drawn(env):
        found = []
        for seed in (5, None, None):
            env.reset(seed=seed)
            found.append((env.action_space.high[0], env.action_space.sample()[0]))
        return found

    env = cart(Varied)
    first = drawn(env)
    assert len(set(first)) == 3
    assert drawn(env) == drawn(cart(Varied)) == first


def test_the_pipeline_changes_at_the_base():
    env = cart()
    layer = Layer(env)
    assert env.derived is layer
    env._update_pipeline(None)
    assert env.derived is env is layer.derived
    env._update_pipeline(layer)
    layer.reset()
    env._update_pipeline(None)
    for each in (env, layer):
        with pytest.raises(EpisodeError, match="pipeline has changed: call reset"):
            each.step([0.0])


# The order within an episode --------------------------------------------------------------------


def test_steps_are_counted_before_the_last_observation():
    seen = []

    def noting(name):
        def call(self, *arguments):
            seen.append((name, int(self.num_steps), round(self.stepper_state.t, 9)))
            return getattr(RobotEnv, name)(self, *arguments)

        return call

    names = ("compute_command", "refresh_observation", "has_terminated", "compute_reward")
    env = cart(type("Noting", (RobotEnv,), {name: noting(name) for name in names}))
    env.reset()
    assert seen == [("refresh_observation", 0, 0.0), ("has_terminated", 0, 0.0)]
    seen.clear()
    env.step([0.0])
    assert seen == [("compute_command", 0, 0.0), *((name, 1, 0.02) for name in names[1:])]


def test_the_first_state_is_sampled_from_the_neutral_one():
    class Noting(RobotEnv):
        calls = ()

        def _neutral(self):
            self.calls += (("neutral", bool(self.is_simulation_running)),)
            return np.array([0.1, 0.2])

        def _sample_state(self):
            self.calls += ("sample",)
            return super()._sample_state()

    env = cart(Noting)
    observation, _ = env.reset()
    assert env.calls == ("sample", ("neutral", False))
    assert observation["states"]["agent"]["q"].tolist() == [0.1, 0.2]


def test_quantities_are_those_of_the_step():
    class Watching(RobotEnv):
        def note(self):
            return float(self.quantities.get_value(BodyPositions(("cart",)))[0, 0])

        def refresh_observation(self, measurement):
            super().refresh_observation(measurement)
            self.observed = self.note()

        def has_terminated(self, info):
            info["ended"] = self.note()
            return False, False

        def compute_reward(self, terminated, info):
            return self.note()

    env = cart(Watching, control_period=5e-3)
    env.reset()
    for _ in range(3):
        _, reward, *_, info = env.step([30.0])
        assert reward == info["ended"] == env.observed == pytest.approx(env.robot_state.q[0])


@pytest.mark.parametrize(
    "hook", ["_setup", "_sample_state", "_initialize_buffers", "_refresh_buffers"]
)
def test_an_error_in_a_hook_leaves_an_environment_that_can_be_reset(hook):
    class Failing(RobotEnv):
        fails = True

    def fail(self):
        if self.fails:
            raise RuntimeError("now")
        return getattr(RobotEnv, hook)(self)

    setattr(Failing, hook, fail)
    env = cart(Failing)
    with pytest.raises(RuntimeError, match="now"):
        env.reset(seed=0)
    assert not env.is_simulation_running
    with pytest.raises(EpisodeError, match="reset"):
        env.step([0.0])
    env.fails = False
    env.reset(seed=0)
    env.step([0.0])


# Logs -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["evaluation", "debug"])
def test_logs_are_written_by_stop_and_by_the_next_reset(way):
    env = cart(debug=way == "debug")
    env.train(way == "debug")
    _, info = env.reset()
    env.step([0.0])
    assert not Path(info["log_path"]).exists()
    _, second = env.reset()
    assert Path(info["log_path"]).exists()
    assert second["log_path"] != info["log_path"]
    env.step([0.0])
    env.stop()
    assert Path(second["log_path"]).exists()
    env.close()


def test_nothing_is_registered_while_an_episode_runs():
    env = cart()
    env.reset()
    env.register_variable("late", np.zeros(1))  # in training: from the next reset on
    env.stop()
    env.eval()
    env.reset()
    with pytest.raises(EpisodeError, match="before reset"):
        env.register_variable("later", np.zeros(1))
    env.step([0.0])
    assert "late.0" in env.log_data["variables"]


def test_log_data_is_of_the_running_episode_or_of_the_last():
    env = cart()
    assert env.log_data == {}
    env.eval()
    env.reset(seed=0)
    for steps in range(1, 4):
        env.step([1.0])
        assert env.log_data["variables"]["time"][-1] == pytest.approx(0.02 * steps)
    before = env.log_data["variables"]["state.q.robot.slider"]
    env.stop()
    np.testing.assert_array_equal(env.log_data["variables"]["state.q.robot.slider"], before)


def test_a_log_goes_on_where_a_snapshot_was_restored():
    env = cart(control_period=5e-3)
    env.eval()
    env.reset(seed=0)
    env.step([5.0])
    state = env.snapshot()
    for _ in range(300):
        env.step([-5.0])
    env.restore(state)
    assert len(env.log_data["variables"]["time"]) == 5
    env.step([0.0])
    env.stop()
    variables = env.log_data["variables"]
    np.testing.assert_allclose(variables["time"], 0.005 * np.arange(9), atol=1e-12)
    assert variables["motor.command.slider"].tolist() == [5.0] * 4 + [0.0] * 5


def test_a_snapshot_of_what_was_stopped_ends_the_recording():
    env = cart()
    env.eval()
    env.reset(seed=0)
    env.step([1.0])
    env.stop()
    state = env.snapshot()
    for _ in range(2):
        _, info = env.reset()
        env.step([1.0])
        env.restore(state)
        assert not env.is_simulation_running
        assert env.num_steps == 1
        assert Path(info["log_path"]).exists()
        env.restore(state)
    env.close()


def test_a_snapshot_without_quantities_has_no_memories():
    env = cart()
    env.reset(seed=0)
    env.step([1.0])
    state = env.snapshot()
    moved = Delta(JointPositions(), 3)
    env.quantities.add("moved", moved)
    for _ in range(3):
        env.step([20.0])
    assert env.quantities["moved"].any()
    env.restore(state)
    assert not env.quantities["moved"].any()
    before = env.robot_state.q.copy()
    env.step([20.0])
    np.testing.assert_allclose(env.quantities["moved"], (env.robot_state.q - before)[:1])


@pytest.mark.slow
@pytest.mark.parametrize("display", [None, ":0"])
def test_modes_are_those_that_are_possible(display, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
        assert cart().metadata["render_modes"] == ["human", "rgb_array"]
        return
    env = gymnasium.make("physx/Cartpole-v0", render_mode="rgb_array")
    assert env.metadata["render_modes"] == ["rgb_array"]
    try:
        env.unwrapped.reset()
        env.unwrapped.render()
    except VisualizerError as error:
        pytest.skip(str(error))
    env.close()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        check_env(gymnasium.make("physx/Cartpole-v0").unwrapped)


@pytest.mark.parametrize(
    ("space", "names"),
    [
        (spaces.Box(-1, 1, (1,)), ["action.slider"]),
        (spaces.Box(-1, 1, (2,)), ["action.0", "action.1"]),
        (spaces.Discrete(3), ["action"]),
        (spaces.MultiDiscrete([2, 3]), ["action.0", "action.1"]),
        (spaces.Dict({"a": spaces.Discrete(2)}), []),
    ],
)
def test_actions_of_all_types_are_recorded(space, names):
    class Acting(RobotEnv):
        def _initialize_action_space(self):
            self.action_space = space

        def compute_command(self, action, command):
            command[:] = 0.0

    env = cart(Acting)
    env.eval()
    for way in (lambda env: env, copy.deepcopy):
        env = way(env)
        env.reset(seed=1)
        given = [env.action_space.sample() for _ in range(3)]
        for action in given:
            env.step(action)
        env.stop()
        variables = env.log_data["variables"]
        assert [name for name in variables if name.split(".")[0] == "action"] == names
        if names:
            found = np.transpose([variables[name] for name in names])
            np.testing.assert_array_equal(found[:-1], [np.ravel(each) for each in given])
    env.close()


def test_evaluation_leaves_no_files_behind():
    env = cart()
    env.eval()
    folders = set()
    for _ in range(40):
        _, info = env.reset()
        env.step([0.0])
        folders.add(Path(info["log_path"]).parent)
    (folder,) = folders
    assert len(list(folder.iterdir())) <= 32
    del env
    gc.collect()
    assert not folder.exists()
