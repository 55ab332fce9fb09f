"""Worlds that change while they run: masses, friction, terrain, hidden and moving bodies."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from sizes import size

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_core.rotations import from_axis_angle
from physx_sim import (
    BodySettings,
    Box,
    Cylinder,
    Ground,
    HeightField,
    Robot,
    Sphere,
    Weld,
    World,
    Wrench,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

pytestmark = pytest.mark.processes

G = 9.81


def crate(**options):
    given = {"name": "crate", "size": (0.2, 0.2, 0.2), "position": (0, 0, 0.1), "friction": 0.5}
    return Box(**{**given, **options})


def belt(**options):
    given = {"name": "belt", "size": (6, 1, 0.1), "static": True, "position": (0, 0, -0.05)}
    return Box(**{**given, **options})


def slope(degrees, **options):
    x = np.linspace(-2, 2, 9)
    heights = np.tan(np.radians(degrees)) * x[:, None] * np.ones(9)
    return HeightField(heights, spacing=(0.5, 0.5), **options)


# Surfaces and static bodies that move -------------------------------------------------------------


def test_a_belt_accelerates_what_lies_on_it_with_friction(engine):
    with engine.build(World(objects=[crate(), belt()])) as simulation:
        simulation.step(20)
        simulation.set_body("belt", BodySettings(surface_velocity=(1.5, 0, 0)))
        simulation.step(200)
        assert simulation.body_velocities(["crate"])[0, 0] == pytest.approx(0.5 * G * 0.2, rel=0.05)
        simulation.step(300)
        np.testing.assert_allclose(
            simulation.body_velocities(["crate"])[0], [1.5, 0, 0, 0, 0, 0], atol=2e-3
        )
        np.testing.assert_array_equal(simulation.body_velocities(["belt"]), np.zeros((1, 6)))
        simulation.set_body("belt", BodySettings(surface_velocity=(0, 0, 0)))
        simulation.step(500)
        np.testing.assert_allclose(simulation.velocities(), np.zeros(6), atol=1e-5)


@pytest.mark.parametrize("ground", [Ground(), slope(0)], ids=["plane", "heights"])
def test_the_ground_is_a_treadmill(engine, ground):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 0.1))
    with engine.build(World(objects=[ball], ground=ground)) as simulation:
        simulation.set_body("ground", BodySettings(surface_velocity=(0, 0.7, 0)))
        simulation.step(600)
        v = simulation.body_velocities(["ball"])[0]
    # A ball at rest that starts to roll on a moving surface gets 2/7 of its speed.
    assert v[1] == pytest.approx(0.2, rel=0.02)
    assert v[3] == pytest.approx((0.7 - 0.2) / 0.1, rel=0.02)


def test_a_lift_carries_its_load(engine):
    with engine.build(World(objects=[crate(), belt()], ground=None)) as simulation:
        simulation.step(20)
        simulation.set_body("belt", BodySettings(velocity=(0.2, 0, 0.4)))
        simulation.step(1000)
        np.testing.assert_allclose(simulation.body_poses(["belt"])[0, :3], [0.2, 0, 0.35])
        np.testing.assert_allclose(simulation.body_velocities(["belt"])[0, :3], [0.2, 0, 0.4])
        assert simulation.positions()[2] == pytest.approx(0.5, abs=1e-3)
        np.testing.assert_allclose(simulation.velocities(), [0.2, 0, 0.4, 0, 0, 0], atol=3e-3)


def test_a_door_opens_and_pushes(engine):
    """A plate that turns about its center hits a ball with the speed of the point of contact."""
    ball = Sphere(name="ball", radius=0.05, position=(0.4, 0.1, 0.05), friction=0.0)
    door = Box(name="door", size=(1.0, 0.02, 0.1), static=True, position=(0, 0, 0.05), friction=0)
    with engine.build(World(objects=[ball, door], ground=Ground())) as simulation:
        simulation.set_body("door", BodySettings(angular_velocity=(0, 0, 1.0)))
        simulation.step(200)
        turned = from_axis_angle((0, 0, 1), 0.2)
        np.testing.assert_allclose(simulation.body_poses(["door"])[0, 3:], turned, atol=1e-12)
        assert simulation.body_velocities(["ball"])[0, 1] == pytest.approx(0.4, rel=0.1)
        assert simulation.positions()[1] > 0.1


@pytest.mark.slow
def test_a_table_turns_what_stands_on_it(engine):
    table = Cylinder(name="table", radius=0.5, length=0.1, static=True, position=(0, 0, -0.05))
    with engine.build(World(objects=[crate(position=(0.2, 0, 0.1)), table])) as simulation:
        simulation.set_body("table", BodySettings(angular_velocity=(0, 0, 0.5)))
        simulation.step(2000)
        x, y = simulation.positions()[:2]
        assert np.hypot(x, y) == pytest.approx(0.2, abs=3e-3)
        assert np.arctan2(y, x) == pytest.approx(1.0, abs=0.06)


def test_static_objects_jump_to_another_place_and_rays_see_them_there(engine):
    with engine.build(World(objects=[crate(position=(0, 0, 2)), belt()])) as simulation:
        turned = from_axis_angle((0, 1, 0), np.pi / 2)
        simulation.set_body("belt", BodySettings(position=(1, 0, 0), orientation=turned))
        hit = simulation.raycast([[0, 0, 0]], [[2, 0, 0]])
        np.testing.assert_allclose(hit["point"], [[0.95, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(simulation.body_poses(["belt"])[0], [1, 0, 0, *turned])
        simulation.step(800)
        assert simulation.positions()[2] < 0


# Masses, friction, terrain ------------------------------------------------------------------------


@pytest.mark.reported("mjlab#38", about="masses that change have no effect, or a wrong one")
def test_masses_are_as_if_built_with_them(engine, example):
    path = example("panda_description/urdf/panda.urdf")
    q = np.array([0.1, 0.2, 0.3, -1.5, 0.4, 1.5, 0.5, 0.01, 0.01])
    with engine.build(World([Robot(path, mass_factors={"panda_link5": 1.7})])) as other:
        wanted = other.mass_matrix(q), other.forward_dynamics(q, q, q)
        other.set_state(q, 0 * q)
        other.step(100)
        moved = other.positions()
    with engine.build(World([Robot(path)])) as simulation:
        simulation.step(5)
        plain = simulation.mass_matrix(q)
        before = next(
            body.mass
            for body in simulation.parts.movables[0].model.bodies
            if body.name == "panda_link5"
        )
        simulation.set_body("panda_link5", BodySettings(mass=1.7 * before))
        found = simulation.mass_matrix(q), simulation.forward_dynamics(q, q, q)
        for one, two in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9)
        simulation.set_state(q, 0 * q)
        simulation.step(100)
        np.testing.assert_allclose(simulation.positions(), moved, rtol=1e-9)
        simulation.set_body("panda_link5", BodySettings(mass=before))
        np.testing.assert_allclose(simulation.mass_matrix(q), plain, rtol=1e-12)


def test_a_heavier_object_presses_more(engine):
    with engine.build(World(objects=[crate()], ground=Ground())) as simulation:
        simulation.step(50)
        simulation.set_body("crate", BodySettings(mass=3.0))
        simulation.step(100)
        assert simulation.contacts()["force"][:, 2].sum() == pytest.approx(3 * G, rel=1e-3)
        assert simulation.body_settings("crate") == BodySettings(mass=3.0)


@pytest.mark.parametrize("changed", ["crate", "ground"])
def test_friction_changes(engine, changed):
    with engine.build(World(objects=[crate()], ground=Ground())) as simulation:
        simulation.apply_wrench(Wrench("crate", force=(0.4 * G, 0, 0), point=(0, 0, -0.1)))
        simulation.step(200)
        assert abs(simulation.velocities()[0]) < 1e-3
        simulation.set_body(changed, BodySettings(friction=0.2))
        simulation.step(200)
        assert simulation.velocities()[0] == pytest.approx(0.2 * G * 0.2, rel=0.05)


@pytest.mark.parametrize("heights", [False, True], ids=["friction", "heights"])
def test_contacts_stay_until_the_next_step(engine, heights):
    """Whatever replaces the shapes that touched: DART keeps no contacts of those."""
    objects = [crate(name=f"crate {n}", position=(0.4 * n, 0, 0.1)) for n in range(4)]
    with engine.build(World(objects=objects, ground=slope(0))) as simulation:
        simulation.step(5)
        for number in range(5):
            before = simulation.contacts()
            assert len(before) >= 12
            if heights:
                simulation.set_ground(slope(0.001 * number))
            else:
                simulation.set_body("ground", BodySettings(friction=0.1 * number))
            np.testing.assert_array_equal(simulation.contacts(), before)
            np.testing.assert_array_equal(simulation.snapshot().contacts, before)
            simulation.step(2)


def test_a_link_without_mass_is_no_news(engine, tmp_path, capfd):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="arm"><joint axis="0 1 0"/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    with engine.build(World([Robot(path)], contacts="none")) as simulation:
        simulation.set_body("arm", BodySettings(mass=2.0))
    assert capfd.readouterr() == ("", "")


def test_friction_of_static_objects_and_links_changes(engine, write_urdf):
    puck = (
        '<robot name="puck"><link name="puck"><inertial><mass value="1"/><inertia ixx="0.01" '
        'iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>'
        '<box size="0.2 0.2 0.1"/></geometry></collision></link></robot>'
    )
    robot = Robot(write_urdf(puck), fixed_base=False, position=(0, 0, 0.05))
    for changed in ("puck", "belt"):
        with engine.build(World([robot], objects=[belt()])) as simulation:
            simulation.set_body(changed, BodySettings(friction=0.0))
            simulation.step(20)
            simulation.set_state(simulation.positions(), [1.0, 0, 0, 0, 0, 0])
            simulation.step(300)
            assert simulation.velocities()[0] == pytest.approx(1.0, abs=1e-3)


def test_every_episode_has_its_terrain(engine):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 0.4), friction=0.0)
    with engine.build(World(objects=[ball], ground=slope(0))) as simulation:
        start = simulation.snapshot()
        for degrees in (10, -20, 15):
            simulation.restore(start)
            simulation.set_ground(slope(degrees))
            simulation.set_state([0, 0, 0.1 / np.cos(np.radians(degrees)), 0, 0, 0, 1], [0] * 6)
            simulation.step(400)
            slid = -0.5 * G * np.sin(np.radians(degrees)) * 0.4**2
            along = simulation.positions()[0] / np.cos(np.radians(degrees))
            assert along == pytest.approx(slid, rel=0.03)
            (hit,) = simulation.raycast([[1, 0, 2]], [[1, 0, -2]])
            assert hit["point"][2] == pytest.approx(np.tan(np.radians(degrees)))
        with engine.build(World(objects=[ball], ground=slope(15))) as other:
            other.restore(replace(simulation.snapshot(), native=(), engine=""))
            for each in (simulation, other):
                each.step(200)
            np.testing.assert_allclose(
                simulation.positions(), other.positions(), rtol=1e-6, atol=1e-6
            )


# Hidden objects -----------------------------------------------------------------------------------


def test_hidden_objects_wait_and_return(engine):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 0.35))
    with engine.build(World(objects=[crate(), ball], ground=Ground())) as simulation:
        simulation.step(5)
        simulation.set_body("crate", BodySettings(hidden=True))
        where = simulation.positions()[:7].copy()
        simulation.step(400)
        np.testing.assert_array_equal(simulation.positions()[:7], where)
        np.testing.assert_array_equal(simulation.velocities()[:6], np.zeros(6))
        np.testing.assert_array_equal(simulation.accelerations()[:6], np.zeros(6))
        assert simulation.positions()[9] == pytest.approx(0.1, abs=5e-3)  # fell through it
        assert not simulation.raycast([[1, 0, 0.15]], [[0.05, 0, 0.15]], ["ball"])["hit"]
        q = simulation.positions()
        q[:3] = 0, 0, 0.5
        simulation.set_state(q, np.zeros(12))
        simulation.step(100)
        assert simulation.positions()[2] == 0.5
        simulation.set_body("crate", BodySettings(hidden=False))
        simulation.step(600)
        assert simulation.positions()[2] > 0.095  # on the ball, or beside it


def test_static_objects_are_hidden_too(engine):
    with engine.build(World(objects=[crate(), belt()], ground=Ground(height=-1))) as simulation:
        simulation.step(50)
        simulation.set_body("belt", BodySettings(hidden=True))
        simulation.step(1000)
        assert simulation.positions()[2] == pytest.approx(-0.9, abs=5e-3)


# Snapshots ----------------------------------------------------------------------------------------


class Changing(RuleBasedStateMachine):
    """Whatever changes, a snapshot brings all of it back, exactly, here and elsewhere."""

    engine = ""

    @initialize()
    def build(self):
        ball = Sphere(name="ball", radius=0.05, position=(0.3, 0, 0.3))
        table = belt(position=(0, 0, 0.15), size=(0.5, 0.5, 0.1))
        objects = [crate(position=(0, 0, 0.31)), ball, table]
        self.world = World(objects=objects, ground=slope(5))
        backend = plugins.resolve("backend", self.engine)
        self.simulation, self.other = backend.build(self.world), backend.build(self.world)
        self.kept = []

    @rule(name=st.sampled_from(["crate", "ball"]), value=st.sampled_from([0.2, 1.0, 3.0]))
    def weigh(self, name, value):
        self.simulation.set_body(name, BodySettings(mass=value))

    @rule(name=st.sampled_from(["crate", "belt", "ground"]), value=st.sampled_from([0.0, 0.8]))
    def rub(self, name, value):
        self.simulation.set_body(name, BodySettings(friction=value))

    @rule(name=st.sampled_from(["crate", "ball", "belt"]), hidden=st.booleans())
    def hide(self, name, hidden):
        self.simulation.set_body(name, BodySettings(hidden=hidden))

    @rule(x=st.sampled_from([-0.3, 0.0, 0.3]), turn=st.booleans())
    def move(self, x, turn):
        turns = (0.1, 0.2, 0.5) if turn else (0, 0, 0)
        self.simulation.set_body("belt", BodySettings(velocity=(x, 0, 0.1), angular_velocity=turns))

    @rule(name=st.sampled_from(["belt", "ground"]), x=st.sampled_from([0.0, 0.4]))
    def drive(self, name, x):
        self.simulation.set_body(name, BodySettings(surface_velocity=(x, 0, 0)))

    @rule(degrees=st.sampled_from([-5, 5, 10]))
    def reshape(self, degrees):
        self.simulation.set_ground(slope(degrees))

    @rule(steps=st.integers(1, 30))
    def step(self, steps):
        self.simulation.step(steps)

    @rule()
    def keep(self):
        self.kept.append((self.simulation.snapshot(), None))
        self.simulation.step(10)
        self.kept[-1] = self.kept[-1][0], self.simulation.positions()

    @rule(place=st.integers(0, 5), copied=st.booleans())
    def compare(self, place, copied):
        if not self.kept:
            return
        snapshot, future = self.kept[place % len(self.kept)]
        snapshot = copy.deepcopy(snapshot) if copied else snapshot
        for each in (self.simulation, self.other):
            each.restore(snapshot)
            for name in ("crate", "belt", "ground"):
                assert each.body_settings(name) == snapshot.bodies.get(name, BodySettings())
            each.step(10)
            np.testing.assert_array_equal(each.positions(), future)
        np.testing.assert_array_equal(
            self.simulation.body_poses(["belt"]), self.other.body_poses(["belt"])
        )

    def teardown(self):
        self.simulation.close()
        self.other.close()


@pytest.mark.parametrize("name", ["dart", "pinocchio", "mujoco"])
def test_any_changes_are_in_snapshots(name):
    machine = type(f"Changing{name}", (Changing,), {"engine": name})
    machine.TestCase.settings = settings(
        max_examples=size(6, 60), stateful_step_count=16, deadline=None
    )
    machine.TestCase().runTest()


def test_nothing_changes_in_a_world_whose_changes_are_undone(engine):
    world = World(objects=[crate(position=(0, 0, 0.3)), belt()], ground=Ground(height=-1))
    with engine.build(world) as simulation, engine.build(world) as untouched:
        start = simulation.snapshot()
        simulation.set_body("belt", BodySettings(friction=0.1, velocity=(0, 0, 1)))
        simulation.set_body("crate", BodySettings(mass=9.0))
        simulation.step(100)
        for each in (simulation, untouched):
            each.restore(start)
            each.step(300)
        np.testing.assert_array_equal(simulation.positions(), untouched.positions())


# Errors -------------------------------------------------------------------------------------------


def test_wrong_changes_are_errors(engine):
    world = World(objects=[crate(), belt()], ground=Ground())
    with engine.build(world) as simulation:
        for name, change, message in (
            ("belt", {"mass": 1.0}, "is static, so its mass has no effect"),
            ("ground", {"hidden": True}, "is not an object, so it cannot be hidden"),
            ("ground", {"velocity": (0, 0, 1)}, "to move it, add a static object"),
            ("crate", {"position": (0, 0, 1)}, "to move it, use set_state"),
            ("crate", {"surface_velocity": (0, 0, 1)}, "is not static"),
            ("crat", {"mass": 1.0}, 'Did you mean "crate"'),
        ):
            with pytest.raises(SimulationError, match=message):
                simulation.set_body(name, BodySettings(**change))
        with pytest.raises(SimulationError, match="is not a BodySettings"):
            simulation.set_body("crate", {"mass": 1.0})
        with pytest.raises(SimulationError, match="only if the ground was one"):
            simulation.set_ground(slope(3))
        with pytest.raises(SimulationError, match="is not a HeightField"):
            simulation.set_ground(Ground())
        number = simulation.attach(Weld("crate"))
        with pytest.raises(SimulationError, match="is attached; detach it"):
            simulation.set_body("crate", BodySettings(hidden=True))
        simulation.detach(number)
        simulation.set_body("crate", BodySettings(hidden=True))
        with pytest.raises(SimulationError, match="is hidden, so nothing"):
            simulation.attach(Weld("crate"))
    with engine.build(World(objects=[crate()], ground=slope(3))) as simulation:
        with pytest.raises(SimulationError, match="with \\(9, 9\\) heights"):
            simulation.set_ground(HeightField(np.zeros((3, 3))))
        simulation.close()
        with pytest.raises(SimulationError, match="is closed"):
            simulation.set_body("crate", BodySettings(mass=1.0))
    with (
        engine.build(World(objects=[crate(), belt()], contacts="none", integrator="rk4")) as free,
        pytest.raises(FeatureNotSupportedError, match="moving_statics"),
    ):
        free.set_body("belt", BodySettings(velocity=(0, 0, 1)))


def test_wrong_settings_are_errors():
    for change in ({"mass": 0.0}, {"friction": -1.0}, {"velocity": (1, 2)}, {"hidden": 1}):
        with pytest.raises(ConfigError, match="BodySettings"):
            BodySettings(**change)
