"""Every member of RobotEnv does what it says."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core.errors import (
    ConfigError,
    EpisodeError,
    SimulationError,
    UnknownOptionError,
    UsageError,
)
from physx_core.gym import Layer, PipelineEnv, RobotEnv, Simulator
from physx_core.motors import Motor
from physx_core.sensors import Encoder
from physx_core.world import Ground, Robot, World

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


def cart(backend="dart", step_dt=0.02, **options):
    return RobotEnv("cartpole", step_dt, backend=backend, motors=SLIDER, period=5e-3, **options)


def ant(backend="dart", **options):
    options = {"control_period": 0.01, "period": 2e-3, **options}
    return RobotEnv("ant", 0.02, backend=backend, fixed_base=False, **options)


# Spaces and buffers -----------------------------------------------------------------------------


def test_default_spaces(backend):
    env = ant(backend)
    assert env.action_space == spaces.Box(-15.0, 15.0, (8,), np.float64)
    observed = env.observation_space
    assert observed["t"].low == 0 and observed["t"].high == 86400.0
    q, v = observed["states"]["agent"]["q"], observed["states"]["agent"]["v"]
    assert q.shape == (15,) and v.shape == (14,)
    assert q.low[3:7] == pytest.approx([-1.01] * 4) and q.high[8] == pytest.approx(1.7 + 0.014)
    shapes = {kind: box.shape for kind, box in observed["measurements"].items()}
    assert shapes == {"Encoder": (2, 8), "Imu": (10, 1)}
    assert all(leaf.dtype == np.float64 for leaf in (q, v, observed["t"]))


def test_default_observation_is_the_measurement(backend):
    env = ant(backend)
    observation, info = env.reset(seed=0)
    assert info == {} and observation in env.observation_space
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert (reward, terminated, truncated, info) == (0.0, False, False, {})
    assert observation in env.observation_space
    simulation, agent = env.simulator.simulation, observation["states"]["agent"]
    assert np.array_equal(agent["q"], simulation.positions())
    assert np.array_equal(agent["v"], simulation.velocities())
    measured = observation["measurements"]["Encoder"]
    assert np.array_equal(measured, [agent["q"][7:], agent["v"][6:]])
    assert observation["t"] == 0.02
    assert np.array_equal(env.measurements["measurements"]["Encoder"], measured)


def test_buffers_stay_and_what_is_returned_is_a_copy(backend):
    env = cart(backend)
    observation, _ = env.reset(seed=0)
    leaf = env.observation["states"]["agent"]["q"]
    kept = (env.action, env.robot_state.q, env.measurements["t"], env.num_steps, leaf)
    later = env.step(np.array([1.0]))[0]
    assert not np.array_equal(observation["states"]["agent"]["q"], later["states"]["agent"]["q"])
    env.reset(seed=1)
    again = env.observation["states"]["agent"]["q"]
    now = (env.action, env.robot_state.q, env.measurements["t"], env.num_steps, again)
    assert all(old is new for old, new in zip(kept, now, strict=True))
    later["states"]["agent"]["q"][:] = 7.0
    assert not (leaf == 7.0).any()


def test_robot_and_stepper_state(backend):
    env = cart(backend)
    assert env.num_steps == -1 and not env.is_simulation_running
    env.reset(seed=0)
    assert env.num_steps == 0 and env.is_simulation_running.shape == ()
    assert env.is_simulation_running and env.stepper_state.t == 0.0
    assert (env.robot_state.a == 0).all() and (env.robot_state.torques == 0).all()
    before = env.robot_state.v.copy()
    for _ in range(3):
        env.step([50.0])
    assert env.num_steps == 3 and env.stepper_state.iter == 12
    assert env.stepper_state.t == pytest.approx(0.06) and env.stepper_state.dt == 5e-3
    assert env.robot_state.command == [30.0] and env.robot_state.torques == [30.0]
    assert env.robot_state.v[0] > before[0] and env.robot_state.a[0] > 10.0
    assert env.robot.name == "robot" and not env.robot.floating
    assert env.simulator.world.robots[0].urdf == "cartpole"


def test_periods():
    env = ant(observe_period=0.02)
    assert (env.step_dt, env.control_dt, env.observe_dt) == (0.02, 0.01, 0.02)
    assert cart().control_dt == cart().observe_dt == 0.02


def test_quantities_are_made_once():
    env = cart()
    assert env.quantities is env.quantities


# What an episode's end is -------------------------------------------------------------------


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


def test_the_longest_duration_truncates():
    env = RobotEnv("cartpole", 0.02, 0.1, motors=SLIDER, period=5e-3)
    for _ in range(2):
        env.reset()
        ends = [env.step([0.0])[2:4] for _ in range(5)]
        assert ends == [(False, False)] * 4 + [(False, True)]
        with pytest.raises(EpisodeError, match="truncated"):
            env.step([0.0])
    assert env.observation in env.observation_space
    env.simulation_duration_max = 0.05
    env.reset()
    assert [env.step([0.0])[3] for _ in range(3)] == [False, False, True]


class Falling(Cart):
    def has_terminated(self, info):
        info["angle"] = float(self.robot_state.q[1])
        return abs(self.robot_state.q[1]) > 0.2, False

    def compute_reward(self, terminated, info):
        return -1.0 if terminated else 1.0

    def _sample_state(self):
        return np.array([0.0, 0.1]), np.zeros(2)


def test_falling_terminates_and_is_no_truncation(backend):
    env = Falling(backend=backend)
    env.reset()
    for _ in range(100):
        _, reward, *ends, info = env.step([0.0])
        if any(ends):
            break
    assert ends == [True, False] and reward == -1.0 and info["angle"] > 0.2


def test_actions_are_cut_before_anything_sees_them():
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


def test_what_is_no_number_is_an_error_that_says_where():
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


# Overriding -----------------------------------------------------------------------------------


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


def test_neutral_is_0_or_the_middle_of_the_limits(backend):
    neutral = ant(backend)._neutral()
    assert neutral[:7] == pytest.approx([0, 0, 0, 0, 0, 0, 1])
    assert neutral[7:] == pytest.approx([0.0, 1.0] * 4)


@pytest.mark.parametrize("height", [0.0, -0.7])
def test_a_floating_robot_begins_on_the_ground(backend, height):
    env = ant(backend, ground=Ground(height=height))
    env.reset(seed=0)
    simulation = env.simulator.simulation
    lowest = -simulation.reach("robot", np.array([0.0, 0.0, -1.0]))
    assert lowest == pytest.approx(height, abs=1e-12)
    env.step(np.zeros(8))
    assert len(simulation.contacts()) >= 1 and abs(env.robot_state.v[2]) < 0.2


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


def test_a_first_state_that_ends_the_episode_is_an_error():
    class Over(Cart):
        def has_terminated(self, info):
            return True, False

    env = Over()
    with pytest.raises(EpisodeError, match="terminated at its first state"):
        env.reset()
    assert not env.is_simulation_running
    with pytest.raises(EpisodeError):
        env.step([0.0])


def test_has_terminated_is_of_a_running_episode():
    with pytest.raises(EpisodeError, match="call reset"):
        cart().has_terminated({})


def test_options_of_several_classes():
    class Extra:
        def __init__(self, *, color="red", **kwargs):
            super().__init__(**kwargs)
            self.color = color

    class Mixed(RobotEnv, Extra):
        pass

    simulator = Simulator.build("cartpole", motors=SLIDER)
    assert Mixed(simulator, 0.02, color="blue").color == "blue"
    with pytest.raises(UnknownOptionError, match="colour"):
        RobotEnv(simulator, 0.02, colour="blue")
    with pytest.raises(UnknownOptionError, match="backened"):
        RobotEnv("cartpole", 0.02, backened="dart")
    with pytest.raises(ConfigError, match="Simulator, a World"):
        RobotEnv(3, 0.02)


# Training, evaluation, recording ----------------------------------------------------------------


def test_training_and_evaluation():
    env = cart()
    assert env.training
    env.eval()
    assert not env.training
    env.train()
    env.reset()
    env.train(True)
    with pytest.raises(EpisodeError, match="stop"):
        env.eval()
    env.stop()
    env.train(False)
    assert not env.training


def test_recording_in_evaluation(tmp_path):
    env = Cart()
    counter = np.zeros(2)
    env.register_variable("counter", counter, ["up", "down"], "mine")
    assert list(env.log_fieldnames) == ["mine.counter"]
    env.reset()
    env.step([0.5])
    assert env.log_data == {}
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


def test_debug_records_every_physics_step_in_training():
    env = RobotEnv("cartpole", 0.02, debug=True, motors=SLIDER, period=5e-3)
    env.reset()
    env.step([0.5])
    env.stop()
    assert env.log_data["variables"]["time"] == pytest.approx([0.0, 0.005, 0.01, 0.015, 0.02])


def test_recording_changes_nothing(backend):
    found = []
    for training in (True, False):
        env = ant(backend)
        env.train(training)
        env.reset(seed=3)
        env.action_space.seed(0)
        found.append([env.step(env.action_space.sample())[0] for _ in range(2)][-1])
        env.stop()
    assert np.array_equal(found[0]["states"]["agent"]["q"], found[1]["states"]["agent"]["q"])


# The pipeline -----------------------------------------------------------------------------------


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


# Gymnasium --------------------------------------------------------------------------------------


def test_gymnasiums_checker_has_nothing_to_say(backend):
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


def test_close_and_reset_again(backend):
    env = cart(backend)
    first, _ = env.reset(seed=0)
    env.close()
    env.close()
    assert not env.is_simulation_running
    again, _ = env.reset(seed=0)
    assert np.array_equal(first["states"]["agent"]["q"], again["states"]["agent"]["q"])
    env.step([0.0])


def test_what_cannot_be_shown_or_played():
    with pytest.raises(UnknownOptionError, match="ansi"):
        RobotEnv("cartpole", 0.02, render_mode="ansi")
    with pytest.raises(UsageError, match="_key_to_action"):
        cart()._key_to_action("k", None, None)


def test_sensors_are_what_is_measured():
    sensors = [Encoder(name="angle", joint="hinge", noise={"position": 0.1})]
    env = cart(sensors=sensors)
    env.reset(seed=0)
    measured = [env.step([0.0])[0]["measurements"]["Encoder"][0, 0] for _ in range(5)]
    assert len(set(measured)) == 5 and max(map(abs, measured)) < 1.0
