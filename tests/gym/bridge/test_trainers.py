"""What trainers expect of environments: TorchRL, stable-baselines3, Gymnasium itself."""

import pickle
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from physx_core.errors import ConfigError, PhysxError, UnknownArgumentError, UnknownOptionError
from physx_gym import ParallelVectorEnv, RobotEnv, Simulator, build_pipeline, plain
from physx_sim import Robot, World

pytestmark = pytest.mark.processes

IDS = sorted(id for id in gymnasium.registry if id.startswith("physx/"))
ENGINES = ["dart", "pinocchio"]
ACCEPTED = {
    "render_mode": "__init__() got an unexpected keyword argument 'render_mode'",
    "frame_skip": "unexpected keyword argument 'frameskip'",
}
"""Texts that TorchRL looks for in a TypeError (torchrl.envs.libs.gym, ACCEPTED_TYPE_ERRORS)."""


def make_as_torchrl(id, **kwargs):
    """Return an environment, made as TorchRL's GymEnv does, and the options that it dropped."""
    kwargs |= {"frameskip": 1, "disable_env_checker": True}
    dropped = []
    while True:
        try:
            return gymnasium.make(id, **kwargs), dropped
        except TypeError as error:
            if ACCEPTED["frame_skip"] in str(error):
                dropped.append("frameskip")
            elif ACCEPTED["render_mode"] in str(error):
                dropped.append("render_mode")
            else:
                raise
            kwargs.pop(dropped[-1])


@pytest.mark.parametrize("id", IDS)
def test_torchrl_goes_on_without_the_argument_that_an_environment_lacks(id):
    env, dropped = make_as_torchrl(id)
    assert dropped == ["frameskip"]
    env.reset(seed=0)
    env.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_torchrl_makes_environments_by_their_ids(engine):
    libs = pytest.importorskip("torchrl.envs")
    utils = pytest.importorskip("torchrl.envs.utils")
    for id in IDS:
        env = libs.GymEnv(id, engine=engine, frame_skip=2)
        assert type(env.unwrapped.simulator.simulation).__name__.lower().startswith(engine)
        utils.check_env_specs(env)
        assert env.rollout(3)["next", "reward"].shape == (3, 1)
        env.close()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("id", IDS)
def test_a_plain_environment_passes_the_checker_of_stable_baselines3(id, engine, recwarn):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.make(id, engine=engine)
    checker.check_env(plain(env))
    env.close()
    assert [str(each.message) for each in recwarn if "stable" in each.filename] == []


def test_a_plain_nested_environment_passes_it_flattened():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.wrappers.FlattenObservation(plain(RobotEnv("cartpole", 0.04)))
    env = gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)
    checker.check_env(env)


def test_a_plain_environment_is_the_environment():
    env, twin = gymnasium.make("physx/Cartpole-v0"), gymnasium.make("physx/Cartpole-v0")
    hidden = plain(twin)
    assert hidden.unwrapped is hidden
    assert not hasattr(hidden, "compute_reward")
    assert hidden.spec is twin.spec
    np.testing.assert_array_equal(hidden.reset(seed=3)[0], env.reset(seed=3)[0])
    assert hidden.np_random_seed == 3
    for _ in range(5):
        mine, theirs = hidden.step(2), env.step(2)
        np.testing.assert_array_equal(mine[0], theirs[0])
        assert mine[1:] == theirs[1:]
    assert hidden.np_random is twin.unwrapped.np_random
    with pytest.raises(ConfigError, match="plain needs a Gymnasium environment"):
        plain("physx/Cartpole-v0")


# Unknown options --------------------------------------------------------------------------------


def test_an_unknown_option_is_a_type_error_in_the_words_of_python():
    with pytest.raises(TypeError) as caught:
        RobotEnv("cartpole", 0.04, perod=1e-3)
    assert isinstance(caught.value, UnknownOptionError)
    assert caught.value.unknown == ["perod"]
    words = r"RobotEnv.__init__\(\) got an unexpected keyword argument 'perod'. Did you mean"
    assert re.match(words, str(caught.value))
    assert "period" in caught.value.known
    assert "engine" in caught.value.known


def test_gymnasium_extends_the_error_without_losing_its_class():
    with pytest.raises(UnknownArgumentError, match=r"'continous'.*raised from the .* creator"):
        gymnasium.make("physx/Cartpole-v0", continous=True)


def test_the_error_survives_pickling():
    error = UnknownArgumentError("Thing", ["colour"], ["color"])
    again = pickle.loads(pickle.dumps(error))  # noqa: S301
    assert (str(again), again.owner, again.known) == (str(error), "Thing", ["color"])


def test_the_error_of_an_environment_in_another_process_is_the_same():
    with pytest.raises(PhysxError, match="unexpected keyword argument 'frameskip'"):
        ParallelVectorEnv("physx/Cartpole-v0", 2, env_kwargs={"frameskip": 1}, num_processes=1)


class Scored:
    """A class beside the environment in the inheritance of another one."""

    def __init__(self, score=0):
        self.score = score


class ScoredEnv(RobotEnv, Scored):
    """An environment of a robot that is named, with two base classes."""


def test_options_go_to_the_simulator_and_to_the_next_base_class():
    env = ScoredEnv("cartpole", 0.04, score=5, period=2e-3)
    assert (env.score, env.simulator.period) == (5, 2e-3)
    assert ScoredEnv(World([Robot("cartpole")]), 0.04, score=6).score == 6


# The engine ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda **o: gymnasium.make("physx/Cartpole-v0", **o),
        lambda **o: RobotEnv("cartpole", 0.04, **o),
        build_pipeline({"cls": "physx/Cartpole-v0"}),
        build_pipeline(
            {
                "cls": "RobotEnv",
                "kwargs": {
                    "step_dt": 0.04,
                    "simulator": {
                        "cls": "physx_gym:Simulator.build",
                        "kwargs": {"urdf": "cartpole"},
                    },
                },
            }
        ),
    ],
)
def test_engine_is_another_name_of_backend(make):
    first, second = make(engine="pinocchio"), make(backend="pinocchio")
    for env in (first, second):
        env.reset(seed=1)
        assert env.unwrapped.simulator.simulation.engine == "pinocchio"
    action = first.action_space.sample()
    np.testing.assert_equal(first.step(action), second.step(action))


def test_an_engine_replaces_that_of_a_simulator_that_is_built():
    simulator = Simulator.build("ant", fixed_base=False)
    assert simulator.simulation.engine == "dart"
    env = RobotEnv(simulator, 0.02, engine="pinocchio")
    env.reset(seed=0)
    assert env.simulator.simulation.engine == "pinocchio"
    env.step(np.zeros(8))


def test_the_robot_and_its_state_have_the_names_of_jiminy():
    env = RobotEnv("ant", 0.02, fixed_base=False)
    env.reset(seed=0)
    env.step(np.ones(8))
    assert (env.robot.nq, env.robot.nv) == (15, 14)
    np.testing.assert_array_equal(env.robot_state.u_motor, env.robot_state.torques)
    assert np.all(env.robot_state.u_motor == 1.0)


@pytest.mark.faults
def test_a_trainer_in_one_file_learns_with_gymnasiums_own_vector_environments():
    """As CleanRL's scripts do, which know Gymnasium only."""
    pytest.importorskip("torch")
    program = Path(__file__).parents[1] / "programs/single_file_ppo.py"
    command = [sys.executable, program, "physx/Cartpole-v0", "12288"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not ended.returncode, ended.stderr
    first, last = map(float, ended.stdout.split())
    assert last > 2 * first
