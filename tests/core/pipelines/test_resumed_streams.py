"""Streams whose run is interrupted or killed go on from their states, with the same rows."""

from __future__ import annotations

import importlib
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from sizes import seed, trials

from physx_core import Dataset, checkpoint
from physx_core.cli import main
from physx_core.errors import CheckpointError, ConfigError
from physx_core.plugins import resolve
from physx_core.workers.pasts import Past, PastFiles, pack, unpack

pytestmark = pytest.mark.processes

PROGRAM = Path(__file__).parents[1] / "programs" / "stream_run.py"
RIVER = f"{PROGRAM.with_name('stream_envs.py')}:River"
LOCAL, CLIENTS = "local", "clients"


@pytest.fixture
def run(monkeypatch):
    """The module of the program that is run."""
    monkeypatch.syspath_prepend(str(PROGRAM.parent))
    return importlib.import_module("stream_run")


@pytest.fixture
def made():
    """Return how many steps this process has made since the last call."""
    kind = resolve("environment", RIVER)

    def count():
        found, kind.made = kind.made, 0
        return found

    count()
    return count


@pytest.fixture
def at_once(monkeypatch):
    """States are written as soon as they may be."""
    monkeypatch.setattr("physx_core.workers.pasts._PERIOD", 0.0)


def stored(name):
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        return {
            f"{mode}/{field}": dataset[mode][field][:].tobytes()
            for mode in dataset.modes
            for field in dataset.fields(mode)
        }


def interrupt(*_):
    raise KeyboardInterrupt


def ended_early(pipeline, monkeypatch, *, killed):
    """End the run of "stopped" in its first step, as an interrupt or as a kill leaves it."""

    def step(_):
        if killed:
            shutil.copytree("sessions/stopped", "killed")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(resolve("environment", RIVER), "step", step)
        pipeline.execute()
    if killed:
        shutil.rmtree("sessions/stopped", ignore_errors=True)
        shutil.move("killed", "sessions/stopped")


def interrupted(pipeline, after):
    """Run a pipeline that is interrupted after some batches."""

    class Interrupted(type(pipeline)):
        def batch_end(self):
            self.ended = getattr(self, "ended", 0) + 1
            if self.ended == after:
                raise KeyboardInterrupt

    pipeline.__class__ = Interrupted
    with pytest.raises(KeyboardInterrupt):
        pipeline.execute()


# Generations ------------------------------------------------------------------------------------


@pytest.mark.parametrize("places", [(LOCAL, LOCAL), (CLIENTS, LOCAL), (LOCAL, CLIENTS)])
@pytest.mark.parametrize("every", [0, 5])
def test_a_resumed_generation_has_the_same_rows(run, every, places, nothing_stays_behind):
    run.generation("whole", run.streams(LOCAL, state_every=every)).execute()
    first, second = (run.streams(place, state_every=every) for place in places)
    interrupted(run.generation("stopped", first), 4)
    interrupted(run.generation("stopped", second, resume=True), 8)
    run.generation("stopped", first, resume=True).execute()
    assert stored("stopped") == stored("whole")


@pytest.mark.parametrize("what", ["generation", "training"])
@pytest.mark.parametrize(("killed", "resume"), [(True, True), (True, False), (False, False)])
def test_parameters_saved_by_a_run_without_rows_do_not_count(
    run, what, killed, resume, monkeypatch
):
    """The environment counts its runs with `save_parameters`, before its first row."""
    environment, make = run.streams(LOCAL), getattr(run, what)
    make("whole", environment).execute()
    for resumed in (False, resume, False):
        ended_early(make("stopped", environment, resume=resumed), monkeypatch, killed=killed)
    make("stopped", environment, resume=resume).execute()
    assert stored("stopped") == stored("whole")


@pytest.mark.parametrize("between", ["generation", "training"])
@pytest.mark.parametrize("every", [0, 5])
def test_a_run_without_rows_between_others_changes_nothing(run, every, between, monkeypatch):
    environment = run.streams(LOCAL, state_every=every)
    run.generation("whole", environment).execute()
    interrupted(run.generation("stopped", environment), 4)
    ended_early(getattr(run, between)("stopped", environment), monkeypatch, killed=True)
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


def test_parameters_are_restored_if_a_kill_comes_just_after_the_run_is_recorded(run, monkeypatch):
    environment = run.streams(LOCAL)
    run.generation("whole", environment).execute()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("physx_core.pipelines.generation.accept_parameters", interrupt)
        run.generation("stopped", environment).execute()
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
def test_a_resumed_generation_that_is_complete_changes_nothing(run, where):
    environment = run.streams(where)
    run.generation("once", environment).execute()
    run.generation("again", environment).execute()
    run.generation("again", environment, resume=True).execute()
    for name in ("once", "again"):  # the environment counts its runs
        run.generation(name, environment).execute()
    assert stored("again") == stored("once")


@pytest.mark.parametrize("batches", [1, 3])
def test_rejected_samples_keep_their_order_if_a_kill_comes_between_them_and_their_rows(
    run, batches, monkeypatch
):
    environment = run.streams(LOCAL, state_every=5)
    run.generation("whole", environment).execute()
    store, left = Dataset.append, [batches]

    def append(dataset, mode, rows, **options):
        left[0] -= mode == "wrong"
        if not left[0]:
            raise KeyboardInterrupt
        store(dataset, mode, rows, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Dataset, "append", append)
        run.generation("stopped", environment).execute()
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


def test_nothing_before_a_state_is_simulated_again(run, made, at_once):
    environment = run.streams(LOCAL, state_every=5, env_kwargs={"refuse": 0})
    interrupted(run.generation("stopped", environment), 11)
    assert made() == 77
    run.generation("stopped", environment, resume=True).execute()
    assert made() <= 7 + 2 * 5
    run.generation("stopped", environment, resume=True, batch_nb=13).execute()
    assert made() <= 7 + 2 * 5
    run.generation("whole", environment, batch_nb=13).execute()
    assert stored("stopped") == stored("whole")
    made()
    run.generation("stopped", environment, resume=True).execute()
    assert made() == 0


@pytest.mark.parametrize("lost", ["*[12].bin", "*.bin", "1.*"])
def test_states_that_did_not_reach_the_disk_do_not_count(run, made, at_once, lost):
    environment = run.streams(LOCAL, state_every=5)
    run.generation("whole", environment).execute()
    interrupted(run.generation("stopped", environment), 9)
    for path in Path("sessions/stopped/states").glob(lost):
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    made()
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")
    assert made() > 21


def test_states_after_rows_that_did_not_reach_the_disk_do_not_count(run, at_once):
    """After a power failure there may be fewer rows than when the states were written."""
    environment = run.streams(LOCAL, state_every=5)
    run.generation("whole", environment).execute()
    interrupted(run.generation("stopped", environment), 5)
    interrupted(run.generation("later", environment), 9)
    for path in Path("sessions/later/states").iterdir():
        path.replace(Path("sessions/stopped/states") / path.name)
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


def test_states_of_another_run_do_not_count(run, at_once):
    environment = run.streams(LOCAL, state_every=5)
    other = run.streams(LOCAL, state_every=5, seed=5)
    run.generation("whole", environment).execute()
    run.generation("other", other).execute()
    interrupted(run.generation("stopped", environment), 5)
    for path in Path("sessions/other/states").iterdir():
        path.replace(Path("sessions/stopped/states") / path.name)
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


def test_states_are_kept_until_their_rows_are_on_the_disk(tmp_path):
    class Clock:
        now = 0.0

        def monotonic(self):
            return self.now

    clock = Clock()
    files = PastFiles(tmp_path / "states", "run", clock)

    def newest(limit=999):
        return files.read(lambda number, past: past.rows <= limit).get(1, Past()).rows

    for rows in range(1, 200):
        files.keep({1: Past(rows, b"state")})
        assert newest() > rows - 3
        if clock.now > 2 * 2.2:  # of the last two seconds, nothing may be on the disk
            assert rows - 2 * 45 < newest(rows - 40) <= rows - 40
        clock.now += 0.05
    files.keep({1: Past(500, b"state")})
    files.close()
    assert newest() == 500


def test_streams_without_states_repeat_their_rows_and_say_so(run, made, capfd):
    environment = run.streams(LOCAL, env_kwargs={"refuse": 0})
    interrupted(run.generation("stopped", environment), 6)
    made()
    run.generation("stopped", environment, resume=True, quiet=False).execute()
    assert made() == 84
    assert "42 samples are stored, and simulated again first; with state_every" in (
        capfd.readouterr().err
    )
    run.generation("stopped", environment, resume=True, quiet=False).execute()
    assert ", 0 samples/s" in capfd.readouterr().err


@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
def test_streams_whose_state_cannot_be_captured_repeat_their_rows(
    run, where, caplog, nothing_stays_behind
):
    kwargs = {"env_kwargs": {"kind": "opaque"}}
    run.generation("whole", run.streams(LOCAL, **kwargs)).execute()
    environment = run.streams(where, state_every=5, **kwargs)
    interrupted(run.generation("stopped", environment), 6)
    said = [each.getMessage() for each in caplog.records if "gives none" in each.getMessage()]
    assert len(said) == 1
    assert ".lock" in said[0]
    run.generation("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("state_every", {"state_every": 6}),
        ("num_clients", {"num_clients": 3}),
        ("seed", {"seed": 1}),
    ],
)
def test_a_generation_resumes_only_with_what_its_rows_depend_on(run, name, changed):
    interrupted(run.generation("stopped", run.streams(LOCAL, state_every=5)), 3)
    other = run.streams(LOCAL, **{"state_every": 5, **changed})
    with pytest.raises(ConfigError, match=f"cannot be resumed .*{name} was"):
        run.generation("stopped", other, resume=True).execute()


def test_no_rows_follow_those_of_another_run(run):
    environment = run.streams(LOCAL, state_every=5)
    interrupted(run.generation("stopped", environment), 3)
    data = {"mode": "validation", "batch_nb": 2}
    run.generation("stopped", environment, **data).execute()
    with pytest.raises(ConfigError, match="no episodes"):
        run.generation("stopped", environment, resume=True).execute()


def test_resume_command_goes_on_with_streams(run, capfd):
    run.generation("whole", run.streams(LOCAL, state_every=5)).execute()
    interrupted(run.generation("stopped", run.streams(LOCAL, state_every=5), quiet=False), 5)
    assert "next: physx generate sessions/stopped --resume" in capfd.readouterr().err
    assert main(["generate", "sessions/stopped", "--resume"]) == 0
    assert stored("stopped") == stored("whole")


# Trainings --------------------------------------------------------------------------------------

BUFFERS = {
    "stream": {},
    "reservoir": {"online": "physx/reservoir", "online_kwargs": {"capacity": 40, "views": 2}},
}


def learned(name):
    found = checkpoint.find(Path(f"sessions/{name}"), None, -1)
    return (found.path / "parameters.npz").read_bytes()


@pytest.mark.parametrize("buffer", BUFFERS)
@pytest.mark.parametrize("places", [(LOCAL, LOCAL), (CLIENTS, CLIENTS), (CLIENTS, LOCAL)])
def test_a_training_goes_on_with_streams_that_ask_the_network(
    run, places, buffer, nothing_stays_behind
):
    asking = {"env_kwargs": {"asks": True}, "state_every": 5}
    if places[0] != places[1]:  # a network rounds predictions of several samples differently
        asking["num_clients"] = 1
    first, second = (run.streams(place, **asking) for place in places)
    options = BUFFERS[buffer]
    run.training("whole", first, **options).execute()
    interrupted(run.training("stopped", first, **options), 5)
    interrupted(run.training("stopped", second, resume=True, **options), 4)
    run.training("stopped", first, resume=True, **options).execute()
    assert learned("stopped") == learned("whole")
    assert stored("stopped") == stored("whole")


@pytest.mark.parametrize("asks", [False, True])
def test_a_training_simulates_nothing_before_the_states_of_its_checkpoint(run, made, asks):
    environment = run.streams(LOCAL, state_every=5, env_kwargs={"asks": asks, "refuse": 0})
    interrupted(run.training("stopped", environment), 11)
    assert made() == 77
    run.training("stopped", environment, resume=True).execute()
    assert made() <= 7 + 2 * 5


def test_a_training_without_states_cannot_go_on_with_streams_that_ask(run):
    environment = run.streams(LOCAL, env_kwargs={"asks": True})
    interrupted(run.training("stopped", environment), 5)
    with pytest.raises(ConfigError, match="set EnvironmentConfig.state_every"):
        run.training("stopped", environment, resume=True).execute()


def test_a_training_that_learned_nothing_yet_begins_anew_with_streams_that_ask(run):
    environment = run.streams(LOCAL, env_kwargs={"asks": True})
    run.training("whole", environment).execute()

    interrupted(run.training("stopped", environment), 2)
    shutil.rmtree("sessions/stopped/network")  # as if it had been killed before
    run.training("stopped", environment, resume=True).execute()
    assert learned("stopped") == learned("whole")
    assert stored("stopped") == stored("whole")


def test_rows_that_differ_from_those_that_are_learned_are_replaced(run):
    environment = run.streams(LOCAL, state_every=5, env_kwargs={"asks": True})
    run.training("whole", environment).execute()
    interrupted(run.training("stopped", environment), 5)
    shutil.rmtree("sessions/stopped/network/network_1")
    with Dataset.open("sessions/stopped/dataset", writable=True) as dataset:
        assert dataset.num_samples("training") == 35
        dataset.update("training", slice(24, 30), {"x": np.zeros((6, 2))})
    run.training("stopped", environment, resume=True).execute()
    assert stored("stopped") == stored("whole")


def test_states_after_rows_that_are_not_there_are_an_error(run, monkeypatch):
    environment = run.streams(LOCAL, state_every=5, env_kwargs={"asks": True})
    interrupted(run.training("stopped", environment), 5)
    found = checkpoint.find(Path("sessions/stopped"), None, -1)
    content = checkpoint.read_streams(found)
    for given, words in ((b"nothing", "cannot be used"), (_later(content), "rows")):
        monkeypatch.setattr(checkpoint, "read_streams", lambda _, given=given: given)
        with pytest.raises(CheckpointError, match=words):
            run.training("stopped", environment, resume=True).execute()


def _later(content):
    rows, pasts = unpack(content)
    return pack(rows + 1000, pasts)


def test_too_many_answers_between_states_are_said(run, caplog):
    environment = run.streams(LOCAL, state_every=1000, journal_size=1e-6, env_kwargs={"asks": True})
    interrupted(run.training("stopped", environment), 9)
    assert "nor go on in a later run" in caplog.text
    with pytest.raises(ConfigError, match="has no states"):
        run.training("stopped", environment, resume=True).execute()


# Kills ------------------------------------------------------------------------------------------


def survives(run_killed, random, kills, where, what):
    """Check runs that are killed at random moments, so often in all, against a whole one."""

    def killed(name, moments):
        return run_killed(str(PROGRAM), Path.cwd(), moments, name, where, what)

    _, whole = killed("whole", [])
    number = 0
    while kills > 0:
        name = f"killed{number}"
        moments = [whole * random.uniform(0.2, 1.0) for _ in range(5)]
        kills -= killed(name, moments)[0]
        assert stored(name) == stored("whole")
        if what == "training":
            assert learned(name) == learned("whole")
        number += 1


@pytest.mark.slow
@pytest.mark.parametrize("what", ["generation", "training"])
def test_killed_streams_resume_bit_identically(what, run_killed):
    survives(run_killed, random.Random(1), trials(4, 2), CLIENTS, what)


@pytest.mark.faults
@pytest.mark.parametrize("where", [LOCAL, CLIENTS])
@pytest.mark.parametrize("what", ["generation", "training"])
def test_streams_killed_at_random_moments(where, what, run_killed):
    survives(run_killed, random.Random(seed()), trials(60, 10), where, what)
