"""Couplings of joints: differentials, locked joints, limits and motors, snapshots, and errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_sim import JointCoupling, JointSettings, Mimic, Robot, World
from physx_sim.engines import read_robot
from physx_sim.errors import FeatureNotSupportedError, ModelError

pytestmark = pytest.mark.processes

INERTIAS = {"left": 0.02, "right": 0.05, "carrier": 0.3}
"""Moments of inertia about the axes, in kg m²."""
ERROR = 2e-3
"""Difference of accelerations relative to the largest."""
SIDES = {"left": 0.5, "right": 0.5, "carrier": -1.0}
DIFFERENTIAL = JointCoupling(SIDES)
WHEEL = (
    '<link name="{0} gear"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="{1}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="{0}" type="continuous"><parent link="base"/><child link="{0} gear"/>'
    '<axis xyz="0 0 1"/><limit effort="50" velocity="{2}"/></joint>'
)


@pytest.fixture
def gears(write_urdf):
    """Return robots of three wheels on parallel axes, with a differential unless others are given.

    The third one, the carrier, turns at the mean speed of the others.
    """

    def make(fastest=(0, 0, 0), couplings=(DIFFERENTIAL,), **options):
        given = zip(INERTIAS.items(), fastest, strict=True)
        wheels = "".join(WHEEL.format(name, inertia, v) for (name, inertia), v in given)
        path = write_urdf(f'<robot name="gears"><link name="base"/>{wheels}</robot>')
        return Robot(path, couplings=couplings, **options)

    return make


@pytest.fixture
def bar_with_limits(write_urdf):
    """Return robots of the joints a, up to 0.1 rad, b and c."""
    limits = ' type="revolute"><limit lower="-1" upper="{1}" effort="50" velocity="0"/>'
    joint = WHEEL.partition("<limit")[0].replace(' type="continuous">', limits) + "</joint>"
    uppers = {"a": 0.1, "b": 1.0, "c": 1.0}
    joints = "".join(joint.replace("{0}", n).replace("{1}", str(x)) for n, x in uppers.items())
    path = write_urdf(f'<robot name="bars"><link name="base"/>{joints}</robot>')
    return lambda *couplings: Robot(path, couplings=couplings)


def in_order(simulation, values):
    return np.array([values.get(name, 0.0) for name in simulation.layout.joints])


def gap(simulation, coefficients=SIDES):
    """Return the sum of coefficients times positions."""
    return in_order(simulation, coefficients) @ simulation.positions()


def velocities(simulation):
    return dict(zip(simulation.layout.joints, simulation.velocities().tolist(), strict=True))


def test_a_differential_shares_torques_and_speeds(engine, gears):
    torques = {"left": 0.3, "right": -0.1, "carrier": 0.7}
    with engine.build(World([gears()])) as simulation:
        simulation.set_torques(in_order(simulation, torques))
        simulation.step(1000)
        found = velocities(simulation)
        assert gap(simulation) == pytest.approx(0.0, abs=1e-7)
    # Lagrange's equations of the wheels' angles, on which that of the carrier depends.
    left, right, carrier = INERTIAS.values()
    mass = np.full((2, 2), carrier / 4) + np.diag([left, right])
    share = torques["carrier"] / 2
    wanted = np.linalg.solve(mass, [torques["left"] + share, torques["right"] + share])
    np.testing.assert_allclose([found["left"], found["right"]], wanted, rtol=1e-7)
    assert found["carrier"] == pytest.approx(wanted.mean(), rel=1e-7)


@settings(max_examples=size(12, 3))
@given(st.sampled_from(["dart", "pinocchio", "mujoco"]), st.integers(0, 2**32 - 1))
def test_a_floating_robot_accelerates_as_gauss_says(name, seed):
    """Of all accelerations that couplings allow, it has the one nearest to the free ones."""
    random = np.random.default_rng(seed)
    joints = read_robot(Robot("ant")).joints
    q = np.array([0.5 * (joint.lower + joint.upper) for joint in joints])
    q += random.uniform(-0.2, 0.2, len(q))
    rows = np.linalg.qr(random.normal(size=(len(q), random.integers(1, 5))))[0].T
    couplings = [
        JointCoupling({joint.name: x for joint, x in zip(joints, row, strict=True)}, row @ q)
        for row in rows
    ]
    robot = Robot("ant", fixed_base=False, couplings=couplings)
    with plugins.resolve("backend", name).build(
        World([robot], period=1e-4, contacts="none")
    ) as simulation:
        q = np.concatenate([simulation.positions()[:7], q])
        v, torques = random.uniform(-1.0, 1.0, 14), random.uniform(-1.0, 1.0, 8)
        v[6:] -= np.linalg.pinv(rows) @ rows @ v[6:]
        simulation.set_state(q, v)
        simulation.set_torques(torques)
        free = simulation.forward_dynamics(q, v, np.pad(torques, (6, 0)))
        wide = np.pad(rows, ((0, 0), (6, 0)))
        spread = np.linalg.solve(simulation.mass_matrix(q), wide.T)
        wanted = free - spread @ np.linalg.solve(wide @ spread, wide @ free)
        simulation.step()
        found = (simulation.velocities() - v)[6:] / simulation.period
    np.testing.assert_allclose(found, wanted[6:], atol=ERROR * abs(free).max())


def test_a_coupling_of_one_joint_locks_it(engine, bar):
    robot = bar(couplings=[JointCoupling({"hinge": -2.0}, 0.6)])
    with engine.build(World([robot])) as simulation:
        assert simulation.positions()[0] == pytest.approx(-0.3)  # where it starts
        simulation.step(500)
        assert simulation.positions()[0] == pytest.approx(-0.3, abs=1e-4)


def test_a_robot_starts_within_the_limits_of_all(bar_with_limits):
    robot = bar_with_limits(JointCoupling({"a": 1, "b": 1, "c": -0.5}, 1.0))
    model = read_robot(robot)
    names = [joint.name for joint in model.joints]
    start = dict(zip(names, model.start.tolist(), strict=True))
    assert start["a"] + start["b"] - 0.5 * start["c"] == pytest.approx(1.0, abs=1e-9)
    # The nearest to 0: a stays at its limit, and the others share the rest as their coefficients.
    assert start == pytest.approx({"a": 0.1, "b": 0.72, "c": -0.36}, abs=1e-6)


def test_states_that_violate_a_coupling_return_to_it(engine, gears):
    offset = JointCoupling(SIDES, 0.2)
    with engine.build(World([gears(couplings=[offset])])) as simulation:
        assert gap(simulation) == pytest.approx(0.2)
        q = simulation.positions() + in_order(simulation, {"left": 0.1})
        simulation.set_state(q, np.zeros(3))
        assert gap(simulation) == pytest.approx(0.25)
        simulation.step(500)
        assert gap(simulation) == pytest.approx(0.2, abs=1e-6)
        assert abs(simulation.velocities()).max() < 1e-5


@pytest.mark.parametrize(
    ("fastest", "wanted"),
    [((1, 1, 2), (1, 1, 1)), ((1, 1, 0.8), (None, None, 0.8)), ((0.5, 1, 2), (0.5, 1, 0.75))],
)
def test_the_velocity_limits_of_all_hold(engine, gears, fastest, wanted):
    with engine.build(World([gears(fastest)])) as simulation:
        simulation.set_torques(np.full(3, 5.0))
        simulation.step(300)
        found = velocities(simulation)
        assert gap(simulation) == pytest.approx(0.0, abs=3e-4)
    for name, speed, most in zip(INERTIAS, wanted, fastest, strict=True):
        assert found[name] <= most + 1e-6
        assert speed is None or found[name] == pytest.approx(speed, abs=1e-6)
    assert found["left"] + found["right"] == pytest.approx(2 * found["carrier"], abs=1e-5)


@pytest.mark.parametrize("mode", ["servo", "velocity"])
def test_motors_of_two_joints_drive_the_third(engine, gears, mode):
    robot = gears(joints={name: JointSettings(mode) for name in ("left", "right")})
    with engine.build(World([robot])) as simulation:
        simulation.set_commands(in_order(simulation, {"left": 1.0, "right": 0.4}))
        simulation.step(500)
        assert velocities(simulation) == pytest.approx({"left": 1, "right": 0.4, "carrier": 0.7})


def test_followers_take_part_in_couplings(engine, gears):
    """The right wheel follows the left one with half its speed, so the carrier has 0.75 of it."""
    robot = gears(joints={"right": JointSettings(mimic=Mimic("left", 0.5))})
    with engine.build(World([robot])) as simulation:
        simulation.set_torques(in_order(simulation, {"carrier": 0.3}))
        simulation.step(1000)
        speed = velocities(simulation)["left"]
    left, right, carrier = INERTIAS.values()
    assert speed == pytest.approx(0.75 * 0.3 / (left + right / 4 + carrier * 0.75**2), rel=1e-6)


def test_coupled_joints_continue_from_a_snapshot(engine, gears):
    world = World([gears()])
    with engine.build(world) as simulation, engine.build(world) as other:
        simulation.set_torques([0.3, -0.1, 0.7])
        simulation.step(100)
        other.restore(simulation.snapshot())
        for each in (simulation, other):
            each.step(100)
        np.testing.assert_array_equal(simulation.positions(), other.positions())


@pytest.mark.parametrize(
    ("couplings", "mode", "said"),
    [
        ([JointCoupling({"lift": 1.0})], "force", 'names "lift", which is not a movable joint'),
        ([DIFFERENTIAL, JointCoupling({"left": 1, "right": 1, "carrier": -2})], "force", "repeat"),
        ([DIFFERENTIAL], "velocity", "hold joints whose motors impose their velocities"),
    ],
)
def test_couplings_that_cannot_hold_are_errors(gears, couplings, mode, said):
    joints = {name: JointSettings(mode) for name in INERTIAS}
    with pytest.raises(ModelError, match=said):
        read_robot(gears(couplings=couplings, joints=joints))


def test_couplings_that_limits_do_not_allow_are_errors(bar_with_limits):
    sums = [JointCoupling({"a": 1, "b": 1}, 1.0), JointCoupling({"b": 1}, 0.5)]
    with pytest.raises(ModelError, match='no positions within the limits of "a"'):
        read_robot(bar_with_limits(*sums))


@pytest.mark.parametrize(
    ("joints", "said"),
    [({}, "is empty"), ({"left": 0.0}, "must not be 0"), ({"left": np.inf}, "finite")],
)
def test_wrong_coefficients_are_errors(joints, said):
    with pytest.raises(ConfigError, match=said):
        JointCoupling(joints)


def test_what_is_no_coupling_is_an_error(gears):
    with pytest.raises(ConfigError, match=r"\{'left': 1.0\} is not a JointCoupling"):
        gears(couplings=[{"left": 1.0}])


def test_a_robot_may_do_without_those_of_its_file(tmp_path):
    path = tmp_path / "locked.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a"><joint name="j"/><geom size=".1"/></body></worldbody>'
        '<equality><joint joint1="j" polycoef="0.2 0 0 0 0"/></equality></mujoco>'
    )
    assert read_robot(Robot(path)).couplings == (JointCoupling({"j": 1.0}, 0.2),)
    assert read_robot(Robot(path, couplings=())).couplings == ()


def test_runge_kutta_couples_nothing(engine, gears):
    with pytest.raises(FeatureNotSupportedError, match="couplings in rk4"):
        engine.build(World([gears()], integrator="rk4"))
