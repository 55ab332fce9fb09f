"""Log files are read back exactly as recorded; damaged ones are in `test_damaged_logs`."""

from __future__ import annotations

import copy
from pathlib import Path

import h5py
import numpy as np
import pytest

from physx_core import plugins
from physx_core.cli import main
from physx_core.errors import ComponentNotFoundError
from physx_gym import Log, RobotEnv, Simulator, read_log
from physx_gym.errors import LogError
from physx_gym.telemetry.log_folder import KEPT, LogFolder
from physx_gym.telemetry.telemetry import Telemetry
from physx_sim import (
    Box,
    Cylinder,
    Ground,
    HeightField,
    JointSettings,
    Mesh,
    Robot,
    Sphere,
    Stairs,
    World,
)

pytestmark = pytest.mark.processes


def run(env, steps, seed=0):
    _, info = env.reset(seed=seed)
    for _ in range(steps):
        env.step(env.action_space.sample())
    return info


# There and back -----------------------------------------------------------------------------


def test_every_bit_comes_back(log, tmp_path):
    log.write(tmp_path / "new" / "a.h5")
    found = read_log(tmp_path / "new" / "a.h5")
    assert list(found.variables) == list(log.variables)
    for name, column in log.variables.items():
        assert found.variables[name].dtype == column.dtype
        np.testing.assert_array_equal(found.variables[name], column)
    assert found.constants == log.constants
    assert found.units == {"time": "s", "v.1": "m/s²"}
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.h5"]


def test_a_log_is_an_ordinary_file_in_few_pieces(log, tmp_path):
    log.write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["float64/values"].shape == (50, 4)
        assert file["float64/values"].chunks is None
        assert file["int64/values"].shape == (50, 1)
        assert file["float64/names"][:].tolist() == [b"time", b"v.0", b"v.1", b"v.2"]


def test_a_log_of_a_walking_robot_is_small(tmp_path):
    """That of the original takes 1.70 MB for the same number of rows and columns."""
    telemetry = Telemetry()
    telemetry.register("v", np.random.default_rng(0).standard_normal(328))
    telemetry.begin(tmp_path / "a.h5")
    for row in range(226):
        telemetry.record(row * 0.0025)
    telemetry.end()
    assert (tmp_path / "a.h5").stat().st_size < 0.7e6


def test_an_episode_comes_back_exactly(backend):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 3))
    world = World([Robot("cartpole")], objects=[ball], contacts="static")
    env = RobotEnv(Simulator(world, backend=backend, control_period=0.005), 0.02)
    env.eval()
    counter = np.zeros(1, np.int64)
    env.register_variable("counter", counter)
    path = run(env, 10)["log_path"]
    states = [(env.simulator.positions.copy(), env.simulator.velocities.copy())]
    running = env.log_data["variables"]
    counter[0] = 7
    for _ in range(5):
        env.step(env.action_space.sample())
        states.append((env.simulator.positions.copy(), env.simulator.velocities.copy()))
    env.stop()
    log = read_log(path)
    assert running["time"][-1] == 0.2
    assert len(running["time"]) == 41  # each 5 ms, and the present state
    motion = log.trajectory()
    assert len(motion.times) == 61
    np.testing.assert_allclose(motion.times, np.arange(61) * 0.005, rtol=1e-12)
    for (q, v), row in zip(states, range(40, 61, 4), strict=True):
        np.testing.assert_array_equal(motion.positions[row], q)
        np.testing.assert_array_equal(motion.velocities[row], v)
    np.testing.assert_array_equal(log.trajectory("ball").positions, motion.positions[:, 2:])
    assert log.trajectory("robot").positions.shape == (61, 2)
    assert log.variables["counter.0"].tolist() == [0] * 40 + [7] * 21
    np.testing.assert_array_equal(
        log.column("sensor.Encoder.hinge.position"), log.column("state.q.robot.hinge")
    )
    assert log.constants["seed"] == 0
    assert log.constants["backend"] == backend
    assert log.units["state.q.ball.z"] == "m"
    slider, hinge = "state.v.robot.slider", "state.q.robot.hinge"
    assert (log.units[slider], log.units[hinge]) == ("m/s", "rad")
    assert log.units["sensor.Encoder.hinge.velocity"] == "rad/s"
    assert log.units["motor.torque.slider"] == "N"
    with pytest.raises(ComponentNotFoundError, match='no robot or object "bal"'):
        log.trajectory("bal")
    with pytest.raises(LogError, match=r'no column "state.q.robot.hing"\. Did you mean'):
        log.column("state.q.robot.hing")


def test_an_episode_without_steps_leaves_no_file():
    env = RobotEnv("cartpole", 0.02)
    env.eval()
    path = run(env, 0)["log_path"]
    env.reset()
    assert not Path(path).exists()


def test_the_world_comes_back(tmp_path):
    world = World(
        [
            Robot("cartpole", name="a", joints={"hinge": JointSettings(damping=0.1)}),
            Robot("ant", name="b", fixed_base=False, feet={"foot": 0.1}, package_dirs={"p": "/q"}),
        ],
        period=2e-3,
        gravity=(0.0, 0.1, -9.0),
        objects=[
            Box(name="box", size=(1.0, 2.0, 3.0), static=True),
            Cylinder(name="can", radius=0.1, length=0.2, mass=3.0),
            Mesh(name="mesh", path="/tmp/a.stl", scale=2.0),
        ],
        ground=Stairs(steps=3),
    )
    variables = {"time": np.zeros(1)}
    for number, ground in enumerate((world.ground, Ground(normal=(0.0, 0.6, 0.8)), None)):
        each = World(tuple(world.robots), objects=tuple(world.objects), ground=ground)
        Log({"world": each}, variables).write(tmp_path / f"{number}.h5")
        assert read_log(tmp_path / f"{number}.h5").world() == each
    field = World(world.robots, ground=HeightField(np.arange(6.0).reshape(2, 3)))
    Log({"world": field}, variables).write(tmp_path / "field.h5")
    found = read_log(tmp_path / "field.h5").world().ground
    np.testing.assert_array_equal(found.heights, field.ground.heights)


@pytest.mark.parametrize("moved", [False, True])
def test_a_log_is_replayed_from_any_folder(moved, tmp_path, monkeypatch, capsys):
    made, other = tmp_path / "made", tmp_path / "other"
    made.mkdir()
    monkeypatch.chdir(made)
    robots = plugins.resolve("backend", "dart").robots()
    model = next(robot.path for robot in robots if robot.name == "cartpole")
    Path("own.urdf").write_bytes(Path(model).read_bytes())
    env = RobotEnv("own.urdf", 0.02)
    env.eval()
    env.reset(seed=5, options={"log_path": "own.h5"})
    env.step(env.action_space.sample())
    env.close()
    other.mkdir()
    monkeypatch.chdir(other)
    if moved:
        made.rename(tmp_path / "moved")
        made = tmp_path / "moved"
    assert main(["log", str(made / "own.h5"), "--replay", "own.rrd"]) == 0
    assert Path("own.rrd").read_bytes()[:3] == b"RRF"


# Where logs lie -----------------------------------------------------------------------------


def test_logs_are_deleted_with_their_environment():
    env = RobotEnv("cartpole", 0.02)
    env.eval()
    path = run(env, 1)["log_path"]
    env.stop()
    assert Path(path).exists()
    env.close()
    assert not Path(path).parent.exists()
    again = run(env, 1)["log_path"]
    env.stop()
    assert Path(again).exists()
    env.close()


def test_a_log_whose_path_is_given_stays(tmp_path):
    env = RobotEnv("cartpole", 0.02)
    env.eval()
    _, info = env.reset(seed=0, options={"log_path": str(tmp_path / "mine.h5")})
    env.step(env.action_space.sample())
    env.close()
    assert info["log_path"] == str(tmp_path / "mine.h5")
    assert len(read_log(tmp_path / "mine.h5").time) == 2


def test_only_the_newest_logs_stay():
    folder, paths = LogFolder(), []
    for number in range(KEPT + 3):
        paths.append(folder.new_path("log"))
        paths[-1].write_text(str(number))
    assert [path for path in paths if path.exists()] == paths[3:]
    folder.close()
    assert not paths[-1].parent.exists()


def test_training_records_what_is_measured_once_a_step_and_writes_no_file():
    env = RobotEnv("cartpole", 0.04, control_period=0.02, period=0.01)
    assert env.log_data == {}
    observation, info = env.reset(seed=2)
    assert "log_path" not in info
    seen = [observation]
    for _ in range(3):
        seen.append(env.step(env.action_space.sample())[0])
        data = env.log_data["variables"]
        assert data["time"] == pytest.approx([0.04 * number for number in range(len(seen))])
    env.stop()
    data = env.log_data
    log = Log(data["constants"], data["variables"])
    for robot, motion in ((None, log.trajectory()), ("robot", log.trajectory("robot"))):
        for row, one in enumerate(seen):
            np.testing.assert_array_equal(motion.positions[row], one["states"]["agent"]["q"], robot)
    names = ["sensor.Encoder.slider.position", "sensor.Encoder.slider.velocity"]
    sensed = [one["measurements"]["Encoder"][:, 0] for one in seen]
    np.testing.assert_array_equal([log.column(name) for name in names], np.transpose(sensed))
    assert not [name for name in log.variables if name.startswith(("motor", "action", "state.a"))]
    assert (log.constants["seed"], log.constants["step_dt"]) == (2, 0.04)
    assert log.world() == env.simulator.world


def test_an_episode_in_training_is_replaced_by_the_next():
    env = RobotEnv("cartpole", 0.02)
    run(env, 3)
    env.reset(seed=1)
    assert len(env.log_data["variables"]["time"]) == 1
    env.step([0.5, 0.0])
    times = env.log_data["variables"]["time"]
    state = env.snapshot()
    env.step([0.5, 0.0])
    assert len(env.log_data["variables"]["time"]) == 3
    env.restore(state)
    np.testing.assert_array_equal(env.log_data["variables"]["time"], times)
    twin = copy.deepcopy(env)
    for each in (env, twin):
        each.step([0.5, 0.0])
        each.reset(seed=2)
        each.step([0.5, 0.0])
    assert env.log_data["variables"].keys() == twin.log_data["variables"].keys()
    for name, column in env.log_data["variables"].items():
        np.testing.assert_array_equal(column, twin.log_data["variables"][name])


def test_options_that_are_changed_describe_the_next_episode_in_training():
    env = RobotEnv("ant", 0.02, fixed_base=False)
    run(env, 1)
    env.stop()
    env.simulator.set_options({"world": {"ground": {"friction": 0.25}}})
    assert env.log_data["constants"]["options"]["world"]["ground"]["friction"] == 1.0
    env.reset(seed=0)
    env.step(env.action_space.sample())
    data = env.log_data
    assert data["constants"]["options"]["world"]["ground"]["friction"] == 0.25
    assert (
        data["variables"]["state.q.robot.z"][0] == env.log_data["variables"]["state.q.robot.z"][0]
    )


# On the command line ------------------------------------------------------------------------


def test_command_line(tmp_path, capsys):
    env = RobotEnv("cartpole", 0.02)
    env.eval()
    path = str(tmp_path / "a.h5")
    env.reset(seed=5, options={"log_path": path})
    for _ in range(10):
        env.step(env.action_space.sample())
    env.close()
    assert main(["log", path]) == 0
    told = capsys.readouterr().out
    assert "RobotEnv on dart, seed 5" in told
    assert "11 rows of" in told
    assert "0.2 s" in told
    assert "state.q.robot.hinge" in told
    assert main(["log", path, "--columns", "motor"]) == 0
    told = capsys.readouterr().out
    assert "motor.torque.slider" in told
    assert "state.q" not in told
    plot, recording = tmp_path / "a.png", tmp_path / "a.rrd"
    words = ["log", path, path, "--columns", "motor", "--plot", str(plot)]
    assert main([*words, "--replay", str(recording)]) == 0
    assert plot.read_bytes()[:4] == b"\x89PNG"
    assert recording.read_bytes()[:3] == b"RRF"
    assert main(["log", str(tmp_path / "none.h5")]) == 1
    assert "There is no log" in capsys.readouterr().err
