"""Truncated, emptied, overwritten and changed files: an error or the right rows, nothing else."""

import os
import random
import shutil
import time
import warnings

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from sizes import trials

from physx_core import Dataset, Field
from physx_core.errors import DatasetError

N = 1000
ROWS = {"x": np.random.default_rng(0).normal(size=(N, 5)), "n": np.arange(N, dtype="int32")}
FIELDS = [Field("x", (5,), unit="m"), Field("n", (), "int32", role="additional")]


def count_sealed(folder):
    with Dataset.open(folder) as dataset:
        return sum(part.sealed for part in dataset._manifest.modes["training"].partitions)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A closed dataset, and one whose writer was killed; three partitions each."""
    place = tmp_path_factory.mktemp("places")
    with Dataset.create(place / "closed", max_file_size=3e-5) as dataset:
        dataset.define_fields("training", FIELDS)
        dataset.append("training", ROWS)
        while count_sealed(place / "closed") < 2:
            time.sleep(0.01)  # full partitions are sealed beside the writing
            dataset.append("training", {name: values[:0] for name, values in ROWS.items()})
        shutil.copytree(place / "closed", place / "killed")
    return place


@pytest.fixture(params=["closed", "killed"])
def copy(request, places, tmp_path):
    """Return a function that makes a fresh copy of a dataset."""

    def make():
        shutil.rmtree(tmp_path / request.param, ignore_errors=True)
        return shutil.copytree(places / request.param, tmp_path / request.param)

    return make


def outcome(read):
    try:
        return read()
    except DatasetError:
        return None


def read_rows(dataset):
    return {name: dataset["training"][name][:] for name in ROWS}


def read_batch(dataset):
    return next(dataset.batches("training", N))


def read_some(dataset):
    index = np.arange(0, N, 7)
    return {name: dataset["training"][name][index] for name in ROWS}


def examine(folder):
    """Read a damaged dataset in every way; return whether it was noticed."""
    try:
        dataset = Dataset.open(folder)
    except DatasetError:
        return True
    with dataset:
        found = bool(dataset.verify())
        for read, index in (
            (read_rows, slice(None)), (read_batch, slice(None)), (read_some, slice(None, None, 7)),
        ):  # fmt: skip
            rows = outcome(lambda read=read: read(dataset))
            if rows is None:
                assert found, "reading fails, but nothing was found"
            elif not found or read is not read_some:
                for name, values in ROWS.items():
                    assert_array_equal(rows[name], values[index])
    return found


def repaired(folder):
    """Repair a dataset, and check that the remaining rows are right."""
    done = Dataset.repair(folder)
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        n = dataset["training"]["n"][:] if "training" in dataset else np.zeros(0, int)
        assert len(np.unique(n)) == len(n) and (np.diff(n) > 0).all()
        if len(n):
            assert_array_equal(dataset["training"]["x"][:], ROWS["x"][n])
            mean = dataset.normalization["x"].mean
            np.testing.assert_allclose(mean, ROWS["x"][n].mean(axis=0), atol=1e-12)
    assert Dataset.repair(folder) == []
    return done


def damages(content, step):
    """Yield possible damages of a file: each length, and then other bytes."""
    for length in range(0, len(content), step):
        yield content[:length]
    chance = random.Random(len(content))
    yield chance.randbytes(len(content))
    yield bytes(len(content))
    yield content[: len(content) // 2] + chance.randbytes(len(content) // 2)
    yield content + b"more"


def campaign(copy, step, *, repair_every):
    """Damage each file in each way; return how often, and how often it was noticed."""
    tried = noticed = 0
    folder = copy()
    for name in sorted(path.name for path in folder.iterdir()):
        content = (folder / name).read_bytes()
        for damaged in damages(content, step):
            (folder / name).write_bytes(damaged)
            noticed += examine(folder)
            tried += 1
            if tried % repair_every == 0:
                repaired(folder)
                folder = copy()
        (folder / name).write_bytes(content)
        assert not examine(folder)
    return tried, noticed


@pytest.mark.slow
def test_corrupt_files_give_no_wrong_rows(copy):
    tried, noticed = campaign(copy, 4500, repair_every=9)
    assert noticed > tried / 2


@pytest.mark.faults
def test_truncation_at_every_512th_byte_gives_no_wrong_rows(copy, record_property):
    record_property("tried, noticed", campaign(copy, 512, repair_every=40))


@pytest.mark.parametrize("name", ["run_training_x_1.h5", "run_training_n_0.h5", "dataset.json"])
def test_a_lost_file_gives_no_wrong_rows(copy, name):
    folder = copy()
    (folder / name).unlink()
    assert examine(folder) == (name != "dataset.json")
    assert repaired(folder)


def flips(folder, step):
    """Yield a file and its content with one bit flipped, for bits all over the dataset."""
    chance = random.Random(step)
    for path in sorted(folder.iterdir()):
        content = path.read_bytes()
        for start in range(0, len(content), step):
            place = min(len(content) - 1, start + chance.randrange(step))
            changed = bytearray(content)
            changed[place] ^= 1 << chance.randrange(8)
            yield path, content, bytes(changed), place


def flip_bits(places, tmp_path, step):
    """Flip bits in files of a closed dataset: rows are right, or the flip is noticed."""
    folder = shutil.copytree(places / "closed", tmp_path / "copy")
    tried = noticed = 0
    for path, content, changed, place in flips(folder, step):
        path.write_bytes(changed)
        found = examine(folder)
        path.write_bytes(content)
        tried, noticed = tried + 1, noticed + found
        rows = len(content) - len(content) % 4096  # where they begin is a page of its own
        if path.name == "dataset.json" or ("_training_" in path.name and place >= rows > 12000):
            assert found, f"bit of byte {place} of {path.name}"
    return tried, noticed


@pytest.mark.slow
def test_bit_flips_are_detected(places, tmp_path):
    tried, noticed = flip_bits(places, tmp_path, 1500)
    assert 0 < noticed < tried


@pytest.mark.faults
def test_many_bit_flips_are_detected(places, tmp_path, record_property):
    record_property("tried, noticed", flip_bits(places, tmp_path, trials(100, 300)))


def test_bit_flip_in_rows_is_detected_on_read(places, tmp_path):
    folder = shutil.copytree(places / "closed", tmp_path / "copy")
    path, chance = folder / "run_training_x_1.h5", random.Random(0)
    content = path.read_bytes()
    for _ in range(30):
        place = len(content) - 1 - chance.randrange(340 * 40)
        changed = bytearray(content)
        changed[place] ^= 1 << chance.randrange(8)
        path.write_bytes(changed)
        for dtype in (None, "float32"):
            with (
                Dataset.open(folder) as dataset,
                pytest.raises(DatasetError, match=r"run_training_x_1\.h5 was changed"),
            ):
                next(dataset.batches("training", 10, dtype=dtype))
        with (
            Dataset.open(folder) as dataset,
            pytest.raises(DatasetError, match=r"run_training_x_1\.h5 was changed"),
        ):
            dataset.recompute_normalization()
    os.utime(path)


@pytest.mark.faults
def test_bit_flips_in_open_partitions_crash_no_process(places, tmp_path):
    folder = shutil.copytree(places / "killed", tmp_path / "copy")
    chance = random.Random(1)
    path = folder / "run_training_x_2.h5"
    content = path.read_bytes()
    for _ in range(600):
        changed = bytearray(content)
        for _ in range(chance.choice((1, 1, 1, 8))):
            changed[chance.randrange(12288)] ^= 1 << chance.randrange(8)
        path.write_bytes(changed)
        try:
            with Dataset.open(folder) as dataset:
                dataset.verify()
                rows = outcome(lambda dataset=dataset: dataset["training"]["n"][:])
                if rows is not None:  # the number of rows itself may be what was flipped
                    assert_array_equal(rows[:680], ROWS["n"][:680])
        except DatasetError:
            continue


# Random damages ---------------------------------------------------------------------------------


def damaged(content, chance):
    """Return a file's content as a failing disk, program or person may leave it."""
    changed = bytearray(content)
    kind = chance.choice(("flip", "flip", "flip", "8 flips", "cut", "sector", "page", "grown"))
    if kind in ("flip", "8 flips"):
        for _ in range(8 if kind == "8 flips" else 1):
            changed[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    elif kind == "cut":
        del changed[chance.randrange(len(content)) :]
    elif kind == "grown":
        changed += chance.choice((b"more", bytes(4096), chance.randbytes(512)))
    else:
        size = 512 if kind == "sector" else 4096
        first = chance.randrange(0, len(content), size)
        changed[first : first + size] = bytes(len(changed[first : first + size]))
    return bytes(changed), kind


def check_prefix(dataset):
    """Check that the rows are the first of those that were written; return how many."""
    count = dataset.num_samples("training")
    for name, values in ROWS.items() if count else ():
        assert_array_equal(dataset["training"][name][:], values[:count])
    return count


def check_reading(folder, name):
    """Check that a reader of a damaged dataset gets all rows, an error, or, with a word, fewer."""
    try:
        with Dataset.open(folder) as dataset:
            problems = dataset.verify()
            assert not problems or any(name in problem for problem in problems)
            try:
                count = check_prefix(dataset)
                assert count == N or problems
                if count:
                    assert_array_equal(read_batch(dataset)["x"], ROWS["x"][:count])
            except DatasetError as error:
                assert name in str(error) and problems
    except DatasetError as error:
        assert name in str(error)


def check_writing(folder, name):
    """Check what the next writer of a damaged dataset finds: rows are missing only with a word."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            Dataset.open(folder, writable=True).close()
        except DatasetError as error:
            assert name in str(error)
            return
    with Dataset.open(folder) as dataset:
        if dataset.verify() == []:  # damaged blocks have been left out in all fields
            n = dataset["training"]["n"][:]
            assert (np.diff(n) > 0).all()
            assert_array_equal(dataset["training"]["x"][:], ROWS["x"][n])
            assert len(n) == N or any(str(folder) in str(w.message) for w in told)


def damage_at_random(folder, paths, tries, seed):
    """Damage one of some files in many ways: nobody ever gets other rows without a word."""
    chance = random.Random(seed)
    for number in range(tries):
        copy = shutil.copytree(folder, folder.with_name("damaged"))
        path = copy / chance.choice(paths)
        content, kind = damaged(path.read_bytes(), chance)
        path.write_bytes(content)
        try:
            check_reading(copy, path.name)
            if number % 2:
                check_writing(copy, path.name)
            repaired(copy)
        except Exception as error:
            error.add_note(f"Try {number}: {kind} of {path.name}")
            raise
        shutil.rmtree(copy)


DAMAGED = [
    ("closed", [f"run_training_{name}_{index}.h5" for name in ROWS for index in range(3)]),
    ("killed", [f"run_training_{name}_2.h5" for name in ROWS]),
    ("closed", ["dataset.json"]),
    ("killed", ["dataset.json"]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("place", "paths"), DAMAGED)
def test_random_corruption_gives_no_wrong_rows(places, tmp_path, place, paths):
    folder = shutil.copytree(places / place, tmp_path / "copy")
    damage_at_random(folder, paths, 15, 0)


@pytest.mark.faults
@pytest.mark.parametrize(("place", "paths"), DAMAGED)
def test_random_corruption_campaign_gives_no_wrong_rows(places, tmp_path, place, paths):
    folder = shutil.copytree(places / place, tmp_path / "copy")
    damage_at_random(folder, paths, 150 if paths == ["dataset.json"] else 300, 1)
