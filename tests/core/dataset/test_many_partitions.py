"""New partitions are lines beside the manifest, which takes them over now and then."""

import json
import re
import shutil
import zlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset
from physx_core.dataset.store import changes_file
from physx_core.errors import DatasetError

SIZE = (2**14 + 80) / 1e9  # a few rows in each partition


def block(start, stop):
    rows = np.arange(start, stop)
    return {"x": np.sin(rows[:, None] + np.arange(2)), "n": rows}


def read(folder):
    with Dataset.open(folder) as dataset:
        return dataset["training"]["n"][:]


def lines(folder):
    path = folder / "changes.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def uncounted(dataset):
    """How many partitions do not count in the statistics that are stored."""
    return sum(not part.counted for part in dataset._manifest.modes["training"].partitions)


@pytest.fixture
def killed(tmp_path, folder):
    """A dataset whose writer was killed while the newest partitions were only lines.

    Partitions are sealed by a thread, and count once the writer has taken them back.
    """
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        dataset.append("training", block(0, 50))
        while len(lines(folder)) < 3 or uncounted(dataset) > 3:
            start = dataset.num_samples("training")
            dataset.append("training", block(start, start + 5))
        return shutil.copytree(folder, tmp_path / "killed")


@pytest.fixture
def rows(killed, folder):
    """The numbers of its rows."""
    return np.arange(len(read(folder)))


@pytest.mark.slow
def test_the_manifest_is_seldom_written_anew(folder):
    written, counts = set(), []
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        for start in range(0, 600, 5):
            dataset.append("training", block(start, start + 5))
            written.add((folder / "dataset.json").stat().st_mtime_ns)
            with Dataset.open(folder) as reader:
                counts.append(reader.num_samples("training"))
    assert counts == [*range(5, 601, 5)]
    assert len(written) < 20
    assert not lines(folder)
    plain = json.loads((folder / "dataset.json").read_text())
    partitions = plain["modes"]["training"]["partitions"]
    assert len(partitions) > 100
    assert all(each["sealed"] and each["counted"] for each in partitions)
    assert_array_equal(read(folder), np.arange(600))


@pytest.mark.slow
def test_a_refreshed_reader_sees_new_partitions(folder):
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        dataset.append("training", block(0, 5))
        with Dataset.open(folder) as reader:
            for start in range(5, 100, 5):
                dataset.append("training", block(start, start + 5))
                reader.refresh()
                assert_array_equal(reader["training"]["n"][:], np.arange(start + 5))


@pytest.mark.slow
def test_a_torn_line_loses_no_rows(killed, rows, tmp_path):
    content, total = (killed / "changes.jsonl").read_bytes(), len(rows)
    for end in [*range(0, len(content), 37), len(content) - 1]:
        copy = shutil.copytree(killed, tmp_path / "copy")
        (copy / "changes.jsonl").write_bytes(content[:end])
        assert_array_equal(read(copy), rows)
        with Dataset.open(copy, writable=True, max_file_size=SIZE) as dataset:
            dataset.append("training", block(total, total + 30))
        assert_array_equal(read(copy), np.arange(total + 30))
        with Dataset.open(copy) as dataset:
            assert dataset.verify() == []
        assert not lines(copy)
        shutil.rmtree(copy)


def test_partitions_that_are_sealed_together_count_in_statistics_together(
    folder, tmp_path, monkeypatch
):
    """A cut may leave only the first bytes of what lists them and names their statistics."""
    append, before = changes_file.append, []

    def kept(directory, end, change):
        found = append(directory, end, change)
        shutil.copytree(folder, tmp_path / f"after_{end.nbytes}")
        before.append(end.nbytes)
        return found

    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        dataset.append("training", block(0, 17))
        monkeypatch.setattr(changes_file, "append", kept)
    after = tmp_path / f"after_{before[0]}"
    content, rows = (after / "changes.jsonl").read_bytes(), block(0, 17)
    assert content[before[0] :].count(b'"sealed": true') > 2
    for end in range(before[0], len(content) + 1, 50):
        copy = shutil.copytree(after, tmp_path / "copy")
        (copy / "changes.jsonl").write_bytes(content[:end])
        with Dataset.open(copy, writable=True, max_file_size=SIZE) as dataset:
            found = dataset.normalization_of("training")["x"]
            np.testing.assert_allclose(found.mean, rows["x"].mean(axis=0), err_msg=str(end))
        shutil.rmtree(copy)


def test_a_damaged_line_loses_no_rows(killed, rows):
    content = (killed / "changes.jsonl").read_bytes()
    for place in range(0, len(content), 41):
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        (killed / "changes.jsonl").write_bytes(damaged)
        assert_array_equal(read(killed), rows)
    Dataset.repair(killed)
    assert_array_equal(read(killed), rows)
    with Dataset.open(killed) as dataset:
        assert dataset.verify() == []


def test_lines_that_do_not_continue_the_manifest_are_ignored(killed, rows, folder):
    shutil.copy(killed / "changes.jsonl", folder)
    assert_array_equal(read(folder), rows)
    assert Dataset.repair(folder) == []
    with Dataset.open(folder, writable=True) as dataset:
        dataset.append("training", block(len(rows), len(rows) + 10))
    assert_array_equal(read(folder), np.arange(len(rows) + 10))
    assert not lines(folder)


def test_a_killed_writers_statistics_are_not_computed_again(killed, rows):
    with Dataset.open(killed) as dataset:
        assert uncounted(dataset) <= 3 < len(dataset._manifest.modes["training"].partitions)
        mean = dataset.normalization["x"].mean
    np.testing.assert_allclose(mean, block(0, len(rows))["x"].mean(axis=0), atol=1e-12)


def hostile(folder, change):
    """Append a line with the right checksum."""
    crc = int(re.findall(rb'"crc32": "(\w+)"', (folder / "changes.jsonl").read_bytes())[-1], 16)
    body = json.dumps(change).encode()[:-1]
    with (folder / "changes.jsonl").open("ab") as file:
        file.write(body + b', "crc32": "%08x"}\n' % zlib.crc32(body, crc))


@pytest.mark.parametrize("change", [
    {},
    {"mode": "other", "partition": {}},
    {"mode": "training", "partition": {"session": "../x"}},
    {"mode": "training", "partition": []},
    {"mode": ["training"]},
    {"mode": "training", "partition": {"session": "run", "index": 99, "first_row": 1000, "rows": 0,
        "sealed": False, "offsets": {"x": 0, "n": 0}}, "also": [{"mode": "other"}]},
    {"mode": "training", "partition": {
        "session": "run", "index": 99, "first_row": 2**62, "rows": 2**62, "sealed": True,
        "offsets": {"x": 0, "n": 0}}},
    {"mode": "training", "partition": {"session": "run", "index": 99, "first_row": 0,
        "sealed": False, "offsets": {}}, "statistics": {"file": "/etc/passwd", "crc32": "0"}},
])  # fmt: skip
def test_a_line_that_no_dataset_has_written_is_an_error(killed, rows, change):
    hostile(killed, change)
    with pytest.raises(DatasetError, match=r"changes\.jsonl.*repair"):
        Dataset.open(killed)
    assert Dataset.repair(killed)
    assert_array_equal(np.sort(read(killed)), rows)


def test_changes_that_cannot_be_read_are_an_error(killed, tmp_path):
    (killed / "changes.jsonl").unlink()
    (killed / "changes.jsonl").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=r"changes\.jsonl cannot be read"):
        Dataset.open(killed)
