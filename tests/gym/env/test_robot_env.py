"""Every member of RobotEnv does what it says.

What subclasses change is in `test_derived_environments`.
"""

import warnings

import numpy as np
import pytest
from gymnasium import spaces

from physx_core.errors import ConfigError, EpisodeError, UnknownOptionError, UsageError
from physx_gym import RobotEnv, Simulator
from physx_sim import (
    Encoder,
    Ground,
    JointCoupling,
    JointSettings,
    Mimic,
    Motor,
    Robot,
    World,
)

pytestmark = pytest.mark.processes

SLIDER = [Motor(joint="slider")]


def cart(backend="dart", step_dt=0.02, **options):
    return RobotEnv("cartpole", step_dt, backend=backend, motors=SLIDER, period=5e-3, **options)


def ant(backend="dart", **options):
    options = {"control_period": 0.01, "period": 2e-3, **options}
    return RobotEnv("ant", 0.02, backend=backend, fixed_base=False, **options)


# Spaces and buffers -------------------------------------------------------------------------------


def test_default_spaces(backend):
    env = ant(backend)
    assert env.action_space == spaces.Box(-60.0, 60.0, (8,), np.float64)
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


def test_quantities_are_created_once():
    env = cart()
    assert env.quantities is env.quantities


def test_sensors_are_what_is_measured():
    sensors = [Encoder(name="angle", joint="hinge", noise={"position": 0.1})]
    env = cart(sensors=sensors)
    env.reset(seed=0)
    measured = [env.step([0.0])[0]["measurements"]["Encoder"][0, 0] for _ in range(5)]
    assert len(set(measured)) == 5 and max(map(abs, measured)) < 1.0


# Begin and end of an episode ----------------------------------------------------------------------


def test_neutral_positions_are_those_that_couplings_and_leaders_allow(backend):
    hips = [f"{end}_{side}_hip" for end in ("back", "front") for side in ("left", "right")]
    couplings = [JointCoupling({hips[0]: 1.0, hips[1]: 1.0}, 0.4), JointCoupling({hips[2]: 2}, 0.5)]
    followers = {hips[3]: JointSettings(mimic=Mimic(hips[2], -1.0, 0.1))}
    for given, wanted in ((couplings, (0.2, 0.2, 0.25, -0.15)), ((), (0.0, 0.0, 0.0, 0.1))):
        robot = Robot("ant", couplings=given, joints=followers)
        env = RobotEnv(World([robot], gravity=(0, 0, 0), contacts="none"), 0.02, backend=backend)
        found = dict(zip(env.simulator.layout.joints, env._neutral().tolist(), strict=True))
        assert [found[name] for name in hips] == pytest.approx(wanted)
        assert found["front_left_knee"] == pytest.approx(1.0)
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape))
        assert np.abs(env.simulator.velocities).max() < 1e-6  # nothing had to return


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


def test_an_observation_outside_of_its_space_truncates_and_the_first_one_warns():
    class Narrow(RobotEnv):
        def _initialize_observation_space(self):
            self.observation_space = spaces.Box(-0.1, 0.1, (2,), np.float64)

        def refresh_observation(self, measurement):
            self.observation[:] = measurement["states"]["agent"]["q"]

        def _sample_state(self):
            return np.array([0.09, 0.0]), np.array([5.0, 0.0])

    env = Narrow("cartpole", 0.02, motors=SLIDER, period=5e-3)
    env.reset()
    expected = r"Narrow is outside its space: 0\.\d+ at \[0\] is not between -0\.1 and 0\.1"
    with pytest.warns(UserWarning, match=expected):
        assert env.step([0.0])[2:4] == (False, True)
    env.reset()
    with warnings.catch_warnings(action="error"):
        assert env.step([0.0])[3]


def test_has_terminated_needs_a_running_episode():
    with pytest.raises(EpisodeError, match="call reset"):
        cart().has_terminated({})


def test_close_and_reset_again(backend):
    env = cart(backend)
    first, _ = env.reset(seed=0)
    env.close()
    env.close()
    assert not env.is_simulation_running
    again, _ = env.reset(seed=0)
    assert np.array_equal(first["states"]["agent"]["q"], again["states"]["agent"]["q"])
    env.step([0.0])


# Training, evaluation, recording ------------------------------------------------------------------


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


# Options ------------------------------------------------------------------------------------------


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


def test_what_cannot_be_shown_or_played():
    with pytest.raises(UnknownOptionError, match="ansi"):
        RobotEnv("cartpole", 0.02, render_mode="ansi")
    with pytest.raises(UsageError, match="_key_to_action"):
        cart()._key_to_action("k", None, None)
