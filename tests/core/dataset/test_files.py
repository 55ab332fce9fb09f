import json
import os
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from safetensors.numpy import load_file
from xxhash import xxh3_64_intdigest

from physx_core import Dataset, Field
from physx_core.errors import DatasetError

pytestmark = pytest.mark.processes

N = 1000
ROWS = {
    "x": np.random.default_rng(0).normal(size=(N, 5)),
    "n": np.arange(N, dtype="int32"),
}
FIELDS = [Field("x", (5,), unit="m"), Field("n", (), "int32", role="additional")]


def write(folder, session="run", *, close=True, **options):
    """Write ROWS in many partitions of 340 rows; leave the last one open if not `close`."""
    dataset = Dataset.create(folder, session, max_file_size=3e-5, **options)
    dataset.define_fields("training", FIELDS)
    dataset.append("training", ROWS)
    if close:
        dataset.close()
    return dataset


def check(folder, rows=ROWS):
    with Dataset.open(folder) as dataset:
        assert dataset.num_samples("training") == len(rows["n"])
        for name in rows:
            assert_array_equal(dataset["training"][name][:], rows[name])
            batch = next(dataset.batches("training", len(rows["n"])))
            assert_array_equal(batch[name], rows[name])
        mean = dataset.normalization["x"].mean
        np.testing.assert_allclose(mean, rows["x"].mean(axis=0), rtol=1e-9, atol=1e-12)
        assert dataset.fields("training") == {field.name: field for field in FIELDS}
        assert dataset.verify() == []


def content(folder):
    return {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in sorted(folder.iterdir())}


def partitions(folder):
    plain = json.loads((folder / "dataset.json").read_text())
    return plain["modes"]["training"]["partitions"]


def abandoned(folder, copy):
    """Copy a dataset as it would be found if its writer were killed now."""
    shutil.copytree(folder, copy)
    return copy


# The format -----------------------------------------------------------------------------------


def test_h5py_reads_the_partitions_and_the_index(folder):
    write(folder, info={"seed": 1})
    names = {p.name for p in folder.glob("*.h5")}
    count = len(names) // 2
    assert names == {"run.h5"} | {
        f"run_training_{field}_{i}.h5" for field in "xn" for i in range(count)
    }
    assert count == 3
    for name, values in ROWS.items():
        parts = []
        for index in range(count):
            with h5py.File(folder / f"run_training_{name}_{index}.h5") as file:
                assert file["rows"][()] == len(file["data"])
                parts.append(file["data"][:])
                assert dict(file.attrs) == {
                    "format": "physx partition", "format_version": 4, "session": "run",
                    "mode": "training", "field": name, "partition": index,
                    "unit": "m" if name == "x" else "", "first_row": 340 * index,
                    "role": "training" if name == "x" else "additional",
                }  # fmt: skip
        assert_array_equal(np.concatenate(parts), values)
        with h5py.File(folder / "run.h5") as index:
            assert_array_equal(index[f"training/{name}"][:], values)
            assert index[f"training/{name}"].dtype == values.dtype
    with h5py.File(folder / "run.h5") as index:
        assert index["training/x"].attrs["unit"] == "m"
    plain = json.loads((folder / "dataset.json").read_text())
    assert plain["format_version"] == 1 and plain["info"] == {"seed": 1}
    assert [p["rows"] for p in plain["modes"]["training"]["partitions"]] == [340, 340, 320]
    stored = load_file(folder / plain["statistics"]["file"])
    assert stored["training/x/count"] == N
    assert_allclose(stored["training/x/mean"], ROWS["x"].mean(axis=0), atol=1e-12)


def test_partitions_respect_their_size(folder):
    write(folder)
    sizes = [p.stat().st_size for p in folder.glob("run_training_*.h5")]
    assert max(sizes) <= 30000


def test_a_row_larger_than_a_partition(folder):
    with Dataset.create(folder, max_file_size=1e-6) as dataset:
        dataset.append("training", {"x": np.arange(3000.0).reshape(3, 1000)})
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["x"], np.arange(3000.0).reshape(3, 1000))
        assert dataset.describe()[0]["partitions"] == 3


def test_the_folder_may_move(folder, tmp_path, monkeypatch):
    write(folder)
    folder.rename(tmp_path / "moved")
    monkeypatch.chdir("/")
    check(tmp_path / "moved")
    with h5py.File(tmp_path / "moved" / "run.h5") as index:
        assert_array_equal(index["training/x"][:], ROWS["x"])


def test_live_partitions_open_in_h5py(folder):
    with write(folder, close=False) as dataset:
        with h5py.File(folder / "run_training_x_2.h5") as file:
            assert file["data"].shape == (340, 5) and file["rows"][()] == 320
            assert_array_equal(file["data"][:320], ROWS["x"][680:])
            dataset.append("training", {name: values[:20] for name, values in ROWS.items()})
        with h5py.File(folder / "run_training_x_2.h5") as file:
            assert file["rows"][()] == 340
        assert dataset.verify() == []


def test_reading_leaves_every_byte_alone(folder, tmp_path):
    live = write(folder, close=False)
    killed = abandoned(folder, tmp_path / "killed")
    live.close()
    for place in (folder, killed):
        before = content(place)
        check(place)
        with Dataset.open(place) as dataset:
            dataset.recompute_normalization()
            dataset.refresh()
        assert content(place) == before


def test_durable_commits(folder):
    write(folder, durable=True)
    check(folder)


def test_a_session_continues_where_the_last_one_ended(folder):
    half = {name: values[:500] for name, values in ROWS.items()}
    with Dataset.create(folder, "one") as dataset:
        dataset.define_fields("training", FIELDS)
        dataset.append("training", half)
    before = content(folder)
    with Dataset.open(folder, writable=True, session="two") as dataset:
        dataset.append("training", {name: values[500:] for name, values in ROWS.items()})
    after = content(folder)
    check(folder)
    for name, was in before.items():
        changed = name in ("dataset.json", "dataset.lock", "one.h5") or "statistics" in name
        assert changed or after[name] == was
    for session in ("one", "two"):
        with h5py.File(folder / f"{session}.h5") as index:
            assert_array_equal(index["training/n"][:], ROWS["n"])
    with Dataset.open(folder, writable=True) as dataset:
        assert dataset.session == "two"
        dataset.append("training", half)
    assert (folder / "two_training_x_1.h5").exists()


def test_names_that_could_be_confused(folder):
    with Dataset.create(folder, "a") as dataset:
        dataset.append("training", {"validation_x": np.zeros(2)})
    with Dataset.open(folder, writable=True, session="a_training") as dataset:
        dataset.append("validation", {"x": np.ones(3)})
    with Dataset.open(folder) as dataset:
        assert not dataset["training"]["validation_x"][:].any()
        assert dataset["validation"]["x"][:].all()
        assert dataset.verify() == []


def test_nothing_heavy_is_imported_before_it_is_used(tmp_path):
    code = (
        "import sys, physx_core; physx_core.Dataset; "
        "assert not {'h5py', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


# What a killed writer leaves ------------------------------------------------------------------


def test_an_open_partition_is_read_and_then_sealed(folder, tmp_path):
    live = write(folder, close=False)
    killed = abandoned(folder, tmp_path / "killed")
    live.close()
    check(killed)
    with Dataset.open(killed, writable=True, max_file_size=3e-5) as dataset:
        assert len(h5py.File(killed / "run_training_x_2.h5")["data"]) == 320
        dataset.append("training", ROWS)
    check(killed, {name: np.concatenate([values] * 2) for name, values in ROWS.items()})
    with Dataset.open(killed) as dataset:
        assert [p["index"] for p in partitions(killed)] == [0, 1, 2, 3, 4, 5]


def test_stale_manifest_hides_no_row(folder, tmp_path):
    live = write(folder, close=False)
    early = (folder / "dataset.json").read_bytes()
    live.append("training", ROWS)
    live.close()
    (folder / "dataset.json").write_bytes(early)
    twice = {name: np.concatenate([values] * 2) for name, values in ROWS.items()}
    check(folder, twice)
    Dataset.open(folder, writable=True).close()
    check(folder, twice)
    assert all(p["sealed"] for p in partitions(folder))


def test_a_commit_counts_only_if_all_fields_made_it(folder, tmp_path):
    live = write(folder, close=False)
    killed = abandoned(folder, tmp_path / "killed")
    live.close()
    with h5py.File(killed / "run_training_x_2.h5", "r+") as file:
        file["rows"][()] = 330
        file["commits"][0] = 330, 330, xxh3_64_intdigest(b"")
    check(killed)
    Dataset.open(killed, writable=True).close()
    check(killed)


def test_a_partition_without_rows_is_forgotten(folder, tmp_path):
    live = write(folder, close=False)
    killed = abandoned(folder, tmp_path / "killed")
    live.close()
    for name in ROWS:
        shutil.copy(killed / f"run_training_{name}_2.h5", killed / f"run_training_{name}_3.h5")
        with h5py.File(killed / f"run_training_{name}_3.h5", "r+") as file:
            file["rows"][()] = 0
            file.attrs["partition"] = 3
    (killed / "run_training_x_4.h5.tmp").write_bytes(b"half")
    check(killed)
    Dataset.open(killed, writable=True).close()
    check(killed)
    assert not [p for p in killed.iterdir() if "_3" in p.name or "_4" in p.name]


@pytest.mark.parametrize("close", [True, False])
def test_a_lost_manifest_is_rebuilt(folder, tmp_path, close):
    live = write(folder, "session_1", close=close)
    killed = abandoned(folder, tmp_path / "killed")
    live.close()
    with Dataset.open(killed, writable=True, session="b") as dataset:
        dataset.append("training", {name: values[:10] for name, values in ROWS.items()})
    (killed / "dataset.json").unlink()
    rows = {name: np.concatenate([values, values[:10]]) for name, values in ROWS.items()}
    check(killed, rows)
    assert not (killed / "dataset.json").exists()
    Dataset.open(killed, writable=True).close()
    check(killed, rows)
    with Dataset.open(killed) as dataset:
        assert [p["session"] for p in partitions(killed)] == ["session_1"] * 3 + ["b"]


# Damage ---------------------------------------------------------------------------------------


def fails_to_read(folder, match, name="x"):
    with Dataset.open(folder) as dataset:
        problems = dataset.verify()
        assert len(problems) == 1
        with pytest.raises(DatasetError, match=match):
            dataset["training"][name][:]
        with pytest.raises(DatasetError, match=match):
            list(dataset.batches("training", 10, shuffle=True))
        with pytest.raises(DatasetError, match=match):
            dataset["training"][name][[0, 999]]
        return problems[0]


def test_a_truncated_partition(folder):
    write(folder)
    path = folder / "run_training_x_1.h5"
    size = path.stat().st_size
    os.truncate(path, size - 41)
    match = f"run_training_x_1.h5 is truncated: it has {size - 41} bytes, but {size}.*\\. 338 rows"
    assert "338 rows" in fails_to_read(folder, match)


@pytest.mark.parametrize("left", [0, 7, 1000, 12288 + 40 * 7 + 3])
def test_a_truncated_partition_that_was_open(folder, tmp_path, left):
    live = write(folder, close=False)
    killed = abandoned(folder, tmp_path / "killed")
    live.close()
    os.truncate(killed / "run_training_x_2.h5", left)
    with Dataset.open(killed) as dataset:
        assert len(dataset.verify()) == 1
        with pytest.raises(DatasetError, match=r"run_training_x_2\.h5") as caught:
            dataset.num_samples("training")
    if left > 12288:
        assert "7 rows" in str(caught.value)
    with pytest.raises(DatasetError):
        Dataset.open(killed, writable=True)


def test_a_missing_partition(folder):
    write(folder)
    (folder / "run_training_x_1.h5").unlink()
    assert "missing" in fails_to_read(folder, r"run_training_x_1\.h5 is missing")


def test_garbage_instead_of_a_partition(folder):
    write(folder)
    path = folder / "run_training_x_1.h5"
    path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size))
    fails_to_read(folder, r"run_training_x_1\.h5")
    (folder / "dataset.json").unlink()
    with pytest.raises(DatasetError, match=r"run_training_x_1\.h5"):
        Dataset.open(folder)


def test_verify_finds_changed_byte(folder):
    write(folder)
    path = folder / "run_training_n_1.h5"
    damaged = bytearray(path.read_bytes())
    damaged[partitions(folder)[1]["offsets"]["n"] + 340 * 4 - 1] ^= 1
    path.write_bytes(damaged)
    with Dataset.open(folder) as dataset:
        assert "checksum" in dataset.verify()[0] and str(path) in dataset.verify()[0]


def test_a_partition_of_something_else_is_found_by_verify(folder, tmp_path):
    write(folder)
    write(tmp_path / "other", "other")
    shutil.copy(tmp_path / "other" / "other_training_x_0.h5", folder / "run_training_x_0.h5")
    with Dataset.open(folder) as dataset:
        assert "another partition" in dataset.verify()[0]


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b'{"format": "x"}', b"\xff\xfe", b"null"])
def test_garbage_instead_of_the_manifest(folder, text):
    write(folder)
    (folder / "dataset.json").write_bytes(text)
    with pytest.raises(DatasetError, match=r"dataset\.json \(\d+ bytes\).*Dataset\.repair"):
        Dataset.open(folder)
    (folder / "dataset.json").unlink()
    check(folder)


def test_a_damaged_dataset_can_still_be_extended(folder):
    write(folder)
    (folder / "run_training_x_0.h5").unlink()
    with Dataset.open(folder, writable=True) as dataset:
        dataset.append("training", ROWS)
        assert_array_equal(dataset["training"]["n"][:], np.tile(ROWS["n"], 2))
        assert_array_equal(dataset["training"]["x"][340:1000], ROWS["x"][340:])
    with Dataset.open(folder) as dataset:
        assert len(dataset.verify()) == 1
