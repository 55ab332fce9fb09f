"""States of environments that others have written with MuJoCo's own objects."""

import gymnasium
import numpy as np
import pytest

from physx_core.net import decode, encode
from physx_core.states import Baseline
from physx_testing import check_environment

pytestmark = pytest.mark.processes

NAMES = ["Hopper-v5", "Ant-v5", "Pusher-v5"]


def made(name):
    """Return an environment of Gymnasium and its baseline."""
    env = gymnasium.make(name)
    return env, Baseline(env)


def future(env, actions):
    """Return all that an environment answers to actions, as text of the same bits."""
    answers = [env.step(action) for action in actions]
    return [(answer[0].tobytes(), *map(repr, answer[1:])) for answer in answers]


@pytest.mark.parametrize("name", NAMES)
def test_a_restored_environment_of_gymnasium_goes_on_with_the_same_bits(name):
    (env, baseline), (other, target) = made(name), made(name)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(60)]
    env.reset(seed=3)
    future(env, actions[:20])
    state = encode(baseline.capture(), "the state")
    target.restore(decode(state))
    assert encode(target.capture(), "the state") == state
    assert future(other, actions[20:]) == future(env, actions[20:])
    assert encode(target.capture(), "the state") == encode(baseline.capture(), "the state")


def test_changed_models_are_restored():
    (env, baseline), (other, target) = made("Hopper-v5"), made("Hopper-v5")
    env.reset(seed=0)
    env.unwrapped.model.body_mass[1] *= 2.0
    env.unwrapped.model.opt.gravity[2] = -5.0
    env.unwrapped.model.opt.timestep = 0.001
    target.restore(decode(encode(baseline.capture(), "the state")))
    action = np.ones(3, np.float32)
    assert other.unwrapped.model.opt.timestep == 0.001
    assert future(other, [action] * 5) == future(env, [action] * 5)


def test_environments_of_gymnasium_pass_the_checks_of_states_in_another_process():
    report = check_environment("gym/Hopper-v5")
    status = {each.name: each.status for each in report.checks if "state" in each.name}
    assert status and set(status.values()) == {"passed"}, report
    assert report.ok
