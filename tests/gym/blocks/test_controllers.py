"""Controllers: targets, torques and safety, alone and on running robots."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_gym import (
    ControlledEnv,
    MotorSafetyLimit,
    PDAdapter,
    PDController,
    RobotEnv,
    Simulator,
)
from physx_sim import Encoder, Motor, Robot, World

DT = 0.005


def simulator(robot="ant", **options):
    options = {"fixed_base": True, "control_period": DT, **options}
    return Simulator.build(robot, ground=None, **options)


def with_pd(base, **options):
    options = {"kp": 20.0, "kd": 0.02, "joint_acceleration_limit": 200.0, **options}
    return ControlledEnv(base, PDController("pd", base, **options))


class Standing(RobotEnv):
    """The A1 on its feet."""

    def _neutral(self):
        found = np.array(super()._neutral())
        found[7:] = np.tile([0.0, 0.8, -1.6], 4)
        return found


# The PD controller ---------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_targets_are_consistent_and_within_limits(backend):
    env = with_pd(
        RobotEnv(simulator(backend=backend), DT),
        joint_position_margin=0.05,
        joint_velocity_limit=4.0,
    )
    pd, rng = env.controller, np.random.default_rng(0)
    observed = [env.reset(seed=0)[0]]
    actions = []
    for step in range(400):
        if step % 20 == 0:
            action = env.action_space.low * rng.choice([-1.0, -0.1, 0.0, 0.1, 1.0], 8)
        actions.append(action)
        observed.append(env.step(action)[0])
    targets = np.array([each["states"]["pd"] for each in observed])
    q, v = targets[:, 0], targets[:, 1]
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, v[1:], atol=1e-6)
    acceleration = np.diff(v, axis=0) / DT
    assert (np.abs(acceleration) <= pd.max_acceleration + 1e-6).all()
    assert (np.abs(v) <= 4.0 + 1e-9).all()
    assert (q >= pd.lower - 1e-9).all()
    assert (q <= pd.upper + 1e-9).all()
    kept = np.abs(acceleration - np.array(actions)) < 1e-6  # where no bound is close
    assert 0.2 < kept.mean() < 0.9
    np.testing.assert_allclose(pd.lower, pd.joints.lower + 0.05)


def test_torques_follow_the_formula_and_are_clipped():
    env = with_pd(RobotEnv(simulator(), DT), kp=3200.0, kd=0.01)
    rng = np.random.default_rng(1)
    cut = free = 0
    observation, _ = env.reset(seed=0)
    for _ in range(100):
        q, v = observation["measurements"]["Encoder"]
        observation, *_ = env.step(rng.uniform(env.action_space.low, env.action_space.high))
        target_q, target_v = observation["states"]["pd"]
        wanted = 3200.0 * ((target_q - q) + 0.01 * (target_v - v))
        most = env.simulator.layout.max_torque
        expected = np.clip(wanted, -most, most)
        np.testing.assert_allclose(env.robot_state.command, expected, atol=1e-9)
        cut, free = cut + (wanted != expected).sum(), free + (wanted == expected).sum()
    assert cut > 0
    assert free > 0


def test_gears_and_the_order_of_encoders_do_not_matter():
    def run(motors, sensors):
        env = with_pd(RobotEnv(simulator(motors=motors, sensors=sensors), DT))
        env.reset(seed=0)
        rng = np.random.default_rng(2)
        for _ in range(30):
            env.step(rng.uniform(env.action_space.low, env.action_space.high))
        return env.robot_state.q.copy()

    joints = simulator().layout.joints
    plain = run([Motor(joint=name) for name in joints], [Encoder(name=n, joint=n) for n in joints])
    ratios = [-6.0, 9.0] * 4
    geared = run(
        [Motor(joint=n, reduction=r) for n, r in zip(joints, ratios, strict=True)],
        [Encoder(name=n, joint=n, reduction=-3.0) for n in reversed(joints)],
    )
    np.testing.assert_allclose(geared, plain, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_standing_comes_to_rest(backend):
    options = {"period": 2e-3, "control_period": 2e-3, "backend": backend}
    built = Simulator.build("a1/a1", fixed_base=False, **options)
    env = with_pd(Standing(built, 0.05), kp=200.0, kd=0.02)
    env.reset(seed=0)
    steps = 0
    while np.abs(env.robot_state.v).max() > 1e-3 or steps < 5:
        env.step(np.zeros(12))
        steps += 1
        assert steps < 50, np.abs(env.robot_state.v).max()
    assert (env.controller.targets.velocities == 0).all()
    assert env.robot_state.q[2] > 0.2


def test_the_default_acceleration_reverses_the_highest_velocity_in_a_step():
    env = RobotEnv(simulator(), 0.02)
    pd = PDController("pd", env, kp=1.0, kd=0.0)
    np.testing.assert_allclose(pd.action_space.high, 2 * 20.0 / 0.02)


def test_requirements_of_a_pd_controller():
    env = RobotEnv(simulator(), 0.02)
    with pytest.raises(ConfigError, match="kp is -1"):
        PDController("pd", env, kp=-1.0, kd=0.0)
    with pytest.raises(ConfigError, match="one for each of the 8 motors"):
        PDController("pd", env, kp=[1.0, 2.0], kd=0.0)
    with pytest.raises(ConfigError, match="above the upper"):
        PDController("pd", env, kp=1.0, kd=0.0, joint_position_margin=1.0)
    above = with_pd(env, joint_acceleration_limit=10.0)
    above.action_space = type(above.action_space)(-1.0, 1.0, (3,))
    with pytest.raises(ConfigError, match="not the torques of 8 motors"):
        PDController("other", above, kp=1.0, kd=0.0)
    joints = simulator().layout.joints
    some = RobotEnv(simulator(sensors=[Encoder(name="one", joint=joints[0])]), 0.02)
    with pytest.raises(ConfigError, match=f'needs an Encoder on the joint "{joints[1]}"'):
        PDController("pd", some, kp=1.0, kd=0.0)
    world = World([Robot("double_pendulum")])
    motors = [Motor(joint="shoulder", max_torque=1.0)]
    endless = RobotEnv(Simulator(world, motors=motors), 0.02)
    with pytest.raises(ConfigError, match="are not limited"):
        PDController("pd", endless, kp=1.0, kd=0.0)


# The adapter ---------------------------------------------------------------------------------


def adapted(order, *, step_dt=0.02, **options):
    env = with_pd(RobotEnv(simulator(), step_dt), joint_acceleration_limit=2000.0)
    return ControlledEnv(env, PDAdapter("adapter", env, order=order, **options))


@pytest.mark.parametrize("instantaneous", [False, True])
def test_targets_go_to_positions(instantaneous):
    env = adapted(0, is_instantaneous=instantaneous)
    env.reset(seed=0)
    targets = env.env.controller.targets
    for sign in (1.0, -1.0):
        wanted = targets.positions + sign * np.linspace(0.01, 0.2, 8)
        wanted = np.clip(wanted, env.action_space.low + 0.01, env.action_space.high - 0.01)
        before = np.sign(wanted - targets.positions)
        overshoot = 0.0
        for _ in range(40):
            env.step(wanted)
            overshoot = max(overshoot, np.max(before * (targets.positions - wanted)))
        np.testing.assert_allclose(targets.positions, wanted, atol=1e-6)
        np.testing.assert_allclose(targets.velocities, 0.0, atol=1e-4)
        assert not instantaneous or overshoot < 1e-9


@pytest.mark.parametrize("instantaneous", [False, True])
def test_targets_reach_velocities(instantaneous):
    env = adapted(1, is_instantaneous=instantaneous)
    env.reset(seed=0)
    targets = env.env.controller.targets
    wanted = np.linspace(-1.0, 1.0, 8)
    env.step(wanted)
    np.testing.assert_allclose(targets.velocities, wanted, atol=1e-9)
    moved = targets.positions - env.env.controller.joints.encoders.values[0]
    assert (np.sign(moved) == np.sign(wanted)).all()


def test_instantaneous_is_faster():
    def first_tick(instantaneous):
        env = adapted(1, is_instantaneous=instantaneous)
        env.reset(seed=0)
        env.env.controller.setup()
        env.compute_command(np.full(8, 0.5), np.zeros(8))
        return env.env.controller.targets.velocities.copy()

    np.testing.assert_allclose(first_tick(True), 0.5, atol=1e-9)
    np.testing.assert_allclose(first_tick(False), 0.5 * DT / 0.02, atol=1e-9)


def test_deadband():
    env = adapted(1, deadband=0.1)
    env.reset(seed=0)
    env.step(np.array([0.05, -0.09, 0.2, -0.2, 0.0, 0.11, -0.11, 0.099]))
    moving = env.env.controller.targets.velocities != 0
    np.testing.assert_array_equal(moving, [False, False, True, True, False, True, True, False])


def test_an_adapter_goes_on_a_pd_controller():
    env = RobotEnv(simulator(), 0.02)
    with pytest.raises(ConfigError, match="directly on a ControlledEnv with a PDController"):
        PDAdapter("adapter", env)
    with pytest.raises(ConfigError, match="order is 2"):
        PDAdapter("adapter", with_pd(env), order=2)


# Safety --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_safety_limit_keeps_joints_within_soft_limits():
    env = RobotEnv(simulator(control_period=1e-3), 0.01)
    safety = MotorSafetyLimit(
        "safety", env, kp=10.0, kd=4.0, soft_position_margin=0.1, soft_velocity_max=6.0
    )
    env = ControlledEnv(env, safety)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    fastest = 0.0
    for step in range(300):
        if step % 15 == 0:
            action = env.action_space.high * rng.choice([-1.0, -0.2, 0.2, 1.0], 8)
        env.step(action)
        q, v = env.robot_state.q, env.robot_state.v
        fastest = max(fastest, np.abs(v).max())
        assert (q > safety.soft_lower - 0.05).all()
        assert (q < safety.soft_upper + 0.05).all()
    assert 5.0 < fastest < 20.0
    without = RobotEnv(simulator(control_period=1e-3), 0.01)
    without.reset(seed=0)
    for _ in range(30):
        without.step(without.action_space.high)
    assert (without.robot_state.q > safety.soft_upper + 0.05).any()


@pytest.mark.parametrize("fastest", [np.inf, 3.0])
@pytest.mark.parametrize("ratio", [1.0, -4.0])
def test_the_safety_limit_follows_the_formula(fastest, ratio):
    joints = simulator().layout.joints
    motors = [Motor(joint=name, reduction=ratio) for name in joints]
    env = RobotEnv(simulator(motors=motors), DT)
    options = {"kp": 10.0, "kd": 2.0, "soft_position_margin": 0.2, "soft_velocity_max": fastest}
    safety = MotorSafetyLimit("safety", env, **options)
    rng = np.random.default_rng(0)
    measured = env.simulator.sensed["Encoder"]
    command = np.zeros(8)
    same = 0
    for _ in range(50):
        q = rng.uniform(safety.joints.lower - 0.1, safety.joints.upper + 0.1)
        v = rng.normal(size=8)
        measured[:] = q, v
        action = rng.uniform(-8.0, 8.0, 8)
        safety.compute_command(action, command)
        low = np.clip(10.0 * (safety.soft_lower - q), -fastest, fastest)
        high = np.clip(10.0 * (safety.soft_upper - q), -fastest, fastest)
        expected = np.clip(action * ratio, 2.0 * (low - v), 2.0 * (high - v)) / ratio
        np.testing.assert_allclose(command, expected, atol=1e-12)
        same += (command == action).sum()
    assert same > 0
