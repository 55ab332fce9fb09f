"""Permanent views of measurements and torques, and hooks that run between the steps."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from physx_core.errors import ComponentNotFoundError
from physx_sim import (
    ContactSensor,
    EffortSensor,
    Encoder,
    Ground,
    Imu,
    Motor,
    Motors,
    Robot,
    Sensors,
    World,
)


@pytest.fixture
def world(example):
    robot = Robot(
        example("a1_description/urdf/a1.urdf"), "a1", fixed_base=False, position=(0, 0, 0.35)
    )
    return World([robot], ground=Ground())


def kinds(joints, **options):
    return [
        Encoder(name="first", joint=joints[0], **options),
        Imu(name="imu", body="trunk", position=(0.1, 0, 0), **options),
        ContactSensor(name="foot", body="FL_foot", **options),
        Encoder(name="last", joint=joints[-1], reduction=3.0, **options),
        EffortSensor(name="effort", joint=joints[3], **options),
    ]


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_views_are_permanent_and_kinds_are_grouped(backend, world, noise):
    with backend.build(world) as simulation:
        joints = simulation.layout.joints
        rng = np.random.default_rng(0)
        sensors = Sensors(simulation, world, kinds(joints, noise=noise), rng)
        names = [sensor.name for sensor in sensors.sensors]
        assert names == ["first", "last", "imu", "foot", "effort"] == list(sensors.dtype.names)
        view, encoders, imu = sensors.view, sensors.block(Encoder), sensors.block(Imu)
        assert np.isnan(view).all()
        assert (encoders.shape, imu.shape) == ((2, 2), (1, 10))
        simulation.set_torques(np.linspace(-3, 3, 12))
        for _ in range(3):
            simulation.step(100)
            sensors.update(simulation)
            q, v = simulation.positions(), simulation.velocities()
            expected = [[q[7], v[6]], [3 * q[-1], 3 * v[-1]]]
            np.testing.assert_allclose(encoders, expected, atol=1e-7)
            np.testing.assert_array_equal(view, sensors.values)
            np.testing.assert_array_equal(view[:4].reshape(2, 2), encoders)
            assert np.shares_memory(view, encoders) and np.shares_memory(view, imu)
            assert sensors["last"]["position"] == encoders[1, 0]
        state = sensors.snapshot()
        sensors.reset(np.random.default_rng(1))
        assert np.isnan(view).all()
        sensors.restore(state)
        np.testing.assert_array_equal(view, state.values)
        for array in (view, encoders):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1.0
        with pytest.raises(ComponentNotFoundError, match='no kind of sensor "Motor"'):
            sensors.block(Motor)


def pickled(thing):
    return pickle.loads(pickle.dumps(thing))  # noqa: S301 - our own


@pytest.mark.parametrize("clone", [copy.deepcopy, pickled])
def test_a_copy_has_its_own_memory(backend, world, clone):
    with backend.build(world) as simulation:
        sensors = Sensors(simulation, world, kinds(simulation.layout.joints))
        sensors.update(simulation)
        other = clone(sensors)
        view, before = other.view, sensors.values
        simulation.step(10)
        other.update(simulation)
        np.testing.assert_array_equal(sensors.values, before)
        assert (view[4:8] != before[4:8]).any()
        sensors.update(simulation)
        np.testing.assert_array_equal(view, sensors.values)


def test_sensors_of_one_kind_may_have_different_periods(backend, world):
    with backend.build(world) as simulation:
        a, b = simulation.layout.joints[:2]
        sensors = Sensors(
            simulation,
            world,
            [
                Encoder(name="often", joint=a, period=2e-3),
                Encoder(name="seldom", joint=b, period=3e-3),
                Imu(name="imu", body="trunk", period=6e-3),
            ],
        )
        sensors.update(simulation)
        simulation.set_torques(np.ones(12))
        block, changes = sensors.block(Encoder), []
        for _ in range(7):
            before = block[:, 0].copy()
            simulation.step()
            sensors.update(simulation)
            changes.append((block[:, 0] != before).tolist())
        yes, no = True, False
        assert changes == [
            [no, no],
            [yes, no],
            [no, yes],
            [yes, no],
            [no, no],
            [yes, yes],
            [no, no],
        ]


def test_attached_motors_and_sensors_equal_called_ones(backend, world):
    """Attached, they run at their periods only, and the steps between are one block."""
    with backend.build(world) as one, backend.build(world) as other:
        joints = one.layout.joints
        motors, torques = {}, {}
        for simulation in (one, other):
            each = [Motor(joint=joint, max_torque=20.0, period=5e-3) for joint in joints]
            motors[simulation] = Motors(simulation, world, each)
            torques[simulation] = motors[simulation].torques_view
        motors[one].attach(one)
        sensors = Sensors(one, world, [Imu(name="imu", body="trunk", period=5e-3)]).attach(one)
        rng = np.random.default_rng(0)
        for _ in range(20):
            commands = 15 * rng.normal(size=12)
            for simulation in (one, other):
                motors[simulation].set_commands(commands)
            one.step(5)
            for _ in range(5):
                motors[other](other)
                other.step()
            np.testing.assert_array_equal(one.positions(), other.positions())
            np.testing.assert_array_equal(torques[one], torques[other])
            np.testing.assert_array_equal(torques[one], np.clip(commands, -20, 20))
            np.testing.assert_array_equal(one.commands(), torques[one])
        sensors.update(one)
        with pytest.raises(ValueError, match="read-only"):
            torques[one][0] = 1.0
        motors[one].reset(one)
        assert not one.commands().any()
        assert not torques[one].any()
