"""Every legal state of the disk: nothing wrong is read back, and planted bugs are found."""

import errno
import itertools
import os
import random
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from powercut.checker import NEXT_BOOT, Checker, Problem
from powercut.disk import Disk, Folder, Killed, Recorder
from powercut.planted import BUGS
from powercut.promises import encode, look
from powercut.stage import Stage

from physx_core import Dataset, Field
from physx_core.errors import DatasetError

HISTORIES = 25  # of which one at least finds a planted bug


@pytest.mark.slow
@given(seed=st.integers(0, 2**32))
@settings(
    max_examples=4,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_nothing_wrong_is_read_back_after_a_power_cut(tmp_path, seed):
    problems = Checker(tmp_path, states=200).check(seed).problems
    assert not problems, "\n".join(map(describe, problems))


def describe(problem: Problem) -> str:
    return f"{problem}\n    python benchmarks/crash.py --replay {problem.place}"


@pytest.mark.faults
@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.what)
def test_a_planted_bug_is_found(bug, tmp_path):
    checker = Checker(tmp_path, checkpoints=float(bug.checkpoints))
    with bug.planted():
        for seed in itertools.islice(itertools.count(bug.first), HISTORIES):
            if checker.check(seed).problems:
                return
    pytest.fail(f"not found in {checker.result.distinct} states")


def test_there_are_at_least_twelve_planted_bugs():
    assert len({bug.what for bug in BUGS}) >= 12


# Repairing after a kill or a cut -----------------------------------------------------------------


def test_what_repair_has_found_survives_a_power_cut(tmp_path):
    """The manifest may be one that a killed writer had named without waiting for the disk."""
    (tmp_path / "work").mkdir()
    stage, recorder = Stage(), Recorder(tmp_path / "work")
    folder = tmp_path / "work" / "data"
    with stage.entered(), stage.recorded(recorder):
        dataset = Dataset.create(folder, max_file_size=2e-5)
        syncs = itertools.count()

        def kill(operation):
            if operation == "fsync" and next(syncs) == 1:
                recorder.kill()

        recorder.before = kill
        with pytest.raises(Killed):  # before it waits for the manifest's name
            dataset.append_sample("training", {"x": np.zeros(2)})
        recorder.before = lambda operation: None
        recorder.bury()
        stage.bury()
        Dataset.repair(folder)
        assert look(folder).fields.keys() == {"training"}
        for state in states(tmp_path, stage, recorder):
            assert look(state / "data").fields.keys() == {"training"}


def test_rebuilding_gives_out_no_rows_behind_lost_ones(tmp_path):
    stage, folder, cut = Stage(), tmp_path / "data", tmp_path / "cut"
    with stage.entered():
        with Dataset.create(folder, max_file_size=2e-5) as dataset:
            dataset.define_fields("training", [FIELD])
            append(dataset, 0, 300)
            tick(stage)
            shutil.copytree(folder, cut)
        stage.boot = NEXT_BOOT
        first, second = sorted(cut.glob("run_training_x_*.h5"))
        content = first.read_bytes()
        lost = content.index(encode(FIELD, np.arange(100, 103), 0).tobytes())
        first.write_bytes(content[:lost] + bytes(512) + content[lost + 512 :])
        assert not len(look(cut).rows("training"))
        Dataset.rebuild(cut)
        assert not len(look(cut).rows("training"))
        assert look(cut).error == ""
    assert {path.name for path in (cut / "damaged").iterdir()} == {first.name, second.name}


def states(tmp_path, stage, recorder):
    """Yield a folder in states that a power cut may leave now."""
    stage.boot = NEXT_BOOT
    disk = Disk(recorder.top, recorder.journal)
    disk.advance(len(recorder.journal))
    folder = Folder(tmp_path / "state")
    for tree in itertools.islice(map(disk.build, disk.choices(random.Random)), 100):
        folder.become(tree)
        yield folder.path


# A sync that fails ------------------------------------------------------------------------------

FIELD = Field("x", (2,))


@pytest.mark.parametrize("durable", [True, False], ids=["durable", "default"])
@pytest.mark.parametrize("failing", range(3))
def test_a_failed_sync_is_an_error_and_never_retried_as_success(tmp_path, durable, failing):
    """What the sync that failed was to write is lost, though later syncs succeed."""
    (tmp_path / "work").mkdir()
    stage, recorder = Stage(), Recorder(tmp_path / "work")
    promised = stored = 0
    with stage.entered(), stage.recorded(recorder):
        dataset = Dataset.create(tmp_path / "work" / "data", durable=durable, max_file_size=2e-5)
        dataset.define_fields("training", [FIELD])
        append(dataset, 0, 5)
        tick(stage)
        promised = stored = 5
        recorder.before = fail_at(failing, "fsync")
        errors = 0
        for _ in range(8):
            try:
                append(dataset, stored, 3)
                stored += 3
                tick(stage)
                dataset.flush()
            except DatasetError as error:
                errors += 1
                assert "disk has failed" in str(error)
            if not errors and (durable or not any(s.error for s in stage.syncers)):
                promised = stored
        assert errors >= 3  # it does not go on as if nothing had happened
        with pytest.raises(DatasetError, match="disk has failed"):
            dataset.close()
        for state in states(tmp_path, stage, recorder):
            seen = look(state / "data")
            assert not seen.error and not seen.wrong
            rows = seen.rows("training")
            np.testing.assert_array_equal(rows, np.arange(1, len(rows) + 1))
            assert promised <= len(rows) <= stored + 3


def append(dataset, start, count):
    rows = np.arange(start + 1, start + count + 1)
    dataset.append("training", {"x": encode(FIELD, rows, 0)})


def tick(stage):
    for syncer in stage.syncers:
        syncer.sync()


def fail_at(number, wanted):
    left = [number]

    def before(name):
        if name == wanted:
            left[0] -= 1
            if left[0] == -1:
                raise OSError(errno.EIO, os.strerror(errno.EIO))

    return before
