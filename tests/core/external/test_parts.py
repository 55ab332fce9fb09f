"""Programs of several processes, each of which sends its part of a field."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core.errors import ProgramError
from physx_core.external.messages import Kind, MalformedMessageError, Message
from physx_core.external.parts import Division, Part, read_part
from physx_core.fields import Field

pytestmark = pytest.mark.processes

SOURCES = Path(__file__).parents[1] / "programs" / "external"
SEVERAL = [sys.executable, "-S", str(SOURCES / "several.py")]
WHOLE = [[[2.0 * i, step] for i in range(10)] for step in range(3)]


def program(way):
    return [*SEVERAL, "4", sys.executable, "-S", str(SOURCES / "parts.py"), way]


def rows_of(source, count=3):
    with source as opened:
        return {name: values.copy() for name, values in opened.batch(count).items()}


@pytest.mark.parametrize("place", ["local", "clients"])
def test_parts_of_a_field_are_joined_in_order(place, request):
    make = request.getfixturevalue(place)
    kwargs = {"program": program("well"), "parameters": {"scale": 2.0}}
    rows = rows_of(make("external/program", env_kwargs=kwargs), 4)
    np.testing.assert_array_equal(rows["u"], [*WHOLE, WHOLE[0]])
    np.testing.assert_array_equal(rows["t"], [0, 1, 2, 0])
    np.testing.assert_array_equal(rows["episode"], [0, 0, 0, 1])


def test_each_process_gets_its_part_of_a_prediction(local, services):
    services.predict = lambda fields: {"predicted": 0.5 * np.asarray(fields["u"])}
    kwargs = {"program": program("ask"), "parameters": {"scale": 2.0}}
    rows = rows_of(local("external/program", env_kwargs=kwargs))
    np.testing.assert_array_equal(rows["u"], WHOLE)
    np.testing.assert_array_equal(rows["predicted"], 0.5 * np.array(WHOLE))


def test_one_process_may_ask_for_a_prediction_alone(local, services):
    services.predict = lambda fields: {"v": 0.5 * np.asarray(fields["t"])}
    kwargs = {"program": program("ask alone"), "parameters": {"scale": 2.0}}
    np.testing.assert_array_equal(rows_of(local("external/program", env_kwargs=kwargs))["u"], WHOLE)


WAYS = {
    "overlap": r'parts of "u" that overlap: 0 to 2 \(rank 1\) and 2 to 6 \(rank 2\)',
    "gap": r'parts of "u" with a gap: nobody has 3 to 4, before 5 to 6 \(rank 2\)',
    "negative": r'"u" with the offset -1 in rank 2',
    "missing": r"did nothing in rank 2 for 2 s",
    "twice": r"called physx_open_part\(\) in rank 1 of 4, after rank . of 4: each rank",
    "number": r"called physx_open_part\(\) in rank . of ., after rank . of .: each rank",
    "scalar": r'"t" in several ranks, although it has no first axis .*: 0, 1, 2, 3',
    "type": r'"u" that differ .*: <f8 of .* \(rank 0\), <f4 of .* \(rank 2\)',
    "axes": r'"u" that differ in more than their first axis',
    "other call": r"a message of the kind SAMPLE in rank 0, but CLOSE in rank 2",
    "size": r'"u" in rank 2 with the shape \(3, 2\), but declared a part of the shape \(4, 2\)',
    "left out": r'"u" in rank 2 not at all, but declared a part of the shape \(4, 2\)',
    "one more": r'sent "t", of which no rank declared a part, in the ranks 0, 2',
    "dies": r"ended with exit status 3 .*after 1 samples|exit status 3 in rank",
    "hangs": r"did nothing in rank 2 for 2 s",
}


@pytest.mark.parametrize("way", WAYS)
def test_parts_that_do_not_fit_together_are_named(local, way, nothing_stays_behind):
    timeout = 2 if "2 s" in WAYS[way] else 50
    kwargs = {"program": program(way), "parameters": {"scale": 2.0}, "timeout": timeout}
    with pytest.raises(ProgramError, match=WAYS[way]):
        rows_of(local("external/program", env_kwargs=kwargs))


def test_ranks_of_an_mpi_program_send_their_parts(local, build, monkeypatch):
    if shutil.which("mpicc") is None and os.environ.get("CI") != "true":
        pytest.skip("no MPI is installed (openmpi-bin, libopenmpi-dev)")
    for name in ("ALLOW_RUN_AS_ROOT", "ALLOW_RUN_AS_ROOT_CONFIRM"):
        monkeypatch.setenv(f"OMPI_{name}", "1")
    built = build("parts.c", "-std=c99", "-Wall", "-Wextra", "-Werror", using="mpicc")
    command = ["mpirun", "--oversubscribe", "-n", "3", built]
    kwargs = {"program": command, "parameters": {"scale": 2.0}}
    rows = rows_of(local("external/program", env_kwargs=kwargs), 4)
    i, j = np.mgrid[:6, :3]
    wanted = [2.0 * i + 10 * step + j for step in (0, 1, 2, 0)]
    np.testing.assert_array_equal(rows["u"], wanted)
    np.testing.assert_array_equal(rows["sum"], [each.sum() for each in wanted])


def test_processes_in_fortran_send_their_parts(local, build):
    built = build("parts.f90", "-Wall", "-Wextra", "-Werror", using="gfortran")
    kwargs = {"program": [*SEVERAL, "2", built], "parameters": {"scale": 2.0}}
    rows = rows_of(local("external/program", env_kwargs=kwargs))
    i, j = np.mgrid[:4, :3]
    np.testing.assert_array_equal(rows["u"], [2.0 * i + 10 * step + j for step in range(3)])


# What has no process -----------------------------------------------------------------------------


@given(st.lists(st.integers(0, 4), min_size=1, max_size=6), st.randoms())
def test_what_is_divided_and_joined_is_what_it_was(sizes, rng):
    ends = np.cumsum(sizes).tolist()
    ranks = list(range(len(sizes)))
    rng.shuffle(ranks)  # the order of the parts is another one than that of the ranks
    declared = [(Field("x", (sizes[n], 2)),) for n in ranks]
    parts = [Part(n, len(sizes), (ends[n] - sizes[n],)) for n in ranks]
    renumbered = [part._replace(rank=rank) for rank, part in enumerate(parts)]
    division = Division(renumbered, declared)
    whole = np.arange(2.0 * ends[-1]).reshape(-1, 2)
    assert division.fields[0].shape == whole.shape
    given = [{"x": division.divide(rank, *fields, whole)} for rank, fields in enumerate(declared)]
    messages = [
        Message(Kind.PREDICT, each, fields) for each, fields in zip(given, declared, strict=True)
    ]
    merged = division.merge(messages)
    np.testing.assert_array_equal(merged.given["x"], whole)
    assert merged.wanted == tuple(division.fields)


@pytest.mark.parametrize("part", [[], [0], [0.0, 1.0], [[0, 1]], [1, 1], [-1, 1], [0, 10**9]])
def test_a_part_that_cannot_be_is_refused(part):
    message = Message(Kind.PART, {"part": np.array(part)}, ())
    with pytest.raises(MalformedMessageError):
        read_part(message)
