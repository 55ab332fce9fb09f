"""Feeder: items and calls in their order, whatever each side does when."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core.pipelines.learning.batches.feeder import Feeder


@dataclass
class Made:
    """An item."""

    number: int
    count: int
    nbytes: int = 0


class Maker:
    """Makes items; some ask or tell the training's thread something first, one may fail."""

    def __init__(self, feeder, *, asks=(), tells=(), fails_at=-1, nbytes=0):
        self.feeder, self.number, self.nbytes = feeder, 0, nbytes
        self.asks, self.tells, self.fails_at = asks, tells, fails_at
        self.log, self.canceled = [], threading.Event()
        self._ask = feeder.calling(self.answer)
        self._tell = feeder.telling(self.hear)

    def answer(self, number):
        assert threading.current_thread() is threading.main_thread()
        self.log.append(("asked", number))
        return 2 * number

    def hear(self, number):
        assert threading.current_thread() is threading.main_thread()
        self.log.append(("told", number))

    def __call__(self, count):
        number, self.number = self.number, self.number + 1
        if number in self.tells:
            self._tell(number)
        if number in self.asks:
            assert self._ask(number) == 2 * number
        if number == self.fails_at:
            raise OverflowError(number)
        return Made(number, count, self.nbytes)


NUMBERS = st.sets(st.integers(0, 11))


@settings(max_examples=size(60, 7), deadline=None)
@given(
    steps=st.lists(
        st.one_of(st.just("next"), st.lists(st.integers(0, 9), max_size=4)), max_size=12
    ),
    asks=NUMBERS,
    tells=NUMBERS,
    fails_at=st.integers(-1, 14),
)
def test_it_gives_what_a_loop_would_give(steps, asks, tells, fails_at):
    feeder = Feeder()
    maker = Maker(feeder, asks=asks, tells=tells, fails_at=fails_at)
    feeder.start(maker, maker.canceled.set)
    expected, taken, log = [], 0, []
    for step in steps:
        if step != "next":
            feeder.expect(step)
            expected += step
            continue
        if taken == len(expected):
            expected.append(5)
        log += [("told", taken)] * (taken in tells) + [("asked", taken)] * (taken in asks)
        if taken == fails_at:
            for _ in range(2):  # nothing follows an error
                with pytest.raises(OverflowError):
                    feeder.next(5)
            break
        item = feeder.next(5)
        assert (item.number, item.count) == (taken, expected[taken])
        taken += 1
        assert maker.log == log
    feeder.close()
    feeder.close()
    assert maker.canceled.is_set()
    assert maker.log[: len(log)] == log  # and what it was told after that, but no more questions
    assert all(kind == "told" for kind, _ in maker.log[len(log) :])


@pytest.mark.parametrize(("nbytes", "most"), [(0, 64), (1 << 20, 64), (1 << 24, 4), (1 << 30, 1)])
def test_no_more_items_wait_than_there_is_room_for(nbytes, most):
    feeder = Feeder()
    maker = Maker(feeder, nbytes=nbytes)
    feeder.start(maker, maker.canceled.set)
    feeder.expect([1] * 200)
    deadline = time.monotonic() + 20
    for taken in range(5):
        while maker.number < taken + most and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(0.01)
        assert maker.number == taken + most
        feeder.next(1)
    feeder.close()


def test_it_ends_while_its_thread_waits_for_an_answer():
    feeder = Feeder()
    maker = Maker(feeder, asks={0})
    feeder.start(maker, maker.canceled.set)
    feeder.expect([1])
    feeder.close()
    assert not maker.log and "physx-feeder" not in {one.name for one in threading.enumerate()}
