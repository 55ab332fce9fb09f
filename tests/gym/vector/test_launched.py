"""Vector environments whose processes are clients that a launcher starts."""

import contextlib
import importlib.util
import os
import random
import signal
import threading
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import physx_gym  # noqa: F401 - registers the environments
from physx_core.errors import ClientError, ComponentNotFoundError, EnvironmentFailedError
from physx_gym import ParallelVectorEnv

pytestmark = pytest.mark.processes

WALK = Path(__file__).parents[1] / "programs" / "walk.py"
spec = importlib.util.spec_from_file_location("walk", WALK)
walk = importlib.util.module_from_spec(spec)
spec.loader.exec_module(walk)

COUNT = 5  # one client has an environment more than the other


@contextlib.contextmanager
def vectors(**options):
    own = {"num_processes": 2, "launcher": "physx/subprocess"} | options
    vector = ParallelVectorEnv(f"{WALK}:Walk", COUNT, **own)
    with contextlib.closing(vector):
        vector.reset(seed=0)
        yield vector


def actions(faults=(0,) * COUNT, pauses=(0,) * COUNT):
    count = len(faults)
    push = np.linspace(-1, 1, 2 * count, dtype=np.float32).reshape(count, 2)
    return {"push": push, "pause": np.array(pauses), "fault": np.array(faults)}


def same(one, other):
    for first, second in zip(one[:-1], other[:-1], strict=True):
        if isinstance(first, dict):
            first, second = list(first.values()), [second[name] for name in first]
        for ours, theirs in zip(first, second, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_a_registered_environment_takes_a_launcher(nothing_stays_behind):
    options = {"launcher": "physx/subprocess", "launcher_kwargs": {"affinity": True}}
    vector = gymnasium.make_vec("physx/Cartpole-v0", 3, num_processes=2, **options)
    plain = gymnasium.make_vec("physx/Cartpole-v0", 3, num_processes=1)
    with contextlib.closing(vector), contextlib.closing(plain):
        np.testing.assert_array_equal(vector.reset(seed=1)[0], plain.reset(seed=1)[0])
        plain.action_space.seed(0)
        for _ in range(20):
            action = plain.action_space.sample()
            same(vector.step(action), plain.step(action))


def test_each_environment_has_a_client_unless_told_otherwise(nothing_stays_behind):
    with vectors(num_processes=None) as vector:
        assert len(set(vector.get_attr("pid"))) == COUNT


def test_some_step_while_others_wait(nothing_stays_behind):
    with vectors() as vector, vectors(launcher=None) as shared:
        for ids in ([0, 3], [4], [1, 2]):
            chosen = {name: values[: len(ids)] for name, values in actions().items()}
            for each in (vector, shared):
                each.send(chosen, ids)
        same(vector.recv(), shared.recv())


def test_a_client_that_dies_is_named(nothing_stays_behind):
    with vectors() as vector:
        os.kill(vector.get_attr("pid")[4], signal.SIGKILL)
        with pytest.raises(ClientError, match=r"Client 2 .*killed by signal 9 \(SIGKILL\)"):
            for _ in range(3):
                vector.step(actions())


def test_a_client_that_is_silent_is_named(nothing_stays_behind):
    with vectors(timeout=2) as vector, pytest.raises(ClientError, match="Client 1"):
        vector.step(actions(pauses=(0, 4, 0, 0, 0)))


def test_an_environment_that_raises_is_named(nothing_stays_behind):
    with vectors() as vector:
        with pytest.raises(EnvironmentFailedError) as caught:
            vector.step(actions(faults=(0, 0, 0, 1, 1)))
        error = caught.value
        assert (error.instance_id, error.method, error.step) == (4, "step", 0)
        assert error.__notes__ == ["in step() of environment 3 of the vector environment (from 0)"]


@pytest.mark.parametrize(
    ("where", "text"),
    [
        ("__init__", r"Instance 1 raised in __init__\(\): OSError: no more"),
        ("reset", r"Instance 1 raised in reset\(\): KeyError: 'place'"),
        ("close", r"raised in close\(\): OSError: the door"),
    ],
)
def test_errors_outside_of_steps_are_named_too(where, text, nothing_stays_behind):
    with (
        pytest.raises(EnvironmentFailedError, match=text),
        vectors(env_kwargs={"fails_in": where}),
    ):
        pass


def test_large_values_travel_both_ways(nothing_stays_behind):
    with vectors() as vector:
        gifts = [np.full(100_000, float(number)) for number in range(COUNT)]
        vector.set_attr("gift", gifts)
        for found, given in zip(vector.get_attr("gift"), gifts, strict=True):
            np.testing.assert_array_equal(found, given)


def test_an_unknown_launcher_is_named(nothing_stays_behind):
    with pytest.raises(ComponentNotFoundError, match="subprocess"):
        ParallelVectorEnv("CartPole-v1", 2, launcher="physx/subproces")


@pytest.mark.slow
def test_one_that_dies_is_started_again_and_goes_on(nothing_stays_behind):
    draw = random.Random(1)
    with vectors(retries=3) as vector, vectors(launcher=None) as shared:
        for number in range(60):
            if number in (10, 30, 50):
                pid = draw.choice(vector.get_attr("pid"))
                threading.Timer(draw.uniform(0, 0.01), os.kill, (pid, signal.SIGKILL)).start()
            same(vector.step(actions()), shared.step(actions()))
