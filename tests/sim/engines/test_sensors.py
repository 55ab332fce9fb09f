"""Sensors on the engines, against analytic values."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_sim import (
    Box,
    ContactSensor,
    EffortSensor,
    Encoder,
    ForceTorqueSensor,
    Ground,
    Imu,
    JointSettings,
    Motor,
    Motors,
    Robot,
    Sensors,
    Sphere,
    World,
    Wrench,
)
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes

TOWER = """
<robot name="tower">
  <link name="foot">
    <inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision><geometry><box size="1 1 0.2"/></geometry></collision>
  </link>
  <joint name="neck" type="prismatic">
    <origin xyz="0.2 0 0.5" rpy="1.5707963267948966 0 0"/>
    <parent link="foot"/><child link="head"/><axis xyz="0 1 0"/>
    <limit lower="-0.1" upper="0.1" velocity="9" effort="99"/>
  </joint>
  <link name="head">
    <inertial><origin xyz="0.1 0 0"/><mass value="3"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
</robot>
"""


LUMP = """
<robot name="lump"><link name="brick"><inertial><origin xyz="0.1 0 0.05"/><mass value="2"/>
  <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01" ixz="0" iyz="0"/></inertial></link></robot>
"""


def turn(quaternion):
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_an_imu_on_a_pendulum_measures_the_analytic_values(backend, bar):
    """The hinge turns about y; 0.7 m down the bar and turned by 90 degrees about z."""
    half = np.sqrt(0.5)
    world = World([bar()])
    with backend.build(world) as simulation:
        imu = Imu(name="imu", body="bar", position=(0, 0, -0.7), rotation=(0, 0, half, half))
        sensors = Sensors(simulation, world, [imu])
        simulation.set_state([0.4], [3.0])
        for _ in range(30):
            simulation.step(20)
            sensors.update(simulation)
            found = sensors["imu"]
            q, v, a = simulation.positions()[0], simulation.velocities()[0], 0.0
            a = simulation.accelerations()[0]
            np.testing.assert_allclose(found["angular_velocity"], [v, 0, 0], atol=1e-9)
            along, down = -0.7 * a - 9.81 * np.sin(q), 0.7 * v * v + 9.81 * np.cos(q)
            np.testing.assert_allclose(found["acceleration"], [0, -along, down], atol=1e-7)
            rotation = turn(found["orientation"])
            expected = [[0, -np.cos(q), np.sin(q)], [1, 0, 0], [0, np.sin(q), np.cos(q)]]
            np.testing.assert_allclose(rotation, expected, atol=1e-9)


def test_an_imu_of_a_thrown_body_feels_only_its_spin(backend, brick):
    """The center of mass falls freely; a place away from it feels the rotation about it."""
    with backend.build(brick) as simulation:
        imus = [
            Imu(name="center", body="brick", position=(0.1, 0, 0.05)),
            Imu(name="edge", body="brick", position=(0.4, 0.1, 0.05)),
        ]
        sensors = Sensors(simulation, brick, imus)
        simulation.set_state(simulation.positions(), [1, 2, 3, 2.0, -1.0, 0.5])
        simulation.step(200)
        sensors.update(simulation)
        read = sensors.read()
        spin, change = simulation.velocities()[3:6], simulation.accelerations()[3:6]
        np.testing.assert_allclose(read["edge"]["angular_velocity"], spin, atol=1e-9)
        arm = np.array([0.3, 0.1, 0.0])
        felt = np.cross(change, arm) + np.cross(spin, np.cross(spin, arm))
        difference = read["edge"]["acceleration"] - read["center"]["acceleration"]
        np.testing.assert_allclose(difference, felt, atol=1e-7)
        assert np.linalg.norm(read["center"]["acceleration"]) < 0.05  # of the order of the period


def test_an_imu_on_a_base_agrees_with_one_on_a_link_that_is_welded_to_it(backend, write_urdf):
    """The first is read off the base's twist, the second comes from the bodies' kinematics."""
    joint = '<joint name="weld" type="fixed"><origin xyz="0.2 0.1 -0.3" rpy="0.4 -0.2 0.9"/>'
    ends = '<parent link="brick"/><child link="corner"/></joint><link name="corner"/></robot>'
    robot = Robot(write_urdf(LUMP.replace("</robot>", joint + ends)), fixed_base=False)
    world = World([robot], gravity=(1.0, 2.0, -9.0))
    with backend.build(world) as simulation:
        simulation.set_state([0, 0, 0, *simulation.positions()[3:]], [1, 2, 3, 2.0, -1.0, 0.5])
        simulation.step(100)
        corner, base = simulation.body_poses(["corner", "brick"])
        back = turn(base[3:]).T
        inverse = base[3:] * [-1, -1, -1, 1]
        x, w = inverse[:3], corner[3:]
        rotation = [*(inverse[3] * w[:3] + w[3] * x + np.cross(x, w[:3])), inverse[3] * w[3]]
        rotation[3] -= x @ w[:3]
        kinds = [
            Imu(name="link", body="corner"),
            Imu(name="base", body="brick", position=back @ (corner - base)[:3], rotation=rotation),
        ]
        sensors = Sensors(simulation, world, kinds)
        sensors.update(simulation)
        link, base = sensors["link"], sensors["base"]
        for name in ("angular_velocity", "acceleration"):
            np.testing.assert_allclose(link[name], base[name], atol=1e-7)
        np.testing.assert_allclose(turn(link["orientation"]), turn(base["orientation"]), atol=1e-9)


def test_accelerations_are_the_change_of_the_velocities(backend, example):
    """Of a limb's place in the world, against finite differences over one step."""
    world = World([Robot(example("panda_description/urdf/panda.urdf"))], period=1e-5)
    with backend.build(world) as simulation:
        rng = np.random.default_rng(0)
        body = simulation.layout.bodies[6]
        sensors = Sensors(simulation, world, [Imu(name="imu", body=body)])
        lower, upper = simulation.layout.lower, simulation.layout.upper
        simulation.set_state(lower + 0.5 * (upper - lower), 0.02 * rng.normal(size=9))
        simulation.step(3)
        before = simulation.body_velocities([body])[0, :3]
        simulation.step()
        after = simulation.body_velocities([body])[0, :3]
        sensors.update(simulation)
        felt = turn(sensors["imu"]["orientation"]) @ sensors["imu"]["acceleration"]
        np.testing.assert_allclose(felt + world.gravity, (after - before) / 1e-5, atol=2e-3)


def test_at_rest_an_imu_measures_gravity_and_contacts_the_weight(backend):
    world = World(
        objects=[Box(name="box", size=(0.4, 0.3, 0.2), mass=3.0, position=(0, 0, 0.1))],
        ground=Ground(),
    )
    with backend.build(world) as simulation:
        sensors = Sensors(
            simulation,
            world,
            [
                ContactSensor(name="ground", body="ground"),
                ContactSensor(name="box", body="box"),
                Imu(name="imu", body="box", position=(0.1, 0.1, 0)),
            ],
        )
        sensors.update(simulation)
        assert not sensors.values[:10].any()
        simulation.step(1500)
        sensors.update(simulation)
        read = sensors.read()
        assert abs(np.linalg.norm(read["imu"]["acceleration"]) - 9.81) < 1e-2
        np.testing.assert_allclose(read["imu"]["angular_velocity"], 0, atol=1e-3)
        for name, sign in (("box", 1), ("ground", -1)):
            assert read[name]["touching"] == 1
            np.testing.assert_allclose(read[name]["normal_force"], 3 * 9.81, rtol=1e-3)
            np.testing.assert_allclose(read[name]["force"], [0, 0, sign * 3 * 9.81], atol=0.03)


def test_effort_sensor_and_encoder_measure_the_motor(backend, bar):
    world = World([bar()])
    with backend.build(world) as simulation:
        motors = Motors(simulation, world, [Motor(joint="hinge", max_torque=2, reduction=3)])
        sensors = Sensors(
            simulation,
            world,
            [
                Encoder(name="joint", joint="hinge"),
                Encoder(name="shaft", joint="hinge", reduction=3),
                EffortSensor(name="effort", joint="hinge"),
            ],
        )
        simulation.add_hook(motors)
        sensors.attach(simulation)
        motors.set_commands([5.0])
        simulation.step(100)
        sensors.update(simulation)
        read = sensors.read()
        assert read["effort"]["torque"] == 6
        assert read["joint"].tolist() == (simulation.positions()[0], simulation.velocities()[0])
        assert read["shaft"]["velocity"] == 3 * read["joint"]["velocity"]


def test_noise_delay_and_walk_repeat_after_restore_and_in_a_copy(backend, bar):
    world = World([bar()])

    def make(simulation):
        kinds = [
            Encoder(name="e", joint="hinge", noise=0.1, delay=3e-3, jitter=2e-3, interpolation=1),
            Imu(name="i", body="bar", noise=0.1, random_walk=0.2, bias_deviation=0.1, period=2e-3),
        ]
        return Sensors(simulation, world, kinds, np.random.default_rng(5))

    runs = []
    for _ in range(2):
        with backend.build(world) as simulation:
            simulation.set_state([0.4], [3.0])
            sensors = make(simulation).attach(simulation)
            simulation.step(50)
            state, own = simulation.snapshot(), pickle.loads(pickle.dumps(sensors.snapshot()))  # noqa: S301
            copied = pickle.loads(pickle.dumps(sensors))  # noqa: S301
            simulation.step(33)
            runs.append(sensors.values.tolist())
            simulation.restore(state)
            sensors.restore(own)
            simulation.step(33)
            runs.append(sensors.values.tolist())
            simulation.remove_hook(sensors)
            simulation.restore(state)
            simulation.add_hook(copied)
            simulation.step(33)
            runs.append(copied.values.tolist())
    assert runs.count(runs[0]) == 6


ANEW = """
import sys
import numpy as np
from physx_core import plugins
from physx_sim import Encoder, Imu, Motor, Motors, Robot, Sensors, World
world = World([Robot(sys.argv[2])])
with plugins.resolve("backend", sys.argv[1]).build(world) as simulation:
    gear = {"stiffness": 300.0, "inertia": 0.2, "backlash": 0.01, "dry": 0.02}
    motors = Motors(simulation, world, [Motor(joint="hinge", **gear)]).attach(simulation)
    motors.set_commands([0.7])
    kinds = [Imu(name="i", body="bar", noise=0.1, jitter=0.01, random_walk=0.1)]
    kinds += [Encoder(name="e", joint="hinge", bias_deviation=0.1, delay=0.004, period=2e-3)]
    sensors = Sensors(simulation, world, kinds, np.random.default_rng(8)).attach(simulation)
    simulation.step(100)
    print(sensors.values.tobytes().hex(), motors.torques.tobytes().hex())
"""


def test_everything_is_the_same_bit_for_bit_in_a_new_process(backend, bar):
    engine = backend.__module__.split(".")[1].split("_")[0]
    command = [sys.executable, "-c", ANEW, engine, str(bar().urdf)]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    first, second = (run.communicate()[0] for run in runs)
    assert len(first) > 100
    assert first == second


def test_a_hinge_carries_weight_motion_and_contact_forces(backend, bar):
    world = World([bar()])
    with backend.build(world) as simulation:
        sensors = Sensors(simulation, world, [ForceTorqueSensor(name="w", joint="hinge")])
        simulation.set_state([0.4], [3.0])
        simulation.set_torques([1.5])
        simulation.step(50)
        sensors.update(simulation)
        q, v = simulation.positions()[0], simulation.velocities()[0]
        a = simulation.accelerations()[0]
        along, down = 2 * (-0.5 * a - 9.81 * np.sin(q)), 2 * (0.5 * v * v + 9.81 * np.cos(q))
        np.testing.assert_allclose(sensors["w"]["force"], [along, 0, down], atol=1e-7)
        torque = 0.6 * a + 2 * 9.81 * 0.5 * np.sin(q)
        np.testing.assert_allclose(sensors["w"]["torque"], [0, torque, 0], atol=1e-7)


@pytest.fixture
def carrying(backend):
    """Build a simulation and a sensor of a joint, on engines that have the feature."""

    def make(world, joint):
        simulation = backend.build(world)
        return simulation, Sensors(simulation, world, [ForceTorqueSensor(name="w", joint=joint)])

    return make


@pytest.mark.reported("bullet3#3204", about="force and torque at a fixed joint")
def test_a_joint_carries_the_wrench_on_its_link(carrying, bar):
    """The same motion with and without a push differs by the push alone."""
    simulation, sensors = carrying(World([bar()]), "hinge")
    with simulation:
        simulation.apply_wrench(Wrench("tip", force=(0, 3.0, 5.0), point=(0.1, 0, 0)))
        simulation.set_state([0.3], [0.0])
        simulation.step(20)
        sensors.update(simulation)
        q, v = simulation.positions()[0], simulation.velocities()[0]
        a = simulation.accelerations()[0]
        back = np.array([[np.cos(q), 0, -np.sin(q)], [0, 1, 0], [np.sin(q), 0, np.cos(q)]])
        push = back @ np.array([0, 3.0, 5.0])
        along, down = 2 * (-0.5 * a - 9.81 * np.sin(q)), 2 * (0.5 * v * v + 9.81 * np.cos(q))
        force = np.array([along, 0, down]) - push
        np.testing.assert_allclose(sensors["w"]["force"], force, atol=1e-7)
        torque = [0, 0.6 * a + 2 * 9.81 * 0.5 * np.sin(q), 0] - np.cross([0.1, 0, -1], push)
        np.testing.assert_allclose(sensors["w"]["torque"], torque, atol=1e-7)


def test_a_standing_robot_carries_its_head(carrying, write_urdf):
    robot = Robot(write_urdf(TOWER), fixed_base=False, position=(0, 0, 0.1))
    simulation, sensors = carrying(World([robot], ground=Ground()), "neck")
    with simulation:
        simulation.set_torques([3 * 9.81])
        simulation.step(1000)
        sensors.update(simulation)
        np.testing.assert_allclose(sensors["w"]["force"], [0, 3 * 9.81, 0], atol=3e-3)
        np.testing.assert_allclose(sensors["w"]["torque"], [0, 0, 0.1 * 3 * 9.81], atol=3e-3)


def test_contacts_on_the_child_link_are_carried_too(carrying, write_urdf):
    """The same robot on its head, which the ground holds: the neck carries the foot."""
    box = '<collision><geometry><box size="0.4 0.2 0.4"/></geometry></collision>'
    text = TOWER.replace('<link name="head">', f'<link name="head">{box}')
    robot = Robot(write_urdf(text), fixed_base=False)
    simulation, sensors = carrying(World([robot], ground=Ground()), "neck")
    with simulation:
        simulation.set_state([-0.2, 0, 0.6, 1, 0, 0, 0, 0], np.zeros(7))
        simulation.set_torques([-2 * 9.81])
        simulation.step(60)
        sensors.update(simulation)
        q, v = simulation.positions(), simulation.velocities()
        torques = simulation.inverse_dynamics(q, v, simulation.accelerations())
        head = simulation.layout.bodies.index("head")
        pose = simulation.body_poses(["head"])[0]
        pushed = 0.0
        for contact in simulation.contacts():
            assert contact["body_a"] == head
            point = turn(pose[3:]).T @ (contact["point"] - pose[:3])
            pushed += contact["force"] @ simulation.jacobian("head", q, point)[:3, 6]
        assert abs(pushed) > 10
        force = sensors["w"]["force"][1]
        np.testing.assert_allclose(force, torques[6] - pushed, atol=1e-7)
        np.testing.assert_allclose(force, -2 * 9.81, atol=0.02)


def test_the_component_along_the_axis_is_the_joint_torque(carrying, example):
    path = example("panda_description/urdf/panda.urdf")
    robot = Robot(path, joints={"panda_joint3": JointSettings(damping=0, friction=0)})
    simulation, sensors = carrying(World([robot]), "panda_joint3")
    with simulation:
        simulation.set_torques(np.linspace(-3, 3, 9))
        simulation.step(30)
        sensors.update(simulation)
        q, v = simulation.positions(), simulation.velocities()
        torques = simulation.inverse_dynamics(q, v, simulation.accelerations())
        np.testing.assert_allclose(sensors["w"]["torque"][2], torques[2], atol=1e-7)


def test_a_ball_in_the_air_touches_nothing(backend):
    world = World(
        objects=[Sphere(name="ball", radius=0.1, position=(0, 0, 2))], ground=Ground(), period=2e-3
    )
    with backend.build(world) as simulation:
        sensors = Sensors(simulation, world, [ContactSensor(name="c", body="ball")])
        sensors.attach(simulation)
        simulation.step(5)
        assert not sensors.values.any()


def test_a_fixed_joint_measures_what_it_carries(engine, bar):
    robot = bar('<limit lower="0" upper="0" effort="50" velocity="10"/>')
    world = World([robot], gravity=(0, 0, -9.81))
    with engine.build(world) as simulation:
        simulation.apply_wrench(Wrench("tip", force=(1.0, 2.0, 3.0), torque=(0.1, 0.2, 0.3)))
        simulation.step()
        sensors = Sensors(
            simulation,
            world,
            [
                ForceTorqueSensor(name="tool", link="tip"),
                ForceTorqueSensor(name="hinge", joint="hinge"),
                ForceTorqueSensor(name="whole", link="base"),
            ],
        )
        sensors.update(simulation)
        tool, hinge = sensors["tool"], sensors["hinge"]
        np.testing.assert_allclose(tool["force"], (-1, -2, -3), atol=1e-4)
        np.testing.assert_allclose(tool["torque"], (-0.1, -0.2, -0.3), atol=1e-4)
        whole = simulation.link_wrenches(["bar"])[0]
        np.testing.assert_allclose([*hinge["force"], *hinge["torque"]], whole, atol=1e-12)
        assert np.isfinite(sensors["whole"]["force"]).all()
    with pytest.raises(ConfigError, match="needs a joint or a link"):
        ForceTorqueSensor(name="both", joint="hinge", link="tip")


def test_no_joint_leads_to_a_floating_root(engine, brick):
    with (
        engine.build(brick) as simulation,
        pytest.raises(SimulationError, match='leads to "brick"'),
    ):
        simulation.link_wrenches(["brick"])


def test_the_first_reading_after_restore_is_that_of_the_snapshot(engine):
    ball = Sphere(name="ball", radius=0.1, mass=2.0, position=(0, 0, 0.1))
    world = World(objects=[ball], ground=Ground())
    kinds = [
        Imu(name="imu", body="ball"),
        ContactSensor(name="touch", body="ball"),
    ]
    with engine.build(world) as simulation, engine.build(world) as other:
        simulation.step(200)
        sensors = Sensors(simulation, world, kinds)
        sensors.update(simulation)
        state = simulation.snapshot()
        for each in (simulation, other):
            each.restore(state)
            again = Sensors(each, world, kinds)
            again.update(each)
            np.testing.assert_array_equal(again.values, sensors.values)
        assert sensors["touch"]["normal_force"] == pytest.approx(2 * 9.81, rel=1e-3)
        other.set_state(other.positions(), other.velocities())
        assert not len(other.contacts()) and not other.accelerations().any()
