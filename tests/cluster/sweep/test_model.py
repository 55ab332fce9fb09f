"""A study against the simplest model of it: the same trials, run one after the other, undisturbed.

Trials are not really run: an executor stands in that brings about what a process can leave behind.
"""

import hashlib
import itertools
import os
import tempfile
from pathlib import Path

import hypothesis.strategies as st
import pytest
import tomli_w
from hypothesis import settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)
from sizes import size, trials

from physx_cluster.errors import StudyError
from physx_cluster.sweep import Definition, Result, Study, run_study
from physx_cluster.sweep.executors.executor import Executor, Job
from physx_cluster.sweep.results import FAILURE, RESULT, TRIAL, Failure
from physx_core.config import read_toml

optuna = pytest.importorskip("optuna")

RESTARTS = 2
SAMPLERS = ("random", "optuna/tpe", "optuna/random")
RANGE = {"low": 1e-4, "high": 1.0, "log": True}


class KilledError(BaseException):
    """The sweep's own process is killed."""


class PretendedJob(Job):
    """A process that ends after some looks at it, and leaves what processes leave."""

    def __init__(self, folder, end, looks):
        self.folder, self.end, self.looks = folder, end, looks

    def has_ended(self):
        self.looks -= 1
        if self.looks == 0:
            self.end(self.folder)
        return self.looks <= 0

    def describe_end(self):
        return "was killed"

    def close(self):
        self.looks = 0


class Pretender(Executor):
    """Runs trials as `ends` says, and kills the sweep after the last of them."""

    interval = 0.0

    def __init__(self, ends):
        self.ends = iter(ends)

    def start(self, folder):
        end, looks = next(self.ends, (None, 0))
        if end is None:
            raise KilledError
        return PretendedJob(folder, end, looks)

    def close(self):
        pass


def outcome(folder):
    """Return what a trial comes to, which its values and its seed determine."""
    trial = read_toml(folder / TRIAL)["trial"]
    text = repr((trial["pipeline"], trial["seed"], sorted(trial["values"].items())))
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little") / 2**32
    if number < 0.15:
        return Failure("ValueError", "it fails\nevery time", False, True)
    numbers = {epoch: number + 1 / epoch for epoch in (1, 2, 3)}
    return Result("pruned" if number > 0.8 else "complete", numbers[3], 3, "", numbers)


def finish(folder):
    outcome(folder).write(folder)


def die(folder):
    """Leave nothing behind."""


def advance(folder):
    """Leave a checkpoint behind, and die."""
    network = folder / "network"
    place = network / f"network_{len(list(network.glob('*')))}"
    place.mkdir(parents=True)
    (place / "checkpoint.toml").touch()


def fill_disk(folder):
    Failure("OSError", "the disk is full", False, False).write(folder)


def break_off(folder):
    """Leave a file under the name that it is written to before it gets its own."""
    (folder / f"{RESULT}.tmp").write_text("state = ")


ENDS = st.sampled_from([finish, finish, finish, die, advance, fill_disk, break_off])
RUNS = st.lists(st.tuples(ENDS, st.integers(1, 4)), max_size=12)


class Sweeps(RuleBasedStateMachine):
    """Runs a study in parts, each of which is killed, and compares it with an undisturbed one."""

    @initialize(
        sampler=st.sampled_from(SAMPLERS),
        trials=st.integers(1, 6),
        seeds=st.sampled_from([[0], [0, 1]]),
        batch=st.integers(1, 3),
        pipelines=st.integers(1, 2),
    )
    def begin(self, sampler, trials, seeds, batch, pipelines):
        self.root = tempfile.TemporaryDirectory(dir=os.environ.get("PYTEST_DEBUG_TEMPROOT"))
        self.folder, self.count = Path(self.root.name) / "study", itertools.count()
        table = {"training": {"epoch_nb": 1, "batch_size": 1, "network": {"network": "toy/linear"}}}
        self.plain = {
            "study": {"sampler": sampler, "trials": trials, "seeds": seeds, "batch": batch},
            "run": {"restarts": RESTARTS},
            "parameters": {"training.network.lr": RANGE, "training.batch_size": [1, 2]},
            "pipelines": dict.fromkeys("ab"[:pipelines], table),
        }
        self.expected = None

    def definition(self):
        file = Path(self.root.name) / "sweep.toml"
        file.write_text(tomli_w.dumps(self.plain))
        return Definition.read(file, "study")

    def run_to_end(self, folder):
        ends = itertools.repeat((finish, 1))
        run_study(self.definition(), folder, lambda line: None, lambda _: Pretender(ends))
        return (folder / "trials.csv").read_text()

    def undisturbed(self):
        """Return the table of an undisturbed run, one process at a time."""
        if self.expected is None:
            parallel, self.plain["run"]["parallel"] = self.plain["run"].get("parallel", 1), 1
            self.expected = self.run_to_end(Path(self.root.name) / f"whole{next(self.count)}")
            self.plain["run"]["parallel"] = parallel
        return self.expected

    @rule(ends=RUNS, parallel=st.integers(1, 4))
    def run(self, ends, parallel):
        """Run it until it is killed, or ends."""
        self.plain["run"]["parallel"] = parallel
        try:
            run_study(self.definition(), self.folder, lambda line: None, lambda _: Pretender(ends))
        except KilledError:
            return
        except StudyError as error:
            assert "the same command resumes" in str(error)
            return
        assert (self.folder / "trials.csv").read_text() == self.undisturbed()

    @rule(more=st.integers(1, 3))
    def add_trials(self, more):
        """Ask for more settings."""
        self.plain["study"]["trials"] += more
        self.expected = None

    @precondition(lambda self: hasattr(self, "folder") and self.folder.exists())
    @rule(place=st.integers(0, 20))
    def lose_a_result(self, place):
        """Remove a result: the trial comes to the same again."""
        results = sorted(self.folder.glob(f"trial_*/{RESULT}"))
        if results:
            results[place % len(results)].unlink()

    @precondition(lambda self: hasattr(self, "folder") and self.folder.exists())
    @rule()
    def change_the_definition(self):
        """Ask for something else: nothing is touched."""
        before = (self.folder / "study.toml").read_bytes()
        changed = {**self.plain, "study": {**self.plain["study"], "seed": 99}}
        kept, self.plain = self.plain, changed
        with pytest.raises(StudyError, match=r"study.seed was None and is 99"):
            self.run_to_end(self.folder)
        self.plain = kept
        assert (self.folder / "study.toml").read_bytes() == before

    @invariant()
    def holds_a_part_of_the_undisturbed_table(self):
        if not hasattr(self, "folder") or not (self.folder / "trials.csv").exists():
            return
        lines = (self.folder / "trials.csv").read_text().splitlines()
        expected = self.undisturbed().splitlines()
        assert [line for line in expected if line in set(lines)] == lines
        study = Study.read(self.folder)
        results = {path.parent.name for path in self.folder.glob(f"trial_*/{RESULT}")}
        assert {f"trial_{number:04}" for number in study.results} == results
        for number in study.results:
            written = Result.read(self.folder / f"trial_{number:04}")
            assert repr(written) == repr(study.results[number])  # NaN equals nothing

    def teardown(self):
        if not hasattr(self, "folder"):
            return
        whole = self.undisturbed()
        for _ in range(3):  # a full disk that is mentioned before has been given up once at most
            try:
                assert self.run_to_end(self.folder) == whole
                break
            except StudyError:
                continue
        else:
            pytest.fail("the study does not end")
        assert not list(self.folder.glob(f"trial_*/{FAILURE}.tmp"))
        best = Study.read(self.folder).best()
        rows = [line.split(",") for line in whole.splitlines()[1:]]
        if best is not None:
            values = [float(row[8]) for row in rows if row[6] == "complete"]
            assert best.value >= min(values)
        self.root.cleanup()


Sweeps.TestCase.settings = settings(max_examples=size(trials(20, 12), 2), stateful_step_count=8)
test_sweeps = Sweeps.TestCase
