"""Damage in a partition that a killed writer left open costs its block of rows, and no other."""

import contextlib
import random
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from xxhash import xxh3_64_intdigest

from physx_core import Dataset, Field, files
from physx_core.dataset import EpisodeRecord
from physx_core.dataset.store.partition import commits
from physx_core.dataset.store.partition import format as partition_format
from physx_core.dataset.store.partition.commits import BlockDigests, block_ends
from physx_core.dataset.store.partition.format import inspect
from physx_core.dataset.write.partition_writer import PartitionWriter
from physx_core.errors import DatasetError

N, SIZE = 200, 5e-5
ROWS = {"x": np.random.default_rng(0).normal(size=(N, 6)), "n": np.arange(N)}
FIELDS = [Field("x", (6,)), Field("n", (), "int64")]
FILES = {name: f"run_training_{name}_0.h5" for name in ROWS}


def left_open(folder, *, synced=0, rows=ROWS):
    """Write rows, mark the first ones, and leave the dataset as a killed writer does."""
    work = folder.with_name("work")
    dataset = Dataset.create(work, max_file_size=SIZE)
    dataset.define_fields("training", FIELDS)
    count = len(rows["n"])
    for start, stop in ((0, synced), (synced, count)):
        if start < stop:
            dataset.append("training", {name: array[start:stop] for name, array in rows.items()})
        dataset._appender.writer._syncer.sync()
        if stop == synced:
            dataset._appender.writer._syncer.sync()
    shutil.copytree(work, folder)
    dataset.close()


def flip(folder, name, row, bit=3):
    """Flip a bit of a row of a field."""
    path = folder / FILES[name]
    place = inspect(path).data_offset + row * ROWS[name][:1].nbytes
    content = bytearray(path.read_bytes())
    content[place + bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def block_of(name, row, total=N):
    """The rows that are lost with one."""
    ends = block_ends(ROWS[name][:1].nbytes, 10**6)
    number = int(np.searchsorted(ends, row, "right"))
    return range(ends[number - 1] if number else 0, min(ends[number], total))


def close(folder, how):
    """Let whoever comes next finish the dataset; return what is said."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        done = []
        if how == "repair":
            done = Dataset.repair(folder)
        elif how == "rebuild":
            Dataset.rebuild(folder)
        else:
            Dataset.open(folder, writable=True).close()
    return " ".join([*done, *(str(each.message) for each in told)])


def check(folder, lost, rows=ROWS):
    """Check that all rows but some are there, and nothing is wrong."""
    kept = np.setdiff1d(np.arange(len(rows["n"])), list(lost))
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        assert dataset.num_samples("training") == len(kept)
        for name, array in rows.items():
            assert_array_equal(dataset["training"][name][:], array[kept])
        if len(kept):
            np.testing.assert_allclose(
                dataset.normalization["x"].mean, rows["x"][kept].mean(axis=0), atol=1e-12
            )


# One flipped bit --------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["writer", "repair", "rebuild"])
@pytest.mark.parametrize(("name", "row"), [("x", 0), ("x", 20), ("x", 199), ("n", 0), ("n", 90)])
def test_salvage_drops_only_the_block_of_a_bit_flip(folder, how, name, row):
    left_open(folder, synced=150)
    flip(folder, name, row)
    lost = block_of(name, row)
    assert row in lost and len(lost) <= 64
    said = close(folder, how)
    assert f"Rows {lost[0]} to {lost[-1]} are damaged: their bits have changed" in said
    assert "reach the disk" not in said
    check(folder, lost)
    assert {path.name for path in (folder / "damaged").iterdir()} == set(FILES.values())


def test_salvage_drops_corrupt_blocks_of_all_fields(folder):
    left_open(folder)
    for name, row in (("x", 3), ("x", 150), ("n", 130), ("n", 131)):
        flip(folder, name, row)
    said = close(folder, "repair")
    lost = {*block_of("x", 3), *block_of("x", 150), *block_of("n", 130)}
    assert said.count("are damaged") >= 1 and "rows" in said.lower()
    check(folder, lost)


def test_a_partition_without_any_sound_row_is_set_aside(folder):
    left_open(folder)
    for row in range(N):
        flip(folder, "x", row)
    close(folder, "writer")
    with Dataset.open(folder) as dataset:
        assert dataset.num_samples("training") == 0 and dataset.verify() == []
    assert {path.name for path in (folder / "damaged").iterdir()} == set(FILES.values())


def test_a_reader_gets_other_rows_and_an_error_that_names_the_damaged_ones(folder):
    left_open(folder)
    flip(folder, "x", 20)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with Dataset.open(folder) as dataset:
        assert dataset.num_samples("training") == N
        assert_array_equal(dataset["training"]["x"][100:], ROWS["x"][100:])
        assert_array_equal(dataset["training"]["n"][:], ROWS["n"])
        (problem,) = dataset.verify()
        assert "bits of rows 20 to 29 changed" in problem
        with pytest.raises(DatasetError, match=r"rows 20 to 29 do not match.*--repair"):
            list(dataset.batches("training", 32))
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_salvage_after_any_bit_flip_drops_at_most_one_block(folder, tmp_path, seed):
    """Records and digests may be hit too; a damaged header makes the partition unreadable."""
    rng = random.Random(seed)
    left_open(folder, synced=150)
    for number in range(15):
        copy = tmp_path / f"copy-{number}"
        shutil.copytree(folder, copy)
        name = rng.choice(list(FILES))
        path = copy / FILES[name]
        found, content = inspect(path), bytearray(path.read_bytes())
        spans = [
            (found.rows_offset, commits.NBYTES),
            (found.table_offset, len(found.table)),
            (found.data_offset, ROWS[name].nbytes),
        ]
        start, length = rng.choice(spans)
        place, bit = start + rng.randrange(length), rng.randrange(8)
        content[place] ^= 1 << bit
        path.write_bytes(content)
        said = close(copy, "writer")
        where = f"{name}, bit {bit} of byte {place} ({found.rows_offset}): {said}"
        assert "reach the disk" not in said, where
        with Dataset.open(copy) as dataset:
            assert dataset.verify() == [], where
            kept = dataset["training"]["n"][:]
            assert_array_equal(dataset["training"]["x"][:], ROWS["x"][kept], where)
            assert (np.diff(kept) > 0).all() and len(kept) >= N - 64, where
            assert len(kept) == N or "damaged" in said, where


# Power cuts -------------------------------------------------------------------------------------


@pytest.fixture
def rebooted(monkeypatch):
    """Return a function after which the machine seems to have been off."""

    def reboot():
        monkeypatch.setattr(partition_format, "boot_id", lambda: "another boot")

    return reboot


def test_after_a_power_cut_rows_that_were_seen_on_the_disk_are_damaged_and_others_lost(
    folder, rebooted
):
    left_open(folder, synced=150)
    path = folder / FILES["x"]
    found, content = inspect(path), bytearray(path.read_bytes())
    end = found.data_offset + 48 * N
    content[end - 480 : end] = bytes(480)  # rows after the marks never reached the disk
    path.write_bytes(content)
    flip(folder, "n", 70)
    # the older mark has 150 rows, as the second sync was the one of all rows
    content = bytearray(path.read_bytes())
    rebooted()
    said = close(folder, "repair")
    lost = {*block_of("n", 70)}
    assert "are damaged" in said
    with Dataset.open(folder) as dataset:
        kept = dataset["training"]["n"][:]
        assert dataset.verify() == []
        assert_array_equal(dataset["training"]["x"][:], ROWS["x"][kept])
    assert not lost & set(kept.tolist())
    assert set(range(150)) - lost <= set(kept.tolist())


def test_rows_that_were_updated_have_no_digest_and_others_still_have(folder):
    work = folder.with_name("updated")
    dataset = Dataset.create(work, max_file_size=SIZE)
    dataset.define_fields("training", FIELDS)
    dataset.append("training", {name: array[:100] for name, array in ROWS.items()})
    dataset.update("training", 5, {"x": np.zeros(6)})
    dataset.append("training", {name: array[100:] for name, array in ROWS.items()})
    shutil.copytree(work, folder)
    dataset.close()
    rows = {**ROWS, "x": ROWS["x"].copy()}
    rows["x"][5] = 0
    flip(folder, "x", 150)
    close(folder, "writer")
    check(folder, block_of("x", 150), rows)


# Several open partitions of a mode --------------------------------------------------------------


def left_open_by_clients(folder):
    """Let two clients write every other episode of ten rows, and kill everything."""
    work = folder.with_name("work")
    dataset = Dataset.create(work, max_file_size=SIZE)
    dataset.define_episodes()
    delegation = dataset.delegate("training")
    shares = [delegation.share(FIELDS) for _ in range(2)]
    writers = [PartitionWriter(work, FIELDS, share.capacity) for share in shares]
    for share, writer in zip(shares, writers, strict=True):
        writer.add(replace(share.begin()))
    for episode in range(N // 10):
        share, writer = shares[episode % 2], writers[episode % 2]
        first = writer.append({n: a[10 * episode :][:10] for n, a in ROWS.items()}, 10)
        share.take(first, 10)
        record = EpisodeRecord(episode=episode, rows=10)
        dataset.append_episodes("training", {}, [record], first_row=first)
    for writer in writers:
        writer.close()
    shutil.copytree(work, folder)
    dataset.close()


@pytest.mark.parametrize("how", ["writer", "repair", "rebuild"])
def test_damage_in_the_partition_of_a_client_costs_its_own_episodes(folder, how):
    left_open_by_clients(folder)
    path = folder / "run_training_x_1.h5"
    content = bytearray(path.read_bytes())
    content[inspect(path).data_offset + 48 * 33] ^= 4
    path.write_bytes(content)
    assert "Rows 30 to 39 are damaged" in close(folder, how)
    check(folder, range(70, 80))


def test_rows_that_a_client_has_reported_and_lost_are_an_error(folder):
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        dataset.define_episodes()
        delegation = dataset.delegate("training")
        share = delegation.share(FIELDS)
        with PartitionWriter(folder, FIELDS, share.capacity) as writer:
            writer.add(replace(share.begin()))
            for episode in range(2):
                rows = {name: a[10 * episode :][:10] for name, a in ROWS.items()}
                first = writer.append(rows, 10)
                share.take(first, 10)
                record = EpisodeRecord(episode=episode, rows=10)
                dataset.append_episodes("training", {}, [record], first_row=first)
        path = folder / FILES["x"]
        content = bytearray(path.read_bytes())
        content[inspect(path).data_offset + 48 * 15] ^= 4
        path.write_bytes(content)
        with pytest.raises(DatasetError, match="10 rows that clients wrote .* are missing"):
            delegation.close()
        assert dataset["training"]["n"][:].tolist() == list(range(10))
    check(folder, range(10, N))


# Ends in the middle -----------------------------------------------------------------------------


class Killed(BaseException):
    """The process is gone."""


@pytest.mark.slow
def test_killed_salvage_shifts_no_rows(folder, tmp_path, monkeypatch):
    left_open(folder)
    flip(folder, "x", 20)
    flip(folder, "n", 150)
    lost = {*block_of("x", 20), *block_of("n", 150)}
    names = ("rename", "sync_folder", "remove", "link", "write_at")
    for moment in range(1, 400):
        copy = tmp_path / f"copy-{moment}"
        shutil.copytree(folder, copy)
        left = [moment]

        def maybe(do, left=left):
            def killing(*given, **named):
                left[0] -= 1
                if left[0] <= 0:
                    raise Killed
                return do(*given, **named)

            return killing

        with monkeypatch.context() as patch, contextlib.suppress(Killed):
            for name in names:
                patch.setattr(files, name, maybe(getattr(files, name)))
            close(copy, "writer")
        close(copy, "writer")
        check(copy, lost)
        shutil.rmtree(copy)
        if left[0] > 0:
            return
    pytest.fail("it never came to its end")


# Blocks -----------------------------------------------------------------------------------------


@given(st.sampled_from([1, 8, 48, 512, 5000, 2**23]), st.integers(1, 10**7))
def test_blocks_are_few_and_small(row_nbytes, capacity):
    ends = np.array(block_ends(row_nbytes, capacity))
    starts = np.concatenate([[0], ends[:-1]])
    assert ends[-1] == capacity and (ends > starts).all()
    assert len(ends) <= 32 * (2 + np.log(1 + row_nbytes * capacity / 512)) + 512
    most = np.maximum(np.maximum(512, starts * row_nbytes // 32), row_nbytes)
    assert ((ends - starts) * row_nbytes <= most).all()


def test_fields_without_bytes_have_one_block():
    assert block_ends(0, 10**9) == (10**9,)


@given(st.integers(0, 99), st.lists(st.integers(0, 900), max_size=12))
def test_digests_do_not_depend_on_how_the_rows_came(row, lengths):
    ends, nbytes = block_ends(24, 400), 24
    content = np.random.default_rng(0).bytes(400 * nbytes)[row * nbytes :]
    digests, place = BlockDigests(nbytes, ends, row), 0
    for length in lengths:
        digests.update(content[place : place + length])
        place = min(place + length, len(content))
    end = row + place // nbytes
    blocks = zip((0, *ends[:-1]), ends, strict=True)
    full = [(max(row, start), stop) for start, stop in blocks if row < stop <= end]
    part = [content[(a - row) * nbytes : (b - row) * nbytes] for a, b in full]
    last = content[(full[-1][1] - row) * nbytes if full else 0 : place]
    assert digests.finished == [xxh3_64_intdigest(each) for each in part]
    assert digests.running.intdigest() == xxh3_64_intdigest(last)
