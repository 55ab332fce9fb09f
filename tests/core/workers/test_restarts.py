"""ClientSource: clients that fail and are started again; the rows are those without the failure."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import random
import tempfile
from pathlib import Path

import numpy as np
import pytest

from physx_core.errors import ClientError, EnvironmentFailedError, SampleError
from physx_core.net import Kind, pack
from physx_core.workers.journal import Journal

ENVS = Path(__file__).parents[1] / "programs" / "restart_envs.py"
WANDERER = f"{ENVS}:SimulatedWanderer"


@pytest.fixture
def batch_services(services):
    """The services, predicting several samples at once."""
    services.sizes = []

    def predict_batch(batch):
        services.sizes.append(len(batch["x"]))
        return {"y": 2 * batch["x"]}

    services.predict_batch = predict_batch
    return services


@pytest.fixture
def kill_one(simulation):
    """Return a function that has one of the clients killed soon, both by chance."""

    def kill():
        simulation.sleep(random.random() * 0.5)
        if alive := [*simulation.alive.values()]:
            random.choice(alive).kill()

    return lambda: simulation.start(kill)


@pytest.fixture
def fresh_notes():
    """Return a function that removes what environments noted in the folder, and tells how much."""

    def clear():
        found = [*Path().glob("broke-*"), *Path().glob("started-*")]
        for note in found:
            note.unlink()
        return sum(note.name.startswith("started") for note in found)

    return clear


def digest(batches):
    """Return a hash of rows by field, whatever the sizes of the batches."""
    found = hashlib.sha256()
    for name in sorted(batches[0]):
        for batch in batches:
            found.update(np.ascontiguousarray(batch[name]).tobytes())
    return found.hexdigest()


def run(source, sizes, *, apply=False, kill=None):
    """Return copies of batches; each is applied to the environments; `kill` kills a client."""
    batches = []
    with source:
        if kill:
            kill()
        for size in sizes:
            batch = source.batch(size)
            batches.append({name: values.copy() for name, values in batch.items()})
            if apply:
                source.apply({"y": batch["position"][:, :1] / 10})
    return batches


# The same rows, whatever happens ----------------------------------------------------------------


@pytest.mark.parametrize("asks", [False, True])
def test_rows_depend_on_the_seed_alone(simulated, batch_services, kill_one, asks):
    """Three runs with delays by chance, and one in which a client is killed by chance."""
    ahead, sizes = (0, [1, 7, 9, 13]) if asks else (None, [1, 40, 50, 60])
    delay = 0.02 if asks else 0.01
    hashes = set()
    for attempt in range(4):
        source = simulated(
            WANDERER,
            num_clients=3,
            env_kwargs={"asks": asks, "delay": delay, "refuse": 4},
            run_ahead=ahead,
            retries=int(attempt == 3),
        )
        kill = kill_one if attempt == 3 else None
        hashes.add(digest(run(source, sizes, apply=asks, kill=kill)))
    assert len(hashes) == 1


def test_run_ends_before_restarted_client_joined(simulated, batch_services, simulation, caplog):
    arguments = {"fault": "dawdle", "place": "close", "pace": 0.1}
    source = simulated(WANDERER, num_clients=2, env_kwargs=arguments, run_ahead=0, retries=1)
    with source:
        source.batch(3)
        simulation.alive[1].kill()
        source.batch(1)  # of instance 2
    assert "Restart 1 of 1" in caplog.text


@pytest.mark.parametrize(
    ("fault", "place"),
    [
        ("fail", "create"),
        ("leave", "init_database"),
        ("kill", "step"),
        ("fail", "step"),
        ("stop", "step"),
        ("garble", "step"),
        ("disconnect", "prediction"),
        ("kill", "prediction"),
        ("leave", "apply_prediction"),
        ("kill", "close"),
        ("fail", "close"),
    ],
)
def test_failed_client_is_restarted(
    local, simulated, batch_services, fresh_notes, caplog, fault, place
):
    settings = {"num_clients": 2, "env_kwargs": {"asks": True, "refuse": 3}}
    sizes = [3, 9, 1, 6]
    expected = digest(run(local(WANDERER, **settings), sizes, apply=True))
    fresh_notes()
    settings["env_kwargs"] |= {"fault": fault, "place": place, "at": 7}
    source = simulated(WANDERER, run_ahead=0, retries=1, **settings)
    assert digest(run(source, sizes, apply=True)) == expected
    (warning,) = [record for record in caplog.records if record.name == "physx"]
    assert warning.levelname == "WARNING"
    assert ("Client 2" if fault != "fail" else "Instance 2") in warning.getMessage()
    if place == "close":
        assert "it has all its rows" in warning.getMessage()
    else:
        assert "Restart 1 of 1" in warning.getMessage()
    assert fresh_notes() == (2 if place == "close" else 3)


def test_several_restarts_of_several_clients(local, simulated, fresh_notes, caplog, simulation):
    settings = {"num_clients": 3, "env_kwargs": {"pace": 0.003}}
    with local(WANDERER, **settings) as source:
        expected = digest([source.batch(30)])
    fresh_notes()
    victims = [1, 3, 1]
    batches = []
    with simulated(WANDERER, retries=2, run_ahead=2, **settings) as source:
        while victims or len(batches) < 30:
            batches.append({name: values.copy() for name, values in source.batch(1).items()})
            if victims and victims[0] in simulation.alive:
                simulation.alive[victims.pop(0)].kill()
    assert digest(batches[:30]) == expected
    texts = [record.getMessage() for record in caplog.records if record.name == "physx"]
    assert [text.split(" was ")[0] for text in texts] == ["Client 1", "Client 3", "Client 1"]
    assert "Restart 2 of 2" in texts[2]


def test_restart_keeps_batches_of_prediction_requests(simulated, batch_services, fresh_notes):
    asked = []
    for fault in ("", "kill", "fail"):
        batch_services.sizes.clear()
        kwargs = {"asks": True, "fault": fault, "place": "step", "at": 4}
        with simulated(
            WANDERER, num_clients=3, env_kwargs=kwargs, run_ahead=0, retries=1
        ) as source:
            for _ in range(4):
                source.batch(6)
        asked.append(batch_services.sizes.copy())
        fresh_notes()
    assert asked[1] == asked[0]
    assert asked[2] == asked[0]


def test_restart_repeats_no_drawing_and_no_saved_parameters(simulated, services, fresh_notes):
    seen = []
    for fault in ("", "kill"):
        services.shown.clear()
        services.kept.clear()
        kwargs = {"fault": fault, "place": "step", "at": 6}
        settings = {"num_clients": 2, "visualizer": "rerun", "retries": 1}
        with simulated(WANDERER, env_kwargs=kwargs, total=20, **settings) as source:
            source.batch(20)
        drawn = sorted((i, step, str(events)) for i, step, events in services.shown)
        seen.append((drawn, {number: kept["drawn"] for number, kept in services.kept.items()}))
        fresh_notes()
    assert len(seen[0][0]) == 22
    assert seen[1] == seen[0]
    assert seen[0][1] == {1: 1, 2: 1}


def test_restart_keeps_rejected_rows(simulated, fresh_notes):
    seen = []
    for fault in ("", "kill", "leave"):
        kwargs = {"refuse": 3, "fault": fault, "at": 11, "pace": 0.002}
        settings = {"num_clients": 2, "record_wrong_samples": True, "retries": 1}
        rejected = []
        with simulated(WANDERER, env_kwargs=kwargs, **settings) as source:
            for size in (5, 20, 11):
                source.batch(size)
                rejected.append(source.pop_rejected())
        seen.append(digest([batch for batch in rejected if batch]))
        fresh_notes()
    assert len(set(seen)) == 1


def test_restart_resends_stored_rows(simulated, fresh_notes):
    stored = [{"position": np.arange(12.0).reshape(6, 2) * k} for k in (1, 2, 3)]
    seen = []
    for fault in ("", "kill"):
        kwargs = {"fault": fault, "at": 6}
        with simulated(
            WANDERER, num_clients=2, env_kwargs=kwargs, run_ahead=0, retries=1
        ) as source:
            rows = []
            for part in stored:
                rows.append({n: v.copy() for n, v in source.batch(6, part).items()})
                source.apply({"y": part["position"][:, :1]})
        seen.append(digest(rows))
        fresh_notes()
    assert seen[0] == seen[1]


def test_regenerating_rows_after_restart_is_no_timeout(simulated, caplog):
    """Making twelve rows again takes longer than a client may be silent."""
    timeout = 1.0
    kwargs = {"pace": timeout / 10, "fault": "kill", "at": 12, "who": 1}
    with simulated(WANDERER, env_kwargs=kwargs, run_ahead=0, retries=1, timeout=timeout) as source:
        for row in range(14):
            assert source.batch(1)["step"] == [row]
    assert len([record for record in caplog.records if record.name == "physx"]) == 1


# Limits -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "error"), [("kill", ClientError), ("fail", EnvironmentFailedError)]
)
def test_client_beyond_restart_limit_ends_run(simulated, caplog, fresh_notes, fault, error):
    kwargs = {"fault": fault, "at": 3, "times": 9}
    with (
        pytest.raises(error, match="SIGKILL|no more beans"),
        simulated(WANDERER, num_clients=2, env_kwargs=kwargs, retries=2) as source,
    ):
        source.batch(20)
    said = [record.getMessage() for record in caplog.records if record.name == "physx"]
    texts = [text for text in said if "has been waiting" not in text]  # on a busy machine
    assert ["Restart 1 of 2" in texts[0], "Restart 2 of 2" in texts[1]] == [True, True]
    assert len(texts) == 2
    assert fresh_notes() == 4


def test_deterministic_error_is_not_restarted(simulated, caplog, fresh_notes):
    kwargs = {"fault": "refuse_rows", "at": 3, "times": 9}
    with (
        pytest.raises(SampleError, match="this would come again"),
        simulated(WANDERER, num_clients=2, env_kwargs=kwargs, retries=2) as source,
    ):
        source.batch(20)
    assert not [record for record in caplog.records if record.name == "physx"]
    assert fresh_notes() == 2


# The size of the journal -------------------------------------------------------------------------


@pytest.fixture
def full_disk(monkeypatch, tmp_path):
    """Let files for temporary data take 5 kB each, then none."""

    class Small(io.BytesIO):
        def write(self, data):
            if self.tell() + len(data) > 5_000:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super().write(data)

    monkeypatch.setattr(tempfile, "SpooledTemporaryFile", lambda *_: Small())
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


ASKS = {"num_clients": 2, "env_kwargs": {"asks": True}}


def test_run_continues_at_journal_limit_with_one_warning(local, simulated, batch_services, said):
    expected = digest(run(local(WANDERER, **ASKS), [30, 30], apply=True))
    source = simulated(WANDERER, run_ahead=0, retries=1, journal_size=2e-6, **ASKS)
    assert digest(run(source, [30, 30], apply=True)) == expected
    assert [text.partition(":")[0] for text in said()] == [
        f"Instance {number} can no longer be restarted, nor go on in a later run"
        for number in (1, 2)
    ]
    assert all("journal_size = 2e-06 GB" in text for text in said())


def test_client_crash_beyond_journal_limit_ends_run_with_reason(
    simulated, batch_services, simulation
):
    with simulated(WANDERER, run_ahead=0, retries=3, journal_size=2e-6, **ASKS) as source:
        source.batch(60)
        simulation.alive[2].kill()
        with pytest.raises(ClientError, match="SIGKILL") as caught:
            source.batch(60)
    (note,) = caught.value.__notes__
    assert "Instance 2 can no longer be restarted" in note
    assert "journal_size" in note


def test_restart_below_journal_limit(local, simulated, batch_services, simulation, said):
    expected = digest(run(local(WANDERER, **ASKS), [10, 90], apply=False))
    with simulated(WANDERER, run_ahead=0, retries=1, journal_size=4e-6, **ASKS) as source:
        batches = [{name: rows.copy() for name, rows in source.batch(10).items()}]
        assert not said()
        simulation.alive[1].kill()
        batches.append(source.batch(90))
    assert digest(batches) == expected
    assert len(said("Restart 1 of 1")) == 1
    assert len(said("can no longer")) == 2


def test_full_temporary_folder_is_reported_and_run_continues(
    local, simulated, batch_services, full_disk, said
):
    expected = digest(run(local(WANDERER, **ASKS), [200], apply=True))
    source = simulated(WANDERER, run_ahead=0, retries=1, **ASKS)
    assert digest(run(source, [200], apply=True)) == expected
    assert len(said(f"cannot grow in {full_disk}: No space left")) == 2


def test_full_temporary_folder_during_restart_is_an_error(full_disk):
    journal = Journal(2, 1e9, None, None)
    journal.record(pack(Kind.APPLY, bytes(3_000), 1))
    with pytest.raises(ClientError, match=rf"Client 2 .* {full_disk}, fails: No space .* TMPDIR"):
        journal.record(pack(Kind.APPLY, bytes(3_000), 1), is_read=True)
    assert journal.order(0)


# The journal ------------------------------------------------------------------------------------


def test_journal_replays_messages():
    journal = Journal(1, 1e9, None, None)
    told = [
        pack(Kind.CREDIT, number=2),
        pack(Kind.ANSWER, b"first", 1),
        pack(Kind.CREDIT, number=3),
        pack(Kind.APPLY, b"three" * 3_000_000, 1),
        pack(Kind.CREDIT, number=4),
        pack(Kind.REFUSAL, b"third", 3),
        pack(Kind.STORED, b"four", 1),
        pack(Kind.APPLY, b"four", 1),
        pack(Kind.CLOSE),
        pack(Kind.CREDIT, number=5),
    ]
    assert [journal.record(message) for message in told] == [1, 0, 1, 1, 1, 0, 1, 1, 0, 1]
    orders = [told[2] + told[3], told[4] + told[6], told[7]]
    assert [journal.order(index) for index in range(4)] == [*orders, None]
    assert journal.credit == told[9]
    assert [journal.answer(number) for number in (1, 2, 3, 4)] == [told[1], None, told[5], None]
    journal.close()


def test_journal_at_limit_is_dropped_once_client_is_up_to_date(said):
    journal = Journal(3, 1000, None, None)
    answers = [pack(Kind.ANSWER, b"x" * 400, number) for number in (1, 2, 3, 4)]
    for answer in answers[:3]:
        journal.record(answer, is_read=True)
    assert journal.answer(1) == answers[0]
    assert not journal.given_up
    assert not journal.record(answers[3])
    assert "journal_size" in journal.given_up
    assert journal.answer(1) is journal.answer(4) is None
    assert journal.record(pack(Kind.APPLY, b"x", 1))
    assert journal.order(0) is None
    (warning,) = said()
    assert "Instance 3 can no longer be restarted" in warning
    journal.close()


def test_a_journal_of_credit_alone_does_not_grow():
    journal = Journal(1, 1e9, None, None)
    for number in range(1000):
        journal.record(pack(Kind.CREDIT, number=number))
    assert journal.order(0) is None
    assert journal.credit == pack(Kind.CREDIT, number=999)
    journal.close()
