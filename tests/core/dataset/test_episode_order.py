"""Random histories of episodes and streams, compared with the simplest model: lists in memory.

Every row holds a number of its own, so that any mix-up shows.
"""

import contextlib
import os
import shutil
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine
from sizes import trials

from physx_core import Dataset, Field, View
from physx_core.dataset import EPISODES, EpisodeRecord, EpisodeStatus
from physx_core.dataset.read import shuffling
from physx_core.dataset.read.access import disk, memory
from physx_core.dataset.store import locks
from physx_core.dataset.write.partition_writer import PartitionWriter
from physx_core.errors import DatasetError, UsageError

FIELDS = [Field("n", (), "int64"), Field("x", (2,))]
QUICK = settings(database=None, max_examples=2, stateful_step_count=30)
FINISHED, FAILED, CUT, MORE = (
    EpisodeStatus.FINISHED,
    EpisodeStatus.FAILED,
    EpisodeStatus.CUT,
    EpisodeStatus.MORE,
)


@pytest.fixture(autouse=True)
def little_at_a_time(monkeypatch):
    monkeypatch.setattr(disk, "_OPEN_FILES", 2)
    monkeypatch.setattr(shuffling, "_CHUNK", 200)
    monkeypatch.setattr(shuffling, "_BLOCK", 100)
    monkeypatch.setattr(shuffling, "_WINDOW", 3)
    for name in ("fsync", "fdatasync"):  # nothing here depends on what has reached the disk
        monkeypatch.setattr(os, name, lambda descriptor: None)


@dataclass
class Model:
    """What is in a mode.

    Attributes:
        streams: Rows of streams, by the campaign that they come before.
        episodes: For each campaign and number its complete computations, the last one last: the
            status, the rows, and all rows that were recorded together.
        parts: The rows of unfinished ones.
        stored: All rows as they are stored.
        shares: Rows that each of several other processes has written, and how many it has reported.
        stream: Campaign of the stream that takes rows; None: rows need a record.
    """

    streams: dict = field(default_factory=dict)
    episodes: dict = field(default_factory=dict)
    parts: dict = field(default_factory=dict)
    stored: list = field(default_factory=list)
    shares: list = field(default_factory=list)
    stream: int | None = 0

    @property
    def there(self):
        """All rows that are known to be stored."""
        return set(self.stored).union(*(rows[:known] for rows, known in self.shares))

    def entries(self):
        """Campaign, first number, status and rows of all that counts, in order."""
        found = [(c, -1, None, rows) for c, rows in self.streams.items()]
        there = self.there
        for (campaign, episode), computed in self.episodes.items():
            left = [(s, rows) for s, rows, needed in computed if needed <= there]
            found += [(campaign, episode, *left[-1])] if left else []
        return sorted(found, key=lambda entry: entry[:2])

    def rows(self, entries=None):
        return [row for entry in entries or self.entries() for row in entry[3]]

    def until_gap(self):
        found, last = [], (-1, -1)
        for entry in self.entries():
            campaign, episode = entry[:2]
            if episode > (last[1] + 1 if campaign == last[0] else 0):
                break
            found.append(entry)
            last = campaign, episode
        return [row for entry in found for row in entry[3]]

    def add(self, record, rows):
        for number in range(record.episode, record.episode + record.count):
            key = record.campaign, number
            mine = rows if record.count == 1 else [rows[number - record.episode]]
            parts = (self.parts.get(key, []) if record.part else []) + mine
            if record.status is MORE:
                self.parts[key] = parts
            else:
                parts = [] if record.status is FAILED else parts
                needed = set(parts) | set(rows if record.count > 1 else ())
                self.episodes.setdefault(key, []).append((record.status, parts, needed))
                self.parts.pop(key, None)

    def last_campaign(self):
        return max([0, *(c for c, _ in (*self.episodes, *self.parts)), *self.streams])


CAMPAIGNS = st.sampled_from([0, 0, 0, 1])
EPISODE = st.tuples(
    CAMPAIGNS,
    st.integers(0, 9),
    st.integers(0, 4),
    st.sampled_from([FINISHED, FINISHED, FINISHED, FAILED, CUT, MORE, MORE]),
    st.sampled_from([1, 1, 1, 2, 4]),
    st.booleans(),
)


def look(dataset, mode):
    """Return rows, episodes number by number, reasons and statistics: what compaction keeps."""
    if mode not in dataset:
        return None
    known = dataset.recorded_episodes(mode)
    each = np.repeat(np.arange(len(known.rows)), known.numbers)
    place = np.arange(len(each)) - np.repeat(np.cumsum(known.numbers), known.numbers)
    place += known.numbers[each]
    is_range = known.numbers[each] > 1
    numbers = known.campaign[each], known.episode[each] + place, known.status[each]
    rows = np.where(is_range, 1, known.rows[each])
    return (
        [column.tolist() for column in (*numbers, rows)],
        {name: dataset[mode][name][:].tobytes() for name in dataset[mode]},
        dataset.failed_episodes(mode),
        {
            name: [array.tobytes() for array in each.arrays().values()]
            for name, each in dataset.normalization_of(mode).items()
        },
    )


@dataclass(eq=False)
class Client:
    """Another process that writes rows, here in this one."""

    share: object
    writer: PartitionWriter
    place: int

    def write(self, block, count):
        """Write rows; return their address."""
        while self.writer.room < count:
            self.writer.add(replace(self.share.begin()))
        return self.writer.append(block, count)

    def take_sealed(self):
        for sealed in self.writer.take_sealed(wait=True):
            assert self.share.accept(sealed.index, sealed.checksums)

    def die(self):
        """End as if the process were killed: files are closed, and nothing else."""
        writer = self.writer
        writer._sealer.close()
        opened, writer._opened = writer._opened, None
        for file in opened.files.values() if opened else ():
            file.close()
        writer._digester.close()
        writer._syncer._helper.close()


class Machine(RuleBasedStateMachine):
    """A dataset with one writer, which may let others write, and a reader beside it."""

    mode = "training"

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=Path.cwd()))
        self.folder, self.copies = self.root / "data", 0
        self.model, self.next_row, self.turn = Model(), 0, 0
        self.dataset = self.delegation = None
        self.clients = []

    def teardown(self):
        for client in self.clients:
            client.die()
        if self.dataset is not None:
            with contextlib.suppress(Exception):  # it would hide what failed before
                self.dataset.close()
        shutil.rmtree(self.root)

    @initialize(capacity=st.integers(1, 12), durable=st.booleans(), before=st.integers(0, 5))
    def create(self, capacity, durable, before):
        self.options = {
            "max_file_size": (2**14 + 16 * capacity + 0.5) * 1e-9, "durable": durable,
        }  # fmt: skip
        self.dataset = Dataset.create(self.folder, **self.options)
        self.append(before)

    def draw(self, count):
        first, self.next_row = self.next_row, self.next_row + count
        return list(range(first, self.next_row))

    def block(self, rows):
        numbers = np.array(rows, np.int64)
        return {"n": numbers, "x": numbers[:, None] + np.array([0.0, 0.5])}

    # Writing ------------------------------------------------------------------------------------

    @rule(count=st.integers(0, 7))
    def append(self, count):
        if self.goes_on():
            return
        rows, model = self.draw(count), self.model
        self.dataset.append(self.mode, self.block(rows))
        if count and model.stream is None:
            model.stream = model.last_campaign() + 1
        if count:
            model.streams.setdefault(model.stream, []).extend(rows)
            model.stored += rows

    def records(self, drawn):
        """Records of what was drawn, the rows of each, and the next part of unfinished episodes."""
        records, rows = [], []
        unfinished = dict.fromkeys(self.model.parts, 1)
        parts = dict(self.counts) if hasattr(self, "counts") else {}
        for campaign, episode, count, status, several, goes_on in drawn:
            key = campaign, episode
            part = parts.get(key, 0) if goes_on and key in unfinished else 0
            if several > 1 and not part and status is FINISHED:
                record = EpisodeRecord(
                    campaign=campaign, episode=episode, rows=several, count=several,
                )  # fmt: skip
            else:
                record = EpisodeRecord(
                    campaign=campaign, episode=episode, rows=0 if status is FAILED else count,
                    part=part, status=status, reason=f"of {campaign}, {episode}", seconds=1.5,
                )  # fmt: skip
            for number in range(episode, episode + record.count):
                unfinished.pop((campaign, number), None)
            if status is MORE and record.count == 1:
                unfinished[key], parts[key] = 1, part + 1
            records.append(record)
            rows.append(self.draw(record.rows))
        return records, rows, parts

    def note(self, records, rows, parts):
        """Add records that have been stored to the model."""
        self.counts = parts
        if self.model.stream is not None:
            self.model.streams.setdefault(self.model.stream, [])
            self.model.stream = None
        for record, mine in zip(records, rows, strict=True):
            self.model.add(record, mine)

    @rule(drawn=st.lists(EPISODE, min_size=1, max_size=5))
    def append_episodes(self, drawn):
        if self.goes_on():
            return
        records, rows, parts = self.records(drawn)
        block = [row for mine in rows for row in mine]
        self.dataset.append_episodes(self.mode, self.block(block), records)
        self.model.stored += block
        self.note(records, rows, parts)

    # Other processes that write -----------------------------------------------------------------

    @rule(writes=st.lists(st.tuples(
        st.integers(0, 2), st.lists(EPISODE, min_size=1, max_size=2), st.booleans()
    ), min_size=1, max_size=6))  # fmt: skip
    def write_in_clients(self, writes):
        for write in writes:
            self.write_in_a_client(*write)
            self.compare(self.dataset)

    def write_in_a_client(self, which, drawn, seals):
        client = self.client(which)
        records, rows, parts = self.records(drawn)
        block = [row for mine in rows for row in mine]
        first = None
        if block:
            first = client.write(self.block(block), len(block))
            client.share.take(first, len(block))
            known, count = self.model.shares[client.place]
            assert count == len(known)
            self.model.shares[client.place] = [*known, *block], count + len(block)
        self.dataset.append_episodes(self.mode, {}, records, first_row=first)
        self.note(records, rows, parts)
        if seals:
            client.take_sealed()

    @rule(which=st.integers(0, 3), count=st.integers(0, 9), is_known=st.booleans())
    def lose_a_client(self, which, count, is_known):
        """It may have written rows that it has not reported; another one does not go on there."""
        client = self.client(which)
        rows = self.draw(count)
        if rows:
            client.write(self.block(rows), count)
        known, told = self.model.shares[client.place]
        self.model.shares[client.place] = known + rows, told
        client.die()
        self.clients.remove(client)
        if is_known:
            self.delegation.end(client.share)

    @rule(which=st.integers(0, 3))
    def only_clients_write(self, which):
        client = self.client(which)
        with pytest.raises(UsageError, match="Other processes write"):
            self.dataset.append(self.mode, self.block([0]))
        with pytest.raises(UsageError, match="Other processes write"):
            record = EpisodeRecord(episode=0, rows=1)
            self.dataset.append_episodes(self.mode, self.block([0]), [record])
        with pytest.raises(UsageError, match="has written 1 rows"):
            self.dataset.append_episodes(self.mode, {}, [record], first_row=client.share.end)
        with pytest.raises(ValueError, match="rows at the address"):
            client.share.take(client.share.end + 1, 1)

    def client(self, which):
        """One of the clients, or a new one."""
        if self.delegation is None:
            self.dataset.define_episodes()
            self.delegation = self.dataset.delegate(self.mode)
        if which < len(self.clients):
            return self.clients[which]
        share = self.delegation.share(FIELDS)
        writer = PartitionWriter(self.folder, share.fields, share.capacity)
        self.clients.append(Client(share, writer, len(self.model.shares)))
        self.model.shares.append(([], 0))
        if self.model.stream is not None:
            self.model.streams.setdefault(self.model.stream, [])
            self.model.stream = None
        return self.clients[-1]

    def goes_on(self):
        """Whether clients go on writing; a few of the calls that need them to end let them end."""
        if self.delegation is not None and self.turn % 6 == 0:
            self.end_delegation()
        return self.delegation is not None

    def end_delegation(self):
        """Let all clients end, so that this process can write again."""
        if self.delegation is not None:
            for client in self.clients:
                client.writer.close()
            self.delegation.close()
            self.take_shares()

    def take_shares(self):
        """Take what other processes have stored, of which unreported rows may be left."""
        mode = self.dataset._manifest.modes.get(self.mode)
        stored = self.dataset._reader.read(self.mode, "n", 0, mode.rows).tolist() if mode else []
        shares, self.model.shares = self.model.shares, []
        unsure = {row for rows, told in shares for row in rows[told:]}
        self.model.stored += [row for rows, told in shares for row in rows[:told]]
        assert [row for row in stored if row not in unsure] == self.model.stored
        self.model.stored, self.delegation, self.clients = stored, None, []

    # Changing -----------------------------------------------------------------------------------

    @rule(index=st.lists(st.integers(0, 300), max_size=5))
    def update(self, index):
        if self.goes_on():
            return
        before = self.model.rows()
        if not before:
            return
        index = sorted({number % len(before) for number in index})
        rows = self.draw(len(index))
        self.dataset.update(self.mode, index, self.block(rows))
        new = dict(zip([before[k] for k in index], rows, strict=True))
        model = self.model

        def renamed(numbers):
            return [new.get(number, number) for number in numbers]

        model.stored = renamed(model.stored)
        model.streams = {key: renamed(rows) for key, rows in model.streams.items()}
        model.parts = {key: renamed(rows) for key, rows in model.parts.items()}
        for key, computed in model.episodes.items():
            model.episodes[key] = [
                (status, renamed(rows), set(renamed(needed))) for status, rows, needed in computed
            ]

    @rule(which=st.integers(0, 50))
    def remove_partition(self, which):
        if self.turn % 4 or self.mode not in self.dataset or self.goes_on():
            return
        parts = [p for p in self.dataset._manifest.modes[self.mode].partitions if p.rows]
        if not parts:
            return
        which %= len(parts)
        start = sum(p.rows for p in parts[:which])
        gone = self.model.stored[start : start + parts[which].rows]
        self.dataset.remove_partition(self.mode, parts[which].index, parts[which].session)
        del self.model.stored[start : start + len(gone)]
        for rows in self.model.streams.values():
            rows[:] = [row for row in rows if row not in gone]
        for key in [k for k, rows in self.model.parts.items() if set(rows) & set(gone)]:
            del self.model.parts[key]  # it can never be complete
            with pytest.raises(UsageError):
                record = EpisodeRecord(
                    campaign=key[0], episode=key[1], rows=0, part=self.counts.pop(key)
                )  # fmt: skip
                self.dataset.append_episodes(self.mode, self.block([]), [record])

    @rule(again=st.booleans())
    def compact(self, again):
        if self.turn % 3 or EPISODES not in self.dataset.modes:
            return
        if self.goes_on():
            return
        before = look(self.dataset, self.mode)
        self.dataset.compact()
        if again:
            assert self.dataset.compact(self.mode) == 0
        assert look(self.dataset, self.mode) == before
        model = self.model
        for key, computed in list(model.episodes.items()):
            left = [each for each in computed if each[2] <= set(model.stored)][-1:]
            model.episodes[key] = [(status, rows, set(rows)) for status, rows, _ in left]
            if not left:
                del model.episodes[key]
        known = self.dataset.recorded_episodes(self.mode)
        for which in np.flatnonzero(known.numbers > 1):  # they still count together
            first = int(known.episode[which])
            numbers = range(first, first + int(known.numbers[which]))
            each = [model.episodes[int(known.campaign[which]), number] for number in numbers]
            rows = {row for computed in each for row in computed[-1][1]}
            for computed in each:
                computed[-1] = (*computed[-1][:2], rows)
        model.stored = model.rows()
        stored = sum(p.rows for p in self.dataset._manifest.modes[self.mode].partitions)
        assert stored == len(model.stored)
        for key in list(model.parts):
            del model.parts[key]
            with pytest.raises(UsageError):
                record = EpisodeRecord(
                    campaign=key[0], episode=key[1], rows=0, part=self.counts.pop(key)
                )  # fmt: skip
                self.dataset.append_episodes(self.mode, self.block([]), [record])

    @rule(before=st.integers(0, 4), after=st.integers(0, 4), capacity=st.integers(1, 9),
          drawn=st.lists(EPISODE, max_size=4))  # fmt: skip
    def merge(self, before, after, capacity, drawn):
        """Merge a dataset with a stream, episodes, and a stream."""
        if self.goes_on():
            return
        self.copies += 1
        folder, other = self.root / f"other_{self.copies}", Model()
        size = (2**14 + 16 * capacity + 0.5) * 1e-9
        with Dataset.create(folder, max_file_size=size) as given:
            rows = self.draw(before)
            given.append(self.mode, self.block(rows))
            other.streams[0] = rows
            other.stored += rows
            for campaign, episode, count, status, _, _ in drawn:
                record = EpisodeRecord(
                    campaign=campaign, episode=episode, rows=0 if status is FAILED else count,
                    status=status, reason=f"of {campaign}, {episode}",
                )  # fmt: skip
                mine = self.draw(record.rows)
                given.append_episodes(self.mode, self.block(mine), [record])
                other.stored += mine
                other.add(record, mine)
            rows = self.draw(after)
            given.append(self.mode, self.block(rows))
            where = other.last_campaign() + 1 if drawn else 0
            if rows or not drawn:
                other.streams.setdefault(where, []).extend(rows)
            other.stored += rows
            self.dataset.merge(folder)
        self.take(other, bool(drawn))

    def take(self, other, has_records):
        """Add another model's rows and episodes after all others."""
        model = self.model
        is_recorded = model.stream is None or bool(model.episodes or model.parts)
        shift = 0
        if is_recorded or model.stored:
            shift = model.last_campaign() + 1
        if not (is_recorded or has_records):
            model.streams.setdefault(0, []).extend(other.streams[0])
        else:
            for campaign, rows in other.streams.items():
                model.streams.setdefault(campaign + shift, []).extend(rows)
            for (campaign, episode), computed in other.episodes.items():
                model.episodes[campaign + shift, episode] = computed
            model.stream = None
            self.shifts = [*getattr(self, "shifts", []), shift]
        model.stored += other.stored

    @rule(killed=st.booleans(), session=st.sampled_from([None, "b"]))
    def reopen(self, killed, session):
        if killed:
            self.copies += 1
            copy = self.root / f"copy_{self.copies}"
            shutil.copytree(self.folder, copy)
            for client in self.clients:
                client.die()
            self.dataset.close()
            shutil.rmtree(self.folder)
            copy.rename(self.folder)
        else:
            self.end_delegation()
            self.dataset.close()
        with Dataset.open(self.folder) as reader:
            self.compare(reader)
        self.dataset = Dataset.open(self.folder, writable=True, session=session, **self.options)
        if self.delegation is not None:
            self.take_shares()

    @rule(again=st.booleans())
    def repair(self, again):
        if self.turn % 5 or self.goes_on():
            return
        self.dataset.close()
        if again:
            Dataset.rebuild(self.folder)
        else:
            assert Dataset.repair(self.folder) == []
        self.dataset = Dataset.open(self.folder, writable=True, **self.options)

    # Reading ------------------------------------------------------------------------------------

    @invariant()
    def rows_are_right(self):
        self.turn += 1
        if self.dataset is not None and self.mode in self.dataset:
            self.compare(self.dataset)
            with Dataset.open(self.folder) as reader:
                self.compare(reader)

    def compare(self, dataset):
        if self.mode not in dataset:
            return
        expected = self.model.rows()
        view = dataset[self.mode]
        assert dataset.num_samples(self.mode) == len(expected)
        assert view["n"][:].tolist() == expected
        assert view["x"][:].tolist() == self.block(expected)["x"].tolist()
        assert [int(row) for row in view["n"]] == expected

    @rule(index=st.lists(st.integers(-300, 300), max_size=9), start=st.integers(0, 9))
    def read_by_index(self, index, start):
        expected = np.array(self.model.rows(), np.int64)
        if not len(expected):
            return
        index = np.array(index, np.int64) % len(expected)
        view = self.dataset[self.mode]["n"]
        np.testing.assert_array_equal(view[index], expected[index])
        np.testing.assert_array_equal(view[start::3], expected[start::3])
        np.testing.assert_array_equal(view[start : start + 4], expected[start : start + 4])
        assert view[-1] == expected[-1]

    @rule(
        order=st.sampled_from(["stored", "exact", "blocks"]), key=st.integers(0, 3),
        size=st.integers(1, 9), free=st.sampled_from([0, 10**9]),
    )  # fmt: skip
    def batches(self, order, key, size, free):
        expected = np.array(self.model.rows(), np.int64)
        if not len(expected):
            return
        with mock.patch.object(memory, "available_memory", lambda: free):
            found = list(
                self.dataset.batches(
                    self.mode, size, shuffle=order != "stored", seed=key, order=order
                )
            )
        rows = np.concatenate([batch["n"] for batch in found])
        nbytes = sum(field.nbytes for field in self.dataset.fields(self.mode).values())
        chosen = shuffling.key_of(shuffling.key_of(key), 0)
        drawn = shuffling.make_order(order, len(expected), nbytes, chosen)
        assert rows.tolist() == expected[drawn.items(0, len(expected))].tolist()
        x = np.concatenate([batch["x"] for batch in found])
        np.testing.assert_array_equal(x, self.block(rows)["x"])

    @rule()
    def beside_a_writer(self):
        """A reader in another process sees what comes before the first missing number."""
        if EPISODES not in self.dataset.modes or self.mode not in self.dataset:
            return
        at_work = mock.patch.object(locks, "is_written", lambda folder: True)
        with at_work, Dataset.open(self.folder) as reader:
            expected = self.model.until_gap() if self.model.episodes else self.model.rows()
            assert reader[self.mode]["n"][:].tolist() == expected

    @rule()
    def look_at_records(self):
        found = self.dataset.recorded_episodes(self.mode) if self.mode in self.dataset else None
        if found is None:
            return
        entries = self.model.entries()
        assert int(found.rows.sum()) == len(self.model.rows())
        keys = {(c, e) for c, e, status, _ in entries if status is FAILED}
        failed = self.dataset.failed_episodes(self.mode)
        assert {(f.campaign, f.episode) for f in failed} == keys
        shifts = [0, *getattr(self, "shifts", [])]
        for f in failed:
            assert f.reason in {f"of {f.campaign - shift}, {f.episode}" for shift in shifts}

    @rule(fold=st.integers(0, 1), key=st.integers(0, 3))
    def folds(self, fold, key):
        entries = [entry for entry in self.model.entries() if entry[3]]
        if len(entries) < 4 or any(status is None for _, _, status, _ in entries):
            return
        view, found = View(folds=2, fold=fold, fold_seed=key), {}
        for part in ("training", "validation"):
            try:
                with view.open(3, data=self.dataset, mode=self.mode, part=part) as batches:
                    found[part] = {n for batch in batches for n in batch["n"].tolist()}
            except DatasetError:
                found[part] = set()
        both = found["training"] | found["validation"]
        assert sorted(both) == sorted(self.model.rows())
        for entry in entries:
            assert set(entry[3]) <= found["training"] or set(entry[3]) <= found["validation"]

    @rule()
    def episodes(self):
        entries = [entry for entry in self.model.entries() if entry[3]]
        if not entries or any(status is None for _, _, status, _ in entries):
            return
        if self.dataset.recorded_episodes(self.mode) is None:
            return
        numbers = np.array(self.model.rows())
        found = self.dataset.episodes(self.mode)
        assert [(e.campaign, e.episode, numbers[e.rows].tolist()) for e in found] == [
            (campaign, episode, rows) for campaign, episode, _, rows in entries
        ]

    @rule()
    def normalization(self):
        rows = self.block(self.model.rows())["x"]
        if len(rows):
            found = self.dataset.normalization_of(self.mode)["x"]
            np.testing.assert_allclose(found.mean, rows.mean(axis=0), rtol=1e-12)
            np.testing.assert_allclose(found.minimum, rows.min(axis=0))

    @rule()
    def look_at_files(self):
        self.dataset.flush()
        assert self.dataset.verify() == []
        for row in self.dataset.describe():
            if row["mode"] == self.mode:
                assert row["samples"] == len(self.model.rows())

    @rule()
    def virtual_index(self):
        import h5py

        if self.goes_on():
            return
        self.dataset.close()
        with h5py.File(self.folder / f"{self.dataset.session}.h5") as file:
            if self.mode in file:
                assert file[self.mode]["n"][:].tolist() == self.model.rows()
        self.dataset = Dataset.open(self.folder, writable=True, **self.options)


class Writers(Machine):
    """One that other processes write most of the time."""

    update = merge = remove_partition = split = episodes = batches = virtual_index = None
    read_by_index = look_at_files = look_at_records = normalization = append_episodes = None


MACHINES = pytest.mark.parametrize("machine", [Machine, Writers])


@pytest.mark.slow
@MACHINES
@pytest.mark.parametrize("number", range(trials(8, 4)))
def test_episodes_behave_like_lists(number, machine):
    run_machine(seed(number)(machine), settings=QUICK)


@pytest.mark.faults
@MACHINES
@pytest.mark.parametrize("number", range(100, 120))
def test_longer_histories_of_episodes(number, machine):
    run_machine(seed(number)(machine), settings=settings(QUICK, stateful_step_count=50))
