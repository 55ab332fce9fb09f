"""Helpers: jobs done beside the thread that gives them, or within it."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core.processes import Helper


@pytest.fixture(params=[False, True], ids=["thread", "inline"])
def helper(request):
    with Helper("test", inline=request.param) as helper:
        yield helper


def test_results_come_in_the_order_of_the_jobs(helper):
    for number in range(100):
        helper.give(lambda number=number: number)
    assert helper.pending == 100
    assert [helper.take() for _ in range(100)] == list(range(100))
    assert not helper.pending and not helper.is_ready


def test_the_first_error_is_raised_and_later_jobs_are_done(helper):
    done = []
    jobs = [lambda: done.append(1), lambda: 1 / 0, lambda: done.append(2), lambda: [].pop()]
    for job in jobs:
        helper.give(job)
    with pytest.raises(ZeroDivisionError):
        helper.drain()
    with pytest.raises(IndexError):
        helper.drain()
    helper.drain()
    assert done == [1, 2]


def test_jobs_that_were_given_are_done_when_a_helper_is_closed():
    done, go_on = [], threading.Event()
    helper = Helper("test")
    helper.give(lambda: go_on.wait(10))
    for number in range(10):
        helper.give(lambda number=number: done.append(number))
    assert not helper.is_ready
    go_on.set()
    helper.close()
    assert done == list(range(10))


def test_closing_ends_a_pause():
    helper = Helper("test")
    helper.give(lambda: helper.pause(1e6))
    helper.close()
    assert helper.is_ready


def test_a_pause_within_the_caller_takes_no_time():
    with Helper("test", inline=True) as helper:
        helper.give(lambda: helper.pause(1e6))
        helper.drain()


def test_a_helper_without_jobs_has_no_thread():
    before = threading.active_count()
    with Helper("test"):
        assert threading.active_count() == before


@given(st.lists(st.sampled_from(["give", "fail", "take", "drain"]), max_size=30))
def test_any_order_of_calls_is_that_of_a_queue(calls):
    for inline in (True, False):
        with Helper("test", inline=inline) as helper:
            waiting = []
            for number, call in enumerate(calls):
                if call in ("give", "fail"):
                    waiting.append((call, number))
                    helper.give(
                        lambda number=number, call=call: number if call == "give" else 1 / 0
                    )
                elif call == "take" and waiting:
                    check(helper.take, *waiting.pop(0))
                elif call == "drain":
                    failed = next(
                        (n for n, (kind, _) in enumerate(waiting) if kind == "fail"), None
                    )
                    check(helper.drain, "give" if failed is None else "fail", None)
                    waiting = [] if failed is None else waiting[failed + 1 :]
                assert helper.pending == len(waiting)


def check(call, kind, result):
    if kind == "fail":
        with pytest.raises(ZeroDivisionError):
            call()
    else:
        assert call() == result
