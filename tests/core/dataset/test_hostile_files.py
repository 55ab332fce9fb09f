"""Untrusted datasets: any content leads to an error, and nothing else is touched."""

import json
import os
import shutil
import zlib

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.errors import DatasetError

N = 100
ROWS = {"x": np.random.default_rng(0).normal(size=(N, 5)), "n": np.arange(N, dtype="int32")}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The folder of a sound dataset of three partitions."""
    folder = tmp_path_factory.mktemp("sound") / "data"
    with Dataset.create(folder, max_file_size=1.82e-5) as dataset:
        dataset.define_fields("training", [Field("x", (5,), unit="m"), Field("n", (), "int32")])
        dataset.append("training", ROWS)
    return folder


@pytest.fixture
def plain(sound, folder):
    """The manifest of a copy of it, as plain data."""
    shutil.copytree(sound, folder)
    return json.loads((folder / "dataset.json").read_text())


def store(folder, plain, **options):
    """Write a manifest with a valid checksum."""
    plain = {name: value for name, value in plain.items() if name != "crc32"}
    body = json.dumps(plain, indent=1, **options).encode()[:-2]
    (folder / "dataset.json").write_bytes(body + b',\n "crc32": "%08x"\n}' % zlib.crc32(body))


def change(plain, path, value):
    *way, last = path
    for step in way:
        plain = plain[step]
    if value is ...:
        del plain[last]
    else:
        plain[last] = value


MODE = ("modes", "training")
FIRST = (*MODE, "partitions", 0)
X = (*MODE, "fields", 0)
STATISTICS = ("statistics",)

IMPOSSIBLE = [
    ((*FIRST, "rows"), -1),
    ((*FIRST, "rows"), 10**30),
    ((*FIRST, "rows"), 2**61),
    ((*FIRST, "rows"), 44.0),
    ((*FIRST, "rows"), "44"),
    ((*FIRST, "rows"), True),
    ((*FIRST, "rows"), None),
    ((*FIRST, "rows"), float("nan")),
    ((*FIRST, "rows"), float("inf")),
    ((*FIRST, "rows"), ...),
    ((*FIRST, "index"), -1),
    ((*FIRST, "index"), 1),
    ((*FIRST, "index"), "../../0"),
    ((*FIRST, "first_row"), -5),
    ((*FIRST, "sealed"), "yes"),
    ((*FIRST, "sealed"), 1),
    ((*FIRST, "session"), ".."),
    ((*FIRST, "session"), "../outside/run"),
    ((*FIRST, "session"), "/etc/passwd"),
    ((*FIRST, "session"), "a/b"),
    ((*FIRST, "session"), "a\0b"),
    ((*FIRST, "session"), "a" * 5000),
    ((*FIRST, "session"), 5),
    ((*FIRST, "session"), None),
    ((*FIRST, "offsets"), {}),
    ((*FIRST, "offsets"), []),
    ((*FIRST, "offsets", "x"), -4096),
    ((*FIRST, "offsets", "x"), 2**70),
    ((*FIRST, "offsets", "../x"), 0),
    ((*FIRST, "crc32"), {"x": "00000000"}),
    ((*FIRST, "crc32", "x"), "no number"),
    ((*FIRST, "crc32", "x"), 17),
    (FIRST, []),
    (FIRST, None),
    ((*MODE, "partitions"), {"0": 1}),
    ((*MODE, "partitions"), None),
    ((*MODE, "fields"), []),
    ((*MODE, "fields"), None),
    ((*X, "name"), "../x"),
    ((*X, "name"), "x/y"),
    ((*X, "name"), "n"),
    ((*X, "name"), 5),
    ((*X, "name"), "x" * 1000),
    ((*X, "dtype"), "O"),
    ((*X, "dtype"), "<U8"),
    ((*X, "dtype"), None),
    ((*X, "dtype"), "f8,f8"),
    ((*X, "dtype"), [["a", "<f8"]]),
    ((*X, "dtype"), {"names": ["a"], "formats": ["O"]}),
    ((*X, "dtype"), "__import__('os')"),
    ((*X, "shape"), [-5]),
    ((*X, "shape"), [2**40, 2**40]),
    ((*X, "shape"), [2**62]),
    ((*X, "shape"), [1] * 100),
    ((*X, "shape"), 5),
    ((*X, "shape"), "5"),
    ((*X, "shape"), [5.0]),
    ((*X, "shape"), None),
    ((*X, "unit"), 5),
    ((*X, "role"), "root"),
    ((*X, "role"), ["training"]),
    (STATISTICS, []),
    (STATISTICS, None),
    ((*STATISTICS, "file"), "../statistics_00000000.safetensors"),
    ((*STATISTICS, "file"), "/dev/zero"),
    ((*STATISTICS, "file"), 5),
    ((*STATISTICS, "file"), ...),
    ((*STATISTICS, "crc32"), 5),
    ((*STATISTICS, "crc32"), "00000000"),
    ((*STATISTICS, "crc32"), "-1"),
    ((*STATISTICS, "crc32"), "f" * 10**4),
    ((*STATISTICS, "crc32"), ...),
    (MODE, []),
    (MODE, {}),
    (("modes",), []),
    (("modes",), None),
    (("modes",), {"../x": {"fields": [], "partitions": []}}),
    (("info",), []),
    (("info",), "text"),
    (("versions",), {"python": 3}),
    (("versions",), ["3.11"]),
    (("format",), "other"),
    (("format",), ...),
    (("format_version",), 0),
    (("format_version",), 3),
    (("format_version",), -1),
    (("format_version",), "1"),
    (("format_version",), True),
    (("format_version",), 10**400),
    (("format_version",), None),
]


@pytest.mark.parametrize(("path", "value"), IMPOSSIBLE)
def test_impossible_values_are_rejected(folder, plain, path, value):
    change(plain, path, value)
    store(folder, plain)
    with pytest.raises(DatasetError, match=r"dataset\.json"):
        Dataset.open(folder)
    with pytest.raises(DatasetError, match=r"dataset\.json"):
        Dataset.open(folder, writable=True)


def test_a_partition_that_is_listed_twice_is_rejected(folder, plain):
    partitions = plain["modes"]["training"]["partitions"]
    partitions.append(partitions[0])
    store(folder, plain)
    with pytest.raises(DatasetError, match="twice"):
        Dataset.open(folder)


@pytest.mark.parametrize("value", [10**9, 2**40, 2**50])
@pytest.mark.parametrize("key", ["rows", "offset"])
def test_no_memory_is_allocated_for_missing_rows(folder, plain, key, value):
    first = plain["modes"]["training"]["partitions"][0]
    if key == "rows":
        first["rows"] = value
    else:
        first["offsets"]["x"] = value
    store(folder, plain)
    with Dataset.open(folder) as dataset:
        assert dataset.verify()
        for read in (
            lambda: dataset["training"]["x"][:],
            lambda: dataset["training"]["x"][0],
            lambda: list(dataset.batches("training", 32, shuffle=True, seed=0)),
            lambda: np.asarray(dataset["training"]["x"]),
            lambda: dataset.recompute_normalization(),
        ):
            with pytest.raises(DatasetError):
                read()


def test_a_huge_manifest_is_not_read(folder, plain):
    os.truncate(folder / "dataset.json", 2**40)
    with pytest.raises(DatasetError, match="bytes"):
        Dataset.open(folder)


@pytest.mark.parametrize("text", ["[" * 10**5, '{"a":' * 10**5, "9" * 10**5, '"' + "a" * 10**6])
def test_text_that_is_hard_to_read_is_rejected(folder, plain, text):
    (folder / "dataset.json").write_text(text)
    with pytest.raises(DatasetError, match=r"dataset\.json"):
        Dataset.open(folder)


# Links, pipes and other files -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dataset.json", "run_training_x_0.h5"])
@pytest.mark.parametrize("kind", ["link", "pipe", "folder", "loop"])
def test_links_and_pipes_are_not_opened(folder, plain, tmp_path, name, kind):
    path = folder / name
    content = path.read_bytes()
    path.unlink()
    if kind == "link":
        (tmp_path / "outside").write_bytes(content)
        path.symlink_to(tmp_path / "outside")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    else:
        path.mkdir()
    with pytest.raises(DatasetError, match=name), Dataset.open(folder) as dataset:
        assert dataset.verify()
        _ = dataset["training"]["x"][:]
    with pytest.raises(DatasetError, match=name), Dataset.open(folder) as dataset:
        list(dataset.batches("training", 7))


@pytest.mark.parametrize(
    "name",
    ["dataset.json.tmp", "dataset.lock", "run.h5.tmp", "run.h5", "run_training_x_3.h5.tmp",
     "run_training_x_3.h5", "dataset.json.lock"],
)  # fmt: skip
def test_writing_follows_no_link(folder, plain, tmp_path, name):
    target = tmp_path / "precious"
    target.write_text("keep me")
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(target)
    for shared in (False, True):
        try:
            with Dataset.open(folder, writable=True, shared=shared) as dataset:
                dataset.append("training", ROWS)
        except DatasetError as error:
            assert "link" in str(error)
    assert target.read_text() == "keep me"
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["n"][:N], ROWS["n"])


def test_creating_a_dataset_follows_no_link(folder, tmp_path):
    target = tmp_path / "precious"
    target.write_text("keep me")
    folder.mkdir()
    for name in ("dataset.json.tmp", "run_training_x_0.h5.tmp"):
        (folder / name).symlink_to(target)
    with Dataset.create(folder) as dataset:
        dataset.append("training", ROWS)
    assert target.read_text() == "keep me"


# Partition files --------------------------------------------------------------------------------


def unsealed(folder, plain):
    """Turn the first partition into one that only its files describe."""
    first = plain["modes"]["training"]["partitions"][0]
    first["sealed"] = False
    store(folder, plain)
    return folder / "run_training_x_0.h5", 44


def rewrite(path, fill, **changes):
    """Replace a partition file by one made with h5py."""
    with h5py.File(path) as file:
        attributes = dict(file.attrs) | changes
    path.unlink()
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)
        fill(file)


def fails(folder):
    with Dataset.open(folder) as dataset:
        assert dataset.verify()
        with pytest.raises(DatasetError, match=r"run_training_x_0\.h5"):
            _ = dataset["training"]["x"][:]
    with pytest.raises(DatasetError, match=r"run_training_x_0\.h5"):
        Dataset.open(folder, writable=True)


def fill_with(data=None, rows=None):
    def fill(file):
        if data is not None:
            data(file)
        else:
            file["data"] = np.ones((44, 5))
        if rows is not None:
            rows(file)
        else:
            file["rows"] = np.uint64(44)

    return fill


HOSTILE_FILES = {
    "external link": fill_with(lambda f: f.__setitem__("data", h5py.ExternalLink("o.h5", "/d"))),
    "soft link": fill_with(lambda f: f.__setitem__("data", h5py.SoftLink("/rows"))),
    "link for rows": fill_with(rows=lambda f: f.__setitem__("rows", h5py.SoftLink("/data"))),
    "external storage": fill_with(
        lambda f: f.create_dataset("data", (44, 5), "f8", external=[("/etc/passwd", 0, 1760)])
    ),
    "chunks": fill_with(lambda f: f.create_dataset("data", (44, 5), "f8", chunks=(4, 5))),
    "compression": fill_with(lambda f: f.create_dataset("data", (44, 5), "f8", compression="gzip")),
    "big-endian": fill_with(lambda f: f.create_dataset("data", data=np.ones((44, 5), ">f8"))),
    "text": fill_with(lambda f: f.create_dataset("data", data=["a"] * 44)),
    "compound": fill_with(lambda f: f.create_dataset("data", data=np.zeros(44, "f8,f8"))),
    "group": fill_with(lambda f: f.create_group("data")),
    "scalar": fill_with(lambda f: f.create_dataset("data", data=1.0)),
    "other shape": fill_with(lambda f: f.create_dataset("data", data=np.ones((44, 6)))),
    "other type": fill_with(lambda f: f.create_dataset("data", data=np.ones((44, 5), "f4"))),
    "many rows": fill_with(lambda f: f.create_dataset("data", (2**40, 5), "f8")),
    "array of rows": fill_with(rows=lambda f: f.create_dataset("rows", data=np.ones(9, "u8"))),
    "signed rows": fill_with(rows=lambda f: f.create_dataset("rows", data=-1)),
    "nothing": lambda f: None,
}


@pytest.mark.parametrize("kind", HOSTILE_FILES)
def test_hostile_partitions_are_rejected(folder, plain, kind):
    path, _ = unsealed(folder, plain)
    rewrite(path, HOSTILE_FILES[kind])
    fails(folder)


@pytest.mark.parametrize(
    "changes",
    [{"format_version": 2}, {"format": "x"}, {"role": "root"}, {"field": "../x"},
     {"partition": "many"}, {"unit": np.ones(3)}, {"mode": h5py.Empty("f8")}],
)  # fmt: skip
def test_hostile_attributes_are_rejected(folder, plain, changes):
    path, _ = unsealed(folder, plain)
    rewrite(path, fill_with(), **changes)
    with Dataset.open(folder) as dataset:
        assert dataset.verify()


def test_a_count_beyond_the_capacity_is_clipped(folder, plain):
    path, _ = unsealed(folder, plain)
    with h5py.File(path, "r+") as file:
        file["rows"][()] = 2**60
    with Dataset.open(folder) as dataset:
        assert dataset.num_samples("training") == N
        assert_array_equal(dataset["training"]["x"][:], ROWS["x"])


def test_opening_executes_nothing(folder, plain, tmp_path, monkeypatch):
    mark = tmp_path / "executed"
    plain["info"] = {
        "environment": f"os:system('touch {mark}')",
        "__class__": {"py/reduce": ["os.system", f"touch {mark}"]},
    }
    store(folder, plain)
    (folder / "physx_core.py").write_text(f"open({str(mark)!r}, 'w')")
    (folder / "conftest.py").write_text(f"open({str(mark)!r}, 'w')")
    with Dataset.open(folder) as dataset:
        assert dataset.info == plain["info"]
        assert_array_equal(dataset["training"]["n"][:], ROWS["n"])
        assert dataset.verify() == []
    assert not mark.exists()
