"""Rewards and terminations of a composed environment, compared with recomputed values."""

import math

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_gym import RobotEnv, Simulator
from physx_gym.env.layers.composed import ComposedEnv
from physx_gym.errors import LogError
from physx_gym.tasks.quantities import (
    BaseHeight,
    JointPositions,
    MechanicalPower,
    Odometry,
    RollPitch,
    odometry_difference,
)
from physx_gym.tasks.rewards import Minimizing, Product, Sum, Survival, Tracking
from physx_gym.tasks.terminations import (
    Drift,
    OutOfBounds,
    Shift,
    base_height,
    collision,
    high_contact_force,
    high_power,
    lost_ground,
    roll_pitch,
    slippage,
    unsafe_joints,
)
from physx_gym.tasks.trajectory import Trajectory

pytestmark = pytest.mark.processes

SHINS = ("back_left_shin", "back_right_shin", "front_left_shin", "front_right_shin")
STEP = 0.02


def ant():
    simulator = Simulator.build("ant", fixed_base=False, period=2e-3, control_period=0.01)
    return RobotEnv(simulator, STEP)


def still(env, seconds, beyond="clip", **moves):
    """A trajectory on which the robot keeps its first state, but for what moves: (place, rate)."""
    env.reset(seed=0)
    q, v = env.robot_state.q.copy(), env.robot_state.v.copy()
    last = q.copy()
    for place, rate in moves.values():
        last[place] += rate * seconds
    return Trajectory(np.array([0.0, seconds]), np.array([q, last]), np.array([v, v]), beyond)


def test_rewards_follow_their_formulas():
    env = ant()
    path = still(env, 1.0, up=(2, 0.5))
    reward = Sum(
        {
            Survival(): 0.5,
            Tracking(BaseHeight(), 0.2): 2.0,
            Minimizing(MechanicalPower(), 30.0, name="power"): 1.0,
            Product({Minimizing(RollPitch(), 0.5): 3.0, Survival("alive"): 1.0}, "upright"): 0.25,
            Tracking(JointPositions(), 1.0, target=0.1, name="pose"): 0.75,
        }
    )
    top = ComposedEnv(env, reward=reward, trajectory=path)
    top.reset(seed=0)
    first = float(path.positions[0, 2])
    rng = np.random.default_rng(0)
    for _ in range(5):
        *_, info = results = top.step(rng.uniform(-5, 5, 8))
        parts = {name.removeprefix("reward_"): value for name, value in info.items()}

        def kernel(error, cutoff):
            return math.exp(math.log(0.01) * float(np.sum(np.square(error))) / cutoff**2)

        get = env.quantities.get_value
        height = first + 0.5 * float(env.stepper_state.t)
        assert parts["survival"] == 1.0
        assert parts["BaseHeight"] == pytest.approx(kernel(get(BaseHeight()) - height, 0.2))
        assert parts["power"] == pytest.approx(kernel(get(MechanicalPower()), 30.0))
        upright = kernel(get(RollPitch()), 0.5)
        assert parts["RollPitch"] == pytest.approx(upright)
        assert parts["upright"] == pytest.approx(upright**0.75)
        assert parts["pose"] == pytest.approx(kernel(get(JointPositions()) - 0.1, 1.0))
        total = (
            0.5
            + 2.0 * parts["BaseHeight"]
            + parts["power"]
            + 0.25 * parts["upright"]
            + 0.75 * parts["pose"]
        )
        assert results[1] == parts["total"] == pytest.approx(total)


def test_normalized_sums_stay_within_0_and_1_and_rewards_add_up_over_layers():
    env = ant()
    inner = ComposedEnv(env, reward=Sum([Survival(), Minimizing(RollPitch(), 1.0)], normalize=True))
    outer = ComposedEnv(inner, reward=Survival("again"))
    outer.reset(seed=0)
    _, total, _, _, info = outer.step(np.zeros(8))
    assert info["reward_total"] == pytest.approx(0.5 + 0.5 * info["reward_RollPitch"])
    assert total == pytest.approx(info["reward_total"] + 1.0)


def test_terminations_end_episodes():
    env = ant()
    top = ComposedEnv(
        env,
        reward=Survival(),
        terminations=[
            base_height(10.0, grace_period=0.05),
            roll_pitch([-3, -2], [3, 2]),
            OutOfBounds(BaseHeight(), None, 0.0, "cut", is_truncation=True, grace_period=0.07),
            OutOfBounds(BaseHeight(), None, 0.0, "drill", training_only=True, grace_period=0.05),
        ],
    )
    top.reset(seed=0)
    for _ in range(2):
        _, reward, terminated, truncated, info = top.step(np.zeros(8))
        assert (reward, terminated, truncated, info.get("terminations")) == (
            1.0,
            False,
            False,
            None,
        )
    _, reward, terminated, truncated, info = top.step(np.zeros(8))
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["terminations"] == ["base_height", "drill"]
    top.stop()
    top.eval()
    top.reset(seed=0)
    for _ in range(3):
        info = top.step(np.zeros(8))[-1]
    assert info["terminations"] == ["base_height"]
    top.stop()
    top.train()
    later = ComposedEnv(
        ant(),
        terminations=[OutOfBounds(BaseHeight(), None, 0.0, is_truncation=True, grace_period=0.01)],
    )
    later.reset(seed=0)
    assert later.step(np.zeros(8))[2:4] == (False, True)


def test_drift_and_shift_are_relative_to_the_reference():
    env = ant()
    path = still(env, 10.0, forward=(0, 1.0))  # the reference walks off at 1 m/s
    drift = Drift(Odometry(), 5, -0.09, 0.09, difference=odometry_difference)
    shift = Shift(Odometry(), 4, 0.055, name="behind")
    top = ComposedEnv(env, terminations=[drift, shift], trajectory=path)
    top.reset(seed=0)
    places, fired = [float(env.robot_state.q[0])], []
    while not fired:
        info = top.step(np.zeros(8))[-1]
        places.append(float(env.robot_state.q[0]))
        fired = info.get("terminations", [])
    steps = len(places) - 1
    excess = abs((places[-1] - places[max(0, steps - 5)]) - STEP * min(steps, 5))
    far = [abs(x - places[0] - STEP * k) for k, x in enumerate(places)]
    assert ("Odometry_drift" in fired) == (excess > 0.09)
    assert ("behind" in fired) == (steps >= 3 and min(far[-4:]) > 0.055)
    assert steps in (4, 5, 6)


def test_contact_slip_and_power_terminations():
    env = ant()
    feet = tuple(env.simulator.layout.bodies)
    watched = [
        collision((*feet, "ground"), name="touch", is_truncation=True),
        high_contact_force(feet, 1.0, is_truncation=True),
        slippage(feet, 1e-6, is_truncation=True),
        high_power(1e-9, 3, is_truncation=True),
        unsafe_joints(10.0, 1e-6, is_truncation=True),
        lost_ground(feet, -1.0, is_truncation=True),
    ]
    for each in watched:
        each.grace_period = 0.01
    top = ComposedEnv(env, terminations=watched)
    top.reset(seed=0)
    info = top.step(np.full(8, 5.0))[-1]
    assert info["terminations"] == [each.name for each in watched]
    mild = [
        collision(SHINS),
        high_contact_force(feet, 1e6),
        slippage(feet, 1e3),
        high_power(1e6, 3),
        unsafe_joints(10.0, 1e6),
        lost_ground(feet, 10.0),
    ]
    top = ComposedEnv(ant(), terminations=mild)
    top.reset(seed=0)
    assert "terminations" not in top.step(np.full(8, 5.0))[-1]


def test_mistakes_are_reported():
    env = ant()
    with pytest.raises(ConfigError, match="not a Reward"):
        ComposedEnv(env, reward=1.0)
    with pytest.raises(ConfigError, match="not a Termination"):
        ComposedEnv(env, terminations=[1.0])
    with pytest.raises(ConfigError, match="same name"):
        ComposedEnv(env, terminations=[base_height(0.1), base_height(0.2)])
    with pytest.raises(ConfigError, match="same name"):
        Sum([Survival(), Survival()])
    with pytest.raises(ConfigError, match="cannot be normalized"):
        Product([Sum([Survival()])])
    with pytest.raises(ConfigError, match="cutoff"):
        Minimizing(BaseHeight(), 0.0)
    with pytest.raises(ConfigError, match="bounds"):
        OutOfBounds(BaseHeight())
    with pytest.raises(ConfigError, match="bounds"):
        OutOfBounds(BaseHeight(), 1.0, 0.0)
    with pytest.raises(ConfigError, match="grace_period"):
        base_height(0.1, grace_period=-1.0)
    short = Trajectory(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 2)))
    with pytest.raises(ConfigError, match="3 positions"):
        ComposedEnv(env, trajectory=short)


def test_trajectories_are_interpolated_and_saved(tmp_path):
    quarter = [0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)]
    q = np.array([[0, 0, 1, 0, 0, 0, 1, 0.0], [1, 0, 1, *(-np.array(quarter)), 1.0]])
    v = np.array([[0.0] * 7, [2.0] * 7])
    path = Trajectory(np.array([1.0, 3.0]), q, v)
    half, rate = path.at(2.0)
    turn = [0, 0, math.sin(math.pi / 8), math.cos(math.pi / 8)]
    np.testing.assert_allclose(half, [0.5, 0, 1, *turn, 0.5], atol=1e-12)
    np.testing.assert_allclose(rate, 1.0)
    np.testing.assert_array_equal(path.at(1.0)[0], q[0])
    with pytest.raises(ConfigError, match="from 1 s to 3 s"):
        path.at(3.1)
    clipped = Trajectory(path.times, q, v, "clip")
    np.testing.assert_array_equal(clipped.at(9.0)[0][:3], q[1][:3])
    wrapped = Trajectory(path.times, q, v, "wrap")
    np.testing.assert_allclose(wrapped.at(4.0)[0], [1.5, 0, 1, *turn, 0.5], atol=1e-12)
    wrapped.save(tmp_path / "walk.h5")
    again = Trajectory.load(tmp_path / "walk.h5")
    assert again.beyond == "wrap"
    for name in ("times", "positions", "velocities"):
        np.testing.assert_array_equal(getattr(again, name), getattr(wrapped, name))
    (tmp_path / "noise.h5").write_bytes(b"noise" * 100)
    with pytest.raises(LogError, match="cannot be read"):
        Trajectory.load(tmp_path / "noise.h5")
    with pytest.raises(ConfigError, match="must not decrease"):
        Trajectory(np.array([1.0, 0.0]), q, v)
    with pytest.raises(ConfigError, match="finite"):
        Trajectory(path.times, q * np.nan, v)
    with pytest.raises(ConfigError, match="needs times"):
        Trajectory(path.times, q[:1], v)
