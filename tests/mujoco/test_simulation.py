"""MuJoCo's worlds when they are stepped: free motion, contacts, limits, drives, features."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from sizes import size

from physx_core import plugins
from physx_core.errors import UnknownOptionError
from physx_core.rotations import to_matrix
from physx_sim import (
    Box,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    JointSettings,
    Mesh,
    Robot,
    Sphere,
    Stairs,
    World,
    Wrench,
)
from physx_sim.engines import read_robot
from physx_sim.errors import FeatureNotSupportedError, ModelError, SimulationError

pytestmark = pytest.mark.processes

mujoco = pytest.importorskip("mujoco")

WEIGHT = 9.81
JOINTS = ("gantry_x", "gantry_y")


def energy(simulation):
    """Return the energy of the double pendulum."""
    q, v = simulation.positions(), simulation.velocities()
    found = 0.5 * v @ simulation.mass_matrix(q) @ v
    bodies = read_robot(Robot("double_pendulum")).bodies
    for body, pose in zip(bodies, simulation.body_poses(), strict=True):
        found += WEIGHT * body.mass * (pose[2] + (to_matrix(pose[3:]) @ body.center)[2])
    return found


@pytest.mark.parametrize(("integrator", "bound"), [("euler", 2e-2), ("rk4", 1e-9)])
def test_a_double_pendulum_keeps_its_energy(backend, integrator, bound):
    free = JointSettings(damping=0.0, friction=0.0)
    joints = {joint.name: free for joint in read_robot(Robot("double_pendulum")).joints}
    world = World([Robot("double_pendulum", joints=joints)], integrator=integrator)
    with backend.build(world) as simulation:
        simulation.set_state([1.0, 0.5], [0.0, 0.0])
        before, worst = energy(simulation), 0.0
        for _ in range(20):
            simulation.step(100)
            worst = max(worst, abs(energy(simulation) - before))
    assert worst < bound * WEIGHT


def test_free_fall_is_that_of_semi_implicit_euler(backend):
    world = World(objects=[Box(name="b", size=(0.1, 0.2, 0.3), mass=2.0, position=(0, 0, 9.0))])
    with backend.build(world) as simulation:
        simulation.step(1000)
        fallen = WEIGHT * 1e-6 * 1000 * 1001 / 2
        np.testing.assert_allclose(simulation.positions()[:3], [0, 0, 9.0 - fallen], atol=1e-12)
        np.testing.assert_allclose(simulation.velocities()[:3], [0, 0, -WEIGHT], atol=1e-12)
        np.testing.assert_allclose(simulation.accelerations()[:3], [0, 0, -WEIGHT], atol=1e-9)


def test_damped_springs_move_as_with_pinocchio(backend, pinocchio):
    settings = {name: JointSettings(damping=2.0, stiffness=9e3, rest=0.2) for name in JOINTS}
    world, found = World([Robot("gantry", joints=settings)]), []
    for engine in (backend, pinocchio):
        with engine.build(world) as simulation:
            simulation.step(300)
            found.append([*simulation.positions(), *simulation.velocities()])
    np.testing.assert_allclose(*found, rtol=1e-9)


@pytest.mark.parametrize("mode", ["force", "servo", "velocity", "position"])
def test_drives_and_velocity_limits_are_those_of_pinocchio(backend, pinocchio, mode):
    """Both joints speed up against their torque or velocity limits, and reach their targets."""
    world, found = World([Robot("gantry", joints={x: JointSettings(mode) for x in JOINTS})]), []
    commands = {"force": [50.0, -30.0], "position": [0.4, -0.4]}.get(mode, [2.0, -3.0])
    for engine in (backend, pinocchio):
        with engine.build(world) as simulation:
            assert tuple(simulation.layout.joints) == JOINTS
            simulation.set_commands(commands)
            rows = []
            for _ in range(10):
                simulation.step(15)
                rows.append([*simulation.positions(), *simulation.velocities()])
            found.append(rows)
            np.testing.assert_array_equal(simulation.commands(), commands)
    np.testing.assert_allclose(*found, rtol=1e-7, atol=1e-7)


def test_a_joint_stops_at_its_limit(backend):
    with backend.build(World([Robot("gantry")])) as simulation:
        upper = simulation.layout.upper
        simulation.set_torques([50.0, 50.0])
        worst = 0.0
        for _ in range(600):
            simulation.step()
            worst = max(worst, *(simulation.positions() - upper))
        assert worst < 7e-3  # at 5 m/s
        np.testing.assert_allclose(simulation.positions(), upper, atol=1e-4)
        np.testing.assert_allclose(simulation.velocities(), 0.0, atol=1e-4)


def test_coulomb_friction_holds_what_is_weaker(backend):
    for torque, moves in ((0.9, False), (1.1, True)):
        joints = {name: JointSettings(friction=1.0) for name in JOINTS}
        with backend.build(World([Robot("gantry", joints=joints)])) as simulation:
            simulation.set_torques([torque, 0.0])
            simulation.step(500)
            assert (simulation.positions()[0] > 1e-3) == moves
            assert abs(simulation.positions()[1]) < 1e-5


# Contacts ---------------------------------------------------------------------------------------


def rest(backend, thing, ground, height, steps=1500):
    """Let a thing of 1 kg come to rest; its contacts carry it and lie where it touches."""
    with backend.build(World(objects=[thing], ground=ground)) as simulation:
        simulation.step(steps)
        contacts = simulation.contacts()
        assert len(contacts) > 0
        np.testing.assert_allclose(contacts["force"].sum(axis=0), [0, 0, WEIGHT], atol=1e-3)
        np.testing.assert_allclose(contacts["normal"], [[0, 0, 1]] * len(contacts), atol=1e-6)
        assert (contacts["body_a"] == 0).all() and (contacts["body_b"] == 1).all()
        assert contacts["depth"].max() < 1e-4
        assert simulation.positions()[2] == pytest.approx(height, abs=1e-4)
        np.testing.assert_allclose(simulation.velocities(), 0.0, atol=1e-3)


TURNED = (0.0, 0.5**0.5, 0.0, 0.5**0.5)


@pytest.mark.parametrize(
    ("thing", "height"),
    [
        (Box(name="t", size=(0.1, 0.2, 0.3), mass=1.0, position=(0, 0, 0.2)), 0.15),
        (Sphere(name="t", radius=0.1, mass=1.0, position=(0, 0, 0.2)), 0.1),
        (Cylinder(name="t", radius=0.1, length=0.2, mass=1.0, position=(0, 0, 0.2)), 0.1),
        (
            Capsule(
                name="t",
                radius=0.1,
                length=0.2,
                mass=1.0,
                position=(0, 0, 0.2),
                orientation=TURNED,
            ),
            0.1,
        ),
    ],
    ids=["box", "sphere", "cylinder", "capsule"],
)
def test_a_thing_rests_on_the_ground(backend, thing, height):
    rest(backend, thing, Ground(), height)


def test_a_mesh_rests_as_its_convex_hull(backend, tmp_path):
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["f 1 2 4", "f 1 4 3", "f 5 8 6", "f 5 7 8", "f 1 6 2", "f 1 5 6"]
    lines += ["f 3 4 8", "f 3 8 7", "f 1 3 7", "f 1 7 5", "f 2 8 4", "f 2 6 8"]
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    rest(
        backend, Mesh(name="t", path=path, scale=0.1, mass=1.0, position=(0, 0, 0.2)), Ground(), 0.1
    )


def test_stairs_and_height_fields_carry_things_where_they_are(backend):
    box = {"size": (0.1, 0.1, 0.1), "mass": 1.0}
    rest(backend, Box(name="t", position=(1.15, 0.0, 0.2), **box), Stairs(), 0.15)
    rest(backend, Box(name="t", position=(1.45, 0.0, 0.3), **box), Stairs(), 0.25)
    heights = np.full((20, 30), 0.3)
    heights[10:] = -0.2
    field = HeightField(heights, origin=(-1.0, -0.5))
    for x, y, height in ((-0.6, 2.2, 0.3), (0.6, 2.2, -0.2), (0.6, -0.3, -0.2)):
        ball = Sphere(name="t", radius=0.1, mass=1.0, position=(x, y, height + 0.2))
        rest(backend, ball, field, height + 0.1)


@pytest.mark.parametrize("angle", [0.0, 0.7])
@pytest.mark.parametrize(("share", "holds"), [(0.95, True), (1.05, False)])
def test_the_smaller_friction_counts_the_same_in_all_directions(backend, angle, share, holds):
    pull = 0.5 * share * WEIGHT
    gravity = (pull * np.cos(angle), pull * np.sin(angle), -WEIGHT)
    box = Box(name="t", size=(0.2, 0.2, 0.1), mass=1.0, friction=0.5, position=(0, 0, 0.05))
    for friction in (0.9, 3.0):
        world = World(objects=[box], ground=Ground(friction=friction), gravity=gravity)
        with backend.build(world) as simulation:
            simulation.step(1000)
            way = np.hypot(*simulation.positions()[:2])
        if holds:
            assert way < 1e-3
        else:
            assert way == pytest.approx(0.5 * (pull - 0.5 * WEIGHT), rel=0.02)


def test_worlds_say_what_may_touch_what(backend):
    def boxes(**options):
        size = {"size": (0.1, 0.1, 0.1), "mass": 1.0}
        lower = Box(name="lower", position=(0, 0, 0.05), **size)
        upper = Box(name="upper", position=(0, 0, 0.16), **size)
        return World(objects=[lower, upper], ground=Ground(), **options)

    found = {}
    for contacts in ("all", "static", "none"):
        with backend.build(boxes(contacts=contacts)) as simulation:
            simulation.step(500)
            found[contacts] = simulation.positions()[[2, 9]]
    np.testing.assert_allclose(found["all"], [0.05, 0.15], atol=1e-4)
    np.testing.assert_allclose(found["static"], [0.05, 0.05], atol=1e-4)
    assert (found["none"] < -1.0).all()


LEG = """
<joint name="hip{0}" type="revolute"><origin xyz="0 {1} 0"/><parent link="base"/>
<child link="leg{0}"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
<link name="leg{0}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
iyz="0"/></inertial><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
"""


@pytest.mark.parametrize("fixed", [True, False])
def test_links_that_no_joint_connects_touch_each_other_if_asked(backend, tmp_path, fixed):
    """The base lies in both legs, which lie in each other."""
    path = tmp_path / "legs.urdf"
    shape = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    base = f'<link name="base">{shape}</link>'
    text = f"<robot name='legs'>{base}{LEG.format(1, -0.05)}{LEG.format(2, 0.05)}</robot>"
    path.write_text(text, encoding="utf-8")
    for itself in (True, False):
        with backend.build(
            World([Robot(path, fixed_base=fixed, self_collisions=itself)])
        ) as simulation:
            simulation.step()
            pairs = simulation.contacts()[["body_a", "body_b"]].tolist()
            assert pairs == ([(1, 2)] if itself else [])


# Features and failures --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("world", "error", "said"),
    [
        (
            World(
                objects=[Sphere(name="b", radius=0.1, mass=1.0, restitution=0.5)], ground=Ground()
            ),
            FeatureNotSupportedError,
            "mujoco does not have the feature .restitution",
        ),
        (World([Robot("cartpole")], detector="fcl"), FeatureNotSupportedError, "detector fcl"),
        (World([Robot("cartpole")], solver="nsgs"), UnknownOptionError, "newton"),
        (World([Robot("gantry")], integrator="rk4"), FeatureNotSupportedError, "limits in rk4"),
        (
            World(
                [Robot("ant", name=f"r{i}", fixed_base=False) for i in range(30)], ground=Ground()
            ),
            ModelError,
            "room for 29 robots",
        ),
    ],
    ids=["restitution", "detector", "solver", "rk4", "robots"],
)
def test_what_mujoco_does_not_have_is_refused(backend, world, error, said):
    with pytest.raises(error, match=said):
        backend.build(world)


def test_derivatives_are_refused(backend):
    zeros = np.zeros(2)
    with backend.build(World([Robot("cartpole")])) as simulation:
        assert simulation.features.isdisjoint({"derivatives", "restitution"})
        with pytest.raises(FeatureNotSupportedError, match="derivatives"):
            simulation.forward_dynamics_derivatives(zeros, zeros, zeros)
        with pytest.raises(FeatureNotSupportedError, match="derivatives"):
            simulation.forward_dynamics_gradients_batch(*[zeros[None]] * 4)


@pytest.mark.parametrize("solver", ["newton", "cg", "pgs"])
def test_every_solver_carries_a_robot(backend, solver):
    robot = Robot("ant", fixed_base=False, position=(0, 0, 0.5))
    with backend.build(World([robot], ground=Ground(), solver=solver)) as simulation:
        simulation.step(1500)
        weight = 10.6 * WEIGHT
        assert simulation.contacts()["force"][:, 2].sum() == pytest.approx(weight, rel=1e-2)


@pytest.mark.reported("mujoco#1593", about="not-a-number in the state")
def test_a_state_that_is_not_finite_is_an_error_and_leaves_no_log(backend, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with backend.build(World([Robot("double_pendulum")])) as simulation:
        simulation.set_state([0.1, 0.2], [1e9, -1e9])
        with pytest.raises(SimulationError, match="no longer finite, or faster"):
            simulation.step(100)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("memory", "said"), [(16, "cannot simulate"), (18, "too small")])
def test_contacts_that_do_not_fit_into_memory_are_an_error(backend, monkeypatch, memory, said):
    """MuJoCo itself would leave some of them out, and write that into a log."""
    make = mujoco.MjSpec

    def make_small():
        spec = make()
        spec.memory = 1 << memory
        return spec

    monkeypatch.setattr(mujoco, "MjSpec", make_small)
    size = {"size": (1.0, 1.0, 1.0), "mass": 1.0}
    things = [Box(name=f"b{i}", position=(0.1 * i, 0, 0), **size) for i in range(20)]
    simulation = backend.build(World(objects=things, ground=Ground()))
    with simulation, pytest.raises(SimulationError, match=said):
        simulation.step()


def test_a_closed_simulation_says_so(backend):
    simulation = backend.build(World([Robot("cartpole")]))
    simulation.close()
    simulation.close()
    for call in (simulation.step, simulation.positions, simulation.snapshot, simulation.contacts):
        with pytest.raises(SimulationError, match="closed"):
            call()


# Snapshots --------------------------------------------------------------------------------------

numbers = st.floats(-3.0, 3.0)


class Snapshots(RuleBasedStateMachine):
    """What follows a snapshot is, bit for bit, what follows it in another simulation of the world.

    The model is a list of what was done since the snapshot.
    """

    @initialize(mode=st.sampled_from(["force", "servo", "position"]))
    def build(self, mode):
        names = [joint.name for joint in read_robot(Robot("ant")).joints]
        settings = JointSettings(mode, friction=0.1, stiffness=1.0)
        robot = Robot(
            "ant",
            fixed_base=False,
            position=(0, 0, 0.4),
            joints=dict.fromkeys(names[:3], settings),
        )
        ball = Sphere(name="ball", radius=0.1, mass=0.5, position=(0.1, 0, 1.0))
        world = World([robot], objects=[ball], ground=Ground())
        self.one, self.other = (plugins.resolve("backend", "mujoco").build(world) for _ in range(2))
        self.done, self.state = [], None
        self.take()

    def act(self, action):
        action(self.one)
        self.done.append(action)

    @rule(n=st.integers(0, 20))
    def step(self, n):
        self.act(lambda simulation: simulation.step(n))

    @rule(value=numbers)
    def command(self, value):
        self.act(lambda simulation: simulation.set_commands(np.full(8, value)))

    @rule(x=numbers, duration=st.sampled_from([None, 0.01]))
    def push(self, x, duration):
        wrench = Wrench("ball", (x, 0.0, 1.0), point=(0.0, 0.1, 0.0), duration=duration)
        self.act(lambda simulation: simulation.apply_wrench(wrench))

    @rule(speed=numbers)
    def throw(self, speed):
        def action(simulation):
            v = simulation.velocities()
            v[-6:] = speed
            simulation.set_state(simulation.positions(), v)

        self.act(action)

    @rule()
    def take(self):
        self.state = self.one.snapshot()
        self.done.clear()

    @rule()
    def go_back(self):
        self.one.restore(self.state)
        self.done.clear()

    @precondition(lambda self: self.state is not None)
    @invariant()
    def the_other_does_the_same(self):
        self.other.restore(self.state)
        for action in self.done:
            action(self.other)
        calls = ["positions", "velocities", "commands"]
        if self.one.frame > self.state.frame:  # else of the step before, which only one has made
            calls += ["contacts", "accelerations"]
        for call in calls:
            assert np.array_equal(getattr(self.one, call)(), getattr(self.other, call)()), call
        assert self.one.frame == self.other.frame

    def teardown(self):
        if hasattr(self, "one"):
            self.one.close()
            self.other.close()


TestSnapshots = Snapshots.TestCase
TestSnapshots.settings = settings(max_examples=size(10, 4), stateful_step_count=10, deadline=None)


@pytest.mark.parametrize("contacts", ["all", "static"])
def test_things_rest_on_scenery_from_a_file(backend, tmp_path, contacts):
    shape = '<collision><geometry><box size="1 1 0.1"/></geometry></collision>'
    path = tmp_path / "shelf.urdf"
    path.write_text(f'<robot name="shelf"><link name="world">{shape}</link></robot>')
    shelf = Robot(path, "shelf", position=(0.0, 0.0, 0.5))
    box = Box(name="box", size=(0.2, 0.2, 0.2), mass=2.0, position=(0.2, 0.0, 0.66))
    with backend.build(World([shelf], objects=[box], contacts=contacts)) as simulation:
        simulation.step(500)
        assert simulation.body_poses(["box"])[0, 2] == pytest.approx(0.65, abs=1e-3)


def test_servos_of_wheels_on_the_ground_reach_their_velocities(backend):
    wheels = ("left_wheel_joint", "right_wheel_joint")
    joints = {name: JointSettings(mode="servo") for name in wheels}
    robot = Robot("wheeled_base", fixed_base=False, position=(0, 0, 0.15), joints=joints)
    with backend.build(World([robot], ground=Ground())) as simulation:
        at = [simulation.layout.velocity_index[name] for name in wheels]
        commands = [0.01 if name in wheels else 0.0 for name in simulation.layout.joints]
        simulation.set_commands(commands)
        simulation.step(5)
        np.testing.assert_allclose(simulation.velocities()[at], 0.01, rtol=1e-8)
