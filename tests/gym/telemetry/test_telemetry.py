"""Telemetry: variables are registered by reference and recorded row by row."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core.errors import ConfigError, EpisodeError
from physx_gym.telemetry.telemetry import MOST_IN_TRAINING, Telemetry


def columns(telemetry):
    return [name for name in telemetry.log.variables if name != "time"]


def recorded(telemetry, *times):
    telemetry.begin()
    for time in times:
        telemetry.record(time)
    return telemetry.log.variables


def test_names_are_derived_from_the_keys():
    telemetry = Telemetry()
    value = {"arm": np.zeros(2), "hands": [np.zeros((1, 2)), np.zeros((), np.int64)]}
    telemetry.register("robot", value)
    telemetry.register("gain", np.zeros(()), namespace="controller")
    assert columns_after(telemetry) == [
        "robot.arm.0",
        "robot.arm.1",
        "robot.hands.0.0.0",
        "robot.hands.0.0.1",
        "robot.hands.1",
        "controller.gain",
    ]


def columns_after(telemetry):
    telemetry.begin()
    return columns(telemetry)


@pytest.mark.parametrize(
    ("value", "fieldnames", "wanted"),
    [
        (np.zeros(2), ["a", "b"], ["v.a", "v.b"]),
        (np.zeros((2, 2)), [["a", "b"], ["c", "d"]], ["v.a", "v.b", "v.c", "v.d"]),
        (np.zeros((2, 2)), ["a", "b", "c", "d"], ["v.a", "v.b", "v.c", "v.d"]),
        (np.zeros(1), "a", ["v.a"]),
        (np.zeros(()), "a", ["v.a"]),
        (
            {"k": np.zeros(1), "l": (np.zeros(2),)},
            {"k": "a", "l": [["b", "c"]]},
            ["v.a", "v.b", "v.c"],
        ),
    ],
)
def test_names_are_those_given(value, fieldnames, wanted):
    telemetry = Telemetry()
    telemetry.register("v", value, fieldnames)
    assert columns_after(telemetry) == wanted


def test_fieldnames_are_a_live_view_nested_like_the_variables():
    telemetry = Telemetry()
    view = telemetry.fieldnames
    telemetry.register("v", {"k": np.zeros((1, 2)), "l": [np.zeros(1)]}, namespace="n")
    assert dict(view) == {"n.v": {"k": [["n.v.k.0.0", "n.v.k.0.1"]], "l": [["n.v.l.0.0"]]}}


def test_variables_are_read_when_a_row_is_recorded():
    telemetry = Telemetry()
    reals, counts = np.zeros(3), np.zeros(2, np.int64)
    telemetry.register("reals", reals)
    telemetry.register("counts", counts)
    telemetry.begin()
    for number in range(2500):
        reals[:], counts[:] = number / 7, 2**62 + number
        telemetry.record(number * 1e-3)
    found = telemetry.log.variables
    assert telemetry.rows == 2500
    np.testing.assert_array_equal(found["time"], np.arange(2500) * 1e-3)
    np.testing.assert_array_equal(found["reals.2"], np.arange(2500) / 7)
    np.testing.assert_array_equal(found["counts.1"], 2**62 + np.arange(2500))
    assert found["counts.0"].dtype == np.int64


@settings(max_examples=size(60, 7))
@given(st.data())
def test_any_arrangement_of_memory_is_recorded_in_order(data):
    base = np.arange(120.0).reshape(4, 5, 6)
    whole = np.arange(500.0, 560.0)
    parts = [base.T, base[::2, :, ::-1], base[1], base[:, 2], base[3, 4, 5:], base[0, 0, 0:0]]
    parts += [whole[:10], whole[10:30], whole[30:31], whole[31:32].reshape(()), whole[32:]]
    parts += [whole.view(np.int64)[3:9], np.array([[7]]), base[0, 1, 2:3].reshape(())]
    order = data.draw(st.permutations(range(len(parts))))
    telemetry = Telemetry()
    for number in order:
        telemetry.register(f"part{number}", parts[number])
    found = recorded(telemetry, 0.5)
    for number in order:
        prefix = (f"part{number}.", f"part{number}")
        values = [v[0] for k, v in found.items() if k == prefix[1] or k.startswith(prefix[0])]
        np.testing.assert_array_equal(values, parts[number].ravel())


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(2, np.float32), r'"v" is an array of float32; only float64 and int64'),
        (np.zeros(2, ">f8"), "only float64"),
        ({"a": [1.0]}, r'"v\.a\.0" is 1\.0, a float\. Variables are registered by reference'),
        (None, "a NoneType"),
        ("text", "a str"),
    ],
)
def test_values_that_are_not_arrays_are_rejected(value, message):
    with pytest.raises(ConfigError, match=message):
        Telemetry().register("v", value)


@pytest.mark.parametrize(
    ("value", "fieldnames", "message"),
    [
        (np.zeros(2), ["a"], r"shape \(2,\), but fieldnames of shape \(1,\)"),
        (np.zeros((2, 2)), ["a", "b"], r"shape \(2, 2\)"),
        (np.zeros(1), [3], "is 3, not a string"),
        (np.zeros(1), [""], "not a string"),
        ({"k": np.zeros(1)}, {"l": "a"}, "lack 'k': they must be nested like the value"),
        ({"k": np.zeros(1)}, "a", "lack 'k'"),
        (np.zeros(2), ["a", "a"], r'a number "v\.a", but that name is already used by "v" itself'),
    ],
)
def test_names_that_do_not_fit_are_rejected(value, fieldnames, message):
    with pytest.raises(ConfigError, match=message):
        Telemetry().register("v", value, fieldnames)


def test_names_are_unique():
    telemetry = Telemetry()
    kept = np.zeros(2)
    telemetry.register("v", kept)
    telemetry.register("v", kept)
    with pytest.raises(ConfigError, match='"v" is already registered'):
        telemetry.register("v", np.zeros(2))
    with pytest.raises(ConfigError, match=r'"v\.0", but that name is already used by "v"'):
        telemetry.register("0", np.zeros(()), namespace="v")
    with pytest.raises(ConfigError, match="used by the time"):
        telemetry.register("time", np.zeros(()))
    with pytest.raises(ConfigError, match="needs a name"):
        telemetry.register("", kept)
    with pytest.raises(ConfigError, match="2 numbers, but 1 units"):
        telemetry.register("w", kept, unit=["m"])


def test_a_variable_of_an_earlier_episode_is_replaced():
    telemetry = Telemetry()
    telemetry.register("v", np.zeros(2))
    recorded(telemetry, 0.0)
    telemetry.end()
    telemetry.register("v", np.ones(1))
    assert recorded(telemetry, 0.0)["v.0"] == [1.0]
    assert columns(telemetry) == ["v.0"]
    telemetry.end()
    telemetry.unregister("v")
    telemetry.begin()
    assert not telemetry.is_recording


def test_nothing_is_registered_during_an_episode():
    telemetry = Telemetry()
    telemetry.register("v", np.zeros(2))
    telemetry.begin()
    for change in (lambda: telemetry.register("w", np.zeros(2)), lambda: telemetry.unregister("v")):
        with pytest.raises(EpisodeError, match="during an episode"):
            change()


def test_in_training_only_chosen_variables_are_recorded():
    telemetry = Telemetry()
    telemetry.register("v", np.zeros(2))
    telemetry.begin(training=True)
    telemetry.record(0.0)
    assert not telemetry.is_recording
    assert telemetry.log_data == {}
    telemetry.register("w", np.ones(1), is_eval_only=False)
    telemetry.begin(training=True)
    telemetry.record(0.0)
    assert columns(telemetry) == ["w.0"]


def test_a_second_row_of_the_same_time_replaces_the_first():
    telemetry = Telemetry()
    value = np.zeros(())
    telemetry.register("v", value)
    telemetry.begin()
    for number, time in enumerate((0.0, 0.1, 0.1, 0.1, 0.2)):
        value[...] = number
        telemetry.record(time)
    assert telemetry.log.variables["v"].tolist() == [0.0, 3.0, 4.0]
    assert telemetry.log.time.tolist() == [0.0, 0.1, 0.2]


def test_the_last_episode_is_kept_until_the_next_one():
    telemetry = Telemetry()
    assert telemetry.log_data == {}
    value = np.zeros(())
    telemetry.register("v", value, unit="N")
    telemetry.begin(None, {"seed": 3})
    telemetry.record(0.0)
    before = telemetry.log_data
    value[...] = 5.0
    telemetry.record(1.0)
    assert before["variables"]["v"].tolist() == [0.0]
    telemetry.end()
    telemetry.record(2.0)
    after = telemetry.log_data
    assert after["variables"]["v"].tolist() == [0.0, 5.0]
    assert after["constants"] == {"seed": 3, "units": {"time": "s", "v": "N"}}
    telemetry.begin()
    assert telemetry.log_data == {}


def test_pickled_variables_are_still_those_of_their_owner():
    telemetry = Telemetry()
    whole = np.zeros(4)
    telemetry.register("v", {"part": whole[1:3]})
    recorded(telemetry, 0.0)
    copy, owner = pickle.loads(pickle.dumps((telemetry, whole)))  # noqa: S301
    owner[1:3] = 4.0, 5.0
    found = recorded(copy, 0.0)
    assert (found["v.part.0"][0], found["v.part.1"][0]) == (4.0, 5.0)
    assert dict(copy.fieldnames) == dict(telemetry.fieldnames)


def test_only_the_latest_rows_are_kept_in_training():
    telemetry, value = Telemetry(), np.zeros(1, np.int64)
    telemetry.register("n", value, is_eval_only=False)
    telemetry.begin(training=True)
    rows = MOST_IN_TRAINING + 1500
    for number in range(rows):
        value[0] = number
        telemetry.record(float(number))
    found = telemetry.log_data["variables"]
    assert len(found["time"]) == MOST_IN_TRAINING
    for column in found.values():
        np.testing.assert_array_equal(column, np.arange(rows - len(column), rows))
    telemetry.rewind(rows - 1030.0)
    value[0] = -1
    telemetry.record(rows + 1.0)
    assert telemetry.log_data["variables"]["n.0"][-2:].tolist() == [rows - 1031, -1]
    telemetry.begin(training=True)
    assert telemetry.rows == 0
    telemetry.record(0.0)
    assert telemetry.log_data["variables"]["n.0"].tolist() == [-1]
