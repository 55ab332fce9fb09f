"""What must not happen to episodes: refused calls, moved rows, lost tables and copies elsewhere."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from physx_core import Dataset, View
from physx_core.dataset import EPISODES, EpisodeRecord, EpisodeStatus
from physx_core.errors import ConfigError, DatasetError, UsageError


@pytest.fixture
def dataset(tmp_path):
    with Dataset.create(tmp_path / "data") as made:
        yield made


def store(dataset, episode, values, **options):
    record = EpisodeRecord(episode=episode, rows=len(values), **options)
    dataset.append_episodes("training", {"x": np.array(values, float)}, [record])


def test_batches_keep_their_rows_when_earlier_episodes_come_or_replace_them(dataset):
    for number in range(10, 20):
        store(dataset, number, [number])
    with View(fold=0).open(3, data=dataset) as batches:
        before = [batch["x"].tolist() for batch in batches]
        for number in range(5):
            store(dataset, number, [number])
        store(dataset, int(before[0][0]), [-1.0])
        assert [batch["x"].tolist() for batch in batches] == before
        with View(fold=0).open(3, data=dataset, snapshot=batches.snapshot) as again:
            assert [batch["x"].tolist() for batch in again] == before
        dataset.compact()
        with pytest.raises(DatasetError, match="compacted"):
            View(fold=0).open(3, data=dataset, snapshot=batches.snapshot)


def test_iterating_gives_the_rows_that_were_there_at_first(dataset):
    for number in (1, 2):
        store(dataset, number, [number] * 150_000)
    rows = iter(dataset["training"]["x"])
    found = [next(rows) for _ in range(10)]
    store(dataset, 0, [0] * 150_000)
    assert Counter(map(float, [*found, *rows])) == {1.0: 150_000, 2.0: 150_000}


def test_why_all_episodes_failed_is_known_without_any_rows(dataset):
    failed = EpisodeRecord(episode=0, rows=0, status=EpisodeStatus.FAILED, reason="why")
    dataset.append_episodes("training", {}, [failed])
    assert [each.reason for each in dataset.failed_episodes("training")] == ["why"]
    with pytest.raises(DatasetError, match="no mode"):
        dataset.failed_episodes("validation")


@pytest.mark.parametrize("place", ["episode", "campaign", "rows", "part"])
def test_numbers_that_the_table_does_not_hold_are_refused(place):
    with pytest.raises(ConfigError, match="no such episode"):
        EpisodeRecord(**{"episode": 0, "rows": 1, place: 2**60})


def test_only_episodes_change_their_table(dataset):
    store(dataset, 0, [1.0])
    row = {name: dataset[EPISODES][name][0] for name in dataset.fields(EPISODES)}
    changes = (
        lambda: dataset.append(EPISODES, {name: [value] for name, value in row.items()}),
        lambda: dataset.append_sample(EPISODES, row),
        lambda: dataset.update(EPISODES, 0, {"first_row": 0}),
        lambda: dataset.delegate(EPISODES),
        lambda: dataset.remove_partition(EPISODES, 0),
    )
    for change in changes:
        with pytest.raises(UsageError, match="only append_episodes"):
            change()


def test_rows_whose_records_are_lost_are_not_taken_for_others(dataset):
    for number in (3, 2, 1, 0):
        store(dataset, number, [number])
    store(dataset, 4, [99.0], status=EpisodeStatus.MORE)
    dataset.close()
    path = next(dataset.directory.glob("*episodes_first_row*"))
    content = bytearray(path.read_bytes())
    content[content.find(np.array([1, 2, 3]).tobytes())] ^= 0x40
    path.write_bytes(content)
    assert "records of episodes" in " ".join(Dataset.repair(dataset.directory))
    repaired = Dataset.open(dataset.directory)
    assert repaired.num_samples("training") == 0
    assert any("Records of episodes" in problem for problem in repaired.verify())
    with Dataset.open(dataset.directory, writable=True) as accepted:
        accepted.update_info(lost_episodes=None)
        assert accepted.num_samples("training") == 5
