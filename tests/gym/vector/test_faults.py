"""What goes wrong in a vector environment is named, and leaves no process behind."""

import contextlib
import gc
import importlib.util
import os
import random
import signal
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from physx_core.errors import ClientError, ConfigError, EnvironmentFailedError, UsageError
from physx_gym import ParallelVectorEnv

pytestmark = pytest.mark.processes

WALK = Path(__file__).parents[1] / "programs" / "walk.py"
spec = importlib.util.spec_from_file_location("walk", WALK)
walk = importlib.util.module_from_spec(spec)
spec.loader.exec_module(walk)

COUNT = 4


@contextlib.contextmanager
def vectors(**options):
    own = {"num_processes": 2, "batch_size": 2} | options
    vector = ParallelVectorEnv(f"{WALK}:Walk", COUNT, **own)
    with contextlib.closing(vector):
        vector.reset(seed=0)
        yield vector


def actions(faults=(0,) * COUNT, pauses=(0,) * COUNT):
    count = len(faults)
    return {
        "push": np.zeros((count, 2), np.float32),
        "pause": np.array(pauses),
        "fault": np.array(faults),
    }


def test_of_several_environments_that_raise_the_first_is_named(nothing_stays_behind):
    with vectors() as vector:
        with pytest.raises(EnvironmentFailedError) as caught:
            vector.step(actions(faults=(0, 1, 1, 1), pauses=(0, 2, 0, 0)))
        error = caught.value
        assert (error.instance_id, error.method, error.step) == (2, "step", 0)
        assert "ZeroDivisionError: after 0 steps" in str(error)
        assert "walk.py" in error.remote_traceback
        assert error.__notes__ == ["in step() of environment 1 of the vector environment (from 0)"]
        with pytest.raises(UsageError, match="ended with an error"):
            vector.reset()


def test_an_environment_that_raises_is_named_by_recv(nothing_stays_behind):
    with vectors() as vector:
        vector.send(actions(faults=(0, 1), pauses=(0, 0)), [0, 3])
        with pytest.raises(EnvironmentFailedError, match="Instance 4 raised in step"):
            vector.recv()


@pytest.mark.parametrize(
    ("fault", "how", "status"),
    [
        (2, r"Client 2 was killed by signal 9 \(SIGKILL\) in environment 3", -9),
        (3, "Client 2 ended with exit status 7 in environment 3", 7),
    ],
)
def test_a_process_that_ends_is_named_with_what_it_did(fault, how, status, nothing_stays_behind):
    with vectors() as vector:
        vector.send(actions(faults=(0, fault), pauses=(2, 0)), [0, 3])
        with pytest.raises(ClientError, match=how) as caught:
            vector.recv()
        assert caught.value.exit_status == status


def test_a_process_that_dies_between_two_steps_is_noticed_by_the_next(nothing_stays_behind):
    with vectors() as vector:
        os.kill(vector.get_attr("pid")[2], signal.SIGKILL)
        with pytest.raises(ClientError, match=r"Client 2 was killed by signal 9 \(SIGKILL\)"):
            for _ in range(3):
                vector.step(actions())


@pytest.mark.slow
def test_a_step_that_takes_too_long_is_named_with_its_place(nothing_stays_behind):
    with vectors(timeout=3) as vector:
        for _ in range(3):  # each is short enough
            vector.step(actions(pauses=(3, 3, 2, 2)))
        vector.reset(seed=0)
        with pytest.raises(ClientError, match=r"Client 1 sent nothing for 3 s in environment 1"):
            vector.step(actions(pauses=(0, 4, 0, 0)))


def test_a_short_limit_of_steps_leaves_time_to_make_and_close(nothing_stays_behind):
    ParallelVectorEnv(f"{WALK}:Walk", COUNT, num_processes=2, timeout=1e-6).close()


@pytest.mark.parametrize(
    ("where", "error", "text"),
    [
        (
            "__init__",
            EnvironmentFailedError,
            r"Instance 1 raised in __init__\(\): OSError: no more",
        ),
        ("reset", EnvironmentFailedError, r"Instance 1 raised in reset\(\): KeyError: 'place'"),
        ("spaces", ConfigError, "The observations of this environment"),
        ("close", EnvironmentFailedError, r"Instance 1 raised in close\(\): OSError: the door"),
    ],
)
def test_errors_outside_of_steps_are_named_too(where, error, text, nothing_stays_behind):
    with pytest.raises(error, match=text), vectors(env_kwargs={"fails_in": where}):
        pass


def test_calls_that_make_no_sense_are_refused(nothing_stays_behind):
    with vectors() as vector:
        with pytest.raises(UsageError, match="No result is pending"):
            vector.recv()
        vector.send(actions(faults=(0, 0), pauses=(0, 0)), [1, 2])
        with pytest.raises(UsageError, match="environment 1 is still pending"):
            vector.step(actions())
        for wrong in ([1, 1], [4], [-1], [0.5], [[0]], []):
            with pytest.raises((ConfigError, UsageError)):
                vector.send(actions(faults=(0,) * len(wrong), pauses=(0,) * len(wrong)), wrong)
        with pytest.raises(UsageError, match="lock"):
            vector.set_attr("gift", threading.Lock())
        with pytest.raises(UsageError, match='"np_random" of the environments cannot be sent'):
            vector.get_attr("np_random")
        with pytest.raises(EnvironmentFailedError, match="Instance 1 raised in fly.*no attribute"):
            vector.call("fly")
        assert vector.call("n") == (0, 1, 1, 0)
        assert vector.recv()[4]["env_id"].tolist() == [1, 2]
        vector.step(actions())
    for wrong in ({"batch_size": 3}, {"batch_size": 0}, {"num_processes": 0}):
        with pytest.raises(ConfigError, match="batch_size is .* must be between 1 and"):
            ParallelVectorEnv("CartPole-v1", 2, **wrong)


def test_large_values_travel_both_ways(nothing_stays_behind):
    with vectors() as vector:
        gifts = [np.full(1_000_000, float(number)) for number in range(COUNT)]
        vector.set_attr("gift", gifts)
        for found, given in zip(vector.get_attr("gift"), gifts, strict=True):
            np.testing.assert_array_equal(found, given)


def test_it_goes_on_after_ctrl_c(nothing_stays_behind):
    with vectors() as vector:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            vector.step(actions(pauses=(3, 0, 0, 0)))
        observations, _ = vector.reset(seed=7)
        lone = walk.Walk()
        np.testing.assert_array_equal(observations["place"][1], lone.reset(seed=8)[0]["place"])


def test_one_that_is_dropped_ends_its_processes_without_a_warning(nothing_stays_behind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        vector = ParallelVectorEnv("CartPole-v1", 2, num_processes=2)
        vector.reset(seed=0)
        del vector
        gc.collect()


@pytest.mark.faults
def test_processes_killed_at_any_moment(nothing_stays_behind):
    draw = random.Random(0)
    for _ in range(20):
        with vectors() as vector:
            pid = draw.choice(vector.get_attr("pid"))
            threading.Timer(draw.uniform(0.0, 0.05), os.kill, (pid, signal.SIGKILL)).start()
            vector.send(actions())
            until = time.monotonic() + 30
            with pytest.raises(ClientError, match="was killed by signal 9"):
                while time.monotonic() < until:
                    ids = vector.recv()[4]["env_id"]
                    pauses = [draw.randrange(3) for _ in ids]
                    vector.send(actions(faults=(0,) * len(ids), pauses=pauses), ids)
