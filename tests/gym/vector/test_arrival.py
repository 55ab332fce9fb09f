"""Every environment of a vector goes the way of a lone one, in whatever order results arrive.

A model of lone environments is compared with real processes, bit for bit.
"""

import contextlib
import importlib.util
import time
from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import VectorEnv
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sizes import trials

from physx_gym import ParallelVectorEnv

pytestmark = pytest.mark.processes

WALK = Path(__file__).parents[1] / "programs" / "walk.py"
LATE = WALK.with_name("slow_to_count.py")
spec = importlib.util.spec_from_file_location("walk", WALK)
walk = importlib.util.module_from_spec(spec)
spec.loader.exec_module(walk)

COUNT, BATCH = 5, 2
ENV = f"{WALK}:Walk"
SEEDS = st.lists(st.none() | st.integers(0, 3), min_size=COUNT, max_size=COUNT)
OPTIONS = st.sampled_from([None, {"start": 2.0}])
NUMBERS = st.sets(st.integers(0, COUNT - 1), min_size=1)
ACTIONS = st.lists(
    st.tuples(st.floats(-1, 1, width=32), st.sampled_from([0, 0, 1, 2])),
    min_size=COUNT,
    max_size=COUNT,
)


def batch_of(actions):
    pushes = np.array([[push, -push] for push, _ in actions], np.float32)
    pauses = np.array([pause for _, pause in actions])
    return {"push": pushes, "pause": pauses, "fault": np.zeros(len(actions), np.int64)}


def row_of(actions, place):
    return {name: values[place] for name, values in actions.items()}


def same(one, other):
    if isinstance(other, dict):
        assert one.keys() == other.keys()
        for name, value in other.items():
            same(one[name], value)
    elif isinstance(other, np.ndarray) and other.dtype == object:
        assert len(one) == len(other)
        for first, second in zip(one, other, strict=True):
            same(first, second)
    elif other is None or isinstance(other, str):
        assert one == other
    else:
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()
        assert np.asarray(one).dtype == np.asarray(other).dtype


def agree(found, expected):
    """Compare the results of a vector with those of lone environments."""
    observations, rewards, terminated, truncated, infos = found
    vector, wanted = VectorEnv(), {}
    vector.num_envs = len(expected)
    for place, (observation, *rest) in enumerate(expected):
        same({name: each[place] for name, each in observations.items()}, observation)
        reward, over, cut, info = rest
        assert rewards[place].tobytes() == np.float64(reward).tobytes()
        assert (terminated[place], truncated[place]) == (over, cut)
        wanted = vector._add_info(wanted, info, place)
    same(infos, wanted)


class Arrival(RuleBasedStateMachine):
    """Calls the methods of a vector in any order, and those of lone environments beside them."""

    vector: ParallelVectorEnv

    def __init__(self):
        super().__init__()
        self.lone = [walk.Lone(self.vector.autoreset_mode.value) for _ in range(COUNT)]
        self.owed = {}

    def ready(self):
        return not self.owed

    @initialize(seeds=SEEDS)
    def begin(self, seeds):
        self.reset([seed or 0 for seed in seeds], None, range(COUNT))

    @rule(seeds=SEEDS, options=OPTIONS, chosen=NUMBERS)
    def reset(self, seeds, options, chosen):
        mask = np.isin(np.arange(COUNT), list(chosen))
        _, infos = self.vector.reset(seed=seeds, options={**(options or {}), "reset_mask": mask})
        found = self.lone_resets(seeds, options, chosen)
        vector, wanted = VectorEnv(), {}
        vector.num_envs, self.owed = COUNT, {}
        for number, each in found.items():
            wanted = vector._add_info(wanted, each[4], number)
        same(infos, wanted)

    @rule(seeds=SEEDS, options=OPTIONS, chosen=NUMBERS)
    def async_reset(self, seeds, options, chosen):
        mask = np.isin(np.arange(COUNT), list(chosen))
        self.vector.async_reset(seed=seeds, options={**(options or {}), "reset_mask": mask})
        self.owed = self.lone_resets(seeds, options, chosen)

    def lone_resets(self, seeds, options, chosen):
        return {i: self.lone[i].reset(seeds[i], options) for i in sorted(chosen)}

    @precondition(ready)
    @rule(actions=ACTIONS)
    def step(self, actions):
        actions = batch_of(actions)
        found = self.vector.step(actions)
        agree(found, [each.step(row_of(actions, i)) for i, each in enumerate(self.lone)])

    @precondition(lambda self: len(self.owed) < COUNT)
    @rule(data=st.data(), actions=ACTIONS)
    def send(self, data, actions):
        free = [number for number in range(COUNT) if number not in self.owed]
        chosen = data.draw(st.lists(st.sampled_from(free), min_size=1, unique=True))
        actions = batch_of(actions[: len(chosen)])
        self.vector.send(actions, np.array(chosen))
        for place, number in enumerate(chosen):
            self.owed[number] = self.lone[number].step(row_of(actions, place))

    @precondition(lambda self: self.owed)
    @rule()
    def recv(self):
        *found, infos = self.vector.recv()
        numbers = infos.pop("env_id").tolist()
        assert len(numbers) == min(BATCH, len(self.owed))
        assert numbers == sorted(numbers)
        agree((*found, infos), [self.owed.pop(number) for number in numbers])

    @rule()
    def call(self):
        assert self.vector.call("n") == tuple(each.env.n for each in self.lone)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize(
    ("processes", "examples"), [(2, 15), pytest.param(5, trials(75, 25), marks=pytest.mark.faults)]
)
def test_each_goes_its_way_under_any_order_of_calls_and_arrivals(
    mode, processes, examples, nothing_stays_behind
):
    vector = ParallelVectorEnv(
        ENV, COUNT, num_processes=processes, batch_size=BATCH, autoreset_mode=mode
    )
    machine = type("Arrival", (Arrival,), {"vector": vector})
    with contextlib.closing(vector):
        run_state_machine_as_test(
            machine,
            settings=settings(max_examples=examples, stateful_step_count=25, derandomize=True),
        )


def test_none_is_passed_over_and_a_slow_one_delays_no_other(nothing_stays_behind):
    vector = ParallelVectorEnv(ENV, 6, num_processes=2, batch_size=2)
    with contextlib.closing(vector):
        vector.async_reset(seed=0)
        counts, actions = np.zeros(6, int), batch_of([(0.1, 0)] * 2)
        for _ in range(60):
            vector._workers.wait(sum(vector._workers.asked))  # all results are there
            ids = vector.recv()[4]["env_id"]
            counts[ids] += 1
            vector.send(actions, ids)
        assert counts.min() >= 15
        vector.reset(seed=0)
        vector.send(batch_of([(0.0, 3)]), [0])
        vector.send(batch_of([(0.0, 0)] * 3), [3, 5, 4])
        assert vector.recv()[4]["env_id"].tolist() == [3, 4]
        assert vector.num_pending == 2


@pytest.mark.parametrize("count", [1, 3])
def test_recv_of_all_returns_what_step_returns(count, nothing_stays_behind):
    first, second = (ParallelVectorEnv(ENV, 3, num_processes=count) for _ in range(2))
    actions = batch_of([(0.5, 0), (0.25, 1), (-1.0, 0)])
    with contextlib.closing(first), contextlib.closing(second):
        first.reset(seed=3)
        second.async_reset(seed=3)
        second.recv()
        for _ in range(20):
            second.send(actions)
            *found, infos = second.recv()
            assert infos.pop("env_id").tolist() == [0, 1, 2]
            for one, other in zip((*found, infos), first.step(actions), strict=True):
                same(one, other)


def test_a_message_is_read_although_one_of_another_worker_is_not_counted_yet(nothing_stays_behind):
    vector = ParallelVectorEnv(f"{LATE}:LongInfos", 3, num_processes=3, batch_size=1)
    with contextlib.closing(vector):
        vector.async_reset(seed=0)
        found = [vector.recv()[4]]  # meanwhile the message of the first worker is read
        time.sleep(0.5)
        found += [vector.recv()[4] for _ in range(2)]
    assert [infos["env_id"].tolist() for infos in found] == [[2], [1], [0]]
    assert [infos["text"].tolist() for infos in found[1:]] == [["1" * 1000], ["0" * 1000]]


def test_observations_need_not_be_copied(nothing_stays_behind):
    vector = ParallelVectorEnv(ENV, 2, num_processes=1, copy=False)
    with contextlib.closing(vector):
        first, _ = vector.reset(seed=0)
        second = vector.step(batch_of([(0.5, 0)] * 2))[0]
        assert first["place"] is second["place"]
        received = second["place"].copy()
    assert (first["place"] == received).all()  # memory that is still looked at stays mapped
