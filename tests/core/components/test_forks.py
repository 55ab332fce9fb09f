"""Forks: copies of an environment that go on from where it is, in the same process."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from physx_core import Environment, Field, Parameter
from physx_core.errors import StateError, UsageError
from physx_core.workers import Instance


class Walker(Environment):
    """A walk with parameters that saves, loads and asks."""

    closed = 0

    def __init__(self, *, start=0.0, episodes=False, **kwargs):
        super().__init__(**kwargs)
        self.start, self.position = start, np.zeros(2)
        self.independent_episodes = episodes

    def create(self):
        self.define_parameters(Parameter("pull", 0.0, 1.0))
        self.runs = self.load_parameters().get("runs", 0) + 1
        self.save_parameters(runs=self.runs)
        self.position += self.start

    def init_database(self):
        self.define_training_fields(Field("position", (2,)))

    def reset_parameters(self, pull):
        self.pull = pull

    def step(self):
        if self.step_index % 4 == 3:
            (self.end_episode if self.independent_episodes else self.new_episode)()
        saved = self.load_parameters().get("saved", 0)
        if not self.independent_episodes:
            self.save_parameters(saved=saved + 1)
        answer = self.get_prediction(x=self.position)["y"]
        self.position += self.rng.normal(size=2) + self.pull + answer + saved
        self.set_training_data(position=self.position)

    def check_sample(self):
        return self.step_index % 5 != 2

    def close(self):
        Walker.closed += 1


class Run:
    """The services of a run, which count what they are asked."""

    def __init__(self):
        self.kept, self.episodes, self.shown = {}, [], 0

    def predict(self, fields):
        return {"y": 0.1 * np.asarray(fields["x"])}

    def save_parameters(self, instance_id, values):
        self.kept[instance_id] = {**self.kept.get(instance_id, {}), **values}

    def load_parameters(self, instance_id):
        return dict(self.kept.get(instance_id, {}))

    def show(self, instance_id, step, events):
        self.shown += 1

    def choose(self, episode):
        assert not self.episodes or episode > self.episodes[-1]
        self.episodes.append(episode)
        return {"pull": 1 / (1 + episode)}


def opened(services, make=Walker, with_states=True, **kwargs):
    instance = Instance(make, kwargs, instance_id=1, instance_nb=1, seed=[7])
    instance.open(services, draw=True, choose=services.choose, with_states=with_states)
    return instance


def rows(instance, count):
    return [instance.step()["position"].copy() for _ in range(count)]


@pytest.mark.parametrize("before", [0, 1, 5, 9])
def test_a_fork_goes_on_alike_and_influences_nothing(before):
    services, other = Run(), Run()
    with opened(services, start=2.0) as instance, opened(other, start=2.0) as undisturbed:
        rows(instance, before)
        shown, kept = services.shown, services.load_parameters(1)
        with instance.fork() as fork, instance.fork() as second:
            ahead = rows(fork, 12)
            assert (services.shown, services.load_parameters(1)) == (shown, kept)
            with fork.fork() as further:
                beyond = rows(further, 3)
            here = rows(instance, 15)
            np.testing.assert_array_equal(ahead + beyond, here)
            np.testing.assert_array_equal(rows(second, 15), here)
        np.testing.assert_array_equal(rows(undisturbed, before + 15)[before:], here)
        assert services.episodes == sorted({*services.episodes})


def test_a_fork_of_independent_episodes():
    with opened(Run(), episodes=True) as instance:
        rows(instance, 5)
        with instance.fork() as fork:
            np.testing.assert_array_equal(rows(fork, 9), rows(instance, 9))


def test_a_state_knows_the_parameters_that_forks_were_given_ahead():
    services = Run()
    with opened(services) as instance, opened(Run()) as other:
        rows(instance, 2)
        with instance.fork() as fork:
            rows(fork, 12)
        state = instance.get_state()
        there = Run()
        there.episodes = list(services.episodes)  # the run refuses these
        other.environment._choose_parameters = there.choose
        other.set_state(state)
        other.environment._services = there
        there.kept = {1: services.load_parameters(1)}
        np.testing.assert_array_equal(rows(other, 12), rows(instance, 12))


def test_forks_are_closed_alone():
    with opened(Run()) as instance:
        Walker.closed = 0
        instance.fork().close()
        assert Walker.closed == 1
        rows(instance, 1)


def test_an_environment_that_is_not_tracked_says_what_to_do():
    with opened(Run(), with_states=False) as instance:
        rows(instance, 1)
        with pytest.raises(UsageError, match=r"call it at the end of init_database\(\)"):
            instance.environment.fork()


def test_an_environment_that_looks_ahead_by_itself():
    class Planner(Walker):
        def init_database(self):
            super().init_database()
            self.plans, self.is_ahead = [], False
            self.track_state()

        constants = ("plans",)

        def step(self):
            if self.step_index % 3 == 1 and not self.is_ahead:
                with self.fork() as fork:
                    fork.is_ahead = True
                    fork.step()
                    self.plans.append(fork.take_sample()["position"].copy())
            super().step()

    with opened(Run(), Planner, with_states=False) as instance:
        found = rows(instance, 6)
        planned = instance.environment.plans
    np.testing.assert_array_equal(planned[0], found[1])
    with opened(Run()) as instance:
        np.testing.assert_array_equal(rows(instance, 6), found)


def test_what_cannot_be_captured_is_named():
    class Locked(Walker):
        def create(self):
            super().create()
            self.lock = threading.Lock()

    with opened(Run(), Locked) as instance, pytest.raises(StateError, match=r"\.lock"):
        instance.fork()


def test_a_fork_with_methods_of_its_own_for_states():
    class Own(Walker):
        def get_state(self):
            return {"position": self.position.copy(), "pull": self.pull}

        def set_state(self, state):
            self.position[:], self.pull = state["position"], state["pull"]

    with opened(Run(), Own, with_states=False) as instance:
        rows(instance, 2)
        with instance.fork() as fork:
            np.testing.assert_array_equal(rows(fork, 9), rows(instance, 9))
