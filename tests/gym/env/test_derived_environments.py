"""Subclasses of RobotEnv, and layers on them, change only what they override."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core.errors import ConfigError, EpisodeError
from physx_gym import Layer, PipelineEnv, RobotEnv, Simulator
from physx_sim import Motor, Robot, World
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes

SLIDER = [Motor(joint="slider")]


class Cart(RobotEnv):
    """A cartpole with one motor and a normalized action."""

    def __init__(self, step_dt=0.02, **options):
        options = {"motors": SLIDER, "period": 5e-3, **options}
        simulator = Simulator.build("cartpole", **options)
        super().__init__(simulator, step_dt)

    def _initialize_action_space(self):
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def compute_command(self, action, command):
        command[:] = 30.0 * action


# What an episode's end is -------------------------------------------------------------------------


class Narrow(RobotEnv):
    """The cart is to stay within 5 cm."""

    def _initialize_observation_space(self):
        self.observation_space = spaces.Box(-0.05, 0.05, (1,), np.float64)

    def refresh_observation(self, measurement):
        self.observation[0] = measurement["states"]["agent"]["q"][0]


def test_an_observation_outside_of_its_space_truncates(backend):
    env = Narrow("cartpole", 0.02, backend=backend, motors=SLIDER, period=5e-3)
    env.reset(seed=0)
    for _ in range(50):
        observation, _, *ends, _ = env.step([30.0])
        assert ends == [False, not -0.05 <= observation[0] <= 0.05]
        if any(ends):
            break
    assert ends == [False, True]


class Falling(Cart):
    def has_terminated(self, info):
        info["angle"] = float(self.robot_state.q[1])
        return abs(self.robot_state.q[1]) > 0.2, False

    def compute_reward(self, terminated, info):
        return -1.0 if terminated else 1.0

    def _sample_state(self):
        return np.array([0.0, 0.1]), np.zeros(2)


def test_falling_terminates_and_does_not_truncate(backend):
    env = Falling(backend=backend)
    env.reset()
    for _ in range(100):
        _, reward, *ends, info = env.step([0.0])
        if any(ends):
            break
    assert ends == [True, False] and reward == -1.0 and info["angle"] > 0.2


def test_actions_are_clipped_before_anything_sees_them():
    class Seen(Cart):
        def compute_reward(self, terminated, info):
            return float(self.action[0])

    env = Seen()
    env.reset()
    assert env.step(np.array([7.0]))[1] == 1.0
    assert env.step(np.array([-7.0], np.float32))[1] == -1.0
    assert env.step([-0.5])[1] == -0.5
    assert env.robot_state.command == [-15.0]
    env.action[:] = 0.25
    assert env.step(env.action)[1] == 0.25


def test_nan_is_an_error_that_says_where():
    class Broken(RobotEnv):
        def refresh_observation(self, measurement):
            super().refresh_observation(measurement)
            if self.num_steps > 0:
                self.observation["states"]["agent"]["v"][1] = np.nan

    env = Broken("cartpole", 0.02, motors=SLIDER)
    env.reset()
    with pytest.raises(SimulationError, match=r'not a number at \["states"\]\["agent"\]\["v"\]\[1'):
        env.step([0.0])
    with pytest.raises(EpisodeError, match="reset"):
        env.step([0.0])
    env.reset()

    class Worthless(Cart):
        def compute_reward(self, terminated, info):
            return float("nan")

    env = Worthless()
    env.reset()
    with pytest.raises(SimulationError, match="reward of Worthless"):
        env.step([0.0])
    assert not env.is_simulation_running


def test_a_first_state_that_ends_the_episode_is_an_error():
    class Over(Cart):
        def has_terminated(self, info):
            return True, False

    env = Over()
    with pytest.raises(EpisodeError, match="terminated in its initial state"):
        env.reset()
    assert not env.is_simulation_running
    with pytest.raises(EpisodeError):
        env.step([0.0])


# Spaces and states --------------------------------------------------------------------------------


def test_custom_spaces_need_their_methods():
    class Acts(RobotEnv):
        def _initialize_action_space(self):
            self.action_space = spaces.Discrete(3)

    class Observes(RobotEnv):
        def _initialize_observation_space(self):
            self.observation_space = spaces.Box(-1, 1, (2,), np.float64)

    with pytest.raises(ConfigError, match="override compute_command"):
        Acts("cartpole", 0.02, motors=SLIDER)
    with pytest.raises(ConfigError, match="override refresh_observation"):
        Observes("cartpole", 0.02, motors=SLIDER)


class Discrete(RobotEnv):
    """Three actions, and an observation of single precision."""

    def _initialize_action_space(self):
        self.action_space = spaces.Discrete(3)

    def _initialize_observation_space(self):
        most = np.full(4, 1e3, np.float32)
        self.observation_space = spaces.Box(-most, most)

    def compute_command(self, action, command):
        command[0] = 10.0 * (int(action) - 1)

    def refresh_observation(self, measurement):
        agent = measurement["states"]["agent"]
        self.observation[:2], self.observation[2:] = agent["q"], agent["v"]


def test_discrete_actions_and_vector_observations(backend):
    env = Discrete("cartpole", 0.02, backend=backend, motors=SLIDER, period=5e-3)
    observation, _ = env.reset(seed=0)
    assert observation.dtype == np.float32 and observation.shape == (4,)
    assert env.action == 0
    assert env.step(2)[0][2] > 0
    assert env.action == 2 and env.robot_state.command == [10.0]
    env.step(np.int64(0))
    assert env.robot_state.command == [-10.0]


def test_nested_actions():
    class Nested(RobotEnv):
        def _initialize_action_space(self):
            arm = spaces.Box(-1.0, 1.0, (1,), np.float64)
            self.action_space = spaces.Dict({"arm": arm, "on": spaces.Discrete(2)})

        def compute_command(self, action, command):
            command[:] = 5.0 * action["arm"] * action["on"]

    env = Nested("cartpole", 0.02, motors=SLIDER)
    env.reset()
    env.step({"arm": [3.0], "on": 1})
    assert env.robot_state.command == [5.0]
    env.step({"arm": np.array([3.0]), "on": 0})
    assert env.robot_state.command == [0.0]


def test_the_first_state_may_be_that_of_the_whole_world(backend):
    class Far(RobotEnv):
        def _sample_state(self):
            q = self.simulator.simulation.positions()
            q[self.simulator.layout.parts["two"].positions] = [0.4, 0.3]
            return q, np.zeros(4)

    robots = [Robot("cartpole", "one"), Robot("cartpole", "two")]
    world = World(robots, contacts="none")
    env = Far(world, 0.02, backend=backend, robot="one")
    env.reset()
    assert env.robot_state.q.tolist() == [0.0, 0.0] and len(env.simulator.motors) == 2
    assert env.simulator.positions.tolist() == [0.0, 0.0, 0.4, 0.3]
    assert env.observation_space["states"]["agent"]["q"].shape == (2,)
    observation, *_ = env.step([1.0, 0.0])
    assert observation["states"]["agent"]["q"][0] > 0


def test_recording_in_evaluation(tmp_path):
    env = Cart()
    counter = np.zeros(2)
    env.register_variable("counter", counter, ["up", "down"], "mine")
    assert list(env.log_fieldnames) == ["mine.counter"]
    env.reset()
    env.step([0.5])
    assert "mine.counter.up" not in env.log_data["variables"]
    env.stop()
    env.eval()
    _, info = env.reset(options={"log_path": tmp_path / "run.h5"})
    assert info["log_path"] == str(tmp_path / "run.h5")
    for _ in range(4):
        counter[0] += 1
        env.step([0.5])
    env.stop()
    variables = env.log_data["variables"]
    assert variables["time"] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
    assert variables["mine.counter.up"].tolist() == [1, 2, 3, 4, 4]
    assert variables["action.slider"].tolist() == [0.5] * 5
    assert (tmp_path / "run.h5").is_file()
    _, info = env.reset()
    assert info["log_path"] != str(tmp_path / "run.h5")
    env.close()


# The pipeline -------------------------------------------------------------------------------------


class Doubling(Layer):
    """Twice the reward, and memory of its options."""

    def _setup(self):
        self.factor = self.reset_options.get("factor", 2.0)

    def compute_reward(self, terminated, info):
        return self.factor * super().compute_reward(terminated, info)


def test_layers_forward_what_they_do_not_override():
    base = Falling()
    assert base.derived is base and base.unwrapped is base and base.layers == (base,)
    layer = Doubling(base)
    assert isinstance(layer, PipelineEnv) and isinstance(layer, gymnasium.Env)
    assert layer.unwrapped is base and base.derived is layer and layer.derived is layer
    assert layer.layers == (base, layer)
    for name in ("simulator", "robot_state", "num_steps", "step_dt", "training", "measurements"):
        assert getattr(layer, name) is getattr(base, name)
    layer.reset(seed=1)
    assert layer.step([0.0])[1] == 2.0 and layer.np_random is base.np_random
    with pytest.raises(EpisodeError, match="Doubling"):
        base.step([0.0])
    base.reset()
    assert base.derived is base and base.step([0.0])[1] == 1.0
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = layer.nothing_like_it


def test_options_reach_every_layer():
    layer = Doubling(Doubling(Falling()))
    layer.reset(options={"factor": 3.0})
    assert layer.step([0.0])[1] == 9.0
    layer.reset()
    assert layer.step([0.0])[1] == 4.0


def test_a_layer_that_is_gone_leaves_the_base():
    base = Falling()
    Doubling(base)
    assert base.derived is base


def test_wrapper_attributes():
    base = Falling()
    layer = Doubling(base)
    layer.set_wrapper_attr("simulation_duration_max", 3.0)
    assert base.simulation_duration_max == 3.0
    assert "simulation_duration_max" not in vars(layer)
    assert layer.set_wrapper_attr("color", "red") and vars(layer)["color"] == "red"
    assert not hasattr(base, "color")
    assert not layer.set_wrapper_attr("taste", "sweet", force=False)
    assert not layer.has_wrapper_attr("taste")
    assert layer.has_wrapper_attr("color") and layer.get_wrapper_attr("step_dt") == 0.02
    layer.reset()
    layer.set_wrapper_attr("factor", 5.0)
    assert layer.step([0.0])[1] == 5.0


def test_layers_go_on_pipelines_only():
    with pytest.raises(ConfigError, match="goes on a RobotEnv"):
        Doubling(gymnasium.make("CartPole-v1"))


# Gymnasium ----------------------------------------------------------------------------------------


def test_gymnasiums_checker_does_not_complain(backend):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(Cart(backend=backend), skip_render_check=True)
        warnings.filterwarnings("ignore", ".*different from the unwrapped version.*")
        check_env(Doubling(Falling(backend=backend)), skip_render_check=True)


def test_gymnasiums_wrappers():
    env = gymnasium.wrappers.FlattenObservation(Cart())
    observation, _ = env.reset(seed=0)
    assert observation.shape == (7,) and env.unwrapped.num_steps == 0
    env = gymnasium.wrappers.TimeLimit(Cart(), 2)
    env.reset(seed=0)
    assert [env.step(env.action_space.sample())[3] for _ in range(2)] == [False, True]
