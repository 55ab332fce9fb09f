"""Episodes in every legal state of the disk: only whole and recorded ones count."""

import itertools
import random
from dataclasses import replace

import numpy as np
import pytest
from powercut.checker import NEXT_BOOT
from powercut.disk import Disk, Folder, Recorder
from powercut.stage import LaterHelper, Stage
from sizes import trials

from physx_core import Dataset, Field
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.dataset.write.partition_writer import PartitionWriter

STEPS = 14
WHAT = ["part", "part", "part", "range", "stream", "tick", "seal", "compact"]
BY_CLIENTS = ["part", "part", "part", "part", "range", "tick", "seal", "lose"]
X = [Field("x", ())]


def rows(campaign, episode, count, attempt):
    """Rows that say where they belong: campaign, number, attempt, place."""
    start = ((campaign * 100 + episode) * 100 + attempt) * 100
    return start + np.arange(count, dtype=np.float64)


class History:
    """Episodes of four rows in two parts each, ranges, failed ones, and streams in between."""

    def __init__(self, seed):
        self.clients = None  # pairs of a share and a writer, if clients write the rows
        self.chance, self.attempts, self.open = random.Random(seed), {}, {}
        self.streamed, self.finished, self.failed = 0, set(), set()
        self.kept = [(0, set())]  # from which operation on which episodes are on the disk

    def delegate(self, dataset):
        """Let three clients write the rows from now on."""
        dataset.define_episodes()
        self.delegation = dataset.delegate("training")
        self.clients = [self.new_client(dataset) for _ in range(3)]

    def new_client(self, dataset):
        share = self.delegation.share(X)
        writer = PartitionWriter(dataset.directory, X, share.capacity, LaterHelper)
        return share, writer

    def store(self, dataset, block, record):
        if self.clients is None or not len(block):
            dataset.append_episodes("training", {"x": block}, [record])
            return
        share, writer = self.chance.choice(self.clients)
        while writer.room < len(block):
            writer.add(replace(share.begin()))
        first = writer.append({"x": block}, len(block))
        share.take(first, len(block))
        dataset.append_episodes("training", {}, [record], first_row=first)
        for sealed in writer.take_sealed():
            assert share.accept(sealed.index, sealed.checksums)

    def step(self, dataset, stage, journal):
        what = self.chance.choice(WHAT if self.clients is None else BY_CLIENTS)
        if what == "lose":
            which = self.chance.randrange(3)
            share, _ = self.clients[which]
            self.delegation.end(share)
            self.clients[which] = self.new_client(dataset)
        elif what == "compact":
            dataset.compact()
            self.open.clear()
            self.kept.append((len(journal), set(self.finished)))
        elif what == "tick":
            for syncer in stage.syncers:
                syncer.sync()
            self.kept.append((len(journal), set(self.finished)))
        elif what == "seal":
            for executor in stage.executors:
                executor.work()
        elif what == "stream":
            self.streamed += 1
            dataset.append("training", {"x": np.array([-float(self.streamed)])})
        elif what == "range":
            block = rows(2, 0, 4, len(self.attempts))
            record = EpisodeRecord(campaign=2, episode=0, rows=4, count=4)
            self.store(dataset, block, record)
        else:
            self.part(dataset)

    def part(self, dataset):
        episode = self.chance.randrange(4)
        part = self.open.pop(episode, 0)
        if not part:
            self.attempts[episode] = self.attempts.get(episode, 0) + 1
            self.open[episode] = 1
        attempt = self.attempts[episode]
        block = rows(1, episode, 4, attempt)[2 * part : 2 * part + 2]
        failed = bool(part) and self.chance.random() < 0.2
        status = EpisodeStatus.FAILED if failed else EpisodeStatus(0 if part else 3)
        record = EpisodeRecord(
            campaign=1, episode=episode, part=part, status=status, rows=0 if failed else 2,
            reason="of no matter",
        )  # fmt: skip
        block = block[:0] if failed else block
        self.store(dataset, block, record)
        if part:
            (self.failed if failed else self.finished).add(episode)


def check(folder, kept, failed):
    """Whole episodes only, in order, and the first rows of the streams; return how many rows.

    Args:
        folder: The dataset.
        kept: Numbers of episodes that are on the disk for certain.
        failed: Numbers of those that failed later.
    """
    with Dataset.open(folder) as dataset:
        if "training" not in dataset:
            assert not kept
            return 0
        found = dataset["training"]["x"][:]
    stream = found[found < 0]
    np.testing.assert_array_equal(stream, -1.0 - np.arange(len(stream)))
    parts = found[(found >= 1e6) & (found < 2e6)].astype(int).reshape(-1, 4)
    np.testing.assert_array_equal(parts % 100, np.tile(np.arange(4), (len(parts), 1)))
    np.testing.assert_array_equal(parts // 100, np.tile(parts[:, :1] // 100, 4))
    numbers = (parts[:, 0] // 10000 % 100).tolist()
    assert numbers == sorted(set(numbers))
    assert kept - failed <= set(numbers)
    assert (found >= 2e6).sum() in (0, 4)
    return len(found)


@pytest.mark.slow
@pytest.mark.parametrize("by_clients", [False, True])
@pytest.mark.parametrize("seed", range(trials(3, 1)))
def test_after_a_power_cut_only_whole_recorded_episodes_count(tmp_path, seed, by_clients):
    (tmp_path / "work").mkdir()
    stage, recorder = Stage(), Recorder(tmp_path / "work")
    folder, history = tmp_path / "work" / "data", History(seed)
    with stage.entered(), stage.recorded(recorder):
        dataset = Dataset.create(folder, max_file_size=(2**14 + 8 * 7) * 1e-9)
        if by_clients:
            history.delegate(dataset)
        for _ in range(STEPS):
            history.step(dataset, stage, recorder.journal)
    stage.boot = NEXT_BOOT
    journal, state = recorder.journal, Folder(tmp_path / "state")
    chance, examined = random.Random(seed), 0
    with Stage().entered():
        Stage.now.boot = NEXT_BOOT
        disk = Disk(recorder.top, journal)
        for moment in sorted(chance.sample(range(len(journal)), min(40, len(journal)))):
            disk.advance(moment)
            choices = disk.choices(lambda number: random.Random(seed * 1000 + number))
            for tree in map(disk.build, itertools.islice(choices, 8)):
                state.become(tree)
                if not (state.path / "data" / "dataset.json").exists():
                    continue
                kept = [numbers for start, numbers in history.kept if start <= moment][-1]
                count = check(state.path / "data", kept, history.failed)
                examined += 1
                if examined % 4 == 0:
                    go_on(state.path / "data", count)
                    state.touched()
    assert examined > 50


def go_on(folder, count):
    """Rows stored after the cut never become those of a record from before it."""
    with Dataset.open(folder, writable=True) as dataset:
        record = EpisodeRecord(campaign=9, episode=0, rows=3)
        dataset.append_episodes("training", {"x": np.full(3, 9e6)}, [record])
        assert dataset.num_samples("training") == count + 3
        assert dataset["training"]["x"][-3:].tolist() == [9e6] * 3
        assert dataset.verify() == []
    with Dataset.open(folder) as dataset:
        assert dataset.num_samples("training") == count + 3
        kept = dataset["training"]["x"][:]
        assert (kept == 9e6).sum() == 3
