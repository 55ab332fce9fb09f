"""The codec of plain values: everything comes back with the same type and bits."""

from __future__ import annotations

import contextlib
import json
import math
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sizes import size

from physx_core.errors import ConnectionRefusedByPeerError, UsageError
from physx_core.net import Kind, decode, encode, pack, pack_value

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
CONTIGUOUS = hnp.arrays(PLAIN_DTYPES, hnp.array_shapes(min_dims=0, min_side=0, max_side=4))
ARRAYS = st.one_of(
    CONTIGUOUS,
    CONTIGUOUS.map(np.asfortranarray),
    CONTIGUOUS.map(np.transpose),
    CONTIGUOUS.map(lambda array: array[::-2] if array.ndim else array),
)
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


FLAT = st.dictionaries(st.text(max_size=5), st.one_of(ARRAYS, SCALARS), max_size=4)


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


@settings(max_examples=size(150, 18))
@given(VALUES)
def test_values_come_back_with_type_and_bits(value):
    assert same(decode(encode(value)), value)


@settings(max_examples=size(150, 18))
@given(FLAT, st.sampled_from(Kind), st.integers(0, 2**64 - 1))
def test_flat_dictionaries_come_back_however_often_they_travel(value, kind, number):
    for _ in range(2):
        data = encode(value)
        assert same(decode(data), value)
        assert same(decode(bytearray(data)), value)
        assert pack_value(kind, value, "value", number) == pack(kind, data, number)


def test_keys_that_only_look_alike_keep_their_type():
    array = np.arange(3)
    for key in ("x", np.str_("x"), 1, True, 1.0, "x"):
        assert same(decode(encode({key: array})), {key: array})
    for value in (np.float64(1), np.array(1.0), 1.0, np.float32(1), np.array([1.0])):
        assert same(decode(encode({"x": value})), {"x": value})


def test_particular_values_come_back():
    for value in (
        [-0.0, math.inf, -math.inf, math.nan, 5e-324, 0.1, 1e300],
        struct.unpack("<d", bytes.fromhex("010000000000f8ff"))[0],
        "\ud800 lone",
        "\ud83d\ude00 two halves, \U0001f600 one whole",
        np.str_("\ud83d\ude00"),
        {"\ud83d\ude00": np.arange(2)},
        {"unaligned": np.zeros(1, np.int8), "x": np.arange(3.0), "ä": np.float32(2)},
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
    original = np.arange(5)
    for data in (encode({"a": original}), bytearray(encode({"a": original, "b": [1]}))):
        array = decode(data)["a"]
        array[0] = 7
        assert array.flags.writeable and array.flags.aligned and array[0] == 7
    assert original[0] == 0


class Text(str):
    pass


@pytest.mark.parametrize(
    "value",
    [object(), {1, 2}, Text("x"), np.array([None]), np.zeros(2, "i4,f8"), np.ma.array([1]), print],
    ids=["object", "set", "subclass", "objects", "structured", "masked", "function"],
)
def test_unserializable_values_are_named(value):
    with pytest.raises(UsageError, match=r"(?s)options\['deep'\]\[1\] is .*cannot be sent"):
        encode({"deep": [0, value]}, "options")


def test_endless_nesting_is_an_error():
    value = []
    value.append(value)
    with pytest.raises(UsageError, match="nested too deeply"):
        encode(value)


ENCODED = st.one_of(VALUES, FLAT).map(encode)


@st.composite
def damaged(draw):
    """Bytes of a value, of which some are changed, left out or added."""
    data = bytearray(draw(ENCODED))
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, len(data)))
        length = draw(st.integers(0, 3))
        data[place : place + length] = draw(st.binary(max_size=3))
    return bytes(data)


TAGS = st.sampled_from(["i", "f", "c", "b", "w", "t", "d", "a", "s", "u", "y", "p", "flat", "z"])
PLAIN = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 2**70),
    st.floats(),
    st.text(max_size=4),
    st.sampled_from(["<f8", "|O", "<U1", "<M8[s]", "|S0", "(9,9)<f8", "f8,O", "scalar", "00"]),
)
TREES = st.recursive(
    PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(TAGS, inner, min_size=1, max_size=1),
        st.dictionaries(st.text(max_size=2), inner, max_size=3),
    ),
    max_leaves=10,
)


def refused_or_taken(data):
    with contextlib.suppress(ConnectionRefusedByPeerError):
        decode(data)


@settings(max_examples=size(200, 25))
@given(st.binary(max_size=60) | damaged())
def test_corrupt_bytes_raise_only_decoding_errors(data):
    refused_or_taken(data)


@settings(max_examples=size(300, 37))
@given(TREES, st.binary(max_size=20))
def test_random_tags_raise_only_decoding_errors(tree, data):
    text = json.dumps(tree, separators=(",", ":")).encode()
    refused_or_taken(struct.pack("<I", len(text)) + text + data)


@pytest.mark.parametrize(
    "text",
    [
        b'{"a":["|O",[1],0]}',
        b'{"a":["<f8",[1000000000000],0]}',
        b'{"a":["<f8",[-1,-1],8]}',
        b'{"a":["<f8",[0,1180591620717411303424],0]}',
        b'{"a":["<S1000000000",[1],8]}',
        b'{"a":["<f8",[1.0],8]}',
        b'{"a":["(1000000,1000000)<f8",[1],8]}',
        b'{"a":["<f8",{"a":1},8]}',
        b'{"s":["<U1",[],4]}',
        b'{"a":[">U2",[1],8]}',
        b'{"a":["|b1",[8],8]}',
        b'{"flat":[["x","|b1",[8]]]} ',
        b'{"zz":1}',
        b'{"a":1,"b":2}',
        b'{"b":-1}',
        b'{"b":true}',
        b'{"c":[]}',
        b'{"d":[[[],1]]}',
        b'{"w":2}',
        b'{"flat":[["x","<f8",[1000000000000]]]}',
        b'{"flat":[["x","|O",[1]]]}',
        b'{"flat":[["x","<f8",[1],1]]}',
        b'{"flat":[[1,"<f8",[1]]]}',
        b'{"flat":{"x":1}}',
        b'{"flat":[["x","<f8",[1]]]',
        b'{"flat":[]}' + b" " * 5000,
        b"[" * 100000,
        b'{"t":[' * 100000,
        b'{"d":[[1,' * 100000,
        b"1" * 5000,
    ],
)
def test_malicious_text_is_refused_and_takes_little_memory(text):
    tracemalloc.start()
    try:
        with pytest.raises(ConnectionRefusedByPeerError) as caught:
            decode(struct.pack("<I", len(text)) + text + b"\xff" * 8)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 400


def test_too_much_text_is_refused_on_both_sides(monkeypatch):
    monkeypatch.setattr("physx_core.net.values._MAX_TEXT", 1000)
    assert decode(encode(list(range(100)))) == list(range(100))
    with pytest.raises(UsageError, match=r"numbers holds .* Pass NumPy arrays"):
        encode(list(range(1000)), "numbers")
    text = b"1" + b" " * 1000
    with pytest.raises(ConnectionRefusedByPeerError, match="1001 bytes of text"):
        decode(struct.pack("<I", len(text)) + text)


def test_a_message_that_is_too_long_is_refused_before_it_is_made():
    huge = np.broadcast_to(np.zeros(1, np.int8), (1 << 30) + 1)
    with pytest.raises(UsageError, match="too long"):
        pack_value(Kind.PREDICT, {"x": huge}, "get_prediction()")
