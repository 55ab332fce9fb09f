"""Contacts against known physics: rest, friction, restitution, on every detector and solver."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import plugins
from physx_core.rotations import from_axis_angle
from physx_sim import Box, Cylinder, Ground, HeightField, Robot, Sphere, Stairs, World, Wrench

DETECTORS = [("dart", name, None) for name in ("dart", "fcl", "bullet", "ode")]
ENGINES = [*DETECTORS, ("pinocchio", None, "pgs"), ("pinocchio", None, "admm")]
ISOTROPIC = [("dart", None, None), ("dart", None, "fbf"), *ENGINES[-2:]]
BOTH = [("dart", None, None), ("pinocchio", None, None)]


def build(engine, *objects, **options):
    name, detector, solver = engine
    options = {"ground": Ground(), "contacts": "static", **options}
    world = World(objects=objects, detector=detector, solver=solver, **options)
    return plugins.resolve("backend", name).build(world)


def cube(**options):
    return Box(name="cube", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1), **options)


def tilted(ratio, friction, direction=(1.0, 0.0)):
    """Return gravity for which gravity along the ground is `ratio` of the largest friction."""
    angle = np.arctan(ratio * friction)
    along = np.array(direction) / np.hypot(*direction) * 9.81 * np.sin(angle)
    return (*along, -9.81 * np.cos(angle)), angle


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES, ids=str)
def test_a_box_on_an_incline_holds_below_the_friction_angle_and_slides_above(engine):
    gravity, _ = tilted(0.98, 0.5)
    with build(engine, cube(friction=0.5), gravity=gravity) as simulation:
        simulation.step(1000)
        assert np.abs(simulation.positions()[:2]).max() < 1e-5
    gravity, angle = tilted(1.02, 0.5)
    with build(engine, cube(friction=0.5), gravity=gravity) as simulation:
        simulation.step(1000)
        expected = 0.5 * 9.81 * (np.sin(angle) - 0.5 * np.cos(angle))
        np.testing.assert_allclose(simulation.positions()[0], expected, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ISOTROPIC, ids=str)
def test_friction_is_isotropic_with_the_feature(engine):
    gravity, angle = tilted(1.2, 0.5, (1.0, 1.0))
    with build(engine, cube(friction=0.5), gravity=gravity) as simulation:
        assert "isotropic_friction" in simulation.features
        simulation.step(1000)
        expected = 0.5 * 9.81 * (np.sin(angle) - 0.5 * np.cos(angle))
        slid = np.linalg.norm(simulation.positions()[:2])
        np.testing.assert_allclose(slid, expected, rtol=0.005)


def test_the_friction_pyramid_is_stronger_along_its_diagonals():
    gravity, _ = tilted(1.2, 0.5, (1.0, 1.0))
    with build(("dart", None, "dantzig"), cube(friction=0.5), gravity=gravity) as simulation:
        assert "isotropic_friction" not in simulation.features
        simulation.step(1000)
        assert np.abs(simulation.positions()[:2]).max() < 1e-3


@pytest.mark.parametrize("engine", BOTH, ids=str)
@pytest.mark.parametrize(("of_cube", "of_ground"), [(0.3, 0.8), (0.8, 0.3)])
def test_of_two_coefficients_of_friction_the_smaller_counts(engine, of_cube, of_ground):
    with build(engine, cube(friction=of_cube), ground=Ground(friction=of_ground)) as simulation:
        q, v = simulation.positions(), simulation.velocities()
        v[0] = 2.0
        simulation.step(5)
        simulation.set_state(q, v)
        simulation.step(400)
        slowed = (2.0 - simulation.velocities()[0]) / 0.4 / 9.81
        np.testing.assert_allclose(slowed, 0.3, rtol=2e-3)


@pytest.mark.parametrize("engine", ENGINES, ids=str)
@pytest.mark.parametrize("restitution", [0.5, 0.8, 1.0])
def test_things_bounce_by_the_product_of_their_restitutions(engine, restitution):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 1.0), restitution=restitution)
    with build(engine, ball, ground=Ground(restitution=1.0)) as simulation:
        speeds = []
        for _ in range(700):
            simulation.step()
            speeds.append(simulation.velocities()[2])
        np.testing.assert_allclose(max(speeds) / -min(speeds), restitution, rtol=0.005)


@pytest.mark.parametrize("engine", ENGINES, ids=str)
def test_the_contact_force_of_a_resting_box_is_its_weight_and_it_does_not_sink(engine):
    with build(engine, cube(mass=3.0)) as simulation:
        simulation.step(500)
        contacts = simulation.contacts()
        np.testing.assert_allclose(
            contacts["force"].sum(axis=0), [0, 0, 3 * 9.81], rtol=1e-4, atol=1e-3
        )
        np.testing.assert_allclose(contacts["normal"], [[0, 0, 1]] * len(contacts), atol=1e-6)
        assert contacts["depth"].max() < 2e-5
        assert abs(simulation.positions()[2] - 0.1) < 2e-5
        assert np.abs(simulation.velocities()).max() < 1e-6
        names = simulation.layout.names
        assert {names[i] for i in contacts["body_a"]} == {"cube"}
        assert {names[i] for i in contacts["body_b"]} == {"ground"}


@pytest.mark.parametrize("engine", ENGINES, ids=str)
def test_a_dropped_box_sinks_little_and_its_energy_never_rises(engine):
    box = Box(name="cube", size=(0.2, 0.2, 0.2), position=(0, 0, 0.3))
    with build(engine, box) as simulation:
        last = np.inf
        for _ in range(400):
            simulation.step()
            height, speed = simulation.positions()[2], simulation.velocities()[2]
            # Semi-implicit Euler keeps this energy in free fall, not that at one instant.
            energy = 9.81 * (height - 0.5e-3 * speed) + 0.5 * speed**2
            assert energy < last + 1e-3
            assert height > 0.1 - 2.5e-3
            last = energy


@pytest.mark.parametrize("engine", BOTH, ids=str)
def test_the_ground_bears_weight_and_external_forces(engine):
    with build(engine, cube(mass=2.0)) as simulation:
        simulation.step(200)
        simulation.apply_wrench(Wrench("cube", force=(0, 0, -30)))
        simulation.step(300)
        force = simulation.contacts()["force"].sum(axis=0)
        np.testing.assert_allclose(force, [0, 0, 2 * 9.81 + 30], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("engine", BOTH, ids=str)
def test_a_pushed_box_accelerates_by_force_minus_friction(engine):
    with build(engine, cube(mass=2.0, friction=0.4)) as simulation:
        simulation.step(200)
        # At the height of the ground, so that the box does not tip.
        simulation.apply_wrench(Wrench("cube", force=(20, 0, 0), point=(0, 0, -0.1)))
        simulation.step(20)
        before = simulation.velocities()[0]
        simulation.step(200)
        gained = (simulation.velocities()[0] - before) / 0.2
        np.testing.assert_allclose(gained, 20 / 2 - 0.4 * 9.81, rtol=1e-5)
        assert abs(simulation.accelerations()[0] - gained) < 0.02


@pytest.mark.parametrize("engine", BOTH, ids=str)
def test_a_tall_box_stays_upright(engine):
    pole = Box(name="pole", size=(0.1, 0.1, 1.0), position=(0, 0, 0.5))
    with build(engine, pole) as simulation:
        simulation.step(500)
        np.testing.assert_allclose(simulation.positions(), [0, 0, 0.5, 0, 0, 0, 1], atol=2e-5)
        assert np.abs(simulation.velocities()).max() < 3e-3


@pytest.mark.parametrize("engine", BOTH, ids=str)
def test_stairs_carry_at_their_height(engine):
    ground = Stairs(steps=3, rise=0.2, run=0.5, begin=0.0)
    boxes = [
        Box(name=f"box{i}", size=(0.2, 0.2, 0.2), position=(x, 0.1, 0.12 + 0.2 * i))
        for i, x in enumerate((-1.0, 0.25, 0.75, 1.25))
    ]
    with build(engine, *boxes, ground=ground) as simulation:
        simulation.step(250)
        heights = simulation.positions()[2::7]
        np.testing.assert_allclose(heights, [0.1, 0.3, 0.5, 0.7], atol=1e-3)


@pytest.mark.parametrize("engine", BOTH, ids=str)
def test_a_ball_rolls_down_a_height_field(engine):
    heights = 0.3 * np.add.outer(-np.linspace(-2, 2, 21), np.zeros(21))
    field = HeightField(heights, (0.2, 0.2), friction=0.0)
    ball = Sphere(name="ball", radius=0.1, position=(-1, 0.03, 0.3 + 0.1 * np.sqrt(1.09)))
    with build(engine, ball, ground=field) as simulation:
        simulation.step(500)
        x, _, z = simulation.positions()[:3]
        angle = np.arctan(0.3)
        slid = 0.5 * 9.81 * np.sin(angle) * 0.25 * np.cos(angle)
        np.testing.assert_allclose(x + 1, slid, rtol=0.02)
        np.testing.assert_allclose(z, -0.3 * x + 0.1 * np.sqrt(1.09), atol=2e-3)


@pytest.mark.parametrize("engine", [*BOTH, ("pinocchio", None, "admm")], ids=str)
def test_light_wheels_under_a_heavy_base_do_not_bounce(engine):
    """Gauss-Seidel alone does not come to an end at this impact, and drives the wheels."""
    name, _, solver = engine
    base = Robot("wheeled_base", fixed_base=False, position=(0, 0, 0.6))
    world = World([base], ground=Ground(), solver=solver)
    with plugins.resolve("backend", name).build(world) as simulation:
        fastest = 0.0
        for _ in range(45):
            simulation.step(10)
            fastest = max(fastest, np.abs(simulation.velocities()).max())
        assert fastest < np.sqrt(2 * 9.81 * 0.6)
        assert np.abs(simulation.velocities()).max() < 1e-2
        assert np.abs(simulation.positions()[:2]).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("engine", BOTH, ids=str)
def test_a_quadruped_stands(engine, example):
    robot = Robot(
        example("a1_description/urdf/a1.urdf"), "a1", fixed_base=False, position=(0, 0, 0.29)
    )
    name, *_ = engine
    world = World([robot], ground=Ground())
    with plugins.resolve("backend", name).build(world) as simulation:
        q, stand = simulation.positions(), np.tile([0.0, 0.8, -1.6], 4)
        q[7:] = stand
        simulation.set_state(q, np.zeros(18))

        def control(one):
            q, v = one.positions(), one.velocities()
            one.set_torques(100 * (stand - q[7:]) - 5 * v[6:])

        simulation.add_hook(control)
        simulation.step(600)
        weight = simulation.mass_matrix(q)[0, 0] * 9.81
        force = simulation.contacts()["force"].sum(axis=0)
        np.testing.assert_allclose(force[2], weight, rtol=0.01)
        begin = simulation.body_poses(["FL_foot", "RR_foot"])
        simulation.step(200)
        slip = simulation.body_poses(["FL_foot", "RR_foot"]) - begin
        assert np.abs(slip[:, :3]).max() < 1e-3
        touched = {simulation.layout.names[i] for i in simulation.contacts()["body_a"]}
        assert touched == {f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")}


@pytest.mark.slow
def test_legs_at_their_limits_carry_without_chatter(pinocchio):
    """What pushes joints over their limits are contacts: the free motion alone does not."""
    world = World([Robot("ant", fixed_base=False)], ground=Ground(), period=2e-3)
    with pinocchio.build(world) as simulation:
        q = simulation.positions()
        q[2], q[8::2] = 0.377, 1.0
        velocities = np.zeros(14)
        velocities[5] = 1.0  # turns on its feet until the hips are at their limits
        simulation.set_state(q, velocities)
        simulation.step(2000)
        begin = simulation.positions()
        hips = begin[7::2]
        assert np.isclose(np.abs(hips), 0.6, atol=1e-6).any()
        weight = 9.81 * simulation.mass_matrix(begin)[0, 0]
        simulation.step(400)
        for _ in range(100):
            simulation.step()
            force = simulation.contacts()["force"].sum(axis=0)
            np.testing.assert_allclose(force, [0, 0, weight], atol=1e-3 * weight)
            assert np.abs(simulation.velocities()).max() < 1e-3
        assert np.abs(simulation.positions() - begin).max() < 1e-3


def test_a_tilted_cylinder_lands_on_the_deepest_point_of_its_rim():
    turn = np.array([0.5, -0.2, 0.7, 0.9])
    radius, length = 0.2, 0.3
    turn /= np.linalg.norm(turn)
    x, y, z, w = turn
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    low = 0.5 * length * abs(axis[2]) + radius * np.hypot(axis[0], axis[1])
    can = Cylinder(
        name="can", radius=radius, length=length, position=(0, 0, low + 0.02), orientation=turn
    )
    with build(BOTH[1], can) as simulation:
        while not len(simulation.contacts()):
            simulation.step()
        assert abs(simulation.positions()[2] - low) < 2e-3


@pytest.mark.slow
def test_friction_does_no_work_on_a_disk_that_rolls_along_its_rim():
    radius, tilt = 0.1, 0.3
    height = radius * np.sin(tilt) + 0.005 * np.cos(tilt)
    disk = Cylinder(
        name="disk",
        radius=radius,
        length=0.01,
        position=(0, 0, height),
        orientation=from_axis_angle((1, 0, 0), tilt),
    )
    with build(BOTH[1], disk) as simulation:
        v = np.zeros(6)
        v[4] = np.sqrt(4 * 9.81 / (radius * np.sin(tilt))) * np.sin(tilt)  # Euler's disk
        simulation.set_state(simulation.positions(), v)
        energies = []
        for _ in range(20):
            q, v = simulation.positions(), simulation.velocities()
            energies.append(0.5 * v @ simulation.mass_matrix(q) @ v + 9.81 * q[2])
            simulation.step(25)
    assert np.ptp(energies) < 5e-3 * energies[0]
    assert max(energies[1:]) < (1 + 2e-4) * energies[1]  # nor do gyroscopic forces
