"""RowQueue: as many episodes as a number of rows needs, against the simplest model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import UsageError
from physx_core.workers.row_queue import Ended, RowQueue


def ended_episodes(rows):
    """Return episodes with these rows by number as a restarted run finds them."""
    numbers = np.array(sorted(rows), np.int64)
    return Ended(numbers, np.ones_like(numbers), np.array([rows[n] for n in numbers.tolist()]))


def rows_without_gap(ended):
    """Return how many rows the episodes before the first missing one have."""
    total = number = 0
    while number in ended:
        total += ended[number]
        number += 1
    return total


@given(st.data(), st.integers(1, 30), st.sets(st.integers(0, 8), max_size=4))
def test_numbers_are_given_out_until_those_without_a_gap_have_enough_rows(data, goal, recorded):
    ended = {number: data.draw(st.integers(0, 5)) for number in recorded}
    queue = RowQueue(goal, ended_episodes(ended))
    held, lost = [], set()
    for _ in range(300):
        assert queue.rows == rows_without_gap(ended)
        assert queue.is_done == (queue.rows >= goal)
        if queue.is_done:
            break
        number = queue.take()
        if number is not None:
            assert number not in ended
            assert number not in held
            held.append(number)
        assert held  # else nobody would go on
        which = data.draw(st.integers(0, len(held) - 1))
        operation = data.draw(st.sampled_from(["end", "end", "end", "parts", "put back", "lose"]))
        number = held.pop(which)
        rows = data.draw(st.integers(0, 5))
        if operation == "put back":
            queue.put_back(number)
        elif operation == "lose" and number not in lost:
            assert queue.give_back(number)
            lost.add(number)
        elif operation == "parts":
            more = {"episode": number, "status": EpisodeStatus.MORE}
            queue.note(EpisodeRecord(rows=3, **more))
            queue.note(EpisodeRecord(rows=1, **more))  # of a client that begins it anew
            queue.note(EpisodeRecord(episode=number, rows=rows, part=1))
            ended[number] = rows + 1
        else:
            queue.note(EpisodeRecord(episode=number, rows=rows))
            ended[number] = rows


@given(st.integers(1, 40), st.integers(1, 6), st.integers(1, 4))
def test_no_more_episodes_than_needed_if_all_are_of_the_same_length(goal, length, clients):
    queue, held, begun = RowQueue(goal), [], 0
    while not queue.is_done:
        limit = clients if begun else 1
        while len(held) < limit and (number := queue.take()) is not None:
            held.append(number)
            begun += 1
        queue.note(EpisodeRecord(episode=held.pop(0), rows=length))
    assert begun == -(-goal // length)


def test_range_of_episodes_of_one_row_counts_as_its_episodes():
    queue = RowQueue(5)
    taken = [queue.take() for _ in range(5)]
    assert queue.take() is None
    queue.note(EpisodeRecord(episode=taken[1], rows=4, count=4))
    assert (queue.rows, queue.is_done) == (0, False)
    queue.note(EpisodeRecord(episode=0, rows=1))
    assert queue.is_done


def test_episodes_that_never_have_a_row_are_an_error():
    queue = RowQueue(5)
    with pytest.raises(UsageError, match="episodes 0 to 999 have no row"):
        for _ in range(1001):
            queue.note(EpisodeRecord(episode=queue.take(), rows=0))


@pytest.mark.parametrize("restarted", [False, True])
def test_episodes_without_rows_after_others_are_told_and_then_an_error(restarted):
    ended = {0: 2, 1: 0, 2: 1} if restarted else {}
    queue = RowQueue(5, ended_episodes(ended))
    for number in range(len(ended), 3):
        queue.note(EpisodeRecord(episode=queue.take(), rows=[2, 0, 1][number]))
    with pytest.warns(UserWarning, match="episodes 3 to 1002 have no row") as warned:
        for _ in range(9_999):
            queue.note(EpisodeRecord(episode=queue.take(), rows=0))
    assert len(warned) == 1
    with pytest.raises(UsageError, match="episodes 3 to 10002 have no row"):
        queue.note(EpisodeRecord(episode=queue.take(), rows=0))
