"""Actuator networks: learned from what a robot's model leaves, and used as motors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from physx_core import plugins
from physx_core.cli import main
from physx_core.errors import ConfigError
from physx_gym import RobotEnv
from physx_identify import Log, identify, learn_actuators, write_learned
from physx_identify.errors import IdentificationError
from physx_sim import Motor, Motors, Robot, World, read_actuators

ROBOT, PERIOD, JOINTS = Robot("double_pendulum", "arm"), 0.005, ("shoulder", "elbow")
WORLD = World([ROBOT], contacts="none", period=PERIOD)


def command(time, q, v):
    wave = [np.sin(2 * time) + 0.4 * np.sin(7 * time), np.sin(3 * time + 1) - 0.8]
    return [30, 8] * (min(1.0, time) * np.array(wave) - q) - [3, 0.4] * v


def actuator(now, before, v):
    """Return what motors with a lag, a torque that saturates, and friction exert."""
    return 8 * np.tanh((0.6 * now + 0.4 * before) / 8) - 0.4 * np.tanh(v / 0.1)


def moved(exert, seconds, phase=0.0):
    """Return positions and commands of an arm whose motors exert something else."""
    rows, before = [], np.zeros(2)
    with plugins.resolve("backend", "pinocchio").build(WORLD) as simulation:
        for step in range(round(seconds / PERIOD)):
            q, v = simulation.positions(), simulation.velocities()
            now = command(PERIOD * step + phase, q, v)
            rows.append([*q, *now])
            simulation.set_commands(exert(simulation, now, before, v))
            simulation.step()
            before = now
    rows = np.array(rows)
    return rows[:, :2], rows[:, 2:]


@pytest.fixture(scope="module")
def log():
    q, torque = moved(lambda _, *state: actuator(*state), 8.0)
    q = q + np.random.default_rng(0).normal(size=q.shape) * 1e-5
    return Log(JOINTS, PERIOD, q[200:], torque[200:])


@pytest.fixture(scope="module")
def learned(log):
    found = identify(log, ROBOT, ["damping"])
    return found, learn_actuators(found, log, ROBOT)


def test_networks_predict_most_of_what_the_model_leaves_in_unseen_samples(learned):
    for each in learned[1].learned.values():
        assert each.left < 0.5 * each.without
    assert "shoulder: " in str(learned[1]) and "N m" in str(learned[1])


def test_a_motor_with_a_network_moves_more_like_the_real_one(learned, tmp_path):
    found, actuators = learned
    write_learned(tmp_path / "actuator.safetensors", actuators)
    real, _ = moved(lambda _, *state: actuator(*state), 3.0, phase=1.0)
    robot, ends = found.applied_to(ROBOT), {}
    world = World([robot], contacts="none", period=PERIOD)
    for network in (None, str(tmp_path / "actuator.safetensors")):
        with plugins.resolve("backend", "pinocchio").build(world) as simulation:
            motors = Motors(
                simulation, world, [Motor(joint=joint, network=network) for joint in JOINTS]
            )
            motors.attach(simulation)
            rows = []
            for step in range(len(real)):
                q, v = simulation.positions(), simulation.velocities()
                rows.append(q)
                motors.set_commands(command(PERIOD * step + 1.0, q, v))
                simulation.step()
            ends[network is None] = np.abs(np.array(rows) - real).mean()
    assert ends[False] < 0.5 * ends[True]


def test_environments_with_networks_restore_their_history(learned, tmp_path):
    path = str(tmp_path / "actuator.safetensors")
    write_learned(path, learned[1])
    motors = [Motor(joint=joint, max_torque=20.0, network=path) for joint in JOINTS]
    env = RobotEnv(WORLD, 0.01, motors=motors)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([3.0, 1.0]))
    state, ways = env.snapshot(), []
    for _ in range(2):
        env.restore(state)
        for _ in range(5):
            env.step(np.array([-3.0, 2.0]))
        ways.append(env.robot_state.q.copy())
    np.testing.assert_array_equal(*ways)


def test_files_that_are_no_networks_are_named(learned, tmp_path):
    path = tmp_path / "actuator.safetensors"
    write_learned(path, learned[1])
    assert sorted(read_actuators(path)) == ["elbow", "shoulder"]
    world, motor = World([Robot("cartpole")]), Motor(joint="hinge", network=str(path))
    with (
        plugins.resolve("backend", "pinocchio").build(world) as simulation,
        pytest.raises(ConfigError, match='no network of "hinge"; it has'),
    ):
        Motors(simulation, world, [motor])
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(ConfigError, match="not a file of actuator networks"):
        read_actuators(path)
    with pytest.raises(ConfigError, match="--actuator"):
        read_actuators(tmp_path / "none")
    with pytest.raises(ConfigError, match="rigid gear"):
        Motor(joint="hinge", inertia=1.0, stiffness=1.0, network="some")


def test_the_command_learns_networks_from_the_same_log(log, learned, tmp_path, capsys):
    table = np.column_stack([PERIOD * np.arange(len(log)), log.positions, log.torques])
    names = "time,q.shoulder,q.elbow,tau.shoulder,tau.elbow"
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=names, comments="")
    out = tmp_path / "actuator.safetensors"
    given = [tmp_path / "log.csv", "double_pendulum", "--free", "damping", "--actuator", out]
    assert main(["identify", *map(str, given)]) == 0
    assert "last fifth" in capsys.readouterr().out
    assert sorted(read_actuators(out)) == ["elbow", "shoulder"]
    short = Log(JOINTS, PERIOD, log.positions[:200], log.torques[:200])
    with pytest.raises(IdentificationError, match="too few"):
        learn_actuators(learned[0], short, ROBOT)
    touched = dataclasses.replace(short, contacts={"lower": np.zeros(len(short))})
    with pytest.raises(IdentificationError, match="Actuator networks know nothing of contacts"):
        learn_actuators(learned[0], touched, ROBOT)
