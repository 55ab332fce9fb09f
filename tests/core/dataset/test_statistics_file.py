"""Statistics of rows: arrays in a file beside the manifest, which is never stale."""

import json
import os
import shutil
import zlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from safetensors.numpy import load_file, save

from physx_core import Dataset, Field
from physx_core.cli import main

pytestmark = pytest.mark.processes

PARTS = ("mean", "std", "minimum", "maximum")


def rows_of(count, shape=(3,), seed=0):
    return {"x": np.random.default_rng(seed).normal(50.0, 2.0, size=(count, *shape))}


def write(folder, *blocks, size=1.7e-5, **options):
    """Write blocks of rows to partitions of few rows."""
    with Dataset.create(folder, max_file_size=size, **options) as dataset:
        for block in blocks:
            dataset.append("training", block)


def manifest(folder):
    return json.loads((folder / "dataset.json").read_text())


def store(folder, plain):
    """Write a manifest with a valid checksum."""
    plain = {name: value for name, value in plain.items() if name != "crc32"}
    body = json.dumps(plain, indent=1).encode()[:-2]
    (folder / "dataset.json").write_bytes(body + b',\n "crc32": "%08x"\n}' % zlib.crc32(body))


def files_of(folder):
    """Names of the files of statistics."""
    return sorted(path.name for path in folder.glob("statistics_*"))


def statistics_file(folder):
    (name,) = files_of(folder)
    assert manifest(folder)["statistics"]["file"] == name
    return folder / name


def assert_right(found, rows):
    """Check a normalization against all rows."""
    np.testing.assert_allclose(found["x"].mean, rows.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found["x"].std, rows.std(axis=0), rtol=1e-9)
    assert_array_equal(found["x"].minimum, rows.min(axis=0))
    assert_array_equal(found["x"].maximum, rows.max(axis=0))


# Size -------------------------------------------------------------------------------------------


def test_the_manifest_of_a_field_of_128_cubed_is_small(folder):
    with Dataset.create(folder) as dataset:
        dataset.define_fields("training", [Field("x", (128,) * 3, "float32")])
        dataset.append("training", {"x": np.ones((2, 128, 128, 128), "float32")})
    assert (folder / "dataset.json").stat().st_size < 20_000
    with Dataset.open(folder) as dataset:
        assert (dataset.normalization["x"].mean == 1).all()


def test_the_manifest_grows_with_partitions_by_the_same_at_any_width(tmp_path):
    growth = []
    for width in (300, 20_000):
        sizes = []
        for count in (2, 6):  # one row fills a partition
            place = tmp_path / f"{width}-{count}"
            write(place, rows_of(count, (width,)), size=(16_388 + 8 * width) * 1e-9)
            assert len(manifest(place)["modes"]["training"]["partitions"]) == count
            sizes.append((place / "dataset.json").stat().st_size)
        growth.append(sizes[1] - sizes[0])
    assert growth[0] == growth[1]


# Content ----------------------------------------------------------------------------------------


def test_any_reader_of_safetensors_finds_all_that_merging_needs(folder):
    rows = rows_of(60)
    write(folder, rows)
    stored = load_file(statistics_file(folder))
    mean = rows["x"].mean(axis=0)
    wanted = {
        "count": np.array(60),
        "mean": mean,
        "squares": np.square(rows["x"] - mean).sum(axis=0),
        "minimum": rows["x"].min(axis=0),
        "maximum": rows["x"].max(axis=0),
    }
    assert stored.keys() == {f"training/x/{part}" for part in wanted}
    for part, values in wanted.items():
        np.testing.assert_allclose(stored[f"training/x/{part}"], values, rtol=1e-12)


def test_closing_and_reopening_changes_no_bit(tmp_path):
    """Partitions are the same either way: only how often the statistics were stored differs."""
    rows = rows_of(400, seed=3)["x"]
    write(tmp_path / "once", {"x": rows}, size=1.88e-5)
    parts = manifest(tmp_path / "once")["modes"]["training"]["partitions"]
    start = parts[0]["rows"]
    write(tmp_path / "often", {"x": rows[:start]}, size=1.88e-5)
    for part in parts[1:]:
        with Dataset.open(tmp_path / "often", writable=True, max_file_size=1.88e-5) as dataset:
            dataset.append("training", {"x": rows[start : start + part["rows"]]})
        start += part["rows"]
    assert statistics_file(tmp_path / "often").name == statistics_file(tmp_path / "once").name
    with Dataset.open(tmp_path / "once") as one, Dataset.open(tmp_path / "often") as two:
        for part in PARTS:
            first, second = (getattr(each.normalization["x"], part) for each in (one, two))
            assert_array_equal(first, second)


def test_modes_keep_theirs_when_another_changes(folder):
    write(folder, rows_of(30))
    other = rows_of(20, (2, 2), seed=5)
    with Dataset.open(folder, writable=True) as dataset:
        dataset.append("validation", other)
    stored = load_file(statistics_file(folder))
    assert stored["training/x/count"] == 30 and stored["validation/x/count"] == 20
    with Dataset.open(folder, writable=True) as dataset:
        dataset.update("validation", 3, {"x": np.zeros((2, 2))})
    other["x"][3] = 0
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, rows_of(30)["x"])
        assert_right(dataset.normalization_of("validation"), other["x"])


@pytest.mark.parametrize("shape", [(), (0,), (2, 0)])
def test_scalars_and_empty_fields_have_statistics_too(folder, shape):
    write(folder, {"x": np.ones((50, *shape))})
    with Dataset.open(folder) as dataset:
        assert dataset.normalization["x"].mean.shape == shape
        assert dataset.verify() == []
    assert load_file(statistics_file(folder))["training/x/count"] == 50


def test_a_dataset_without_floats_has_no_file(folder):
    write(folder, {"n": np.arange(40)})
    assert files_of(folder) == [] and "statistics" not in manifest(folder)
    with Dataset.open(folder) as dataset:
        assert dataset.normalization == {} and dataset.verify() == []


# When it is written -----------------------------------------------------------------------------


def test_only_sealing_and_closing_write_it(folder):
    write(folder, rows_of(40))
    before = statistics_file(folder).stat().st_ino
    with Dataset.open(folder, writable=True, max_file_size=1.7e-5) as dataset:
        dataset.update_info(seed=3)
        dataset.define_fields("validation", [Field("y", (2,))])
        dataset.append("training", rows_of(1))  # begins a partition
        assert statistics_file(folder).stat().st_ino == before
        dataset.append("training", rows_of(100))  # fills it
    assert statistics_file(folder).stat().st_ino != before
    with Dataset.open(folder) as dataset:
        rows = [block["x"] for block in (rows_of(40), rows_of(1), rows_of(100))]
        assert_right(dataset.normalization, np.concatenate(rows))


def test_full_disk_keeps_previous_statistics(small_disk):
    folder = small_disk / "data"
    rows, size = np.ones((2, 20_000)), 336_400e-9  # two rows fill a partition
    with Dataset.create(folder, max_file_size=size) as dataset:
        dataset.append("training", {"x": rows})
    before = statistics_file(folder).name
    ballast = small_disk / "ballast"
    dataset = Dataset.open(folder, writable=True, max_file_size=size)
    dataset.append("training", {"x": 3 * rows})
    free = os.statvfs(small_disk)
    ballast.write_bytes(bytes(max(0, free.f_bavail * free.f_bsize - 400_000)))
    dataset.close()  # there is no room for the statistics
    assert manifest(folder)["statistics"]["file"] == before
    assert files_of(folder) == [before]
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, np.concatenate([rows, 3 * rows]))
    ballast.unlink()
    Dataset.open(folder, writable=True).close()
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, np.concatenate([rows, 3 * rows]))
        assert dataset.verify() == []
    assert load_file(statistics_file(folder))["training/x/count"] == 4


# Lost, damaged, stale ---------------------------------------------------------------------------


def spoil(path, how):
    if how == "gone":
        path.unlink()
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "flipped":
        content = bytearray(path.read_bytes())
        content[-5] ^= 16
        path.write_bytes(content)
    elif how == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.unlink()
        path.symlink_to("/dev/zero")


HOWS = ("gone", "empty", "flipped", "folder", "link")


@pytest.mark.parametrize("how", HOWS)
def test_without_it_statistics_come_from_the_rows(folder, how):
    rows = rows_of(90)
    write(folder, rows)
    path = statistics_file(folder)
    spoil(path, how)
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, rows["x"])
        (problem,) = dataset.verify()
    assert path.name in problem and "No row is lost" in problem and "--repair" in problem


@pytest.mark.parametrize("how", ["gone", "flipped"])
def test_repair_stores_it_again_and_says_so(folder, how, capsys):
    rows = rows_of(90)
    write(folder, rows)
    name = statistics_file(folder).name
    spoil(folder / name, how)
    assert main(["verify", str(folder)]) == 1
    assert name in capsys.readouterr().out
    (done,) = Dataset.repair(folder)
    assert name in done and "stored again" in done
    assert statistics_file(folder).exists()
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        assert_right(dataset.normalization, rows["x"])


@pytest.mark.parametrize("how", ["gone", "flipped"])
@pytest.mark.parametrize("step", ["append", "update", "merge", "remove", "recompute"])
def test_a_writer_that_lost_it_stores_all_of_it_again(folder, tmp_path, how, step):
    rows = rows_of(200)["x"]
    write(folder, {"x": rows}, size=1.88e-5)
    spoil(statistics_file(folder), how)
    with Dataset.open(folder, writable=True, max_file_size=1.88e-5) as dataset:
        if step == "append":
            dataset.append("training", {"x": rows[:7]})
            rows = np.concatenate([rows, rows[:7]])
        elif step == "update":
            dataset.update("training", 5, {"x": np.zeros(3)})
            rows[5] = 0
        elif step == "merge":
            write(tmp_path / "other", {"x": 2 * rows})
            dataset.merge(tmp_path / "other")
            rows = np.concatenate([rows, 2 * rows])
        elif step == "remove":
            rows = rows[dataset.remove_partition("training", 0) :]
        else:
            dataset.recompute_normalization()
        assert_right(dataset.normalization, rows)
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, rows)
        assert dataset.verify() == []
    assert load_file(statistics_file(folder))["training/x/count"] == len(rows)


def test_a_merged_dataset_that_lost_its_own_is_read_instead(folder, tmp_path):
    write(folder, rows_of(50))
    write(tmp_path / "other", rows_of(70, seed=4))
    statistics_file(tmp_path / "other").unlink()
    with Dataset.open(folder, writable=True) as dataset:
        dataset.merge(tmp_path / "other")
    with Dataset.open(folder) as dataset:
        both = np.concatenate([rows_of(50)["x"], rows_of(70, seed=4)["x"]])
        assert_right(dataset.normalization, both)
        assert dataset.verify() == []
    assert load_file(statistics_file(folder))["training/x/count"] == 120


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("mean", np.zeros(4)),
        ("mean", np.full(3, np.nan)),
        ("mean", np.zeros(3, "float32")),
        ("squares", np.full(3, -1.0)),
        ("count", np.array(89)),
        ("count", np.array(-1)),
        ("count", None),
        ("more", np.zeros(3)),
    ],
)
def test_arrays_that_do_not_fit_are_not_believed(folder, part, value):
    """Their checksum is right: whoever wrote them meant it."""
    rows = rows_of(90)
    write(folder, rows)
    path = statistics_file(folder)
    arrays = {**load_file(path), f"training/x/{part}": value}
    content = save({name: array for name, array in arrays.items() if array is not None})
    path.unlink()
    crc32 = f"{zlib.crc32(content):08x}"
    (folder / f"statistics_{crc32}.safetensors").write_bytes(content)
    store(
        folder,
        {
            **manifest(folder),
            "statistics": {"file": f"statistics_{crc32}.safetensors", "crc32": crc32},
        },
    )
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, rows["x"])


def test_a_manifest_of_before_finds_statistics_of_now_only_if_they_are_its_own(folder):
    write(folder, rows_of(50))
    early, first = (folder / "dataset.json").read_bytes(), statistics_file(folder)
    kept = first.read_bytes()
    with Dataset.open(folder, writable=True) as dataset:
        dataset.append("training", rows_of(30, seed=9))
    (folder / "dataset.json").write_bytes(early)
    for there in (False, True):
        if there:
            first.write_bytes(kept)
        with Dataset.open(folder) as dataset:  # the later partition has been adopted
            both = np.concatenate([rows_of(50)["x"], rows_of(30, seed=9)["x"]])
            assert_right(dataset.normalization, both)


def test_a_reader_keeps_on_reading_while_a_writer_replaces_it(folder):
    write(folder, rows_of(50))
    reader = Dataset.open(folder)
    with Dataset.open(folder, writable=True) as dataset:
        dataset.append("training", rows_of(30, seed=9))
    assert_right(reader.normalization, rows_of(50)["x"])
    assert reader.verify() == []
    reader.refresh()
    both = np.concatenate([rows_of(50)["x"], rows_of(30, seed=9)["x"]])
    assert_right(reader.normalization, both)
    reader.close()


def test_leftovers_of_killed_writer_are_removed(folder):
    write(folder, rows_of(50))
    kept = statistics_file(folder)
    for name in ("statistics_00000000.safetensors", "statistics_12345678.safetensors.tmp"):
        shutil.copy(kept, folder / name)
    own = ("statistics_of_mine.safetensors", "statistics_0000.txt")
    for name in own:
        (folder / name).write_text("mine")
    Dataset.open(folder, writable=True).close()
    assert files_of(folder) == sorted([kept.name, *own])


def test_it_stays_as_long_as_the_manifest_refers_to_it(folder, tmp_path):
    """Removed rows leave no statistics, so a list of further partitions cannot name a new file."""
    with Dataset.create(folder, max_file_size=1e-5) as dataset:
        dataset.define_fields("other", [Field("k", (200,), "i8")])
        dataset.append("training", rows_of(3, (100,)))
        dataset.flush()
        dataset.remove_partition("training", 1, "run")
        dataset.update_info(notes="long" * 2000)  # it is not written anew for few partitions
        for number in range(4):
            dataset.append("other", {"k": np.ones((1, 200), "i8")})
            dataset.flush()
            copy = shutil.copytree(folder, tmp_path / f"copy_{number}")
            with Dataset.open(copy) as killed:
                assert killed.verify() == []
        assert len(files_of(folder)) == 1
    with Dataset.open(folder) as dataset:
        assert_right(dataset.normalization, rows_of(3, (100,))["x"][[0, 2]])


def test_read_only_folder_permissions(folder):
    rows = rows_of(50)
    write(folder, rows)
    statistics_file(folder).unlink()
    folder.chmod(0o500)
    try:
        with Dataset.open(folder) as dataset:
            assert_right(dataset.normalization, rows["x"])
    finally:
        folder.chmod(0o700)
