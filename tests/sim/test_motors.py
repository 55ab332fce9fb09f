"""Descriptions of motors, their torque limits, and rejected values."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
import safetensors.numpy

from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_sim import (
    ActuatorNetwork,
    JointSettings,
    Layout,
    Motor,
    Motors,
    Robot,
    Simulation,
    State,
    World,
    read_actuators,
    with_rotors,
    write_actuators,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

WORLD = World([Robot("masses.urdf")], period=1e-3)


class Held(Simulation):
    """Three joints whose velocities are what the test says; it keeps the commands."""

    engine = "held"
    features = frozenset({"hooks"})
    period = 1e-3

    def __init__(self, modes=("force", "force", "force")):
        names = ("a", "b", "c")
        free, places = np.full(3, np.inf), {name: i for i, name in enumerate(names)}
        most = np.array([np.inf, 50.0, np.inf])
        self.layout = Layout(names, (), places, places, 3, 3, -free, free, free, most, modes=modes)
        self.q, self.v, self.held = np.zeros(3), np.zeros(3), np.array([7.0, 8.0, 9.0])
        self.frames = 0

    frame = property(lambda self: self.frames)

    def positions(self, out=None):
        return self.q.copy()

    def velocities(self, out=None):
        return self.v.copy()

    def set_commands(self, commands):
        self.held = commands.copy()

    def snapshot(self):
        return State(self.q, self.v, self.held.copy(), self.frames)

    def unused(self, *values):
        raise NotImplementedError

    set_torques = set_state = restore = close = step = body_poses = body_velocities = unused
    forward_dynamics = inverse_dynamics = unused


Held.__abstractmethods__ = frozenset()


def run(motors, simulation, commands, velocities=(0, 0, 0)):
    simulation.v = np.array(velocities, float)
    motors.set_commands(commands)
    motors(simulation)
    simulation.frames += 1
    return motors.torques.tolist()


def test_limits_slope_friction_and_reduction_of_each_motor():
    simulation = Held()
    motors = Motors(
        simulation,
        WORLD,
        [
            Motor(joint="c", max_torque=4, max_velocity=10, slope=2, reduction=-5),
            Motor(joint="b", viscous=(0.1, 0.2), dry=(1, 2), dry_velocity=1e-6),
        ],
    )
    assert run(motors, simulation, [3.0, 0.0]) == [-15, 0]
    assert simulation.held.tolist() == [7, 0, -15]
    assert run(motors, simulation, [9.0, 3.0], (0, 10, 1)) == [-20, 1]
    assert run(motors, simulation, [9.0, -3.0], (0, -10, -1.8)) == [-10, 1]
    assert run(motors, simulation, [9.0, 80.0], (0, 0, -2)) == [0, 50]
    assert run(motors, simulation, [9.0, -80.0], (0, 0, -3)) == [0, -50]
    assert run(motors, simulation, [-9.0, 0.0], (0, 0, -3)) == [20, 0]
    motors.set_others([1.0, 2.0, 3.0])
    run(motors, simulation, [0.0, 0.0])
    assert simulation.held.tolist() == [1, 0, 0]


def test_a_limit_without_slope_is_a_step():
    simulation = Held()
    motors = Motors(simulation, WORLD, [Motor(joint="a", max_velocity=10, max_torque=4)])
    assert run(motors, simulation, [9.0], (9.999, 0, 0)) == [4]
    assert run(motors, simulation, [9.0], (10, 0, 0)) == [0]
    assert run(motors, simulation, [-9.0], (10, 0, 0)) == [-4]


def test_invalid_commands_are_rejected_as_a_whole():
    simulation = Held()
    motors = Motors(simulation, WORLD, [Motor(joint="a")])
    motors.set_commands([2.0])
    for wrong in ([1.0, 2.0], [np.nan], [np.inf], "x", [[1.0]], None):
        with pytest.raises(SimulationError):
            motors.set_commands(wrong)
        with pytest.raises(SimulationError):
            motors.set_others(wrong)
    assert motors.commands.tolist() == [2]


def test_invalid_values_are_rejected():
    with pytest.raises(ComponentNotFoundError, match='no joint "d".*It has: a, b, c'):
        Motors(Held(), WORLD, [Motor(joint="d")])
    with pytest.raises(ConfigError, match='2 motors on joint "a"'):
        Motors(Held(), WORLD, [Motor(joint="a"), Motor(joint="a")])
    with pytest.raises(ConfigError, match='mode "servo"'):
        Motors(Held(("force", "servo", "force")), WORLD, [Motor(joint="b")])
    with pytest.raises(ConfigError, match="multiple of the physics period"):
        Motors(Held(), WORLD, [Motor(joint="a", period=2.5e-3)])
    with pytest.raises(ConfigError, match="too stiff"):
        Motors(Held(), WORLD, [Motor(joint="a", stiffness=1e6, inertia=0.1)])
    with pytest.raises(FeatureNotSupportedError, match="armature.*stiffness"):
        Motors(Held(), WORLD, [Motor(joint="a", inertia=0.1)])


def test_a_rigid_rotor_must_be_in_the_world():
    simulation, motor = Held(), Motor(joint="a", inertia=0.1, reduction=-2)
    simulation.features = frozenset({"armature"})
    with pytest.raises(ConfigError, match="with_rotors"):
        Motors(simulation, WORLD, [motor])
    Motors(simulation, with_rotors(WORLD, [motor]), [motor])


def test_rotors_are_added_to_the_joints_of_their_robots():
    joints = {"a": JointSettings(damping=2.0, armature=0.5)}
    world = World([Robot("x.urdf", name="x"), Robot("x.urdf", name="y", joints=joints)])
    motors = [
        Motor(joint="y/a", inertia=0.1, reduction=3),
        Motor(joint="x/b", inertia=0.2),
        Motor(joint="x/c", inertia=0.2, stiffness=10.0),
    ]
    geared = with_rotors(world, motors)
    first, second = geared.robots
    assert first.joints == {"b": JointSettings(armature=0.2)}
    assert second.joints["a"].damping == 2
    np.testing.assert_allclose(second.joints["a"].armature, 1.4)
    assert world.robots[1].joints == joints
    with pytest.raises(ConfigError, match="<robot>/<joint>"):
        with_rotors(world, [Motor(joint="a", inertia=1.0)])


@pytest.mark.parametrize(
    "options",
    [
        {"max_torque": -1.0},
        {"max_torque": float("nan")},
        {"max_velocity": 0.0},
        {"reduction": 0.0},
        {"viscous": (1.0,)},
        {"dry": -1.0},
        {"backlash": 0.1},
        {"stiffness": 10.0},
        {"period": 0.0},
        {"inertia": float("inf")},
        {"joint": 3},
    ],
)
def test_descriptions_are_checked(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        Motor(**{"joint": "a", **options})


def test_motors_can_be_pickled_and_reject_states_of_others():
    motor = Motor(joint="a", stiffness=10.0, inertia=0.1, backlash=0.1)
    assert pickle.loads(pickle.dumps(motor)) == motor  # noqa: S301
    simulation = Held()
    motors = Motors(simulation, WORLD, [motor])
    other = Motors(simulation, WORLD, [Motor(joint="a"), Motor(joint="b")])
    with pytest.raises(SimulationError, match="not of these motors"):
        other.restore(motors.snapshot())
    with pytest.raises(SimulationError, match="not of these motors"):
        other.restore(None)
    simulation.q = np.array([0.3, 0, 0])
    motors.reset(simulation)
    assert motors.snapshot().rotor_positions.tolist() == [0.3]
    state = dataclasses.replace(motors.snapshot(), rotor_positions=np.array([0.5]))
    motors.restore(state)
    motors(simulation)
    np.testing.assert_allclose(motors.torques, 10 * 0.15)


def test_files_of_actuator_networks_hold_joints_of_any_name(tmp_path):
    layers = [(np.ones((1, 2)), np.zeros(1))]
    names = ("arm", "arm:0", "arm:elbow", "größe 1")
    networks = {name: ActuatorNetwork(0.01, layers, 1.0) for name in names}
    write_actuators(tmp_path / "all", networks)
    assert tuple(read_actuators(tmp_path / "all")) == names
    safetensors.numpy.save_file({"weights": np.ones(3)}, tmp_path / "other")
    with pytest.raises(ConfigError, match="it holds other arrays"):
        read_actuators(tmp_path / "other")
