"""ClientSource: misbehaving clients that know the token.

The client joins with the public handshake, beside the test. It sends two good rows, or none, before
it misbehaves.
"""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from simulated import HOST

from physx_core import Dataset, Field
from physx_core.dataset import EpisodeStatus
from physx_core.errors import ClientError, ConnectionRefusedByPeerError, NotFiniteError
from physx_core.net import HEADER, Kind, encode, introduce, pack, retry
from physx_core.net.frames import Frame
from physx_core.rows import ROW_FIELDS
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.server.leases import Leases

TOKEN, PORT = "a token for this test", 1
DEFINED = [Field("x", shape=(2,)), Field("flag", shape=(), dtype="bool")]


def fields(kind, listed):
    return pack(kind, encode([field.to_dict() for field in listed]))


def plain_fields(kind, *listed):
    return pack(kind, encode(list(listed)))


def rows(*steps, x=1.0, width=2, flag=1, env_id=1, count=None):
    size = len(steps)
    payload = (
        np.full((size, width), x).tobytes()
        + bytes([flag]) * size
        + np.full(size, env_id, "<i4").tobytes()
        + np.zeros(size, "<i8").tobytes()
        + np.array(steps, "<i8").tobytes()
    )
    return HEADER.pack(len(payload), Kind.ROWS, 0, size if count is None else count) + payload


def changed(position, **changes):
    """The fields of the rows as they should be, with one of them changed."""
    listed = [field.to_dict() for field in (*DEFINED, *ROW_FIELDS)]
    listed[position].update(changes)
    return plain_fields(Kind.FIELDS, *listed)


STATE = {"orders": 0, "shown": 0, "rejected": 0, "state": b""}
READY = fields(Kind.READY, DEFINED)
FIELDS = fields(Kind.FIELDS, [*DEFINED, *ROW_FIELDS])
X = DEFINED[0].to_dict()


@pytest.fixture
def run_with(simulated, simulation, monkeypatch, folder):
    """Have a client send messages; return the error that ends the run, and the rows it stored."""
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)

    def misbehave(messages, deaf):
        connection = retry(
            lambda left: simulation.connect((HOST, PORT), left),
            *(60, 0.1, ConnectionRefusedError),
            clock=simulation,
        )
        with contextlib.suppress(OSError, EOFError), contextlib.closing(connection):
            reader = introduce(connection, TOKEN, 1)
            granted = 0
            for needed, message in messages:
                while granted < needed:
                    frame = reader.read(connection)
                    granted = frame.number if frame.kind is Kind.CREDIT else granted
                connection.sendall(message)
            if deaf:  # it reads nothing before
                simulation.sleep(60)
            while connection.recv(1 << 16):
                pass

    def run(*messages, deaf=False):
        simulation.start(lambda: misbehave(messages, deaf))
        with (
            Dataset.create(folder) as dataset,
            pytest.raises((ClientError, NotFiniteError)) as caught,
            simulated(run_ahead=0, launcher="physx/manual", port=PORT) as source,
        ):
            for size in (2, 1, 1):
                batch = source.batch(size)
                dataset.define_fields("training", source.fields)
                dataset.append("training", batch)
        with Dataset.open(folder) as dataset:
            assert dataset.verify() == []
            return caught.value, dataset.num_samples("training")

    return run


LATER = {
    "more rows than granted": (rows(2, 3, 4), "3 rows that nobody asked for"),
    "no rows": (rows(), "0 rows that nobody asked for"),
    "as many rows as a number can tell": (rows(2, count=2**64 - 1), "nobody asked for"),
    "fewer bytes than rows": (pack(Kind.ROWS, b"", 1), "0 bytes for 1 rows of 37 bytes"),
    "wider rows": (rows(2, width=3), "45 bytes for 1 rows of 37 bytes"),
    "rows of another instance": (rows(2, env_id=2), "rows of another instance"),
    "rows that were there": (rows(1), "steps do not increase"),
    "rows before the first": (rows(-5), "steps do not increase"),
    "neither true nor false": (rows(2, flag=7), '"flag" is neither true nor false'),
    "rejected rows": (pack(Kind.WRONG, rows(2)[HEADER.size :], 1), "nobody asked for"),
    "fields again": (FIELDS, "fields of its rows twice"),
    "ready again": (READY, "defined its fields twice"),
    "an answer to nobody": (
        pack(Kind.ANSWER, encode({}), 1),
        "ANSWER, which a client may not",
    ),
    "a refusal": (pack(Kind.REFUSAL, b"", 2**64 - 1), "REFUSAL, which a client may not send"),
    "credit": (pack(Kind.CREDIT, number=9), "CREDIT, which a client may not send"),
    "hello again": (pack(Kind.HELLO, bytes(44)), "HELLO, which a client may not send"),
    "proof again": (pack(Kind.PROOF, bytes(32), 1), "PROOF, which a client may not send"),
    "an unknown kind": (HEADER.pack(0, 999, 0, 0), "not a physx message"),
    "a longer message than there can be": (HEADER.pack(2**32 - 1, 8, 0, 1), "not a physx message"),
    "a spare that is used": (HEADER.pack(0, 8, 1, 0), "not a physx message"),
    "a request out of turn": (pack(Kind.LOAD, number=7), "numbered its requests wrongly"),
    "a damaged request": (pack(Kind.PREDICT, b"x", 1), "damaged"),
    "a request of no names": (pack(Kind.PREDICT, encode([1]), 1), "not a dictionary of names"),
    "parameters without names": (pack(Kind.SAVE, encode({1: 2}), 1), "not a dictionary of names"),
    "a deep request": (pack(Kind.SAVE, b"\x40\x0d\x03\0" + b"[" * 200_000, 1), "damaged"),
    "a state of nothing": (pack(Kind.STATE, encode([]), 1), "sent a state that is none"),
    "a state of the future": (pack(Kind.STATE, encode(STATE), 9), "rows that it has not sent"),
    "a state after drawings": (
        pack(Kind.STATE, encode(STATE | {"shown": 1}), 1),
        "rows that it has not sent",
    ),
    "a reason that is none": (pack(Kind.STATE, encode([])), "does not describe an error"),
    "drawing nothing": (pack(Kind.SHOW, encode([("add", "mesh")]), 1), "malformed drawing events"),
    "drawing otherwise": (
        pack(Kind.SHOW, encode([("eval", "mesh", "a", {})]), 1),
        "malformed drawing events",
    ),
    "an error that is none": (
        pack(Kind.ERROR, encode({"classes": ["PhysxError"]})),
        "does not describe an error",
    ),
    "an error with a strange note": (
        pack(
            Kind.ERROR,
            encode(
                {
                    "classes": [],
                    "message": "",
                    "attributes": {"__notes__": [1]},
                    "traceback": "",
                }
            ),
        ),
        "does not describe an error",
    ),
}

FIRST = {
    "another type": (changed(0, dtype="<f4"), "but it defined"),
    "another name": (changed(0, name="y"), "but it defined"),
    "another shape": (changed(0, shape=[3]), "but it defined"),
    "another unit": (changed(0, unit="m"), "but it defined"),
    "another role": (changed(0, role="additional"), "but it defined"),
    "a larger number of the instance": (changed(2, dtype="<i8"), "but it defined"),
    "fewer fields": (fields(Kind.FIELDS, DEFINED), "2 fields, but it defined 5"),
    "rows of unknown fields": (rows(0, 1), "2 rows that nobody asked for"),
}

BEFORE = {
    "fields before all": (FIELDS, "5 fields, but it defined 3"),
    "no fields": (plain_fields(Kind.READY), "not list any fields, or lists one twice"),
    "fields that are no list": (pack(Kind.READY, encode(1)), "is malformed"),
    "a field that is none": (plain_fields(Kind.READY, 1), "is malformed"),
    "a field twice": (plain_fields(Kind.READY, X, X), "not list any fields, or lists one twice"),
    "a field of physx": (plain_fields(Kind.READY, {**X, "name": "step"}), 'field "step"'),
    "a name that is none": (plain_fields(Kind.READY, {**X, "name": "a b"}), "identifier"),
    "objects": (plain_fields(Kind.READY, {**X, "dtype": "|O"}), "is malformed"),
    "a type in parts": (plain_fields(Kind.READY, {**X, "dtype": "f8,f8"}), "is malformed"),
    "a type that is none": (plain_fields(Kind.READY, {**X, "dtype": "<f5"}), "not a NumPy type"),
    "a negative shape": (
        plain_fields(Kind.READY, {**X, "shape": [-1]}),
        "shape is (-1,) but must not be negative",
    ),
    "a shape in words": (plain_fields(Kind.READY, {**X, "shape": "2"}), "is malformed"),
    "fields of episodes alone": (plain_fields(Kind.READY, {**X, "role": "episode"}), "only fields"),
    "an open field of episodes": (
        plain_fields(Kind.READY, X, {"name": "y", "dtype": "<f8", "role": "episode"}),
        "without shape",
    ),
    "a field of episodes that is too large": (
        plain_fields(Kind.READY, X, {**X, "name": "y", "role": "episode", "shape": [2**40]}),
        "the limit is",
    ),
}


@pytest.mark.parametrize("case", LATER)
def test_malformed_message_after_rows_is_reported(run_with, case):
    message, text = LATER[case]
    error, stored = run_with((0, READY), (1, FIELDS), (2, rows(0, 1)), (3, message))
    assert type(error) is ClientError
    assert error.instance_id == 1
    assert str(error).startswith("Client 1 was cut off after 2 rows. ")
    assert text in str(error)
    assert isinstance(error.exit_status, type(None))
    assert stored == 2


@pytest.mark.parametrize("case", FIRST)
def test_malformed_fields_are_reported(run_with, case):
    message, text = FIRST[case]
    error, stored = run_with((0, READY), (2, message))
    assert str(error).startswith("Client 1 was cut off after 0 rows. ")
    assert text in str(error)
    assert stored == 0


@pytest.mark.parametrize("case", BEFORE)
def test_malformed_message_before_ready_is_reported(run_with, case):
    message, text = BEFORE[case]
    error, stored = run_with((0, message))
    assert str(error).startswith("Client 1 was cut off after 0 rows. ")
    assert text in str(error)
    assert stored == 0


@pytest.mark.parametrize("sizes", [[2**31, 2**31, 2**31], [2**62, 4], [2**28]])
def test_huge_rows_are_rejected_before_anything_is_allocated(run_with, sizes):
    open_shape = plain_fields(Kind.READY, {k: v for k, v in X.items() if k != "shape"})
    listed = [{**X, "shape": sizes}, *(field.to_dict() for field in ROW_FIELDS)]
    error, stored = run_with((0, open_shape), (2, plain_fields(Kind.FIELDS, *listed)))
    assert "bytes; the limit is 1073741824" in str(error)
    assert stored == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_inf_rows_are_not_stored(run_with, value):
    error, stored = run_with((0, READY), (1, FIELDS), (2, rows(0, 1)), (3, rows(2, x=value)))
    assert type(error) is NotFiniteError
    assert (error.instance_id, error.field, error.step) == (1, "x", 2)
    assert stored == 2


def test_client_that_reads_no_answers_is_disconnected(run_with, services):
    services.kept[1] = {"large": np.zeros(1 << 21)}
    requests = b"".join(pack(Kind.LOAD, encode(None), number) for number in range(1, 20))
    error, _ = run_with((0, READY), (1, requests), deaf=True)
    assert "does not read the answers" in str(error)


MESH = [Field("mesh", (2,), role="episode"), Field("good", (), "bool", role="episode")]
VALUES = {"mesh": np.zeros(2), "good": np.array(True)}
ENDED = {
    "without its fields": ({}, "the fields"),
    "of other fields": ({"mesh": np.zeros(2), "bad": np.array(True)}, "the fields"),
    "of further fields": ({**VALUES, "more": np.zeros(2)}, "the fields"),
    "of another shape": ({**VALUES, "mesh": np.zeros(3)}, "the fields"),
    "of another type": ({**VALUES, "mesh": np.zeros(2, "f4")}, "the fields"),
    "of lists": ({**VALUES, "mesh": [0.0, 0.0]}, "impossible episodes"),
    "of no dictionary": ([1], "impossible episodes"),
    "that is not finite": ({**VALUES, "mesh": np.array([0, np.inf])}, "infinite"),
    "neither true nor false": ({**VALUES, "good": np.array(2, "u1").view("?")}, "neither 0 nor 1"),
}


def leases_of_one(**options):
    """Return leases, and a client that has the first number."""
    pace = SimpleNamespace(go_on=lambda: None)
    peer = SimpleNamespace(instance_id=1, parameters=[], send=lambda message: None, pace=pace,
                           received=0, **options)  # fmt: skip
    leases = Leases(EpisodeQueue(3), lambda numbers: {})
    leases.grant(peer, 1)
    return leases, peer


def test_more_rejected_rows_than_are_kept_are_refused():
    leases, peer = leases_of_one(row_fields=[*DEFINED, *ROW_FIELDS], episode_fields=[])
    payload = rows(*range(500), env_id=0)[HEADER.size :]
    frame = Frame(Kind.WRONG, 500, bytearray(payload))
    for _ in range(3):
        leases.dispatch[Kind.WRONG](peer, frame)
    with pytest.raises(ConnectionRefusedByPeerError, match="more rejected rows than are kept"):
        leases.dispatch[Kind.WRONG](peer, frame)


@pytest.mark.parametrize("case", ["good", "failed with fields", *ENDED])
def test_malformed_fields_of_episodes_are_refused(case):
    leases, peer = leases_of_one(row_fields=[], episode_fields=MESH)
    values, text = ENDED.get(case, (VALUES, "the fields"))
    status = EpisodeStatus.FAILED if case.startswith("failed") else EpisodeStatus.FINISHED
    payload = encode([[(0, 1, 0, 0, int(status), 0.5, "", values)], None])
    frame = Frame(Kind.EPISODES, 0, bytearray(payload))
    if case == "good":
        leases.dispatch[Kind.EPISODES](peer, frame)
        (record,) = leases.blocks[0].records
        assert {name: value.tolist() for name, value in record.fields.items()} == {
            "mesh": [0, 0],
            "good": True,
        }
        return
    with pytest.raises((ConnectionRefusedByPeerError, NotFiniteError), match=text):
        leases.dispatch[Kind.EPISODES](peer, frame)
