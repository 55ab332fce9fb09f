"""The queue of a campaign's numbers against the simplest one: a sorted list."""

from __future__ import annotations

import pytest
import sizes
from hypothesis import given, settings
from hypothesis import strategies as st

from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.lease import Begun, EpisodeState


class Model:
    """Numbers that came back, then those that were never given out."""

    def __init__(self, total, recorded, retries):
        self.fresh = [number for number in range(total) if number not in recorded]
        self.finished = total - len(self.fresh)
        self.total, self.retries, self.back, self.losses = total, retries, [], {}

    def take(self):
        for waiting in (self.back, self.fresh):
            if waiting:
                number = min(waiting)
                waiting.remove(number)
                return number
        return None

    def give_back(self, number):
        self.losses[number] = self.losses.get(number, 0) + 1
        if self.losses[number] > self.retries:
            return False
        self.back.append(number)
        return True


OPERATIONS = st.lists(
    st.tuples(
        st.sampled_from(["take", "take several", "finish", "put back", "give back"]), st.integers()
    ),
    max_size=60,
)


@given(
    st.integers(0, 12),
    st.sets(st.integers(0, 20)),
    st.integers(0, 2),
    OPERATIONS,
)
@settings(max_examples=sizes.size(300, 40))
def test_numbers_come_in_order_and_those_that_came_back_first(total, recorded, retries, operations):
    queue, model, held = (
        EpisodeQueue(total, recorded, retries),
        Model(total, recorded, retries),
        [],
    )
    lost = 0
    for operation, which in operations:
        if operation == "take":
            number = queue.take()
            assert number == model.take()
            held += [] if number is None else [number]
        elif operation == "take several":
            returned = bool(model.back)
            numbers = list(queue.take_range(1 + which % 5))
            assert numbers == [model.take() for _ in numbers]
            assert len(numbers) == 1 or not returned
            assert bool(numbers) == bool(numbers or model.back or model.fresh)
            held += numbers
        elif held:
            number = held.pop(which % len(held))
            if operation == "finish":
                queue.note(EpisodeRecord(episode=number, rows=2))
                model.finished += 1
            elif operation == "put back":
                queue.put_back(number)
                model.back.append(number)
            else:
                is_back = queue.give_back(number)
                assert is_back == model.give_back(number)
                lost += not is_back
        assert queue.finished == model.finished
        assert queue.is_done == (model.finished == total)
        assert queue.waiting >= len(model.back) + len(model.fresh)
        assert len(held) + len(model.back) + len(model.fresh) + model.finished + lost == total


@given(st.sets(st.integers(0, 12)), st.sets(st.integers(0, 15)))
@settings(max_examples=sizes.size(100, 20))
def test_begun_episodes_come_in_order_and_alone(recorded, begun):
    queue = EpisodeQueue(12, recorded, begun={n: Begun(1, 5, 4, b"s") for n in begun - recorded})
    taken = []
    while numbers := queue.take_range(3):
        assert len(numbers) == 1 or not begun.intersection(numbers)
        assert [n for n in numbers if queue.begun(n)] == [n for n in numbers if n in begun]
        taken += numbers
    assert taken == [number for number in range(12) if number not in recorded]


def test_queue_follows_the_parts_of_an_episode():
    queue = EpisodeQueue(2)

    def follow(part, rows, made=0, status=EpisodeStatus.MORE):
        state = EpisodeState(1, made, b"state") if made else None
        queue.follow(EpisodeRecord(episode=1, rows=rows, part=part, status=status), state)
        return queue.begun(1)

    assert follow(0, 7) is None
    assert follow(1, 3, made=8) == Begun(2, 10, 8, b"state")
    assert follow(2, 5) == Begun(3, 15, 8, b"state")
    assert follow(0, 4) is None  # begun anew
    with pytest.raises(ValueError, match="after rows"):
        follow(1, 4, made=9)
    follow(0, 4, made=4)
    assert follow(1, 1, status=EpisodeStatus.FINISHED) is None


def test_numbers_beyond_the_total_are_no_episodes_of_it():
    queue = EpisodeQueue(3, [1, 3, 7])
    assert (queue.finished, queue.is_done) == (1, False)
    assert [queue.take() for _ in range(3)] == [0, 2, None]
    for number in (0, 2):
        queue.note(EpisodeRecord(episode=number, rows=1))
    assert queue.is_done


@pytest.mark.parametrize("recorded", [[], range(5)])
def test_campaign_without_missing_numbers_is_done_at_once(recorded):
    queue = EpisodeQueue(len(recorded), recorded)
    assert queue.is_done
    assert queue.take() is None


def test_number_that_nobody_began_is_never_lost():
    queue = EpisodeQueue(1, retries=0)
    for _ in range(5):
        assert queue.take() == 0
        queue.put_back(0)
    assert queue.take() == 0
    assert not queue.give_back(0)
    assert queue.take() is None
