"""physx.py, with which a script in any Python sends samples, speaks the protocol by itself."""

from __future__ import annotations

import array
import ast
import importlib.util
import socket
import sys

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.errors import ProgramError
from physx_core.external import INCLUDE
from physx_core.external.messages import (
    DESCRIPTION,
    HEADER,
    Kind,
    pack_answer,
    parse_descriptions,
    parse_header,
)

SPEC = importlib.util.spec_from_file_location("physx_of_programs", INCLUDE / "physx.py")
physx = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(physx)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return a function that connects with some fields, and the other end of the connection."""
    monkeypatch.setenv("PHYSX_SOCKET", str(tmp_path / "s"))
    opened = []
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()

        def connect(fields, **options):
            ours = physx.Run(fields, **options)
            theirs, _ = listener.accept()
            opened.extend([ours._socket, theirs])
            return ours, theirs

        yield connect
    for each in opened:
        each.close()


def heard(connection):
    """Return the next message: its kind, values, and descriptions of what it requests."""
    header = parse_header(connection.recv(HEADER.size, socket.MSG_WAITALL))
    raw = connection.recv(header.arrays * DESCRIPTION.size, socket.MSG_WAITALL)
    content = connection.recv(header.size, socket.MSG_WAITALL) if header.size else b""
    given, wanted = parse_descriptions(header, raw)
    values = {}
    for field in given:
        own, content = content[: field.nbytes], content[field.nbytes :]
        values[field.name] = np.frombuffer(own, field.numpy_dtype).reshape(field.shape)
    return header.kind, values, [(each.name, each.shape, str(each.numpy_dtype)) for each in wanted]


VALUES = [
    (1.5, "float64", 1.5),
    (3, "int64", 3),
    (True, "bool", True),
    (1 - 2j, "complex128", 1 - 2j),
    ([[1, 2.5], [3, 4]], "float64", [[1, 2.5], [3, 4]]),
    ([(1j, 2)], "complex128", [[1j, 2]]),
    ([], "float64", []),
    ([[], []], "float64", [[], []]),
    (array.array("f", [1, 2]), "float32", [1, 2]),
    (array.array("l", [1, 2]), "int64", [1, 2]),
    (b"\1\2", "uint8", [1, 2]),
    ([np.float32(0.5), np.arange(2)[1]], "float64", [0.5, 1]),
    (np.float32(0.5), "float32", 0.5),
    *(
        (np.arange(6).reshape(2, 3).T.astype(kind), kind, [[0, 3], [1, 4], [2, 5]])
        for kind in ("int8", "int16", "uint32", "int64", "float32", "complex64", "complex128")
    ),
    (np.array([[True], [False]]), "bool", [[True], [False]]),
    (np.zeros((0, 3), "u2"), "uint16", np.zeros((0, 3))),
]


@pytest.mark.parametrize(("value", "kind", "wanted"), VALUES)
def test_a_value_arrives_as_what_it_is(run, value, kind, wanted):
    ours, theirs = run({"x": value})
    assert heard(theirs) == (Kind.FIELDS, {}, [("x", np.shape(wanted), kind)])
    ours.send(x=value)
    said, values, _ = heard(theirs)
    assert said is Kind.SAMPLE
    assert str(values["x"].dtype) == kind
    np.testing.assert_array_equal(values["x"], wanted)


@pytest.mark.parametrize(("value", "kind", "wanted"), VALUES)
def test_an_answer_has_the_form_of_what_it_is_asked_with(run, value, kind, wanted):
    ours, theirs = run({"y": 0.0})
    wanted = np.array(wanted, kind)
    for part in pack_answer([wanted, np.array(7.0)]):
        theirs.sendall(part)
    answer = ours.parameters(x=value, z=0.0)
    assert answer["z"] == 7.0 and type(answer["z"]) is float
    np.testing.assert_array_equal(answer["x"], wanted)
    is_array = isinstance(value, (np.ndarray, np.generic))
    assert isinstance(answer["x"], (np.ndarray, np.generic)) == is_array
    if is_array:
        assert answer["x"].dtype == value.dtype and answer["x"].shape == value.shape
        assert not answer["x"].shape or answer["x"].flags.writeable


def test_an_array_without_values_may_be_described(run):
    _, theirs = run({"x": physx.Array("int16", (2, 3)), "y": physx.Array("bool", None)})
    assert heard(theirs)[2] == [("x", (2, 3), "int16"), ("y", None, "bool")]


def test_a_process_of_several_says_where_its_part_begins(run):
    _, theirs = run({"x": [0.0], "t": 0.0}, rank=2, ranks=3, offsets={"x": 10})
    kind, values, _ = heard(theirs)
    assert kind is Kind.PART
    assert values["part"].tolist() == [2, 3, 10, 0]
    assert heard(theirs)[0] is Kind.FIELDS


def test_it_says_that_it_has_sent_all_unless_it_fails(run):
    ours, theirs = run({"x": 0.0})
    heard(theirs)
    with ours:
        ours.send(x=1.0)
    assert [heard(theirs)[0] for _ in range(2)] == [Kind.SAMPLE, Kind.CLOSE]
    ours, theirs = run({"x": 0.0})
    heard(theirs)
    with pytest.raises(ZeroDivisionError), ours:
        _ = 1 / 0
    ours._socket.close()
    assert theirs.recv(1) == b""


def test_a_run_that_is_over_ends_the_program(run):
    ours, theirs = run({"x": 0.0})
    theirs.close()
    with pytest.raises(physx.RunIsOver) as caught:
        ours.parameters(x=0.0)
    assert isinstance(caught.value, SystemExit)
    with pytest.raises(physx.RunIsOver):
        ours.send(x=0.0)


@pytest.mark.parametrize(
    ("value", "error"),
    [
        ("text", "'text' is not a number, a list or an array"),
        ([[1.0], [1.0, 2.0]], "the lists in it have different lengths"),
        (None, "None is not a number"),
        (np.array(["a"]), "physx sends no numbers of the type '1w'"),
        (np.array([1.0], ">f8"), "physx sends no numbers of the type '>d'"),
        (np.array([1], object), "physx sends no numbers of the type 'O'"),
        (physx.Array("float16"), "the type must be one of bool, int8"),
        (physx.Array("int8", (1,) * 9), "arrays up to 8 axes"),
    ],
)
def test_a_value_that_cannot_be_sent_is_named(run, value, error):
    with pytest.raises((TypeError, ValueError), match=f"x: .*{error}"):
        run({"x": value})


def test_a_program_that_no_run_has_started_says_so(monkeypatch):
    monkeypatch.delenv("PHYSX_SOCKET", raising=False)
    with pytest.raises(RuntimeError, match="was not started by a physx run"):
        physx.Run({"x": 0.0})
    monkeypatch.setenv("PHYSX_SOCKET", "/nowhere")
    with pytest.raises(RuntimeError, match="the run is over, or .* has already connected"):
        physx.Run({"x": 0.0})


def test_it_is_written_for_old_interpreters():
    ast.parse((INCLUDE / "physx.py").read_text(), feature_version=(3, 8))


SCRIPT = """
import sys
assert "site" not in sys.modules
import physx
with physx.Run({"x": [0.0, 0.0], "seed": 0}) as run:
    while True:
        given = run.parameters(seed=0, scale=[0.0, 0.0])
        run.send(x=given["scale"], seed=given["seed"])
"""


@pytest.mark.processes
@pytest.mark.parametrize("place", ["local", "clients"])
def test_a_script_needs_nothing_but_an_interpreter(place, request, tmp_path):
    """It finds physx.py in its module path."""
    make = request.getfixturevalue(place)
    (tmp_path / "solver.py").write_text(SCRIPT)
    kwargs = {
        "program": [sys.executable, "-S", str(tmp_path / "solver.py")],
        "ranges": {"scale": {"low": 0.0, "high": 1.0, "shape": 2}},
        "additional": ["seed"],
    }
    with make("external/program", env_kwargs=kwargs, episode_steps=1, num_clients=2) as source:
        rows = source.batch(6)
        assert len({*rows["seed"].tolist()}) == 6
        assert len({*rows["x"][:, 0].tolist()}) == 6


@pytest.mark.processes
def test_a_mistake_in_a_script_is_told_with_its_traceback(local, tmp_path):
    (tmp_path / "solver.py").write_text(SCRIPT.replace('given["scale"]', "'three'"))
    kwargs = {
        "program": [sys.executable, "-S", str(tmp_path / "solver.py")],
        "parameters": {"scale": [1.0, 2.0]},
    }
    error = "ended with exit status 1 after 0 samples[^§]*x: 'three' is not a number"
    with (
        pytest.raises(ProgramError, match=error),
        local("external/program", env_kwargs=kwargs) as source,
    ):
        source.batch(1)


FAILING = """
import sys
import physx
with physx.Run({"number": 0, "k": 0.0}) as run:
    while True:
        given = run.parameters(k=0.0, episode=0)
        if given["k"] > 0.5:
            sys.exit(3)
        run.send(number=given["episode"], k=given["k"])
"""


@pytest.mark.processes
@pytest.mark.parametrize("as_clients", [False, True])
def test_a_program_that_fails_before_its_first_sample_fails_no_other_episode(as_clients, tmp_path):
    (tmp_path / "solver.py").write_text(FAILING)
    kwargs = {
        "program": [sys.executable, "-S", str(tmp_path / "solver.py")],
        "ranges": {"k": [0.0, 1.0]},
    }
    config = EnvironmentConfig(
        "external/program",
        env_kwargs=kwargs,
        episode_steps=1,
        seed=1,
        as_tcp_ip_client=as_clients,
        num_clients=2,
    )
    run = DataGeneration(config, episodes=12, max_failed=12, quiet=True)
    run.execute()
    with Dataset.open(run.session.dataset_dir) as dataset:
        table, rows = dataset["episodes"], dataset["training"]
        failed = {each.episode for each in dataset.failed_episodes("training")}
        assert failed == set(table["episode"][table["k"][:] > 0.5].tolist())
        assert 1 < len(failed) < 11
        assert rows["number"][:].tolist() == [n for n in range(12) if n not in failed]
