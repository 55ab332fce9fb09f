"""The simulator: options, forces, motors and sensors, start and stop."""

import numpy as np
import pytest

from physx_core.errors import ConfigError, EpisodeError
from physx_gym import RobotEnv, Simulator
from physx_sim import (
    Box,
    ContactSensor,
    EffortSensor,
    Encoder,
    ForceTorqueSensor,
    Ground,
    HeightField,
    Imu,
    Motor,
    Motors,
    Robot,
    Sensors,
    Stairs,
    World,
    Wrench,
)
from physx_sim.errors import SimulationError


def test_one_line_from_a_robots_name(backend):
    simulator = Simulator.build("cartpole", backend=backend)
    assert simulator.builds == 0
    assert simulator.simulation.engine == backend and simulator.builds == 1
    assert [motor.joint for motor in simulator.motors] == ["slider", "hinge"]
    assert [sensor.name for sensor in simulator.sensors] == ["slider", "hinge"]
    assert simulator.world.ground is None
    ant = Simulator.build("ant", backend=backend, fixed_base=False)
    assert isinstance(ant.world.ground, Ground) and len(ant.motors) == 8
    assert isinstance(ant.sensors[-1], Imu) and ant.sensors[-1].body == "torso"


def test_start_step_stop(backend):
    simulator = Simulator.build("cartpole", backend=backend, period=1e-3)
    with pytest.raises(EpisodeError, match="call start"):
        simulator.step(1)
    simulator.start([0.1, 0.2], [0.0, 0.0])
    assert simulator.is_simulation_running and simulator.stepper_state.t == 0.0
    assert simulator.robot_state.q.tolist() == [0.1, 0.2]
    simulator.robot_state.command[:] = [100.0, 0.0]
    simulator.apply_command()
    simulator.step(10)
    assert simulator.stepper_state.iter == 10 and simulator.stepper_state.t == 0.01
    assert simulator.robot_state.torques.tolist() == [30.0, 0.0]
    assert simulator.measurements["t"] == 0.01
    simulator.stop()
    assert not simulator.is_simulation_running
    simulator.start([0.0, 0.0], [0.0, 0.0])
    assert simulator.simulation.frame == 0 and not simulator.robot_state.command.any()


def test_options(backend):
    world = World([Robot("cartpole")], 1e-3, ground=Ground(friction=0.4))
    simulator = Simulator(world, backend=backend, motors=[Motor(joint="slider")])
    options = simulator.get_options()
    assert options["world"]["period"] == 1e-3 and options["world"]["gravity"] == (0, 0, -9.81)
    assert options["world"]["ground"]["friction"] == 0.4
    assert options["world"]["robots"]["robot"]["restitution"] == 0.0
    assert options["stepper"] == {"control_period": None, "observe_period": None}
    assert options["motors"]["slider"]["reduction"] == 1.0
    assert options["sensors"]["slider"]["noise"] == 0.0
    simulator.set_options(options)
    assert simulator.simulation.frame == 0 and simulator.builds == 1  # nothing changed
    simulator.set_options(
        {
            "world": {"gravity": (0.0, 0.0, -1.0), "ground": {"friction": 0.7}},
            "stepper": {"control_period": 0.01},
            "motors": {"slider": {"viscous": 2.0}},
            "sensors": {"slider": {"bias": 0.5}},
        }
    )
    assert simulator.builds == 1
    simulator.start([0.0, 0.0], [1.0, 0.0])
    assert simulator.builds == 2 and simulator.world.ground.friction == 0.7
    assert simulator.sensed["Encoder"][:, 0].tolist() == [0.5, 1.5]
    simulator.step(1)
    assert simulator.robot_state.torques == pytest.approx([-2.0], abs=0.1)
    changed = simulator.get_options()
    assert changed["world"]["gravity"] == (0.0, 0.0, -1.0)
    assert changed["stepper"]["control_period"] == 0.01
    assert changed["motors"]["slider"]["viscous"] == (2.0, 2.0)
    simulator.stop()
    with pytest.raises(ConfigError, match="mapping"):
        simulator.set_options({"world": 3})
    with pytest.raises(ConfigError, match="control_period"):
        simulator.set_options({"stepper": {"control_period": -1.0}})
    bare = Simulator.build("cartpole", backend=backend)
    with pytest.raises(ConfigError, match="no ground"):
        bare.set_options({"world": {"ground": {"friction": 1.0}}})


def test_forces_at_their_times(backend):
    class Pushed(RobotEnv):
        def _setup(self):
            if self.reset_options.get("push"):
                push = Wrench("cart", (1000.0, 0.0, 0.0), duration=0.001)
                self.simulator.register_force(push, begin=0.013)

    options = {"period": 1e-3, "motors": [Motor(joint="slider")]}
    env = Pushed("cartpole", 0.01, backend=backend, **options)
    env.reset(options={"push": True})
    assert env.step([0.0])[0]["states"]["agent"]["v"][0] == 0.0
    assert env.step([0.0])[0]["states"]["agent"]["v"][0] == pytest.approx(0.97, abs=0.06)
    bodies = env.simulator.simulation.snapshot().wrenches
    assert not bodies
    env.reset()  # what was registered before is gone
    for _ in range(2):
        last = env.step([0.0])[0]["states"]["agent"]["v"][0]
    assert last == 0.0


def test_held_forces_do_not_outlive_their_episode(backend):
    simulator = Simulator.build("cartpole", backend=backend, period=1e-3)
    simulator.register_force(Wrench("cart", (10.0, 0.0, 0.0)))
    for _ in range(2):
        simulator.start([0.0, 0.0], [0.0, 0.0])
        simulator.step(100)
        assert simulator.robot_state.v[0] == pytest.approx(0.93, abs=0.05)
        simulator.stop()
    simulator.remove_all_forces()
    simulator.start([0.0, 0.0], [0.0, 0.0])
    simulator.step(100)
    assert simulator.robot_state.v[0] == 0.0


def test_all_kinds_of_sensors(backend):
    sensors = [
        EffortSensor(name="effort", joint="slider"),
        Encoder(name="angle", joint="hinge"),
        Imu(name="imu", body="pole"),
        ForceTorqueSensor(name="load", joint="hinge"),
        Encoder(name="place", joint="slider", reduction=2.0),
        ContactSensor(name="touch", body="cart"),
    ]
    world = World([Robot("cartpole")], 1e-3, ground=Ground(height=-5.0))
    simulator = Simulator(world, backend=backend, sensors=sensors)
    simulator.start([0.2, 0.3], [0.0, 0.0])
    simulator.robot_state.command[:] = [3.0, 0.0]
    simulator.apply_command()
    simulator.step(2)
    found = simulator.sensed
    shapes = {"Effort": (1, 1), "Encoder": (2, 2), "Imu": (10, 1)}
    shapes |= {"ForceTorque": (6, 1), "Contact": (5, 1)}
    assert {kind: values.shape for kind, values in found.items()} == shapes
    q = simulator.robot_state.q
    assert found["Encoder"][0].tolist() == [q[1], 2.0 * q[0]]
    assert found["Effort"] == [[3.0]] and found["Contact"][0] == [0.0]
    assert np.linalg.norm(found["Imu"][:4]) == pytest.approx(1.0)
    assert [sensor.name for sensor in simulator.sensors[1:3]] == ["angle", "place"]


def test_sensors_with_memory_measure_between_the_steps(backend):
    """The same as sensors that are hooks of a bare simulation."""
    options = {"noise": 0.01, "random_walk": 0.1, "delay": 0.003, "interpolation": 1}
    sensors = [Encoder(name="a", joint="slider", **options), Encoder(name="b", joint="hinge")]
    simulator = Simulator.build("cartpole", backend=backend, period=1e-3, sensors=sensors)
    simulator.seed(4)
    simulator.set_reading_period(10)
    simulator.start([0.0, 0.1], [1.0, 0.0])
    bare = Simulator.build("cartpole", backend=backend, period=1e-3).simulation
    bare.set_state(np.array([0.0, 0.1]), np.array([1.0, 0.0]))
    direct = Sensors(bare, simulator.world, sensors, np.random.default_rng(4)).attach(bare)
    for _ in range(3):
        simulator.step(10)
        bare.step(10)
        direct.update(bare)
        assert simulator.sensed["Encoder"].T.tobytes() == direct.values.tobytes()


def test_motors_are_those_of_a_bare_simulation(backend):
    motors = [
        Motor(joint="slider", max_torque=2.0, reduction=3.0, viscous=0.1, dry=0.05),
        Motor(joint="hinge", max_torque=1.0, max_velocity=20.0, slope=0.5),
    ]
    for chosen in (motors, [Motor(joint="slider", max_torque=2.0, reduction=3.0)]):
        simulator = Simulator.build("cartpole", backend=backend, period=1e-3, motors=chosen)
        simulator.start([0.0, 0.1], [0.0, 0.0])
        bare = Simulator.build("cartpole", backend=backend, period=1e-3).simulation
        bare.set_state(np.array([0.0, 0.1]), np.zeros(2))
        direct = Motors(bare, simulator.world, chosen).attach(bare)
        for command in ([1.5, 0.5], [9.0, -9.0], [-0.1, 0.0]):
            simulator.robot_state.command[:] = command[: len(chosen)]
            simulator.apply_command()
            direct.set_commands(command[: len(chosen)])
            simulator.step(10)
            bare.step(10)
            assert simulator.robot_state.q.tobytes() == bare.positions().tobytes()
            assert np.array_equal(simulator.robot_state.torques, direct.torques)


def test_the_maximum_commands():
    motors = [Motor(joint="hinge", max_torque=4.0), Motor(joint="slider", reduction=10.0)]
    simulator = Simulator.build("cartpole", motors=motors)
    assert simulator.max_commands().tolist() == [4.0, 3.0]


def test_no_motors_and_no_sensors(backend):
    env = RobotEnv("cartpole", 0.02, backend=backend, motors=[], sensors=[])
    observation, _ = env.reset()
    assert set(observation) == {"t", "states"} and env.action_space.shape == (0,)
    env.step(np.zeros(0))


def test_robots_stand_on_any_ground(backend):
    heights = np.zeros((30, 30))
    heights[12:18, 12:18] = 0.3
    ramp = Ground(normal=(0.0, 0.6, 0.8), height=0.2)
    up = np.array([0.0, 0.0, 1.0])
    for ground, normal, height in (
        (ramp, np.array(ramp.normal), 0.2),
        (Stairs(begin=0.2), up, 0.2),
        (HeightField(heights, (0.1, 0.1)), up, 0.3),
    ):
        simulator = Simulator.build("ant", backend=backend, fixed_base=False, ground=ground)
        positions = simulator.place_on_ground(simulator.neutral())
        lowest = -simulator.simulation.reach("robot", -normal, positions)
        assert lowest == pytest.approx(height, abs=1e-12)


def test_reach_of_shapes(backend):
    box = Box(name="box", size=(0.2, 0.4, 0.6), position=(1.0, 0.0, 0.0))
    ground = Ground(height=-9.0)
    world = World([Robot("cartpole")], objects=[box], ground=ground, contacts="static")
    simulation = Simulator(world, backend=backend).simulation
    for direction, wanted in (((1, 0, 0), 1.1), ((0, -1, 0), 0.2), ((0, 0, 1), 0.3)):
        assert simulation.reach("box", np.array(direction, float)) == pytest.approx(wanted)
    assert simulation.reach("robot", np.array([0.0, 0.0, 1.0])) == pytest.approx(1.0, abs=0.01)
    with pytest.raises(SimulationError, match='Did you mean "box"'):
        simulation.reach("bo", np.array([1.0, 0.0, 0.0]))


def test_snapshots_of_a_simulator(backend):
    simulator = Simulator.build("ant", backend=backend, fixed_base=False, period=2e-3)
    simulator.start(simulator.place_on_ground(simulator.neutral()), np.zeros(14))
    simulator.step(20)
    state = simulator.snapshot()
    accelerations = simulator.robot_state.a.copy()
    simulator.step(5)
    after = simulator.values.copy()
    simulator.restore(state)
    assert np.array_equal(simulator.robot_state.a, accelerations)
    simulator.step(5)
    assert simulator.values.tobytes() == after.tobytes()
