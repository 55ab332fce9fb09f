"""Observers on running robots, compared with the true state of the simulation."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_core.rotations import rotate_back_rows, to_roll_pitch_yaw
from physx_gym import (
    BodyObserver,
    ControlledEnv,
    MahonyFilter,
    ObservedEnv,
    PDController,
    QuantityObserver,
    RobotEnv,
    Simulator,
)
from physx_gym.tasks.quantities import BaseHeight, BodiesInContact
from physx_sim import Encoder, Imu
from physx_sim.errors import SimulationError

DT = 0.005
TILTED = (0.1, -0.2, 0.3, 0.927361849549570)


class Standing(RobotEnv):
    """The A1 on its feet, rotated about the vertical."""

    def _neutral(self):
        found = np.array(super()._neutral())
        found[7:] = np.tile([0.0, 0.8, -1.6], 4)
        found[3:7] = [0.0, 0.0, 0.2, 0.96**0.5]
        return found


def walker(*, sensors=None, backend="dart", filtered=None, bodies=None):
    """Return the A1 under a PD controller, with a filter and a body observer."""
    options = {"period": 2.5e-3, "control_period": DT, "backend": backend, "sensors": sensors}
    base = Standing(Simulator.build("a1/a1", fixed_base=False, **options), 0.02)
    env = ObservedEnv(base, MahonyFilter("mahony", base, compute_rpy=True, **(filtered or {})))
    env = ObservedEnv(env, BodyObserver("bodies", env, bodies=bodies, compute_rpy=True))
    options = {"kp": 150.0, "kd": 0.01, "joint_acceleration_limit": 100.0}
    return ControlledEnv(env, PDController("pd", env, **options))


def encoders():
    layout = Simulator.build("a1/a1", fixed_base=False).layout
    return [Encoder(name=joint, joint=joint) for joint in layout.joints]


def turn_between(a, b):
    return 2 * np.arccos(np.minimum(np.abs(np.sum(a * b, axis=-1)), 1.0))


def swaying(env, steps, size, rest=0):
    """Go through steps of an episode in which the robot, after a rest, sways on its feet."""
    env.reset(seed=0)
    for _ in range(rest):
        env.step(np.zeros(12))
    rng = np.random.default_rng(0)
    for step in range(steps):
        if step % 40 == 0:
            action = size * rng.normal(size=12)
        if step % 20 == 10:
            action = -action
        yield env.step(action)[0]


def difference(a, b):
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi).max()


def errors(env, size, rest=0):
    """Return the largest error of roll, pitch and yaw over 200 steps, and the largest tilt."""
    worst = tilt = 0.0
    for observed in swaying(env, 200, size, rest):
        truth = np.array(to_roll_pitch_yaw(env.robot_state.q[3:7]))
        tilt = max(tilt, np.abs(truth[:2]).max())
        for name in ("mahony", "bodies"):
            found = observed["features"][name]["roll_pitch_yaw"][:, 0]
            worst = max(worst, difference(found, truth))
    return worst, tilt


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_roll_pitch_yaw_over_200_steps(backend):
    worst, tilt = errors(walker(backend=backend), 0.3, rest=80)
    assert worst < 5e-3
    assert tilt > 5e-3


@pytest.mark.slow
def test_rates_alone_are_followed_through_hard_sways_and_impacts():
    worst, tilt = errors(walker(filtered={"kp": 0.0, "ki": 0.0}), 2.0)
    assert worst < 5e-3
    assert tilt > 0.05


def test_links_between_encoders():
    bodies = ["FL_foot", "base", "RR_calf"]
    env = walker(bodies=bodies, filtered={"kp": 0.0, "ki": 0.0})
    simulation = env.simulator.simulation
    for observed in swaying(env, 40, 1.0):
        seen = observed["features"]["bodies"]
        truth = simulation.body_poses(bodies)[:, 3:]
        assert turn_between(seen["orientation"].T, truth).max() < 5e-3
        rates = rotate_back_rows(truth, simulation.body_velocities(bodies)[:, 3:])
        np.testing.assert_allclose(seen["angular_velocity"].T, rates, atol=0.05)


def test_each_link_uses_the_nearest_of_several_imus():
    imus = [
        Imu(name="trunk", body="base", rotation=TILTED),
        Imu(name="calf", body="FL_calf", rotation=TILTED),
    ]
    env = walker(sensors=[*encoders(), *imus], filtered={"kp": 0.0, "ki": 0.0})
    assert env.derived.layers[2].observer.bodies == ("base", "FL_calf")
    simulation = env.simulator.simulation
    for observed in swaying(env, 20, 1.0):
        truth = simulation.body_poses(["base", "FL_calf"])[:, 3:]
        seen = observed["features"]["bodies"]["orientation"].T
        assert turn_between(seen[0], truth[0]) < 5e-3
        assert turn_between(seen[1], truth[1]) < 3e-2  # a calf is shaken by its foot


@pytest.mark.slow
def test_several_imus_are_filtered_like_one():
    one = walker(sensors=[*encoders(), Imu(name="a", body="base")])
    two = walker(sensors=[*encoders(), Imu(name="a", body="base"), Imu(name="b", body="base")])
    for first, second in zip(swaying(one, 10, 1.0), swaying(two, 10, 1.0), strict=True):
        for key, value in first["features"]["mahony"].items():
            both = second["features"]["mahony"][key]
            np.testing.assert_allclose(both, np.repeat(value, 2, 1), atol=1e-9)


def test_begin_without_orientation_and_without_twist():
    env = walker(filtered={"exact_init": False, "ignore_twist": True})
    for observed in swaying(env, 20, 1.0):
        seen = observed["features"]["mahony"]["orientation"][:, 0]
        assert seen[2] == 0.0
        up = np.array([0.0, 0.0, 1.0])
        found, truth = rotate_back_rows(seen, up), rotate_back_rows(env.robot_state.q[3:7], up)
        assert np.linalg.norm(found - truth) < 0.2
    exact = walker(filtered={"exact_init": True})
    observed, _ = exact.reset(seed=0)
    np.testing.assert_allclose(
        observed["features"]["mahony"]["orientation"][:, 0], exact.robot_state.q[3:7], atol=1e-12
    )


@pytest.mark.slow
def test_the_bias_of_the_gyroscope_is_estimated():
    imu = Imu(name="trunk", body="base", bias={"angular_velocity": [0.05, 0.0, 0.0]})
    env = walker(sensors=[*encoders(), imu], filtered={"kp": 2.0, "ki": 1.0})
    observed, _ = env.reset(seed=0)
    np.testing.assert_allclose(observed["states"]["mahony"], 0.0)
    for _ in range(200):
        observed, *_ = env.step(np.zeros(12))
    np.testing.assert_allclose(observed["states"]["mahony"][0, 0], 0.05, atol=0.01)
    np.testing.assert_allclose(
        observed["features"]["mahony"]["angular_velocity"][0, 0], 0.0, atol=0.02
    )


def test_quantities_as_features():
    base = RobotEnv(Simulator.build("ant", fixed_base=False, control_period=DT), 0.02)
    bodies = base.simulator.layout.bodies[-2:]
    env = ObservedEnv(base, QuantityObserver("height", base, quantity=BaseHeight()))
    env = ObservedEnv(env, QuantityObserver("touching", env, quantity=BodiesInContact(bodies)))
    env.reset(seed=0)
    for _ in range(5):
        features = env.step(np.zeros(8))[0]["features"]
        assert features["height"].shape == ()
        np.testing.assert_array_equal(features["height"], env.quantities.get_value(BaseHeight()))
        np.testing.assert_array_equal(
            features["touching"], env.quantities.get_value(BodiesInContact(bodies))
        )


def test_requirements_of_observers():
    layout = Simulator.build("ant").layout
    base = RobotEnv(Simulator.build("ant", ground=None), 0.02)
    with pytest.raises(ConfigError, match="has no Imu"):
        MahonyFilter("mahony", base)
    with pytest.raises(ConfigError, match="kp"):
        MahonyFilter("mahony", base, kp=-1.0)
    with pytest.raises(ConfigError, match="needs a MahonyFilter"):
        BodyObserver("bodies", base)
    with pytest.raises(ConfigError, match="is not a Quantity"):
        QuantityObserver("height", base, quantity="BaseHeight")
    root = layout.bodies[0]
    bare = RobotEnv(Simulator.build("ant", sensors=[Imu(name="imu", body=root)]), 0.02)
    bare = ObservedEnv(bare, MahonyFilter("mahony", bare))
    with pytest.raises(ConfigError, match="needs an Encoder on the joint"):
        BodyObserver("bodies", bare, bodies=[layout.bodies[-1]])
    with pytest.raises(SimulationError, match="nobody"):
        BodyObserver("bodies", bare, bodies=["nobody"])
