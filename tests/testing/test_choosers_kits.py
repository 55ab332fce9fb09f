"""The kit names what is wrong with samplers and buffers, and finds nothing in right ones."""

import pytest

from physx_core.errors import UsageError
from physx_testing import check_buffer, check_sampler

pytestmark = pytest.mark.processes

SAMPLERS = [
    ("InOrder", "chooses the same in any order", "differently"),
    ("Unseeded", "chooses the same again", "same seed"),
    ("OutOfBounds", "chooses every parameter within its bounds", "stiffness"),
    ("Incomplete", "chooses every parameter within its bounds", "cells"),
    ("Cached", "hands out copies of its sets", "changed by its user"),
    ("LearnsByChance", "learns the same again", "differently"),
    ("ForgetsLosses", "continues from a state", "differently"),
    ("RestoresAnything", "refuses an invalid state", "ValueError"),
]
BUFFERS = [
    ("Decreases", "needs more rows from batch to batch", "decreases"),
    ("NeedsByState", "needs rows that depend only on its options", "after batches were drawn"),
    ("Impatient", "draws rows that it keeps", "slot without a row"),
    ("OwnRandom", "draws the same again", "same seed"),
    ("HiddenState", "continues from a state", "restore()"),
    ("NoStepBack", "steps back by one batch", "checkpoint"),
    ("TakesAnyState", "refuses states of other buffers", "ValueError"),
]


@pytest.mark.parametrize(("name", "check", "text"), SAMPLERS)
def test_wrong_samplers(name, check, text, place, expect_named):
    expect_named(check_sampler(place("wrong_choosers", name)), check, text)


@pytest.mark.parametrize(("name", "check", "text"), BUFFERS)
def test_wrong_buffers(name, check, text, place, expect_named):
    expect_named(check_buffer(place("wrong_choosers", name)), check, text)


@pytest.mark.parametrize("name", ["Right", "Learns"])
def test_nothing_is_found_in_right_samplers(name, place, expect_right):
    expect_right(check_sampler(place("wrong_choosers", name)))


def test_nothing_is_found_in_a_right_buffer(place, expect_right):
    expect_right(check_buffer(place("wrong_choosers", "Ring")))


def test_an_expected_failure_is_one_of_a_check(place):
    where = place("wrong_choosers", "Unseeded")
    known = {"chooses the same again": "known", "chooses the same in any order": "the same"}
    report = check_sampler(where, expected_failures={**known, "begins again": "x"})
    assert report.ok and report.counts()["expected"] >= 2
    with pytest.raises(UsageError, match="no checks"):
        check_sampler(where, expected_failures={"flies": "it cannot"})
