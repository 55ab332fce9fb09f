"""Measured behavior of environments, blocks, quantities and logs, with tolerances."""

import itertools
import runpy
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pinocchio as pin
import pytest
from gymnasium import spaces

from physx_core.errors import VisualizerError
from physx_core.rotations import from_rotation_vector_rows, multiply_rows, to_matrix_rows
from physx_gym import ControlledEnv, PDController, RobotEnv, Simulator, read_log
from physx_gym.tasks.quantities import BodyPoses, geometry
from physx_gym.tasks.terminations import lost_ground, roll_pitch, unsafe_joints
from physx_sim import Encoder, Imu, Motor, Wrench
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes

STAND = np.tile([0.0, 0.8, -1.6], 4)
SHINS = ("back_left_shin", "back_right_shin", "front_left_shin", "front_right_shin")


class Standing(RobotEnv):
    """The A1 on its feet, each episode a little different."""

    def _neutral(self):
        found = np.array(super()._neutral())
        found[7:] = STAND + self.np_random.uniform(-0.05, 0.05, 12)
        return found


class Exact(RobotEnv):
    """The same without differences."""

    def _neutral(self):
        return np.concatenate([super()._neutral()[:7], STAND])


def a1(kind, backend="dart", *, step_dt=0.02, **options):
    options = {"period": 2e-3, "control_period": 2e-3, "backend": backend, **options}
    return kind(Simulator.build("a1/a1", fixed_base=False, **options), step_dt)


def ant(**options):
    options = {"fixed_base": False, "period": 2e-3, "control_period": 0.01, **options}
    return RobotEnv("ant", 0.02, **options)


# The same to the last bit -----------------------------------------------------------------------


def test_first_accelerations_do_not_depend_on_what_was_before(backend):
    sensors = [Imu(name="imu", body="base", noise=0.1, bias_deviation=0.1, random_walk=0.1)]
    env, found = a1(Standing, backend, sensors=sensors), set()
    for steps in (0, 5, 20, 10, 0):
        env.reset(seed=0)
        observation = env.step(np.zeros(12))[0]
        measured = observation["measurements"]["Imu"]
        found.add((env.robot_state.a.tobytes(), measured.tobytes(), env.robot_state.q.tobytes()))
        for _ in range(steps if backend == "dart" else steps // 5):
            env.step(env.action_space.sample())
    assert len(found) == 1


def test_registered_environments_are_the_same_in_another_process():
    program = Path(__file__).parents[1] / "programs" / "registered_runs.py"
    registered = runpy.run_path(str(program))
    words = [sys.executable, str(program), "3"]
    there = subprocess.check_output(words, text=True).split()
    for which, wanted in zip(registered["ALL"], there, strict=True):
        env = registered["make"](*which)
        registered["run"](env, 4, 2)  # an earlier episode
        assert registered["run"](env, 3) == wanted, which
        env.close()


# Blocks -----------------------------------------------------------------------------------------


def with_pd(base, **options):
    return ControlledEnv(base, PDController("pd", base, **options))


@pytest.mark.slow
def test_standing_for_9_s():
    env = with_pd(a1(Exact, step_dt=0.05), kp=200.0, kd=0.02)
    env.reset(seed=0)
    fastest, targets = [], []
    for _ in range(180):
        env.step(np.zeros(12))
        fastest.append(np.abs(env.robot_state.v).max())
        targets.append(np.abs(env.controller.targets.velocities).max())
    assert max(targets[-20:]) < 1e-9
    assert max(fastest[-20:]) < 1e-3
    assert env.robot_state.q[2] > 0.2


@pytest.mark.slow
def test_pictures_of_a_standing_robot_do_not_change(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = with_pd(a1(Exact, step_dt=0.05), kp=200.0, kd=0.02)
    env.unwrapped.render_mode = "rgb_array"
    env.viewer_kwargs["picture_size"] = (160, 120)
    env.reset(seed=0)
    pictures = []
    for steps in (160, 20):
        for _ in range(steps):
            env.step(np.zeros(12))
        try:
            pictures.append(env.render().astype(int))
        except VisualizerError as error:
            pytest.skip(str(error))
    env.close()
    assert np.abs(pictures[1] - pictures[0]).mean() < 0.5
    assert np.ptp(pictures[0]) > 50


def test_recorded_targets_are_consistent(tmp_path):
    period = 5e-3
    built = Simulator.build("ant", fixed_base=True, ground=None, control_period=period)
    env = with_pd(RobotEnv(built, 0.02), kp=20.0, kd=0.02, joint_acceleration_limit=200.0)
    env.eval()
    env.reset(seed=0, options={"log_path": tmp_path / "a.h5"})
    rng = np.random.default_rng(0)
    for _ in range(60):
        env.step(rng.uniform(-1.0, 1.0, 8) * env.action_space.high)
    env.close()
    log, pd = read_log(tmp_path / "a.h5"), env.controller
    np.testing.assert_allclose(np.diff(log.time), period, rtol=1e-9)
    names = [name for name in log.variables if name.startswith("pd.state")]
    states = np.stack([log.variables[name] for name in names], axis=1)[
        :-1
    ]  # at the end none moves on
    q, v = states[:, :8], states[:, 8:]
    np.testing.assert_allclose(np.diff(q, axis=0) / period, v[1:], atol=1e-6)
    assert (np.abs(np.diff(v, axis=0)) / period <= pd.max_acceleration + 1e-6).all()
    assert (np.abs(v) <= pd.max_velocity + 1e-6).all()
    assert ((q >= pd.lower - 1e-6) & (q <= pd.upper + 1e-6)).all()
    assert np.abs(v).max() > 1.0


# Wrappers ---------------------------------------------------------------------------------------


def test_stacked_observations_are_of_the_last_steps():
    env = gymnasium.wrappers.FilterObservation(ant(), ["t"])
    env = gymnasium.wrappers.FrameStackObservation(env, 4, padding_type="zero")
    assert env.reset(seed=0)[0]["t"].tolist() == [0.0] * 4
    for step in range(1, 7):
        times = env.step(np.zeros(8))[0]["t"]
        wanted = np.maximum(0.02 * np.arange(step - 3, step + 1), 0.0)
        np.testing.assert_allclose(times, wanted, atol=1e-6)


class Bounded(RobotEnv):
    """Observes joints between their limits."""

    def _initialize_observation_space(self):
        layout = self.simulator.layout
        angles = spaces.Box(layout.lower, layout.upper, dtype=np.float64)
        rates = spaces.Box(-50.0, 50.0, (len(layout.joints),), np.float64)
        self.observation_space = spaces.Dict({"rates": rates, "angles": angles, "t": rates})

    def refresh_observation(self, measurement):
        state = measurement["states"]["agent"]
        self.observation["angles"][:], self.observation["rates"][:] = state["q"][7:], state["v"][6:]


def test_filtered_normalized_and_flattened_observations(backend):
    env = Bounded("ant", 0.02, fixed_base=False, period=2e-3, backend=backend)
    inner = gymnasium.wrappers.FilterObservation(env, ["rates", "angles"])
    keys = list(inner.observation_space.spaces)
    flat = gymnasium.wrappers.FlattenObservation(inner)
    scaled = gymnasium.wrappers.RescaleObservation(flat, np.float64(-1.0), np.float64(1.0))
    scaled = gymnasium.wrappers.RescaleAction(scaled, np.float64(-1.0), np.float64(1.0))
    observation, _ = scaled.reset(seed=0)
    for action in (0.0, 0.5, -0.5):
        parts = [inner.observation_space[key] for key in keys]
        shares = [
            2 * (env.observation[key] - part.low) / (part.high - part.low) - 1
            for key, part in zip(keys, parts, strict=True)
        ]
        np.testing.assert_allclose(observation, np.concatenate(shares), rtol=1e-7, atol=1e-9)
        observation, *_ = scaled.step(np.full(8, action))
        np.testing.assert_allclose(env.action, action * env.action_space.high)


# Terminations and quantities --------------------------------------------------------------------


def thrown(backend):
    """Go through steps of an ant that is thrown."""
    env = ant(backend=backend)

    def sample():
        q, v = RobotEnv._sample_state(env)
        q[2] += 0.2
        v[:6] = 0.5, 0.0, 1.0, 2.0, 3.0, 0.5
        return q, v

    env._sample_state = sample
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        env.step(rng.uniform(-1, 1, 8) * env.action_space.high)
        yield env


def roll_and_pitch(env):
    return pin.rpy.matrixToRpy(pin.Quaternion(env.robot_state.q[3:7]).matrix())[:2]


def lowest(env):
    return env.simulator.simulation.body_poses(list(SHINS))[:, 2].min()


def fastest_near_limits(env):
    layout, q, v = env.simulator.layout, env.robot_state.q[7:], env.robot_state.v[6:]
    near = np.minimum(q - layout.lower, layout.upper - q) < 0.1
    return np.abs(v[near]).max(initial=0.0)


@pytest.mark.parametrize(
    ("termination", "truth"),
    [
        (roll_pitch([-0.4] * 2, [0.4] * 2), lambda env: np.abs(roll_and_pitch(env)).max() > 0.4),
        (lost_ground(SHINS, 0.45), lambda env: lowest(env) > 0.45),
        (unsafe_joints(0.1, 2.0), lambda env: fastest_near_limits(env) > 2.0),
    ],
)
def test_flags_agree_with_recomputed_ones(backend, termination, truth):
    flags = [(termination.holds(env.quantities), truth(env)) for env in thrown(backend)]
    assert all(found == wanted for found, wanted in flags)
    assert {found for found, _ in flags} == {True, False}


def test_differences_of_poses_agree_with_pinocchio():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 200, 7))
    for poses in (first, second):
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    found = geometry.pose_difference(second, first)
    for row, (a, b) in zip(found, zip(first, second, strict=True), strict=True):
        turn = pin.Quaternion(b[3:]).matrix() @ pin.Quaternion(a[3:]).matrix().T
        np.testing.assert_allclose(row[3:], pin.log3(turn), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(row[:3], b[:3] - a[:3], rtol=1e-7)
    vectors = rng.normal(size=(200, 3))
    turns = from_rotation_vector_rows(vectors)
    exact = np.array([pin.exp3(vector) for vector in vectors])
    np.testing.assert_allclose(to_matrix_rows(turns), exact, rtol=1e-7, atol=1e-9)
    both = np.array([a @ b for a, b in zip(exact, exact[::-1], strict=True)])
    found = to_matrix_rows(multiply_rows(turns, turns[::-1]))
    np.testing.assert_allclose(found, both, rtol=1e-7, atol=1e-9)


# What must not happen ---------------------------------------------------------------------------


def test_sampled_options_take_effect_and_repeat(backend):
    """Friction, errors of sensors and pushes, drawn when an episode begins."""

    class Varied(RobotEnv):
        def _setup(self):
            draw = self.np_random.uniform
            friction = self.reset_options.get("friction", draw(0.2, 2.0))
            noise = draw(1e-3, 1e-2)
            changes = {"noise": noise, "delay": 0.004}
            self.simulator.set_options(
                {"world": {"ground": {"friction": friction}}, "sensors": {"knee": changes}}
            )
            push = Wrench("torso", (0.0, draw(-3.0, 3.0), 0.0), duration=0.05)
            self.simulator.register_force(push, begin=0.02)

        def _sample_state(self):
            q, v = super()._sample_state()
            v[0] = 2.0
            return q, v

    sensors = [Encoder(name="knee", joint="front_left_knee")]
    options = {"fixed_base": False, "period": 5e-3, "backend": backend, "sensors": sensors}
    env = Varied("ant", 0.02, **options)

    def run(steps=3, **given):
        env.reset(**given)
        for _ in range(steps):
            observation = env.step(np.zeros(8))[0]
        return observation["measurements"]["Encoder"].tobytes(), env.robot_state.q.tobytes()

    first = run(seed=1)
    used = env.simulator.get_options()["world"]["ground"]["friction"]
    assert run() != first
    assert env.simulator.get_options()["world"]["ground"]["friction"] != used
    assert run(seed=1) == first
    gone = []
    for friction in (0.0, 1.5):
        run(12, seed=1, options={"friction": friction})
        assert env.simulator.world.ground.friction == friction
        gone.append(env.robot_state.q[0])
    assert gone[0] > gone[1] + 0.05


def test_slow_code_is_not_an_error():
    class Slow(RobotEnv):
        def compute_command(self, action, command):
            time.sleep(0.06)
            command[:] = action

    env = Slow("cartpole", 2e-3, period=1e-3)
    env.reset()
    assert env.step([0.0, 0.0])[2:4] == (False, False)


def test_nan_in_the_first_observation_is_reported():
    class Broken(RobotEnv):
        def refresh_observation(self, measurement):
            super().refresh_observation(measurement)
            self.observation["measurements"]["Encoder"][1, 0] = np.nan

    with pytest.raises(SimulationError, match=r'at \["measurements"\]\["Encoder"\]\[1\]\[0\]'):
        Broken("cartpole", 0.02).reset()


def test_observations_and_rewards_after_the_end_are_correct(backend):
    """What is out of bounds is observed as it is, and the reward is of the action that was cut."""

    class Narrow(RobotEnv):
        def _initialize_observation_space(self):
            self.observation_space = spaces.Box(-0.01, 0.01, (1,), np.float64)

        def refresh_observation(self, measurement):
            self.observation[0] = measurement["states"]["agent"]["q"][0]

        def compute_reward(self, terminated, info):
            return -float(self.action @ self.action)

    motors = [Motor(joint="slider", max_torque=10.0)]
    env = Narrow("cartpole", 0.02, backend=backend, motors=motors, period=5e-3)
    env.reset()
    for _ in itertools.repeat(None, 20):
        observation, reward, terminated, truncated, _ = env.step([1e6])
        assert reward == -100.0
        assert not terminated
        if truncated:
            break
    assert observation[0] == env.robot_state.q[0] > 0.01


def test_quantities_work_for_objects_and_links(backend):
    env = ant(backend=backend)
    env.reset(seed=0)
    poses = env.quantities.get_value(BodyPoses(("torso",)))[0]
    np.testing.assert_allclose(poses, env.robot_state.q[:7], atol=1e-9)
