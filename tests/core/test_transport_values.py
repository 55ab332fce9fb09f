"""The codec of plain values: everything comes back with the same type and bits."""

from __future__ import annotations

import contextlib
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from physx_core.errors import ConnectionRefusedByPeerError, UsageError
from physx_core.transport.values import decode, encode

PLAIN_DTYPES = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(endianness="?"),
    hnp.unsigned_integer_dtypes(endianness="?"),
    hnp.floating_dtypes(endianness="?"),
    hnp.complex_number_dtypes(endianness="?"),
    hnp.unicode_string_dtypes(),
    hnp.byte_string_dtypes(),
    hnp.datetime64_dtypes(),
)
ARRAYS = hnp.arrays(PLAIN_DTYPES, hnp.array_shapes(min_dims=0, min_side=0, max_side=4))
ATOMS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(min_value=-(2**5000), max_value=2**5000),
    st.floats(),
    st.complex_numbers(),
    st.text(st.characters()),
    st.binary(),
)
KEYS = st.recursive(ATOMS, lambda inner: st.tuples(inner, inner), max_leaves=3)
SCALARS = ARRAYS.filter(lambda array: array.size > 0).map(lambda array: array.reshape(-1)[0])
VALUES = st.recursive(
    st.one_of(ATOMS, ARRAYS, SCALARS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.dictionaries(KEYS, inner, max_size=4),
    ),
    max_leaves=12,
)


def same(a, b):
    """Whether two values have the same types and bits throughout."""
    if type(a) is not type(b):
        return False
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        pairs = zip(a.items(), b.items(), strict=True)
        return len(a) == len(b) and all(same(x, y) for x, y in pairs)
    if isinstance(a, (np.ndarray, np.generic)):
        same_bits = a.tobytes() == b.tobytes()
        if a.dtype.char in "gG":  # these have unused bytes
            same_bits = np.array_equal(a, b, equal_nan=True)
        return a.dtype == b.dtype and a.shape == b.shape and same_bits
    if isinstance(a, float):
        return struct.pack("<d", a) == struct.pack("<d", b)
    if isinstance(a, complex):
        return same(a.real, b.real) and same(a.imag, b.imag)
    return a == b


@settings(max_examples=150, deadline=None)
@given(VALUES)
def test_values_come_back_with_type_and_bits(value):
    assert same(decode(encode(value)), value)


def test_particular_values_come_back():
    for value in (
        [-0.0, math.inf, -math.inf, math.nan, 5e-324, 0.1, 1e300],
        struct.unpack("<d", bytes.fromhex("010000000000f8ff"))[0],
        "\ud800 lone",
        10**5000,
        np.array(1.5),
        np.float32(0.1),
        np.longdouble("0.1"),
        np.str_("ends with nul\0"),
        np.zeros((0, 3), np.int8),
        np.arange(12.0).reshape(3, 4)[:, ::2],
        np.asfortranarray(np.arange(6).reshape(2, 3)),
        Path("some/where.urdf"),
        {1: {2.5: (True, b"\0")}, (1, "a"): None},
    ):
        assert same(decode(encode(value)), value), value


def test_decoded_arrays_are_their_own_and_writable():
    array = decode(encode({"a": np.arange(5)}))["a"]
    array[0] = 7
    assert array.flags.owndata or array.base is not None
    assert array.flags.writeable and array[0] == 7


class Text(str):
    pass


@pytest.mark.parametrize(
    "value",
    [object(), {1, 2}, Text("x"), np.array([None]), np.zeros(2, "i4,f8"), np.ma.array([1]), print],
    ids=["object", "set", "subclass", "objects", "structured", "masked", "function"],
)
def test_what_cannot_travel_is_named(value):
    with pytest.raises(UsageError, match=r"(?s)options\['deep'\]\[1\] is .*cannot travel"):
        encode({"deep": [0, value]}, "options")


def test_endless_nesting_is_an_error():
    value = []
    value.append(value)
    with pytest.raises(UsageError, match="nested too deeply"):
        encode(value)


@settings(max_examples=150, deadline=None)
@given(
    st.binary(max_size=60)
    | VALUES.map(encode).flatmap(
        lambda data: st.integers(0, max(0, len(data) - 1)).map(lambda end: data[:end])
    )
)
def test_damaged_bytes_never_raise_anything_else(data):
    with contextlib.suppress(ConnectionRefusedByPeerError):
        decode(data)


@pytest.mark.parametrize(
    "text",
    [
        b'{"a":["|O",[1],0]}',
        b'{"a":["<f8",[1000000000000],0]}',
        b'{"a":["<f8",[-1,-1],8]}',
        b'{"zz":1}',
        b'{"a":1,"b":2}',
        b'{"b":-1}',
        b'{"d":[[[],1]]}',
        b"[" * 100000,
    ],
)
def test_malicious_text_is_refused(text):
    with pytest.raises(ConnectionRefusedByPeerError):
        decode(struct.pack("<I", len(text)) + text + bytes(8))
