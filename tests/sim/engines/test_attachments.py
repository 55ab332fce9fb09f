"""Welds and connections of bodies: from the start or while it runs, in snapshots, and errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from sizes import size

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_core.rotations import from_axis_angle, to_matrix
from physx_sim import (
    Attachment,
    BodySettings,
    Box,
    Connect,
    Ground,
    Robot,
    Sphere,
    Weld,
    World,
    Wrench,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

pytestmark = pytest.mark.processes

ROD = (
    '<link name="{0}"><inertial><origin xyz="{1}"/><mass value="1"/>'
    '<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="{0} hinge" type="continuous"><parent link="{2}"/><child link="{0}"/>'
    '<origin xyz="{3}"/><axis xyz="0 1 0"/></joint>'
)
RODS = (
    ("crank", "0 0 0.25", "base", "0 0 0"),
    ("coupler", "0.5 0 0", "crank", "0 0 0.5"),
    ("rocker", "0 0 -0.25", "coupler", "1 0 0"),
)
FOUR_BAR = f'<robot name="bars"><link name="base"/>{"".join(ROD.format(*r) for r in RODS)}</robot>'
TURNED = from_axis_angle((0.0, 0.0, 1.0), 0.7)


def crate(**options):
    return Box(**{"name": "crate", "size": (0.1, 0.1, 0.1), "mass": 2.0, **options})


def hand(**options):
    given = {"name": "hand", "size": (0.05, 0.05, 0.02), "mass": 5.0, "position": (0.02, 0, 0.2)}
    return Box(**{**given, "orientation": TURNED, **options})


def pose(simulation, name):
    found, row = np.eye(4), simulation.body_poses([name])[0]
    found[:3, :3], found[:3, 3] = to_matrix(row[3:]), row[:3]
    return found


def held(simulation):
    """Return the pose of the crate in the frame of the hand."""
    return np.linalg.inv(pose(simulation, "hand")) @ pose(simulation, "crate")


@pytest.fixture
def four_bar(write_urdf):
    robot = Robot(write_urdf(FOUR_BAR))
    return World([robot], attachments=[Connect("rocker", "", (0, 0, -0.5), (1, 0, 0))])


def test_a_four_bar_turns_as_a_single_crank(engine, four_bar):
    with engine.build(four_bar) as simulation:
        simulation.set_state([0, 0, 0], [0.5, -0.5, 0.5])
        simulation.step(1500)
        q = simulation.positions()
        end = (pose(simulation, "rocker") @ [0, 0, -0.5, 1])[:3]
    # Crank and rocker turn about their ends, and the coupler moves without turning.
    angle, speed, inertia = 0.0, 0.5, 2 * (0.02 + 0.25**2) + 0.5**2
    for _ in range(1500):
        speed += 1e-3 * 9.81 * (2 * 0.25 + 0.5) * np.sin(angle) / inertia
        angle += 1e-3 * speed
    np.testing.assert_allclose(end, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(q, [angle, -angle, angle], atol=1e-3)


@pytest.mark.reported(
    "mujoco#229",
    "robosuite#104",
    "Genesis#681",
    "SAPIEN#26",
    about="a gripper or a suction cup holds and releases while the simulation runs",
)
def test_a_weld_lifts_and_releases(engine):
    with engine.build(World(objects=[crate(), hand()], gravity=(0, 0, 0))) as simulation:
        simulation.step(10)
        number, before = simulation.attach(Weld("hand", "crate")), held(simulation)
        simulation.apply_wrench(Wrench("hand", force=(7, 0, 14), point=(0, 0, 0.1), duration=0.2))
        simulation.step(500)
        np.testing.assert_allclose(held(simulation), before, atol=3e-5)
        momentum = 2 * simulation.body_velocities(["crate"]) + 5 * simulation.body_velocities(
            ["hand"]
        )
        assert momentum[0, 2] == pytest.approx(14 * 0.2, rel=0.2)
        simulation.detach(number)
        simulation.apply_wrench(Wrench("hand", force=(0, 0, 5)))
        simulation.step(200)
        assert np.abs(held(simulation) - before).max() > 0.01


def test_a_load_hangs_from_the_world(engine):
    world = World(
        objects=[crate(position=(0, 0, 1))], attachments=[Connect("crate", "", (0, 0, 0.05))]
    )
    with engine.build(world) as simulation:
        simulation.step(1000)
        np.testing.assert_allclose(simulation.positions()[:3], [0, 0, 1], atol=1e-5)


def test_bodies_are_pulled_to_where_a_weld_says(engine):
    objects = [crate(name="hand"), crate(position=(0.5, 0, 0))]
    weld = Weld("hand", "crate", (0.4, 0, 0), TURNED)
    world = World(objects=objects, attachments=[weld], gravity=(0, 0, 0), contacts="none")
    with engine.build(world) as simulation:
        simulation.step(1000)
        np.testing.assert_allclose(held(simulation)[:3, 3], (0.4, 0, 0), atol=1e-5)
        np.testing.assert_allclose(held(simulation)[:3, :3], to_matrix(TURNED), atol=1e-5)


def test_static_bodies_hold_what_is_welded_to_them(engine):
    objects = [crate(position=(0, 0, 1)), hand(static=True, position=(0, 0, 1.2))]
    with engine.build(World(objects=objects, ground=Ground())) as simulation:
        for weld in (Weld("crate", "hand"), Weld("hand", "crate")):
            number = simulation.attach(weld)
            simulation.step(300)
            np.testing.assert_allclose(simulation.positions()[:3], [0, 0, 1], atol=1e-5)
            simulation.detach(number)


@pytest.mark.parametrize(
    "motion",
    [{"velocity": (0.5, 0, 0)}, {"angular_velocity": (0, 0, 1)}, {"position": (1, 0, 1.2)}],
    ids=str,
)
def test_static_bodies_that_hold_something_cannot_move(engine, motion):
    objects = [crate(position=(0, 0, 1)), hand(static=True, position=(0, 0, 1.2))]
    with engine.build(World(objects=objects)) as simulation:
        number = simulation.attach(Weld("crate", "hand"))
        with pytest.raises(SimulationError, match='"hand" is attached; detach it before moving'):
            simulation.set_body("hand", BodySettings(**motion))
        simulation.set_body("hand", BodySettings(friction=0.5, surface_velocity=(1, 0, 0)))
        simulation.detach(number)
        simulation.set_body("hand", BodySettings(**motion))
        if "position" in motion:
            simulation.attach(Weld("hand", "crate"))
        else:
            with pytest.raises(SimulationError, match='"hand" moves; stop it before attaching'):
                simulation.attach(Weld("hand", "crate"))


def test_a_snapshot_holds_bodies_where_its_static_bodies_are(engine):
    """Attachments that say where they hold are alike, wherever the static body is."""
    objects = [crate(position=(0, 0, 1)), hand(static=True, position=(0, 0, 1.2))]
    world, weld = World(objects=objects, gravity=(0, 0, 0)), Weld("hand", "crate", (0, 0, -0.3))
    with engine.build(world) as simulation, engine.build(world) as other:
        other.set_body("hand", BodySettings(position=(1, 0, 1.2)))
        for each in (simulation, other):
            each.attach(weld)
        other.restore(simulation.snapshot())
        for each in (simulation, other):
            each.step(20)
        np.testing.assert_array_equal(simulation.positions(), other.positions())


@pytest.mark.parametrize("change", [{"mass": 2.0}, {"friction": 0.3}, {"hidden": True}], ids=str)
def test_changes_leave_attachments_where_they_are(engine, change):
    objects = [crate(name=n, position=(x, 0, 1)) for x, n in enumerate("abc")]
    world = World(objects=objects, gravity=(0, 0, 0))
    with engine.build(world) as simulation:
        q = simulation.positions()
        q[8] = 0.5
        simulation.set_state(q, np.zeros(18))
        simulation.attach(Connect("a", "b", (0.5, 0, 0)))
        simulation.set_body("c", BodySettings(**change))
        simulation.step(100)
        np.testing.assert_allclose(simulation.positions(), q, atol=1e-9)


def test_attached_bodies_touch_the_ground(engine):
    objects = [crate(position=(0, 0, 0.05)), hand(position=(0, 0, 0.11), orientation=(0, 0, 0, 1))]
    world = World(objects=objects, ground=Ground(), attachments=[Weld("hand", "crate")])
    with engine.build(world) as simulation:
        simulation.step(500)
        ground = simulation.layout.names.index("ground")
        contacts = simulation.contacts()
        mine = contacts[contacts["body_b"] == ground]
        assert mine["force"].sum(axis=0)[2] == pytest.approx(7 * 9.81, rel=1e-3)


@pytest.mark.parametrize("other", ["crate", "", "ground"])
def test_wrong_attachments_are_errors(engine, other):
    world = World(
        objects=[crate(static=True), hand(static=True, name="wall"), hand()], ground=Ground()
    )
    with engine.build(world) as simulation:
        with pytest.raises(SimulationError, match='Neither "wall" nor .* can move'):
            simulation.attach(Weld("wall", other))
        with pytest.raises(SimulationError, match='Did you mean "crate"'):
            simulation.attach(Connect("hand", "crat"))
        with pytest.raises(SimulationError, match="not a Weld or Connect"):
            simulation.attach("hand")
        with pytest.raises(SimulationError, match="active attachments: \\[\\]"):
            simulation.detach(3)
    with pytest.raises(FeatureNotSupportedError, match="attachments in rk4"):
        engine.build(World(objects=[hand()], attachments=[Weld("hand")], integrator="rk4"))


def test_wrong_descriptions_are_errors():
    with pytest.raises(ConfigError, match="use Weld or Connect"):
        Attachment("hand")
    with pytest.raises(ConfigError, match="needs two bodies"):
        Weld("hand", "hand")
    with pytest.raises(ConfigError, match="point_a has 2 numbers"):
        Connect("hand", "", (0, 0))
    with pytest.raises(ConfigError, match="is not a Attachment"):
        World(objects=[hand()], attachments=["hand"])


class Attaching(RuleBasedStateMachine):
    """Whatever is attached and detached, a snapshot brings all of it back, exactly."""

    engine = ""

    @initialize()
    def build(self):
        ball = Sphere(name="ball", radius=0.05, position=(0.3, 0, 0.3))
        self.world = World(objects=[crate(position=(0, 0, 0.06)), hand(), ball], ground=Ground())
        backend = plugins.resolve("backend", self.engine)
        self.simulation, self.other = backend.build(self.world), backend.build(self.world)
        self.numbers = []

    @rule(pair=st.permutations(["crate", "hand", "ball", ""]), weld=st.booleans())
    def attach(self, pair, weld):
        first, second = sorted(pair[:2], reverse=True)
        kind = Weld(first, second) if weld else Connect(first, second, (0.01, 0.02, 0.0))
        if len(self.numbers) < 3:
            self.numbers.append(self.simulation.attach(kind))

    @precondition(lambda self: self.numbers)
    @rule(place=st.integers(0, 2))
    def detach(self, place):
        self.simulation.detach(self.numbers.pop(place % len(self.numbers)))

    @rule(steps=st.integers(1, 20))
    def step(self, steps):
        self.simulation.step(steps)

    @rule()
    def compare(self):
        snapshot = self.simulation.snapshot()
        assert [each.number for each in snapshot.attachments] == self.numbers
        self.other.restore(snapshot)
        for each in (self.simulation, self.other):
            each.step(5)
        np.testing.assert_array_equal(self.simulation.positions(), self.other.positions())

    def teardown(self):
        self.simulation.close()
        self.other.close()


def test_the_history_of_attachments_changes_no_digit(engine):
    objects = [crate(name=f"crate {n}", position=(0.3 * n, 0.05 * n, 1)) for n in range(4)]
    world = World(objects=objects)
    with engine.build(world) as simulation, engine.build(world) as other:
        first = simulation.attach(Weld("crate 0", "crate 1"))
        simulation.attach(Connect("crate 1", "crate 2"))
        simulation.step(20)
        simulation.detach(first)
        simulation.attach(Weld("crate 0", "crate 3"))
        simulation.apply_wrench(Wrench("crate 0", (3, 1, 2), (0.1, 0.2, 0)))
        simulation.step(20)
        other.restore(simulation.snapshot())
        for each in (simulation, other):
            each.step(50)
        np.testing.assert_array_equal(simulation.positions(), other.positions())
        np.testing.assert_array_equal(simulation.velocities(), other.velocities())


@pytest.mark.parametrize("name", ["dart", "pinocchio", "mujoco"])
def test_any_attachments_are_in_snapshots(name):
    machine = type(f"Attaching{name}", (Attaching,), {"engine": name})
    machine.TestCase.settings = settings(
        max_examples=size(6, 60), stateful_step_count=12, deadline=None
    )
    machine.TestCase().runTest()
