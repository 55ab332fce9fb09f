"""Log files: what was recorded comes back as it was, and nothing else gets in."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from physx_core.cli import main
from physx_core.errors import ComponentNotFoundError, LogError
from physx_core.gym import Log, RobotEnv, Simulator, read_log, replay
from physx_core.gym.log_folder import KEPT, LogFolder
from physx_core.gym.telemetry import Telemetry
from physx_core.world import (
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


@pytest.fixture
def log():
    """A log of two types of numbers, some of which are no ordinary ones."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((50, 3))
    values[3] = np.nan, np.inf, -np.inf
    variables = {"time": np.arange(50) * 0.01}
    variables |= {f"v.{number}": values[:, number] for number in range(3)}
    variables["n"] = rng.integers(-(2**63), 2**63 - 1, 50)
    return Log(
        {"seed": 3, "options": {"a": [1, None]}, "units": {"time": "s", "v.1": "m/s²"}}, variables
    )


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


# Where logs lie -----------------------------------------------------------------------------


def test_logs_go_with_their_environment():
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


def test_training_leaves_no_log():
    env = RobotEnv("cartpole", 0.02)
    info = run(env, 3)
    assert "log_path" not in info
    assert env.log_data == {}


# Damage and malice --------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.9, 0.999])
def test_a_cut_file_is_refused(log, tmp_path, share):
    path = tmp_path / "a.h5"
    log.write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(LogError, match=r"a\.h5 cannot be read"):
        read_log(path)


def link_out(file):
    del file["float64/values"]
    file["float64/values"] = h5py.ExternalLink("other.h5", "/values")


def link_soft(file):
    del file["int64"]
    file["int64"] = h5py.SoftLink("/float64")


def raw_file_elsewhere(file):
    del file["float64/values"]
    place = [("/etc/hostname", 0, 1600)]
    file["float64"].create_dataset("values", (50, 4), "f8", external=place)


def virtual(file):
    del file["float64/values"]
    layout = h5py.VirtualLayout((50, 4), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "values", (50, 4))
    file["float64"].create_virtual_dataset("values", layout)


def bomb(file):
    del file["float64/values"]
    shape, options = (10**9, 4), {"compression": "gzip", "chunks": (10**5, 4)}
    file["float64"].create_dataset("values", shape, "f8", **options)


def claim(file):
    del file["float64/values"]
    file["float64"].create_dataset("values", (10**11, 4), "f8")


def other_numbers(file):
    values = file["float64/values"][:]
    del file["float64/values"]
    file["float64"].create_dataset("values", data=values.astype("f4"))


def fewer_names(file):
    names = file["float64/names"][:3]
    del file["float64/names"]
    file["float64"].create_dataset("names", data=names)


def equal_names(file):
    file["float64/names"][2] = b"v.0"


def no_time(file):
    file["float64/names"][0] = b"t"


def other_length(file):
    values = file["int64/values"][:20]
    del file["int64/values"]
    file["int64"].create_dataset("values", data=values)


def no_text(file):
    file["float64/names"][1] = b"\xff\xfe"


def constants(text):
    def change(file):
        del file["constants"]
        file.create_dataset("constants", data=np.frombuffer(text, np.uint8))

    return change


@pytest.mark.parametrize(
    "change",
    [
        link_out,
        link_soft,
        raw_file_elsewhere,
        virtual,
        bomb,
        claim,
        other_numbers,
        fewer_names,
        equal_names,
        no_time,
        other_length,
        no_text,
        constants(b"[1]"),
        constants(b"{"),
        constants(b"[" * 100_000),
        lambda file: file.attrs.__setitem__("version", 9),
        lambda file: file.attrs.__delitem__("format"),
        lambda file: file.__delitem__("float64/names"),
        lambda file: file.__delitem__("constants"),
    ],
)
def test_what_is_no_log_is_refused(log, tmp_path, change):
    path = tmp_path / "a.h5"
    log.write(path)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(LogError, match=r"a\.h5 cannot be read"):
        read_log(path)


def test_a_log_that_is_missing_or_no_hdf5(tmp_path):
    with pytest.raises(LogError, match=r"There is no log .*a\.h5"):
        read_log(tmp_path / "a.h5")
    (tmp_path / "a.h5").write_text("text")
    with pytest.raises(LogError, match="cannot be read as a log"):
        read_log(tmp_path / "a.h5")


@pytest.mark.parametrize(
    "world",
    [
        None,
        {"kind": "World", "robots": [{"kind": "Popen", "args": ["false"]}]},
        {"kind": "Robot", "urdf": "cartpole"},
        {"kind": "World", "robots": [{"kind": "Robot"}]},
        {"kind": "World", "robots": [{"kind": "Robot", "urdf": "a", "friction": "x"}]},
        {"kind": "World", "robots": [], "objects": []},
        {"kind": ["World"]},
        [[]] * 3,
    ],
)
def test_a_world_that_makes_no_sense_is_refused(world):
    with pytest.raises(LogError, match="of this episode"):
        Log({"world": world}, {"time": np.zeros(1)}).world()


def test_no_code_of_a_file_is_run(tmp_path):
    script = tmp_path / "evil.py"
    script.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nBackend = object\n")
    env = RobotEnv("cartpole", 0.02)
    env.eval()
    run(env, 2)
    data = env.log_data
    for reference in (f"{script}:Backend", "evil:Backend", ["dart"]):
        log = Log({**data["constants"], "backend": reference}, data["variables"])
        log.write(tmp_path / "a.h5")
        with pytest.raises(LogError, match="is no installed plugin"):
            replay(tmp_path / "a.h5", path=tmp_path / "a.rrd")
    assert not (tmp_path / "ran").exists()


def test_a_log_that_cannot_be_written(log, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot be written"):
        log.write(tmp_path / "file" / "a.h5")


WRITER = """
import sys
import numpy as np
from physx_core.gym.log import Log
log = Log({}, {"time": np.arange(20000.0), "v": np.arange(20000.0)})
print("ready", flush=True)
number = 0
while True:
    number += 1
    log.write(f"{sys.argv[1]}/{number % 3}.h5")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_a_killed_process_leaves_whole_files(tmp_path):
    for number in range(3):
        words = [sys.executable, "-c", WRITER, str(tmp_path)]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            time.sleep(0.05 + 0.03 * number)
            process.send_signal(signal.SIGKILL)
        for path in tmp_path.glob("*.h5"):
            assert len(read_log(path).time) == 20000


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
