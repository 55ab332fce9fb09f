"""Files of strangers of every kind that physx reads: no code, no other file, little time, memory.

Each is read by a command, as a user would. A file that would be read elsewhere is watched by the
kernel; code that would be run leaves a mark.
"""

import ctypes
import json
import os
import pickle
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(sys.platform != "linux", reason="the kernel watches files by inotify"),
    pytest.mark.processes,
]

MEASURED = Path(__file__).with_name("programs") / "measured.py"
SECONDS, NBYTES = 10, 10**9
HANGS = 120
OPENED, ACCESSED = 0x20, 0x1
EVIL = """
import pathlib
from physx_core.toy import Linear, Spring
pathlib.Path(__file__).with_name("executed").touch()
class Net(Linear): pass
class Env(Spring): pass
"""


@dataclass(frozen=True)
class Place:
    """Where a hostile file is made.

    Attributes:
        here: The working directory of the command.
        elsewhere: Folder of files that nobody has named.
    """

    here: Path
    elsewhere: Path

    @property
    def secret(self):
        return self.elsewhere / "secret.h5"

    @property
    def description(self):
        return self.here / "sessions/net/network/network_0/checkpoint.toml"

    def copy(self, *names):
        for name in names:
            shutil.copytree(self.elsewhere.parent / "sound" / name, self.here / name)


CASES = {}


def hostile(kind, message):
    """Register a function that makes a hostile file and returns the command that reads it."""

    def register(make):
        CASES[f"{kind}: {make.__name__.replace('_', ' ')}"] = make, message
        return make

    return register


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A folder with a session of each kind, a log, and files that nobody names."""
    base = tmp_path_factory.mktemp("hostile")
    (base / "sound").mkdir()
    code = """
from physx_core import EnvironmentConfig, NetworkConfig, Training
from physx_gym import Log, RobotEnv
env = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
fields = {"net_fields": ["state"], "opt_fields": ["next_state"]}
short = {"epoch_nb": 1, "batch_nb": 2, "batch_size": 4, "quiet": True}
Training(NetworkConfig("toy/linear", fields), None, env, session_name="net", **short).execute()
deep = NetworkConfig("torch/fc", fields | {"layers": [2, 4, 2]}, loss="MSELoss", optimizer="Adam",
                     lr=0.01)
Training(deep, None, env, session_name="torch", **short).execute()
robot = RobotEnv("cartpole", 0.02, backend="dart")
robot.eval()
robot.reset(seed=0)
for _ in range(3):
    robot.step(robot.action_space.sample())
data = robot.log_data
Log(data["constants"], data["variables"]).write("a.h5")
"""
    subprocess.run([sys.executable, "-c", code], cwd=base / "sound", check=True)
    elsewhere = base / "elsewhere"
    elsewhere.mkdir()
    with h5py.File(elsewhere / "secret.h5", "w") as file:
        file["x"] = np.full((5, 2), 4.25)
    for name in ("secret.stl", "secret.txt"):
        (elsewhere / name).write_text("4.25\n")
    return base


@pytest.fixture
def place(sound, tmp_path):
    (tmp_path / "evil.py").write_text(EVIL)
    return Place(tmp_path, sound / "elsewhere")


class Watched:
    """Notes whether anything in a folder is opened or read."""

    def __init__(self, folder):
        library = ctypes.CDLL(None, use_errno=True)
        self._descriptor = library.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        watch = library.inotify_add_watch(self._descriptor, os.fsencode(folder), OPENED | ACCESSED)
        assert watch >= 0, os.strerror(ctypes.get_errno())

    def __enter__(self):
        return self

    def __exit__(self, *error):
        os.close(self._descriptor)

    def was_read(self):
        try:
            return bool(os.read(self._descriptor, 4096))
        except BlockingIOError:
            return False


# Checkpoints ------------------------------------------------------------------------------------


def describe(place, text_of, name="net"):
    """Let the description of a checkpoint be another one, with a valid checksum."""
    place.copy("sessions")
    file = place.here / f"sessions/{name}/network/network_0/checkpoint.toml"
    body = text_of(file.read_text().rpartition("\n[checksum]")[0]).encode()
    file.write_bytes(body + b'\n[checksum]\ncrc32 = "%08x"\n' % zlib.crc32(body))
    return ["predict", f"sessions/{name}", "toy/spring", "--step-nb", "1"]


def swap(place, old, new, name="net"):
    def text_of(text):
        assert old in text
        return text.replace(old, new, 1)

    return describe(place, text_of, name)


@hostile("checkpoint", 'network = "os:system"')
def names_a_program(place):
    words = swap(place, '"toy/linear"', '"os:system"')
    text = place.description.read_text().rpartition("\n[checksum]")[0]
    body = re.sub(
        r"\[network_kwargs\]\n(?:(?!\[).*\n)*",
        '[network_kwargs]\ncommand = "touch executed"\n',
        text,
    )
    place.description.write_bytes(
        body.encode() + b'\n[checksum]\ncrc32 = "%08x"\n' % zlib.crc32(body.encode())
    )
    return words


@hostile("checkpoint", 'evil.py:Net", which may be any')
def brings_its_script(place):
    return swap(place, '"toy/linear"', f'"{place.here}/evil.py:Net"')


@hostile("checkpoint", '"evil:Net"')
def names_a_module_beside_it(place):
    return swap(place, '"toy/linear"', '"evil:Net"')


@hostile("checkpoint", "network_kwargs.module")
def runs_a_program_as_an_argument(place):
    return swap(
        place,
        "[network_kwargs]\n",
        '[network_kwargs]\nmodule = "subprocess:Popen"\nargs = ["touch", "executed"]\n',
    )


@hostile("checkpoint", "network_kwargs.module")
def has_a_module_of_torch_that_runs_a_program(place):
    def text_of(text):
        text = text.replace('"torch/fc"', '"torch/module"')
        return re.sub(
            r"\[network_kwargs\]\n(?:(?!\[).*\n)*",
            '[network_kwargs]\nmodule = "subprocess:Popen"\nmodule_kwargs = {args = "evil"}\n',
            text,
        )

    return describe(place, text_of, "torch")


@hostile("checkpoint", 'transformation = "evil:Net"')
def converts_with_a_script(place):
    return describe(
        place, lambda text: re.sub(r'transformation = "[^"]*"', 'transformation = "evil:Net"', text)
    )


@hostile("checkpoint", "in the file")
def has_layers_of_terabytes(place):
    def text_of(text):
        return re.sub(r"layers = \[[^\]]*\]", "layers = [2, 1000000, 1000000, 2]", text)

    return describe(place, text_of, "torch")


@hostile("checkpoint", "more than 10000 values")
def has_a_million_layers(place):
    def text_of(text):
        return re.sub(r"layers = \[[^\]]*\]", f"layers = [{'2, ' * 10**6}2]", text)

    return describe(place, text_of, "torch")


@hostile("checkpoint", "nested too deeply")
def is_nested_without_end(place):
    return describe(place, lambda text: "a = " + "[" * 10**5 + "]" * 10**5 + "\n" + text)


@hostile("checkpoint", "64 parts")
def has_a_key_of_many_parts(place):
    return describe(place, lambda text: "a." * 10**5 + "a = 1\n" + text)


@hostile("checkpoint", "contains weights")
def says_its_fields_are_huge(place):
    return swap(place, "shape = [", "shape = [1000000000, ")


# Parameters -------------------------------------------------------------------------------------


def parameters(place, content):
    """Replace the parameters of the network of PyTorch, with a valid checksum."""
    words = describe(place, lambda text: text, "torch")
    folder = place.here / "sessions/torch/network/network_0"
    (folder / "parameters.safetensors").write_bytes(content)

    def text_of(text):
        new = f'[files."parameters.safetensors"]\nnbytes = {len(content)}\n'
        return re.sub(
            r'\[files\."parameters\.safetensors"\]\n[^\[]*',
            new + f'crc32 = "{zlib.crc32(content):08x}"\n\n',
            text,
        )

    file = folder / "checkpoint.toml"
    body = text_of(file.read_text().rpartition("\n[checksum]")[0]).encode()
    file.write_bytes(body + b'\n[checksum]\ncrc32 = "%08x"\n' % zlib.crc32(body))
    return words


def tensors(entries, nbytes):
    header = json.dumps(entries).encode()
    return struct.pack("<Q", len(header)) + header + bytes(nbytes)


@hostile("parameters", "header too large")
def claim_a_header_of_exabytes(place):
    return parameters(place, struct.pack("<Q", 2**60) + b"{}")


@hostile("parameters", "not fully covered")
def claim_a_tensor_of_terabytes(place):
    entry = {"dtype": "F32", "shape": [2**20, 2**20], "data_offsets": [0, 2**42]}
    return parameters(place, tensors({"0.weight": entry}, 100))


@hostile("parameters", "invalid offset")
def share_their_bytes(place):
    entry = {"dtype": "F32", "shape": [2**18], "data_offsets": [0, 2**20]}
    return parameters(place, tensors({f"{n}.weight": entry for n in range(5000)}, 2**20))


@hostile("parameters", "header")
def are_a_pickle(place):
    return parameters(place, pickle.dumps(Call(os.mkdir, "executed")))


# Datasets ---------------------------------------------------------------------------------------


class Call:
    def __init__(self, function, *args):
        self.function, self.args = function, args

    def __reduce__(self):
        return self.function, self.args


def manifest(place, change):
    """Change a manifest, with a valid checksum; return the dataset's folder."""
    place.copy("sessions")
    folder = place.here / "sessions/net/dataset"
    plain = json.loads((folder / "dataset.json").read_text())
    plain.pop("crc32")
    change(plain)
    body = json.dumps(plain, indent=1).encode()[:-2]
    (folder / "dataset.json").write_bytes(body + b',\n "crc32": "%08x"\n}' % zlib.crc32(body))
    return folder


def replayed(place, **info):
    folder = manifest(place, lambda plain: plain["info"].update(info))
    return ["replay", folder, "--environment.visualizer", "None", "--step-nb", "1"]


@hostile("dataset", 'evil.py:Env", which may be any')
def brings_its_environment(place):
    return replayed(place, environment=f"{place.here}/evil.py:Env")


@hostile("dataset", '"os:system"')
def replays_a_program(place):
    return replayed(place, environment="os:system", env_kwargs={"command": "touch executed"})


@hostile("dataset", '"evil:Env"')
def has_a_program_among_the_arguments(place):
    return replayed(place, environment="toy/spring", env_kwargs={"a": [{"b": "evil:Env"}]})


@hostile("dataset", "1000000 processes")
def starts_a_million_processes(place):
    return replayed(place, environment="toy/spring", env_kwargs={}, num_clients=10**6)


@hostile("dataset", "problem")
def is_a_link_to_another_file(place):
    place.copy("sessions")
    file = next(place.here.glob("sessions/net/dataset/*_state_0.h5"))
    file.unlink()
    file.symlink_to(place.secret)
    return ["verify", "sessions/net"]


@hostile("dataset", "is truncated")
def has_rows_without_end(place):
    def change(plain):
        for partition in plain["modes"]["training"]["partitions"]:
            partition["rows"] = 2**50

    manifest(place, change)
    return ["export", "sessions/net", "out.npz", "--to", "npz"]


@hostile("dataset", "lists and objects")
def has_a_manifest_of_many_lists(place):
    place.copy("sessions")
    text = '{"info": [' + "[]," * 10**7 + "[]]}"
    (place.here / "sessions/net/dataset/dataset.json").write_text(text)
    return ["info", "sessions/net"]


@hostile("partition", "do not match their stored checksum")
def has_its_values_elsewhere(place):
    place.copy("sessions")
    file = next(place.here.glob("sessions/net/dataset/*_state_0.h5"))
    with h5py.File(file) as old:
        attributes, shape = dict(old.attrs), old["data"].shape
    file.unlink()
    with h5py.File(file, "w") as new:
        new.attrs.update(attributes)
        layout = h5py.VirtualLayout(shape, "f8")
        layout[:5] = h5py.VirtualSource(str(place.secret), "x", (5, *shape[1:]))
        new.create_virtual_dataset("data", layout)
        new["rows"] = np.uint64(5)
    return ["export", "sessions/net", "out.npz", "--to", "npz"]


@hostile("partition", "problem")
def claims_petabytes(place):
    place.copy("sessions")
    file = next(place.here.glob("sessions/net/dataset/*_state_0.h5"))
    with h5py.File(file) as old:
        attributes = dict(old.attrs)
    file.unlink()
    with h5py.File(file, "w") as new:
        new.attrs.update(attributes)
        new.create_dataset("data", (2**47, 2), "f8")
        new["rows"] = np.uint64(2**47)
    return ["verify", "sessions/net"]


# Imports ----------------------------------------------------------------------------------------

IMPORT = ["import", "file", "made"]


def npy(array, shape=None):
    """Return the file of an array, which may claim another shape."""
    header = {"descr": array.dtype.str, "fortran_order": False, "shape": shape or array.shape}
    text = repr(header).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + array.tobytes()


def archive(place, members, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(place.here / "file", "w", compression, compresslevel=1) as file:
        for name, content in members.items():
            with file.open(name, "w", force_zip64=True) as member:
                for part in [content] if isinstance(content, bytes) else content:
                    member.write(part)
    return IMPORT


@hostile("npz", "max-bytes")
def unpacks_to_four_gigabytes(place):
    return archive(place, {"x.npy": (npy(np.empty(0), (2**29,)), *[bytes(2**24)] * 2**8)})


@hostile("npz", "does not match its checksum")
def hides_its_size(place):
    words = archive(place, {"x.npy": (npy(np.empty(0), (2**26,)), *[bytes(2**24)] * 32)})
    content = (place.here / "file").read_bytes()
    real = struct.pack("<Q", 128 + 2**29)
    assert real in content or real[:4] in content
    wrong = struct.pack("<Q", 128 + 2**20)
    (place.here / "file").write_bytes(content.replace(real, wrong).replace(real[:4], wrong[:4]))
    return words


@hostile("npz", "object")
def holds_a_pickle(place):
    objects = np.array([Call(os.mkdir, "executed")], object)
    np.savez(place.here / "file.npz", x=objects)
    (place.here / "file.npz").rename(place.here / "file")
    return IMPORT


@hostile("npz", "")
def leaves_its_folder(place):
    return archive(place, {f"../executed/{n}.npy": npy(np.zeros(3)) for n in range(3)})


@hostile("npz", "no readable header")
def has_a_header_of_nested_lists(place):
    text = b"{'descr': " + b"[" * 60000 + b"\n"
    return archive(place, {"x.npy": b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text})


@hostile("npz", "")
def has_notes_nested_without_end(place):
    words = archive(place, {"x.npy": npy(np.zeros(3))})
    with zipfile.ZipFile(place.here / "file", "a") as file:
        file.comment = b"[" * 60000
    return words


@hostile("HDF5", "is virtual")
def is_virtual(place):
    with h5py.File(place.here / "file", "w") as file:
        layout = h5py.VirtualLayout((5, 2), "f8")
        layout[:] = h5py.VirtualSource(str(place.secret), "x", (5, 2))
        file.create_virtual_dataset("x", layout)
    return IMPORT


@hostile("HDF5", "is a link")
def links_to_another_file(place):
    with h5py.File(place.here / "file", "w") as file:
        file["x"] = h5py.ExternalLink(str(place.secret), "x")
    return IMPORT


@hostile("HDF5", "other files")
def stores_its_values_in_another_file(place):
    with h5py.File(place.here / "file", "w") as file:
        outside = [(str(place.elsewhere / "secret.txt"), 0, 80)]
        file.create_dataset("x", (5, 2), "f8", external=outside)
    return IMPORT


@hostile("HDF5", "max-bytes")
def claims_eighty_gigabytes(place):
    with h5py.File(place.here / "file", "w") as file:
        file.create_dataset("x", (10**10,), "f8", chunks=(10**6,))
    return IMPORT


@hostile("HDF5", "chunks")
def has_a_chunk_of_gigabytes(place):
    with h5py.File(place.here / "file", "w") as file:
        file.create_dataset("x", (10,), "f8", chunks=(2**28,), maxshape=(None,))
    return IMPORT


@hostile("HDF5", "more than 10000")
def has_groups_within_each_other(place):
    with h5py.File(place.here / "file", "w") as file:
        groups = [file.create_group(str(number)) for number in range(30)]
        for number, one in enumerate(groups):
            for other in range(number + 1, len(groups)):
                one[str(other)] = groups[other]
    return IMPORT


# DeepPhysX ----------------------------------------------------------------------------------------

X = np.arange(5.0)
DATABASE = ["import", "a_training_0.db", "made"]


def database(place, value=None, schema="CREATE TABLE training (id INTEGER PRIMARY KEY, x)"):
    with sqlite3.connect(place.here / "a_training_0.db") as made:
        made.execute(schema)
        if value is not None:
            made.execute("INSERT INTO training (x) VALUES (?)", [value])
    made.close()
    return DATABASE


@hostile("DeepPhysX", "not an array of numbers")
def pickles_a_call(place):
    return database(place, pickle.dumps(Call(os.mkdir, "executed")))


@hostile("DeepPhysX", "not an array of numbers")
def has_a_memo_of_gigabytes(place):
    return database(place, b"\x80\x02)r" + struct.pack("<I", 2**27) + b".")


@hostile("DeepPhysX", "not an array of numbers")
def has_a_pickle_nested_without_end(place):
    return database(place, b"\x80\x02}" + b")" + b"\x85" * 10**6 + b"Ns.")


@hostile("DeepPhysX", "impossible type")
def has_an_array_of_a_type_that_is_none(place):
    return database(place, pickle.dumps(X, 2).replace(b"f8", b"i3"))


@hostile("DeepPhysX", "impossible")
def has_an_array_of_impossible_shape(place):
    huge = b"\x8a\x08" + struct.pack("<q", 2**62)
    content = pickle.dumps(np.empty((0, 9, 9)), 2)
    assert b"K\x00K\x09K\x09\x87" in content
    return database(place, content.replace(b"K\x00K\x09K\x09\x87", b"K\x00" + huge * 2 + b"\x87"))


@hostile("DeepPhysX", "none of DeepPhysX's")
def counts_without_end(place):
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS x FROM n"
    return database(place, None, f"CREATE VIEW training AS {endless}")


@hostile("DeepPhysX", "is computed")
def computes_gigabytes(place):
    schema = "CREATE TABLE training (id INTEGER PRIMARY KEY, y, x AS (zeroblob(1000000000)))"
    with sqlite3.connect(place.here / "a_training_0.db") as made:
        made.execute(schema)
        made.execute("INSERT INTO training (y) VALUES (1)")
    made.close()
    return DATABASE


@hostile("DeepPhysX", "more rows than bytes")
def has_a_tree_whose_branches_are_one(place):
    """Each page of the tree names the next one hundreds of times: 400 ** 15 rows in 70 kB."""
    words = database(place)
    with sqlite3.connect(place.here / "a_training_0.db") as made:
        made.executemany("INSERT INTO training (x) VALUES (?)", [(1.0,)] * 20000)
        (root,) = made.execute("SELECT rootpage FROM sqlite_master").fetchone()
    made.close()
    content = bytearray((place.here / "a_training_0.db").read_bytes())
    size = struct.unpack(">H", content[16:18])[0]
    pages = [root, *range(root + 1, root + 15)]
    leaf = next(
        page
        for page in range(pages[-1] + 1, len(content) // size)
        if content[(page - 1) * size] == 13
    )
    for page, below in zip(pages, [*pages[1:], leaf], strict=True):
        cell = struct.pack(">I", below) + b"\x01"
        count, start = 400, size - len(cell)
        head = struct.pack(">BHHHBI", 5, 0, count, start, 0, below)
        body = head + struct.pack(">H", start) * count
        content[(page - 1) * size : page * size] = body.ljust(start, b"\0") + cell
    (place.here / "a_training_0.db").write_bytes(content)
    return words


@hostile("DeepPhysX", "not a regular file")
def is_a_folder_with_a_link(place):
    (place.here / "old").mkdir()
    (place.here / "old/a_training_IN_0.npy").symlink_to(place.secret)
    return ["import", "old", "made"]


@hostile("DeepPhysX", "no readable header|object")
def has_a_file_of_objects(place):
    (place.here / "old").mkdir()
    objects = np.array([Call(os.mkdir, "executed")], object)
    np.save(place.here / "old/a_training_IN_0.npy", objects)
    return ["import", "old", "made"]


# Logs -------------------------------------------------------------------------------------------


def log(place, change):
    shutil.copy(place.elsewhere.parent / "sound/a.h5", place.here)
    with h5py.File(place.here / "a.h5", "a") as file:
        change(file)
    return ["log", "a.h5", "--replay", "out.rrd"]


def constants(place, **values):
    def change(file):
        plain = json.loads(file["constants"][:].tobytes()) | values
        del file["constants"]
        file["constants"] = np.frombuffer(json.dumps(plain).encode(), np.uint8)

    return log(place, change)


@hostile("log", "not an installed plugin")
def names_code_as_its_engine(place):
    return constants(place, backend=f"{place.here}/evil.py:Env")


@hostile("log", "unknown kind")
def has_a_world_of_programs(place):
    return constants(place, world={"kind": "Popen", "args": ["touch", "executed"]})


@hostile("log", "contiguously")
def has_virtual_columns(place):
    def change(file):
        shape = file["float64/values"].shape
        del file["float64/values"]
        layout = h5py.VirtualLayout(shape, "f8")
        layout[:, :2] = h5py.VirtualSource(str(place.secret), "x", (shape[0], 2))
        file["float64"].create_virtual_dataset("values", layout)

    return log(place, change)


@hostile("log", "frames")
def lasts_for_ages(place):
    def change(file):
        values = file["float64/values"][:]
        values[-1, 0] = 1e12
        file["float64/values"][:] = values

    return log(place, change)


@hostile("log", "nested too deeply")
def has_deep_constants(place):
    def change(file):
        del file["constants"]
        file["constants"] = np.frombuffer(b'{"a":' * 10**5, np.uint8)

    return log(place, change)


# Robots -----------------------------------------------------------------------------------------

BODY = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
)


def robot(place, text, encoding="utf-8", **options):
    (place.here / "r.urdf").write_bytes(text.encode(encoding))
    code = f"from physx_gym import RobotEnv; RobotEnv('r.urdf', 0.02, **{options}).reset()"
    return ["-c", code]


def chain(count):
    links = "".join(f'<link name="l{n}">{BODY}</link>' for n in range(count))
    joint = '<joint name="j{}" type="continuous"><parent link="l{}"/><child link="l{}"/></joint>'
    joints = "".join(joint.format(n, n, n + 1) for n in range(count - 1))
    return f'<robot name="r">{links}{joints}</robot>'


LAUGHS = "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(12))


@hostile("URDF", "DOCTYPE")
def has_entities_of_entities(place):
    return robot(place, f'<!DOCTYPE r [<!ENTITY a0 "ha">{LAUGHS}]><robot name="&a12;"/>')


@hostile("URDF", "UTF-16")
def has_them_in_another_encoding(place):
    text = f'<!DOCTYPE r [<!ENTITY a0 "ha">{LAUGHS}]><robot name="&a12;"/>'
    return robot(place, f'<?xml version="1.0" encoding="utf-16"?>{text}', encoding="utf-16")


@hostile("URDF", "DOCTYPE")
def includes_another_file(place):
    entity = f'<!DOCTYPE r [<!ENTITY a SYSTEM "{place.elsewhere}/secret.txt">]>'
    return robot(place, f'{entity}<robot name="r"><link name="l">&a;</link></robot>')


@hostile("URDF", "2000 elements")
def has_two_thousand_links(place):
    return robot(place, chain(2000))


@hostile("URDF", "degrees of freedom")
def has_four_hundred_joints_for_pinocchio(place):
    return robot(place, chain(400), backend="pinocchio")


@hostile("URDF", "no link")
def is_nested_a_million_times(place):
    return robot(place, '<robot name="r">' + "<a>" * 10**6 + "</a>" * 10**6 + "</robot>")


@hostile("URDF", "not a regular file")
def is_a_pipe(place):
    os.mkfifo(place.here / "r.urdf")
    return ["-c", "from physx_gym import RobotEnv; RobotEnv('r.urdf', 0.02)"]


END = (
    f'<link name="m">{BODY}</link><joint name="j" type="continuous"><parent link="l"/>'
    '<child link="m"/></joint></robot>'
)


def shaped(place, mesh, content):
    (place.here / mesh).write_bytes(content)
    geometry = f'<geometry><mesh filename="{place.here / mesh}"/></geometry>'
    shape = f"<collision>{geometry}</collision><visual>{geometry}</visual>"
    return robot(
        place, f'<robot name="r"><link name="l">{BODY}{shape}</link>{END}', fixed_base=False
    )


@hostile("mesh", "cannot be read")
def claims_four_thousand_million_triangles(place):
    return shaped(place, "m.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(500))


@hostile("mesh", "cannot be read")
def names_vertices_that_do_not_exist(place):
    return shaped(place, "m.obj", b"v 0 0 0\n" * 3 + b"f 1 2 999999999\nf -5 -6 -7\n")


@hostile("mesh", "")
def names_another_file_for_its_material(place):
    near = os.path.relpath(place.elsewhere, place.here)
    libraries = f"mtllib {place.elsewhere}/secret.txt\nmtllib {near}/secret.txt\n"
    text = f"{libraries}v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    faces = "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    return shaped(place, "m.obj", (text + "usemtl a\n" + faces).encode())


@hostile("mesh", "cannot be read")
def is_a_collada_of_entities(place):
    text = f'<!DOCTYPE r [<!ENTITY a0 "ha">{LAUGHS}]><COLLADA version="1.4.1">&a12;</COLLADA>'
    return shaped(place, "m.dae", text.encode())


# Other ------------------------------------------------------------------------------------------


@hostile("mesh", "more than 134217728 bytes")
def is_larger_than_the_memory(place):
    words = shaped(place, "m.stl", b"")
    os.truncate(place.here / "m.stl", 2**36)
    return words


@hostile("checkpoint", r"checkpoint\.toml describes a .*cannot be created.*layers")
def has_arguments_that_fit_no_network(place):
    return describe(
        place, lambda text: re.sub(r"layers = \[[^\]]*\]", 'layers = "x"', text), "torch"
    )


@hostile("checkpoint", r"checkpoint\.toml is invalid")
def names_a_number(place):
    return swap(place, '"toy/linear"', "5")


@hostile("statistics", "65536 characters")
def has_a_line_of_a_gigabyte(place):
    place.copy("sessions")
    with (place.here / "sessions/net/stats/scalars.csv").open("ab") as file:
        file.truncate(2**32)
    return ["stats", "sessions/net"]


@hostile("statistics", "damaged")
def has_numbers_that_are_none(place):
    place.copy("sessions")
    with (place.here / "sessions/net/stats/scalars.csv").open("a") as file:
        file.write(f"epoch,{'9' * 10**4},\x1b[31mloss,__import__('os')\n")
    return ["stats", "sessions/net"]


@hostile("configuration", "nested too deeply")
def is_nested_ten_thousand_times(place):
    (place.here / "c.toml").write_text("a = " + "[" * 10**5)
    return ["generate", "--config", "c.toml"]


@hostile("configuration", "64 parts")
def has_one_key_of_many_parts(place):
    (place.here / "c.toml").write_text("[" + "a." * 10**5 + "a]")
    return ["generate", "--config", "c.toml"]


@hostile("pipeline", "nested too deeply")
def is_nested_json(place):
    (place.here / "p.json").write_text('{"a":' * 10**5)
    return ["-c", "from physx_gym import load_pipeline; load_pipeline('p.json')"]


# The test -----------------------------------------------------------------------------------------


def test_there_are_files_of_every_kind():
    assert len(CASES) >= 40
    assert len({name.partition(":")[0] for name in CASES}) >= 10


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_costs_little_and_runs_nothing(place, name, record_property):
    make, message = CASES[name]
    words = list(map(str, make(place)))
    words = words if words[0] == "-c" else ["-m", "physx_core", *words]
    result = place.here / "result.json"
    command = [sys.executable, MEASURED, result, sys.executable, *words]
    with Watched(place.elsewhere) as watched:
        done = subprocess.run(
            list(map(str, command)),
            cwd=place.here,
            env={**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH", "")},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=HANGS,
            check=True,
        )
        assert not watched.was_read()
    found = json.loads(result.read_text())
    for key, value in found.items():
        record_property(key, value)
    print(f"{name}: {found} {done.stderr[-300:]}")
    assert not list(place.here.rglob("executed"))
    assert found["seconds"] < SECONDS
    assert found["bytes"] < NBYTES
    assert not (place.here.parent / "executed").exists()
    assert "4.25" not in done.stdout
    if not message:  # harmless
        assert found["status"] == 0, done.stderr
        return
    assert found["status"] == 1, done.stdout + done.stderr
    assert re.search(r"^(physx: |physx_\w+\.errors\.)\w+Error: ", done.stderr, re.M), done.stderr
    assert re.search(message, done.stderr), done.stderr
    assert words[0] == "-c" or "Traceback" not in done.stderr
