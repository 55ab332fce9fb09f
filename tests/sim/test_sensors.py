"""Sensors on known signals: delay, jitter, noise, periods, and rejected values."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core.errors import ComponentNotFoundError, ConfigError, UnknownOptionError
from physx_sim import (
    ContactSensor,
    EffortSensor,
    Encoder,
    Imu,
    Layout,
    Robot,
    Sensor,
    Sensors,
    Simulation,
    State,
    World,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

WORLD = World([Robot("signal.urdf")], period=1e-3)


class Signal(Simulation):
    """Two joints and a body whose motion is a function of time."""

    engine = "signal"
    features = frozenset({"accelerations", "hooks"})
    period = 1e-3

    def __init__(self, motion=lambda t: np.array([t, -2 * t])):
        self.motion, self._frame, self.hooks = motion, 0, []
        free = np.full(2, np.inf)
        places = {"a": 0, "b": 1}
        self.layout = Layout(("a", "b"), ("body",), places, places, 2, 2, -free, free, free, free)

    frame = property(lambda self: self._frame)

    def add_hook(self, hook, every=1):
        self.hooks.append((hook, every))

    def step(self, n=1):
        for _ in range(n):
            for hook, every in self.hooks:
                if self._frame % every == 0:
                    hook(self)
            self._frame += 1

    def positions(self, out=None):
        return self.motion(self.time)

    def velocities(self, out=None):
        return np.gradient([self.motion(self.time + h) for h in (-1e-3, 0, 1e-3)], 1e-3, axis=0)[1]

    def accelerations(self):
        return np.zeros(2)

    def body_poses(self, names=None, positions=None):
        angle = (self.positions() if positions is None else positions)[0] / 2
        return np.array([[0, 0, 0, 0, 0, np.sin(angle), np.cos(angle)]] * len(names))

    def body_velocities(self, names=None, positions=None, velocities=None):
        v = self.velocities() if velocities is None else velocities
        return np.array([[0, 0, 0, 0, 0, v[0]]] * len(names))

    def body_accelerations(self, names=None):
        return np.zeros((len(names), 6))

    def snapshot(self):
        return State(self.positions(), self.velocities(), np.array([3.0, 4.0]), self._frame)

    def unused(self, *values):
        raise NotImplementedError

    set_torques = set_commands = set_state = restore = close = unused
    forward_dynamics = inverse_dynamics = unused


Signal.__abstractmethods__ = frozenset()


def record(sensors, simulation, steps):
    found = []
    for _ in range(steps):
        sensors.update(simulation)
        found.append(sensors.values)
        simulation.step()
    return np.array(found)


@pytest.mark.parametrize(
    ("delay", "order", "shift"),
    [(0.010, 0, 0.010), (0.0095, 0, 0.010), (0.005, 1, 0.005), (0.0053, 1, 0.0053)],
)
def test_a_delayed_signal_is_the_signal_shifted(delay, order, shift):
    simulation = Signal(lambda t: np.array([1 + 3 * t, 2 - t]))
    encoder = Encoder(name="a", joint="a", delay=delay, interpolation=order)
    found = record(Sensors(simulation, WORLD, [encoder]), simulation, 100)[:, 0]
    times = np.arange(100) * 1e-3
    np.testing.assert_allclose(found, 1 + 3 * np.maximum(times - shift, 0), rtol=1e-7)


def test_delay_counts_in_time_not_in_the_sensors_own_period():
    simulation = Signal()
    encoder = Encoder(name="a", joint="a", delay=0.01, interpolation=1, period=4e-3)
    found = record(Sensors(simulation, WORLD, [encoder]), simulation, 60)[:, 0]
    taken = np.arange(60) // 4 * 4e-3
    np.testing.assert_allclose(found, np.maximum(taken - 0.01, 0), atol=1e-15)


@pytest.mark.slow
def test_jitter_is_uniform_in_its_range():
    simulation = Signal()
    encoder = Encoder(name="a", joint="a", delay=2e-3, jitter=5e-3, interpolation=1)
    sensors = Sensors(simulation, WORLD, [encoder], np.random.default_rng(0))
    lag = np.arange(3000) * 1e-3 - record(sensors, simulation, 3000)[:, 0]
    lag = lag[10:]
    assert lag.min() >= 2e-3 - 1e-12 and lag.max() <= 7e-3 + 1e-12
    np.testing.assert_allclose([lag.mean(), lag.std()], [4.5e-3, 5e-3 / 12**0.5], rtol=0.05)


@pytest.mark.slow
def test_noise_and_bias_have_their_statistics():
    simulation = Signal(lambda t: np.zeros(2))
    noisy = Encoder(
        name="a",
        joint="a",
        noise={"position": 0.3, "velocity": 0.2},
        bias={"position": 1.5, "velocity": -0.5},
    )
    sensors = Sensors(simulation, WORLD, [noisy], np.random.default_rng(1))
    found = record(sensors, simulation, 8_000)
    np.testing.assert_allclose(found.mean(0), [1.5, -0.5], atol=1e-2)
    np.testing.assert_allclose(found.std(0), [0.3, 0.2], atol=1e-2)
    assert abs(np.corrcoef(found.T)[0, 1]) < 0.04
    assert not sensors.ideal.any()


def test_drawn_biases_last_until_the_reset_and_walks_grow_with_the_root_of_time():
    simulation = Signal(lambda t: np.zeros(2))
    kinds = [
        Encoder(name=f"e{i}", joint="a", bias_deviation={"position": 0.5}, random_walk=0.2)
        for i in range(400)
    ]
    sensors = Sensors(simulation, WORLD, kinds, np.random.default_rng(2))
    found = record(sensors, simulation, 101)
    np.testing.assert_allclose(found[0, ::2].std(), 0.5, rtol=0.1)
    np.testing.assert_allclose((found[100] - found[0]).std(), 0.2 * 0.1**0.5, rtol=0.1)
    sensors.reset()
    sensors.update(simulation)
    assert abs(np.corrcoef(sensors.values[::2], found[0, ::2])[0, 1]) < 0.2
    sensors.reset(np.random.default_rng(2))
    sensors.update(simulation)
    assert (sensors.values == found[0]).all()


def test_orientation_errors_are_rotations_and_delays_stay_on_the_sphere():
    simulation = Signal(lambda t: np.array([200 * t, 0]))
    kinds = [
        Imu(name="wrong", body="body", bias={"orientation": (0, 0, 0.2)}),
        Imu(name="late", body="body", delay=0.5e-3, interpolation=1),
        Imu(name="noisy", body="body", noise={"orientation": 0.1}),
    ]
    sensors = Sensors(simulation, WORLD, kinds, np.random.default_rng(3))
    record(sensors, simulation, 50)
    angle = {n: 2 * np.arctan2(*sensors[n]["orientation"][2:]) for n in ("wrong", "late")}
    turns = 200 * 0.049
    assert abs(np.sin((angle["wrong"] - turns - 0.2) / 2)) < 1e-12
    assert abs(np.sin((angle["late"] - turns + 0.1) / 2)) < 1e-12
    for name in sensors.dtype.names:
        assert abs(np.linalg.norm(sensors[name]["orientation"]) - 1) < 1e-12
    np.testing.assert_allclose(sensors["wrong"]["angular_velocity"], [0, 0, 200], rtol=1e-6)


def test_each_sensor_measures_at_its_own_period_as_a_hook():
    simulation = Signal()
    kinds = [
        Encoder(name="slow", joint="a", period=4e-3),
        Encoder(name="slower", joint="b", period=6e-3),
        EffortSensor(name="effort", joint="b", period=4e-3),
    ]
    sensors = Sensors(simulation, WORLD, kinds).attach(simulation)
    assert simulation.hooks[0][1] == 2
    simulation.step(12)
    read = sensors.read()
    np.testing.assert_allclose(read["slow"]["position"], 8e-3)
    np.testing.assert_allclose(read["slower"]["position"], -2 * 6e-3)
    np.testing.assert_allclose(read["slower"]["velocity"], -2)
    assert read["effort"]["torque"] == 4
    assert sensors.values.shape == (5,) and sensors.dtype.itemsize == 40


def test_invalid_values_are_rejected():
    simulation = Signal()

    def make(*kinds, **options):
        return Sensors(simulation, WORLD, kinds, **options)

    with pytest.raises(ComponentNotFoundError, match='no joint "c".*It has: a, b'):
        make(Encoder(name="x", joint="c"))
    with pytest.raises(ComponentNotFoundError, match='no body "boddy". Did you mean "body"'):
        make(Imu(name="x", body="boddy"))
    with pytest.raises(FeatureNotSupportedError, match="contacts"):
        make(ContactSensor(name="x", body="body"))
    with pytest.raises(ConfigError, match="multiple of the physics period"):
        make(Encoder(name="x", joint="a", period=1.5e-3))
    with pytest.raises(ConfigError, match='2 sensors "x"'):
        make(Encoder(name="x", joint="a"), Encoder(name="x", joint="b"))
    with pytest.raises(ConfigError, match="no sensors"):
        make()
    with pytest.raises(ConfigError, match="default_rng"):
        make(Encoder(name="x", joint="a", noise=0.1))
    sensors = make(Encoder(name="x", joint="a"))
    with pytest.raises(SimulationError, match="not measured yet"):
        sensors.read()
    with pytest.raises(ComponentNotFoundError, match='no sensor "y"'):
        sensors["y"]
    other = make(Encoder(name="x", joint="a"), Encoder(name="y", joint="a"))
    with pytest.raises(SimulationError, match="not of these sensors"):
        sensors.restore(other.snapshot())


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"noise": -1.0}, ConfigError, "noise"),
        ({"noise": float("nan")}, ConfigError, "noise"),
        ({"bias": {"place": 1.0}}, UnknownOptionError, "position, velocity"),
        ({"bias": {"position": (1.0, 2.0)}}, ConfigError, "2 numbers but needs 1"),
        ({"delay": -1e-3}, ConfigError, "delay"),
        ({"interpolation": 2}, ConfigError, "interpolation"),
        ({"period": 0.0}, ConfigError, "period"),
        ({"reduction": 0.0}, ConfigError, "reduction"),
        ({"name": ""}, ConfigError, "name"),
    ],
)
def test_descriptions_are_checked(options, error, words):
    with pytest.raises(error, match=words):
        Encoder(**{"name": "x", "joint": "a", **options})


def test_touching_has_no_errors_and_the_base_class_is_not_a_sensor():
    with pytest.raises(UnknownOptionError, match="touching"):
        ContactSensor(name="x", body="b", noise={"touching": 0.1})
    with pytest.raises(ConfigError, match="not a kind of sensor"):
        Sensor(name="x")
