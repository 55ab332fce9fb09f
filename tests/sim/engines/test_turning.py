"""Torsional and rolling friction against theory: torque = coefficient x normal force."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import plugins
from physx_sim import (
    BodySettings,
    Box,
    Cylinder,
    Ground,
    HeightField,
    Robot,
    Sphere,
    Stairs,
    World,
)
from physx_sim.errors import FeatureNotSupportedError

pytestmark = pytest.mark.processes  # importing mujoco starts one
GRAVITY, RADIUS, LENGTH = 9.81, 0.1, 0.01
ENGINES = ("pinocchio", "mujoco")
TOLERANCE = {"pinocchio": 2e-3, "mujoco": 0.03}
"""Relative error of speeds: MuJoCo's contacts are soft, and things that slip hop on them."""
PLATE = Box(name="plate", size=(4, 4, 0.1), static=True, position=(0, 0, -0.05))
GROUNDS = {
    "plane": {"ground": Ground()},
    "slippery plane": {"ground": Ground(friction=0.3)},
    "height field": {"ground": HeightField(np.zeros((41, 41)))},
    "stairs": {"ground": Stairs(begin=2.0)},
    "plate": {"objects": [PLATE]},
}


def built(engine, thing, *, objects=(), **options):
    world = World(objects=[thing, *objects], **options)
    return plugins.resolve("backend", engine).build(world)


def ball(**options):
    return Sphere(name="ball", radius=RADIUS, position=(0, 0, RADIUS), **options)


def launch(simulation, *velocities):
    simulation.step(20)
    v = np.zeros(simulation.layout.nv)
    v[: len(velocities)] = velocities
    simulation.set_state(simulation.positions(), v)


@pytest.mark.parametrize("where", GROUNDS)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_spinning_ball_stops_by_torsional_friction(engine, where):
    with built(engine, ball(torsional_friction=LENGTH), **GROUNDS[where]) as simulation:
        slowing = LENGTH * GRAVITY / (0.4 * RADIUS**2)
        launch(simulation, 0, 0, 0, 0, 0, 0.2 * slowing)
        simulation.step(100)
        spin = simulation.velocities()
        np.testing.assert_allclose(spin[5], 0.1 * slowing, rtol=TOLERANCE[engine])
        np.testing.assert_allclose(spin[[0, 1, 3, 4]], 0.0, atol=1e-5)
        contacts = simulation.contacts()
        torque, force = contacts["torque"].sum(axis=0), contacts["force"][:, 2].sum()
        np.testing.assert_allclose(torque, [0, 0, -LENGTH * force], atol=1e-4 * force)
        simulation.step(150)
        assert abs(simulation.velocities()[5]) < 1e-3


@pytest.mark.parametrize("where", GROUNDS)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_rolling_ball_slows_down_and_stops_by_rolling_friction(engine, where):
    with built(engine, ball(rolling_friction=LENGTH), **GROUNDS[where]) as simulation:
        slowing = LENGTH * GRAVITY / (1.4 * RADIUS)
        speed = 0.2 * slowing
        launch(simulation, speed, 0, 0, 0, speed / RADIUS)
        simulation.step(100)
        v = simulation.body_velocities(["ball"])[0]
        np.testing.assert_allclose(v[0], 0.5 * speed, rtol=2 * TOLERANCE[engine])
        np.testing.assert_allclose(v[4], v[0] / RADIUS, rtol=3 * TOLERANCE[engine])
        simulation.step(150)
        assert np.abs(simulation.velocities()).max() < 1e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_a_ball_holds_on_a_slope_that_rolling_friction_holds(engine):
    """It rolls down where the slope is more than the coefficient per radius."""
    for ratio, holds in ((0.9, True), (1.1, False)):
        slope = np.arctan(ratio * LENGTH / RADIUS)
        gravity = GRAVITY * np.array([np.sin(slope), 0.0, -np.cos(slope)])
        thing = ball(rolling_friction=LENGTH)
        with built(engine, thing, ground=Ground(), gravity=tuple(gravity)) as simulation:
            simulation.step(300)
            assert (abs(simulation.positions()[0]) < 1e-4) == holds


def test_four_corners_of_a_box_share_the_torque():
    box = Box(name="box", size=(0.2, 0.2, 0.1), position=(0, 0, 0.05), torsional_friction=LENGTH)
    with built("pinocchio", box, ground=Ground(friction=0.0)) as simulation:
        launch(simulation, 0, 0, 0, 0, 0, 2.0)
        simulation.step(40)
        slowing = LENGTH * GRAVITY / (0.04 / 6)
        np.testing.assert_allclose(simulation.velocities()[5], 2.0 - 0.04 * slowing, rtol=1e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_ball_that_spins_on_a_turntable_is_taken_along(engine):
    table = Cylinder(name="table", radius=0.5, length=0.1, static=True, position=(0, 0, -0.05))
    with built(engine, ball(torsional_friction=LENGTH), objects=[table]) as simulation:
        simulation.set_body("table", BodySettings(angular_velocity=(0, 0, 1.0)))
        simulation.step(300)
        np.testing.assert_allclose(simulation.velocities()[5], 1.0, rtol=2e-2)


@pytest.mark.parametrize("engine", ENGINES)
def test_two_bodies_slow_each_other_down(engine):
    """The torque on one is opposite to that on the other, and total spin is kept."""
    low = Cylinder(name="low", radius=0.1, length=0.1, mass=2, position=(0, 0, 0.05), friction=0.0)
    top = Sphere(name="top", radius=0.1, position=(0, 0, 0.2), torsional_friction=LENGTH)
    with built(engine, low, objects=[top], ground=Ground(friction=0.0)) as simulation:
        simulation.set_body("low", BodySettings(friction=0.0))
        simulation.step(50)
        v = np.zeros(simulation.layout.nv)
        v[11] = 10.0
        simulation.set_state(simulation.positions(), v)
        simulation.step(50)
        spins = simulation.velocities()[[5, 11]]
        assert 0.1 < spins[0] < spins[1] < 9.9
        np.testing.assert_allclose(0.01 * spins[0] + 0.004 * spins[1], 0.04, rtol=1e-2)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_friction_against_turning_changes_while_it_runs(engine):
    with built(engine, ball(), ground=Ground()) as simulation:
        launch(simulation, 0, 0, 0, 0, 0, 5.0)
        simulation.step(50)
        np.testing.assert_allclose(simulation.velocities()[5], 5.0, rtol=1e-6)
        state = simulation.snapshot()
        simulation.set_body("ball", BodySettings(torsional_friction=LENGTH))
        simulation.step(50)
        slowing = LENGTH * GRAVITY / (0.4 * RADIUS**2)
        wanted = 5.0 - 0.05 * slowing
        np.testing.assert_allclose(simulation.velocities()[5], wanted, rtol=TOLERANCE[engine])
        simulation.restore(state)
        simulation.step(50)
        np.testing.assert_allclose(simulation.velocities()[5], 5.0, rtol=1e-6)


def test_dart_names_what_it_lacks_and_how_to_do_without():
    with pytest.raises(FeatureNotSupportedError, match=r"torsional_friction=0.0, rolling"):
        built("dart", ball(rolling_friction=LENGTH), ground=Ground())
    with built("dart", ball(), ground=Ground()) as simulation:
        assert "torsional_friction" not in simulation.features
        with pytest.raises(FeatureNotSupportedError, match="torsional_friction"):
            simulation.set_body("ball", BodySettings(torsional_friction=LENGTH))


MJCF = """
<mujoco><worldbody>
  <body name="ball" pos="0 0 0.1"><freejoint/>
    <geom name="skin" type="sphere" size="0.1" mass="1" {}/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(
    ("given", "options", "wanted"),
    [
        ('friction="0.7 0.02 0.03"', {}, (0.7, 0.0, 0.0)),
        ('friction="0.7 0.02 0.03" condim="4"', {}, (0.7, 0.02, 0.0)),
        ('friction="0.7 0.02 0.03" condim="6"', {}, (0.7, 0.02, 0.03)),
        ('friction="0.7 0.02 0.03" condim="6"', {"friction": 0.5}, (0.5, 0.02, 0.03)),
        ('condim="6"', {"torsional_friction": 0.0, "rolling_friction": 0.0}, (1.0, 0.0, 0.0)),
    ],
)
def test_friction_is_read_from_mjcf(tmp_path, given, options, wanted):
    path = tmp_path / "ball.xml"
    path.write_text(MJCF.format(given))
    robot = Robot(path, fixed_base=False, position=(0, 0, 0.1), **options)
    world = World([robot], ground=Ground(friction=2.0))
    with plugins.resolve("backend", "pinocchio").build(world) as simulation:
        [shape] = simulation.parts.movables[0].model.shapes
        assert (shape.friction, shape.torsional_friction, shape.rolling_friction) == wanted
