"""URDF files as static scenery, and robots without inertia, in engines."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from physx_sim import Box, Ground, JointSettings, Robot, Sphere, World, Wrench
from physx_sim.errors import ModelError, SimulationError

TABLE = """<robot name="table"><link name="{root}">
<collision><origin xyz="0 0 0.45"/><geometry><box size="1 1 0.1"/></geometry></collision></link>
<link name="leg"><collision><geometry><box size="0.1 0.1 0.8"/></geometry></collision></link>
<joint name="weld" type="fixed"><parent link="{root}"/><child link="leg"/></joint></robot>"""
BARE = """<robot name="bare"><link name="base"/><link name="arm"/>
<joint name="wrist" type="continuous"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/></joint></robot>"""


@pytest.fixture(params=["world", "base"])
def table(request, write_urdf):
    """A table, whose top is 0.5 m above its root."""
    path = write_urdf(TABLE.format(root=request.param), "table.urdf")
    return Robot(path, "table", position=(0.0, 0.0, 0.4))


@pytest.mark.slow
@pytest.mark.parametrize("contacts", ["all", "static"])
def test_things_rest_on_a_table_from_a_file(backend, table, contacts):
    box = Box(name="box", size=(0.2, 0.2, 0.2), mass=2.0, position=(0.2, 0.0, 1.01))
    with backend.build(World([table], objects=[box], contacts=contacts)) as simulation:
        assert simulation.layout.parts["table"].bodies == slice(0, 2)
        assert (simulation.layout.nq, simulation.layout.nv) == (7, 6)
        simulation.step(500)
        poses = simulation.body_poses(["box", "leg"])
        assert poses[0, 2] == pytest.approx(1.0, abs=1e-3)
        np.testing.assert_array_equal(poses[1, :3], [0.0, 0.0, 0.4])
        found = simulation.contacts()
        assert (found["body_a"] < found["body_b"]).all()
        assert found["body_a"].max() == 0 and found["body_b"].min() == 2
        weight = found["force"].sum(axis=0)  # on the table, which is body_a
        np.testing.assert_allclose(weight, [0.0, 0.0, -2 * 9.81], atol=0.05)
        with pytest.raises(SimulationError, match="cannot move"):
            simulation.apply_wrench(Wrench("leg", (1.0, 0.0, 0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("contacts", ["all", "static"])
@pytest.mark.parametrize("first", [True, False])
def test_a_robot_stands_on_scenery_wherever_it_is_in_the_list(backend, table, contacts, first):
    ant = Robot("ant", "ant", fixed_base=False, position=(0.0, 0.0, 1.3))
    robots = [table, ant] if first else [ant, table]
    with backend.build(World(robots, ground=Ground(), contacts=contacts)) as simulation:
        simulation.step(600)
        place = simulation.layout.parts["ant"].positions.start
        assert simulation.positions()[place + 2] > 0.95
        q, v = simulation.positions(), np.zeros(simulation.layout.nv)
        assert simulation.mass_matrix(q).shape == (14, 14)
        assert simulation.jacobian("table/leg", q).shape == (6, 14)
        assert not simulation.jacobian("table/leg", q).any()
        a = simulation.forward_dynamics(q, v, v)
        np.testing.assert_allclose(simulation.inverse_dynamics(q, v, a), v, atol=1e-9)
        state = simulation.snapshot()
        simulation.restore(state)
        np.testing.assert_allclose(simulation.positions(), q, atol=1e-12)


def test_scenery_touches_neither_itself_nor_the_ground(backend, table):
    ball = Sphere(name="ball", radius=0.1, mass=1.0, position=(3.0, 0.0, 0.099))
    twin = Robot(table.urdf, "twin", position=(0.5, 0.0, 0.35), self_collisions=True)
    world = World([table, twin], objects=[ball], ground=Ground())
    with backend.build(world) as simulation:
        simulation.step(10)
        names = np.array(simulation.layout.names)
        assert set(names[simulation.contacts()["body_a"]]) == {"ball"}


def test_a_world_in_which_nothing_moves_says_what_to_add(backend, table):
    with pytest.raises(ModelError, match="nothing else in the world can move") as caught:
        backend.build(World([table], ground=Ground()))
    with (
        pytest.raises(ModelError, match="cannot float")
        if "world" in table.urdf.read_text()
        else (
            pytest.warns(UserWarning, match="the robot cannot be moved")  # it has no mass
        )
    ):
        robot = Robot(table.urdf, type(backend).__name__, fixed_base=False)  # each file warns once
        backend.build(World([robot])).close()
    advised = "fixed_base=False" in str(caught.value)
    assert advised == ("world" not in table.urdf.read_text())


def test_torques_on_a_robot_without_inertia_fail_with_the_right_advice(backend, write_urdf):
    robot = Robot(write_urdf(BARE), type(backend).__name__)  # each file warns once
    with pytest.warns(UserWarning, match="joint wrist cannot be moved by torques"):
        simulation = backend.build(World([robot]))
    with simulation:
        simulation.set_torques([1.0])
        with pytest.raises(SimulationError, match="<inertial>") as caught:
            for _ in range(100):
                simulation.step(100)
        assert "smaller period" not in str(caught.value)


def test_a_robot_without_inertia_follows_imposed_velocities(backend, write_urdf):
    """What the warning advises works, and ends the warning."""
    joints = {"wrist": JointSettings(mode="velocity")}
    world = World([Robot(write_urdf(BARE), joints=joints)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation = backend.build(world)
    with simulation:
        simulation.set_commands([0.5])
        simulation.step(1000)
        assert simulation.positions()[0] == pytest.approx(0.5, abs=1e-6)
