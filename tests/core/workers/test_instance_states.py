"""An instance goes on in another one from its state, with the same rows."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import numpy as np
import pytest

from physx_core import Environment, Field, Parameter
from physx_core.errors import EnvironmentFailedError, StateError, UsageError
from physx_core.net import decode, encode
from physx_core.workers import Instance


class Services:
    """A run without a network."""

    def __init__(self) -> None:
        self.drawn: list[Any] = []

    def predict(self, fields):
        return {"f": fields["x"] * 2}

    def show(self, instance_id, step, events):
        self.drawn += events


class Walk(Environment):
    """Depends on all that came before: aliases, a deque of numbers, a function's memory."""

    def create(self):
        self.x, self.past = np.zeros(2), {"x": []}

    def init_database(self):
        self.define_training_fields([Field("x", (2,)), Field("extra", None)])

    def step(self):
        self.x += self.rng.normal(size=2) + len(self.past["x"])
        self.past["x"] = [*self.past["x"], self.x.sum()][-5:]
        if self.rng.random() < 0.1:
            self.new_episode()
        self.set_training_data(x=self.x.copy(), extra=np.array(self.past["x"][-1]))

    def check_sample(self):
        return self.rng.random() < 0.7


class Drawn(Walk):
    """Its parameters are drawn for each trajectory."""

    def create(self):
        super().create()
        self.define_parameters(Parameter("speed", 1.0, 2.0, shape=(2,)))

    def reset_parameters(self, speed):
        self.speed = speed

    def step(self):
        self.x *= self.speed
        super().step()


class Episodes(Environment):
    independent_episodes = True

    def create(self):
        self.rng.normal()

    def init_database(self):
        self.define_training_fields([Field("x", ())])

    def reset_parameters(self):
        self.x, self.left = self.rng.normal(), int(self.rng.integers(1, 9))

    def step(self):
        self.x, self.left = self.x + self.rng.normal(), self.left - 1
        self.set_training_data(x=self.x)
        if not self.left:
            self.end_episode()


class Own(Walk):
    """Has methods of its own, and what nothing else could capture."""

    def create(self):
        super().create()
        self.lock = threading.Lock()

    def get_state(self):
        return [self.x.copy(), dict(self.past)]

    def set_state(self, state):
        self.x, self.past = state


class Predicted(Walk):
    def step(self):
        super().step()
        self.x += self.get_prediction(x=self.x)["f"] * 0.1

    def apply_prediction(self, prediction):
        if not hasattr(self, "arrow"):
            self.arrow = self.factory.add_arrows("f", [[0, 0, 0]], [[1, 0, 0]])
        self.factory.update_arrows("f", vectors=[[prediction["f"][0], 0, 0]])
        self.x += prediction["f"]


def opened(environment, draw=False, **options):
    arguments = {"instance_id": 2, "instance_nb": 3, "seed": [7], "max_wrong_samples": 99}
    instance = Instance(environment, {}, **(arguments | options))
    instance.open(Services(), draw, with_states=True)
    return instance


def bits(instance, sample):
    place = (instance.last_step, instance.last_episode, instance.has_ended)
    return {name: np.asarray(value).tobytes() for name, value in sample.items()}, place


@pytest.mark.parametrize(
    ("environment", "options"),
    [
        (Walk, {}),
        (Walk, {"simulations_per_step": 3, "record_wrong": True}),
        (Drawn, {}),
        (Episodes, {}),
        (Episodes, {"episode_steps": 3}),
        (Own, {"record_wrong": True}),
        (Predicted, {"draw": True}),
    ],
)
@pytest.mark.parametrize("rows", [0, 1, 7])
def test_rows_go_on_in_another_instance(environment, options, rows):
    def run(instance, count):
        for _ in range(count):
            sample = instance.step()
            yield bits(instance, sample)
            if environment is Predicted:
                instance.apply({"f": np.ones(2)})

    one = opened(environment, **options)
    list(run(one, rows))
    taken = one.get_state()
    state = encode(taken, "state")
    wanted = list(run(one, 20))
    assert encode(taken, "state") == state, "later steps change it"
    fresh = {name: each for name, each in options.items() if not name.startswith("first")}
    other = opened(environment, **fresh)
    other.set_state(decode(state))
    assert list(run(other, 20)) == wanted
    assert encode(other.get_state(), "state") == encode(one.get_state(), "state")
    if one.rejected is not None:
        fields = [Field("x", (2,)), Field("extra", ())]
        first, second = (each.rejected.take(fields, 2) for each in (one, other))
        assert all(first[name].tobytes() == second[name].tobytes() for name in first)
        assert len(first["step"])


def test_numbered_episodes_go_on_in_the_middle():
    one, other = opened(Episodes), opened(Episodes)
    one.begin(3)
    one.step()
    one.begin(12)
    one.step()
    other.set_state(decode(encode(one.get_state(), "state")))
    assert not one.has_ended
    while not one.has_ended:
        assert bits(other, other.step())[0] == bits(one, one.step())[0]
        assert (other.has_ended, other.last_step) == (one.has_ended, one.last_step)
    assert other.step() == one.step() == {}
    for instance in (one, other):
        instance.begin(1)
    assert bits(other, other.step())[0] == bits(one, one.step())[0]


def test_replayed_rows_go_on():
    class Replays(Walk):
        def step(self):
            self.total = getattr(self, "total", 0.0) + self.sample["x"]
            self.set_training_data(x=self.total, extra=np.zeros(()))

        def check_sample(self):
            return True

    rows = [{"x": np.full(2, value), "extra": np.zeros(())} for value in range(6)]
    one, other = opened(Replays), opened(Replays)
    for row in rows[:3]:
        one.step(row)
    other.set_state(decode(encode(one.get_state(), "state")))
    for row in rows[3:]:
        assert bits(other, other.step(row)) == bits(one, one.step(row))


def test_what_an_environment_holds_is_named():
    class Holds(Walk):
        def step(self):
            self.worker = threading.Thread()
            super().step()

    instance = opened(Holds)
    instance.step()
    with pytest.raises(StateError, match=r"^Holds\.worker\..* cannot be captured") as caught:
        instance.get_state()
    assert "in get_state() of instance 2" in caught.value.__notes__
    Holds.constants = ("worker",)
    instance = opened(Holds)
    instance.step()
    instance.get_state()


def test_tasks_that_an_environment_leaves_running_are_named():
    class Leaves(Walk):
        async def step(self):
            super().step()
            self.constants_task = asyncio.ensure_future(asyncio.sleep(100))

    instance = opened(Leaves)
    instance.step()
    with pytest.raises(StateError, match=r"step\(\) has left <Task pending"):
        instance.get_state()
    instance.close()


def test_misuse_is_named():
    class Half(Walk):
        def get_state(self):
            return 1

    with pytest.raises(UsageError, match="defines get_state.., but needs both"):
        opened(Half)

    class Text(Walk):
        constants = "past"

    with pytest.raises(UsageError, match="Text.constants must be a tuple"):
        opened(Text)
    instance = Instance(Walk, {}, instance_id=1, instance_nb=1, seed=[7])
    instance.open(Services(), draw=False)
    with pytest.raises(UsageError, match="track_state"):
        instance.get_state()

    class Raises(Own):
        def set_state(self, state):
            raise ValueError("no")

    with pytest.raises(EnvironmentFailedError, match="set_state"):
        opened(Raises).set_state(opened(Own).get_state())


def test_other_seeds_and_arguments_are_refused():
    state = opened(Walk).get_state()
    for options, name in (({"seed": [8]}, "_seed_entropy"), ({"instance_id": 1}, "instance_id")):
        with pytest.raises(StateError, match=rf"attributes differ: .*{name}"):
            opened(Walk, **options).set_state(state)


def test_a_state_does_not_depend_on_drawing():
    class Shown(Walk):
        def init_visualization(self):
            self.factory.add_points("x", [[0, 0, 0]])
            self.frame, self.step_time = [0], 0.1

        def step(self):
            super().step()
            if self.factory:
                self.frame.append(1)  # which only viewers need
                self.factory.update_points("x", positions=[[*self.x, 0]])

    for draws in ((True, False), (False, True), (True, True)):
        one, other = (opened(Shown, draw) for draw in draws)
        one.step()
        other.set_state(decode(encode(one.get_state(), "state")))
        assert bits(other, other.step()) == bits(one, one.step())
