"""Friction against Coulomb's law with the true normal force, on both engines' default solvers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physx_sim import Box, Ground, Robot, Sphere, World, Wrench

GRAVITY = 9.81
FOOT = 0.02
"""Radius of the A-frame's feet, in m."""
ROD = """
<link name="{0}"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/><inertia ixx="0.0833333333"
  iyy="0.0833333333" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="{0}_foot"/><joint name="{0}_ankle" type="fixed"><origin xyz="0 0 -1"/>
  <parent link="{0}"/><child link="{0}_foot"/></joint>
"""
A_FRAME = f"""
<robot name="a_frame">{ROD.format("left")}{ROD.format("right")}
  <joint name="hinge" type="continuous"><parent link="left"/><child link="right"/>
    <axis xyz="0 1 0"/></joint></robot>
"""


@pytest.mark.parametrize("degrees", [0, 15, 30, 45, 100])
def test_a_sliding_box_stops_at_the_same_distance_in_all_directions(backend, degrees):
    friction, angle = 0.5, math.radians(degrees)
    cube = Box(name="cube", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1), friction=friction)
    with backend.build(World(objects=[cube], ground=Ground())) as simulation:
        simulation.step(20)
        q, v = simulation.positions(), simulation.velocities()
        v[:2] = 2 * math.cos(angle), 2 * math.sin(angle)
        simulation.set_state(q, v)
        simulation.step(600)
        x, y = (simulation.positions() - q)[:2]
        np.testing.assert_allclose(math.hypot(x, y), 4 / (2 * friction * GRAVITY), rtol=5e-3)
        np.testing.assert_allclose(math.atan2(y, x), angle, atol=1e-3)


def test_friction_is_right_with_few_iterations(backend):
    """The solver goes on from the impulses of the last step."""
    cube = Box(name="cube", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1), friction=0.5)
    with backend.build(World(objects=[cube], ground=Ground(), iterations=5)) as simulation:
        v = simulation.velocities()
        v[:2] = 1.2, 1.6
        simulation.step(20)
        simulation.set_state(simulation.positions(), v)
        simulation.step(600)
        np.testing.assert_allclose(
            math.hypot(*simulation.positions()[:2]), 4 / (2 * 0.5 * GRAVITY), rtol=0.01
        )


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [35, 50])
def test_an_a_frame_stands_if_friction_holds_its_legs_together(backend, write_urdf, degrees):
    """Friction bears load here: a bound from the normal forces without friction is too small."""
    angle = math.radians(degrees)
    needed = 0.5 * math.sin(angle) / (math.cos(angle) + FOOT)  # moments about the hinge
    for ratio, stands in ((0.99, False), (1.01, True)):
        robot = Robot(
            write_urdf(A_FRAME),
            fixed_base=False,
            position=(0, 0, math.cos(angle) + FOOT),
            orientation=(0, math.sin(angle / 2), 0, math.cos(angle / 2)),
            feet={"left_foot": FOOT, "right_foot": FOOT},
            friction=ratio * needed,
        )
        with backend.build(World([robot], ground=Ground())) as simulation:
            q = simulation.positions()
            q[7] = -2 * angle
            simulation.set_state(q, np.zeros(7))
            simulation.step(600)
            fell = q[2] - simulation.positions()[2]
            assert (fell < 1e-4) if stands else (fell > 1e-3)


def test_a_ball_begins_to_roll_at_five_sevenths_of_its_speed(backend):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 0.1), friction=0.4)
    with backend.build(World(objects=[ball], ground=Ground())) as simulation:
        v = simulation.velocities()
        v[:2] = 1.2, 1.6
        simulation.set_state(simulation.positions(), v)
        simulation.step(400)
        v = simulation.body_velocities(["ball"])[0]
        np.testing.assert_allclose(v[:2], [5 / 7 * 1.2, 5 / 7 * 1.6], rtol=1e-3)
        np.testing.assert_allclose(v[3:], [-v[1] / 0.1, v[0] / 0.1, 0], atol=1e-3)


@pytest.mark.parametrize(("degrees", "rolls"), [(20, True), (40, False)])
def test_a_ball_rolls_down_an_incline_or_slips(backend, degrees, rolls):
    friction, angle = 0.2, math.radians(degrees)
    down, across = GRAVITY * math.sin(angle), GRAVITY * math.cos(angle)
    gravity = (0.6 * down, 0.8 * down, -across)
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 0.1), friction=friction)
    with backend.build(World(objects=[ball], ground=Ground(), gravity=gravity)) as simulation:
        simulation.step(500)
        speed = 0.5 * (5 / 7 * down if rolls else down - friction * across)
        v = simulation.body_velocities(["ball"])[0]
        np.testing.assert_allclose(v[:2], [0.6 * speed, 0.8 * speed], rtol=2e-3)


@pytest.mark.faults
def test_a_pushed_quadruped_slips_when_the_push_exceeds_its_friction(backend, example):
    friction, stand = 0.3, np.tile([0.0, 0.8, -1.6], 4)
    robot = Robot(
        example("a1_description/urdf/a1.urdf"),
        "a1",
        fixed_base=False,
        position=(0, 0, 0.29),
        friction=friction,
    )

    def control(one):
        q, v = one.positions(), one.velocities()
        one.set_torques(100 * (stand - q[7:]) - 5 * v[6:])

    for ratio, holds in ((0.99, True), (1.01, False)):
        with backend.build(World([robot], ground=Ground())) as simulation:
            q = simulation.positions()
            q[7:] = stand
            simulation.set_state(q, np.zeros(18))
            simulation.add_hook(control)
            simulation.step(800)
            force = ratio * friction * GRAVITY * simulation.mass_matrix(q)[0, 0] / math.sqrt(2)
            profile = np.array([[0, 0, 0], [force, force, 0], [force, force, 0]])
            simulation.apply_wrench(Wrench("trunk", profile, times=(0, 2, 9)))  # slowly
            simulation.step(4000)
            feet = [f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
            begin = simulation.body_poses(feet)
            simulation.step(500)
            moved = (simulation.body_poses(feet) - begin)[:, :2]
            assert (np.hypot(*moved.T).max() < 1e-4) if holds else (np.hypot(*moved.T).min() > 1e-3)
