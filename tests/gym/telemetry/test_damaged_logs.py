"""Truncated, damaged and foreign log files are rejected, and nothing in them is executed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from physx_gym import Log, RobotEnv, read_log, replay
from physx_gym.errors import LogError

pytestmark = pytest.mark.processes


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_file_is_rejected(log, tmp_path, share):
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
def test_files_that_are_not_logs_are_rejected(log, tmp_path, change):
    path = tmp_path / "a.h5"
    log.write(path)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(LogError, match=r"a\.h5 cannot be read"):
        read_log(path)


def test_a_log_that_is_missing_or_not_hdf5(tmp_path):
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
def test_an_invalid_world_is_rejected(world):
    with pytest.raises(LogError, match="of this episode"):
        Log({"world": world}, {"time": np.zeros(1)}).world()


def test_no_code_in_a_file_is_executed(tmp_path):
    script = tmp_path / "evil.py"
    script.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nBackend = object\n")
    env = RobotEnv("cartpole", 0.02)
    env.eval()
    env.reset(seed=0)
    for _ in range(2):
        env.step(env.action_space.sample())
    data = env.log_data
    for reference in (f"{script}:Backend", "evil:Backend", ["dart"]):
        log = Log({**data["constants"], "backend": reference}, data["variables"])
        log.write(tmp_path / "a.h5")
        with pytest.raises(LogError, match="is not an installed plugin"):
            replay(tmp_path / "a.h5", path=tmp_path / "a.rrd")
    assert not (tmp_path / "ran").exists()


def test_a_log_that_cannot_be_written(log, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot be written"):
        log.write(tmp_path / "file" / "a.h5")


WRITER = """
import sys
import numpy as np
from physx_gym.telemetry.episode_log import Log
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
