"""LearnedSets: what a sampler is told before each set, against the simplest model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core import Parameter
from physx_core.components import LearningSampler
from physx_core.dataset import EpisodeRecord
from physx_core.workers.learned_sets import LearnedSets
from physx_core.workers.row_queue import Ended, RowQueue

PARAMETERS = [Parameter("a", 0.0, 1.0, shape=(2,)), Parameter("n", 0, 9, distribution="integer")]


class Telling(LearningSampler):
    """Chooses what shows which losses it was told, in order."""

    memory = 10**9

    def begin(self, parameters, seed):
        super().begin(parameters, seed)
        self.told = np.zeros(1)

    def ask(self, number):
        return {"a": [number, self.told[0]], "n": number % 10}

    def tell(self, numbers, values, losses):
        for number, value in zip(numbers.tolist(), values, strict=True):
            assert value["a"][0] == number
        self.told = 3 * self.told + losses.sum()

    def state(self):
        return self.told

    def restore(self, state):
        if state.shape != (1,):
            raise ValueError("it is no such state")
        self.told = state


def begun(size, batch_nb, run_ahead):
    sampler = Telling()
    sampler.begin(PARAMETERS, [0])
    return LearnedSets(sampler, PARAMETERS, lambda b: (b + 1) * size, batch_nb, run_ahead)


def loss_of(rows):
    return 1.0 + rows[:, 0] % 7


def expected(lengths, size, batch_nb, run_ahead):
    """Return what each set shows: the batches made only of rows of numbers below k - W."""
    ends = np.cumsum([0, *lengths])
    owners = np.repeat(np.arange(len(lengths)), lengths)
    found = []
    for number in range(len(lengths)):
        told = 0.0
        for batch in range(batch_nb):
            if (batch + 1) * size > ends[max(0, number - run_ahead)]:
                break
            rows = owners[batch * size : (batch + 1) * size]
            told = 3 * told + sum(np.mean(loss_of(np.array([[n]]))) for n in {*rows.tolist()})
        found.append(told)
    return found


@pytest.mark.slow
@given(
    st.data(),
    st.lists(st.integers(0, 4), min_size=1, max_size=25),
    st.integers(1, 6),
    st.integers(1, 8),
)
def test_each_set_is_chosen_after_exactly_the_batches_of_earlier_episodes(
    data, lengths, size, run_ahead
):
    """Whenever episodes end and batches are learned from, and after each restoring."""
    batch_nb = sum(lengths) // size
    sets, chosen = begun(size, batch_nb, run_ahead), {}
    queue = RowQueue(10**6)
    queue.choose = sets.choose
    owners, ended, held = np.repeat(np.arange(len(lengths)), lengths), set(), []
    told = restored = 0
    for _ in range(data.draw(st.integers(0, 150))):
        rows = queue.rows
        operation = data.draw(st.sampled_from(["take", "end", "learn", "restore"]))
        if operation == "take" and (number := queue.take()) is not None and number < len(lengths):
            assert number <= queue.missing + run_ahead
            values = sets.values_of(number)
            assert values["n"] == number % 10
            chosen[number] = values["a"][1]
            held.append(number)
        elif operation == "end" and held:
            number = held.pop(data.draw(st.integers(0, len(held) - 1)))
            queue.note(EpisodeRecord(episode=number, rows=lengths[number]))
            ended.add(number)
        elif operation == "learn" and (told + 1) * size <= rows and told < batch_nb:
            numbers = owners[told * size : (told + 1) * size]
            sets.tell(numbers, loss_of(numbers[:, None]))
            told += 1
        elif operation == "restore" and told:
            back = data.draw(st.integers(0, int(told > restored)))
            state = sets.state(told - back)
            restored = told = told - back
            sets = begun(size, batch_nb, run_ahead)
            sets.restore(told, state)
            numbers = np.array(sorted(ended), np.int64)
            rows = np.array(lengths)[numbers]
            queue = RowQueue(10**6, Ended(numbers, np.ones_like(numbers), rows))
            queue.choose, held = sets.choose, []
    wanted = expected(lengths, size, batch_nb, run_ahead)
    assert chosen == {number: wanted[number] for number in chosen}


def test_only_what_is_simulated_is_chosen():
    sets, queue = begun(2, 5, 10**9), RowQueue(10)
    queue.choose, asked = sets.choose, []
    ask = sets._sampler.ask
    sets._sampler.ask = lambda number: asked.append(number) or ask(number)
    assert [queue.take() for _ in range(3)] == [0, 1, 2] == asked


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state[:-1], "no such state"),
        (lambda state: state[:3], "other options"),
        (lambda state: np.where(np.arange(len(state)) == 1, 5.0, state), "other batches"),
        (lambda state: np.where(np.arange(len(state)) == 4, 1e9, state), "other options"),
    ],
)
def test_state_of_another_sampler_is_refused(change, message):
    sets, queue = begun(2, 5, 3), RowQueue(100)
    queue.choose = sets.choose
    for number in range(3):
        queue.take()
        queue.note(EpisodeRecord(episode=number, rows=1))
    sets.tell(np.array([0, 1]), np.array([1.0, 2.0]))
    sets.choose(queue, 10)
    state = sets.state(1)
    begun(2, 5, 3).restore(1, state)
    with pytest.raises(ValueError, match=message):
        begun(2, 5, 3).restore(1, change(state))
