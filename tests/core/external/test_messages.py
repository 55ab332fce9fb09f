"""Messages of programs are data: whatever the bytes, they are a message or a clear error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core.external.messages import (
    DESCRIPTION,
    HEADER,
    Header,
    Kind,
    MalformedMessageError,
    pack_answer,
    parse_descriptions,
    parse_header,
)

NUMBERS = st.one_of(st.integers(0, 9), st.integers(0, 2**32 - 1))
TYPES = st.one_of(st.sampled_from([ord("f") * 256 + 8, ord("b") * 256 + 1]), NUMBERS)
NAMES = st.one_of(st.binary(max_size=52), st.sampled_from([b"x", b"y", b"step", b"\xff"]))
AXES = st.one_of(st.integers(0, 4), st.integers(-(2**63), 2**63 - 1))
RANKS = st.one_of(st.integers(-1, 8), st.integers(-(2**31), 2**31 - 1))
DESCRIPTIONS = st.lists(
    st.builds(
        lambda name, kind, rank, wanted, axes: DESCRIPTION.pack(name, kind, rank, wanted, *axes),
        *(NAMES, TYPES, RANKS, NUMBERS, st.lists(AXES, min_size=8, max_size=8)),
    ),
    max_size=3,
)


@given(st.binary(min_size=HEADER.size, max_size=HEADER.size))
def test_any_bytes_are_a_header_or_an_error(data):
    for each in (data, b"phy\1" + data[4:], b"phy\1\3\0\2\0" + data[8:]):
        try:
            header = parse_header(each)
        except MalformedMessageError:
            continue
        assert header.kind in Kind and header.arrays <= 64 and header.size <= 2**30


@given(st.sampled_from(Kind), DESCRIPTIONS, st.one_of(st.integers(0, 100), st.just(8)))
def test_any_bytes_are_descriptions_or_an_error(kind, parts, size):
    header = Header(kind, len(parts), size)
    try:
        sent, wanted = parse_descriptions(header, b"".join(parts))
    except MalformedMessageError as error:
        assert str(error).isprintable() and len(str(error)) < 500
        return
    assert len(sent) + len(wanted) == len(parts)
    assert sum(field.nbytes for field in sent) == size
    for field in (*sent, *wanted):
        assert field.name.isidentifier()
        assert (field.shape is not None) or kind is Kind.FIELDS
        assert field.nbytes <= 2**30


@pytest.mark.parametrize("shape", [(), (0,), (2, 3), (3, 0, 1)])
def test_an_answer_holds_the_data_in_order(shape):
    arrays = [np.arange(np.prod(shape, dtype=int), dtype="f4").reshape(shape), np.ones(2, "i8").T]
    data = b"".join(bytes(part) for part in pack_answer(arrays))
    magic, kind, count, size = HEADER.unpack(data[: HEADER.size])
    assert (magic, kind, count) == (b"phy\1", Kind.ANSWER, 2)
    content = arrays[0].tobytes() + arrays[1].tobytes()
    assert data[HEADER.size :] == content and size == len(content)
