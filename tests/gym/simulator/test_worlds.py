"""Observations of all kinds, worlds with several robots and objects, and mistakes."""

import copy
import itertools
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core import PhysxError
from physx_core.errors import ActionError, ConfigError, EpisodeError, UnknownOptionError
from physx_gym import ComposedEnv, PDController, RobotEnv, Simulator, build_pipeline
from physx_gym.tasks.quantities import BodyPositions, JointPositions, Stacked
from physx_gym.tasks.rewards import Minimizing, Sum, Survival, Tracking
from physx_gym.tasks.terminations import OutOfBounds
from physx_sim import Encoder, Motor, Robot, Sphere, World


def cart(kind=RobotEnv, **options):
    return kind("cartpole", 0.02, **{"motors": [Motor(joint="slider")], "period": 5e-3, **options})


class Mild(RobotEnv):
    """Actions within 1."""

    def _initialize_action_space(self):
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def compute_command(self, action, command):
        command[:] = 9.0 * action


class Mixed(Mild):
    """Images, choices, flags and numbers of single precision."""

    def _initialize_observation_space(self):
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (4, 4, 3), np.uint8),
                "phase": spaces.Discrete(3, start=1),
                "flags": spaces.MultiBinary(2),
                "both": spaces.Tuple([spaces.Discrete(2), spaces.Box(-9, 9, (2,))]),
            }
        )

    def refresh_observation(self, measurement):
        self.observation["image"][...] = self.stepper_state.iter
        self.observation["phase"][...] = 1 + self.num_steps % 3
        self.observation["flags"][:] = 1, 0
        self.observation["both"][1][:] = measurement["states"]["agent"]["q"]


@pytest.mark.filterwarnings("error::UserWarning")
def test_observations_with_images_and_choices():
    env = cart(Mixed)
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    phases = [observation["phase"]] + [env.step([0.0])[0]["phase"] for _ in range(4)]
    assert phases == [1, 2, 3, 1, 2]
    assert all(isinstance(each, np.int64) for each in phases)
    assert env.step([0.0])[0]["image"][0, 0].tolist() == [20] * 3
    other = pickle.loads(pickle.dumps(env))  # noqa: S301 - our own
    state = env.snapshot()
    after = env.step([1.0])[0]
    env.restore(state)
    for each in (env, other):
        again = each.step([1.0])[0]
        assert again["phase"] == after["phase"]
        np.testing.assert_array_equal(again["both"][1], after["both"][1])
    assert observation["both"][1].tolist() == [0.0, 0.0]  # a copy


def test_an_observation_that_is_a_choice():
    class Side(Mild):
        def _initialize_observation_space(self):
            self.observation_space = spaces.Discrete(2)

        def refresh_observation(self, measurement):
            self.observation[...] = measurement["states"]["agent"]["q"][0] > 0

    env = cart(Side)
    check_env(env, skip_render_check=True)
    assert env.reset()[0] == 0
    assert env.step([1.0])[0] == 1


def test_a_robot_without_motors(backend):
    env = RobotEnv("cartpole", 0.02, motors=(), sensors=(), backend=backend)
    assert env.action_space.shape == (0,)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"t", "states"}
    env.step([])
    with pytest.raises(ActionError, match="shape"):
        env.step([0.0])


@pytest.mark.slow
def test_two_robots_and_an_object_of_which_one_acts(backend, tmp_path):
    robots = [Robot("cartpole", "one"), Robot("cartpole", "two")]
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 3))
    world = World(robots, objects=[ball], contacts="static", period=5e-3)
    options = {"robot": "two", "motors": [Motor(joint="two/slider")], "backend": backend}
    place = BodyPositions(("ball",))
    env = ComposedEnv(
        RobotEnv(world, 0.02, **options),
        reward=Tracking(place, 1.0, target=((0.0, 0.0, 3.0),), name="ball"),
        terminations=[OutOfBounds(place, low=[-1, -1, 2.9], name="fell")],
    )
    env.eval()
    observation, _ = env.reset(seed=0, options={"log_path": tmp_path / "two.h5"})
    assert observation["states"]["agent"]["q"].shape == (2,)
    rewards, terminated = [], False
    while not terminated:
        _, reward, terminated, _, info = env.step([5.0])
        rewards.append(reward)
    assert info["terminations"] == ["fell"]
    assert all(later < earlier for earlier, later in itertools.pairwise(rewards))
    assert env.robot.name == "two"
    assert env.robot_state.q[0] > 0.01
    parts = env.simulator.layout.parts
    assert not env.simulator.positions[parts["one"].positions].any()
    with pytest.raises(PhysxError, match='"bal".*Did you mean "ball"'):
        env.quantities.get_value(BodyPositions(("bal",)))
    env.stop()
    assert env.unwrapped.replay(path=tmp_path / "two.rrd") == tmp_path / "two.rrd"
    assert (tmp_path / "two.rrd").read_bytes()[:3] == b"RRF"
    env.close()


def test_environments_with_their_own_constructor_are_copied_and_restored():
    class Own(RobotEnv):
        def __init__(self, strength, *, backend="dart"):
            self.strength = strength
            super().__init__("cartpole", 0.02, backend=backend)

        def compute_command(self, action, command):
            command[:] = self.strength * action

    env = Own(2.0)
    env.reset()
    env.step([1.0, 0.0])
    for other in (copy.deepcopy(env), Own(2.0)):
        other.restore(env.snapshot())
        assert other.step([1.0, 0.0])[0]["states"]["agent"]["q"][0] > 0
        assert other.robot_state.command.tolist() == [2.0, 0.0]


# Mistakes ---------------------------------------------------------------------------------------


def test_after_close():
    env = cart()
    env.reset()
    env.step([9.0])
    accelerations = env.robot_state.a.copy()
    env.close()
    env.close()
    np.testing.assert_array_equal(env.robot_state.a, accelerations)
    with pytest.raises(EpisodeError, match="call reset"):
        env.step([0.0])
    assert len(env.log_data["variables"]["time"]) == 2
    other = pickle.loads(pickle.dumps(env))  # noqa: S301 - our own
    np.testing.assert_array_equal(other.robot_state.a, accelerations)
    for each in (env, other):
        each.reset()
        each.step([0.0])
        assert each.robot_state.torques == [0.0]
    never = cart()
    never.close()
    never.reset()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"render_mode": 3}, UnknownOptionError, 'no option "3". Options: human, rgb_array'),
        (
            {"motors": ["slider"]},
            ConfigError,
            "'slider' is not a Motor",
        ),
        ({"motors": Motor(joint="slider")}, ConfigError, "must be a list of Motors"),
        ({"sensors": Encoder(name="a", joint="hinge")}, ConfigError, "must be a list of Sensors"),
        ({"sensors": "hinge"}, ConfigError, "must be a list of Sensors"),
        ({"backend": "dartt"}, PhysxError, 'Did you mean "dart"'),
        ({"ground": True}, ConfigError, "not Ground, Stairs"),
        ({"gravity": 9.81}, ConfigError, "a sequence of numbers"),
        ({"period": 0}, ConfigError, "period is 0.0 but must be positive"),
        ({"simulation_duration_max": np.inf}, ConfigError, "finite"),
        ({"backennd": "dart"}, UnknownOptionError, 'Did you mean "backend"'),
    ],
)
def test_wrong_options_are_named(options, error, message):
    with pytest.raises(error, match=message):
        cart(**options)


def test_options_of_a_user_defined_environment_are_listed():
    with pytest.raises(
        UnknownOptionError, match=r'Did you mean "backend"\? Options: backend, cont'
    ):
        gymnasium.make("physx/Cartpole-v0", backendd="dart")
    with pytest.raises(
        UnknownOptionError, match="debug, engine, render_mode, simulation_duration_max, sim"
    ):
        RobotEnv(Simulator.build("cartpole"), 0.02, backend="dart")


def test_wrong_arguments_of_methods():
    env = cart()
    for options in (3, [1]):
        with pytest.raises(ConfigError, match="options of reset"):
            env.reset(options=options)
    for policy in (3, lambda observation: None):
        with pytest.raises(ConfigError, match="previous action, reward"):
            env.evaluate(policy)
    assert env.training
    env.simulation_duration_max = -1.0
    with pytest.raises(ConfigError, match="simulation_duration_max is -1"):
        env.reset()


@pytest.mark.parametrize(
    ("method", "returned", "message"),
    [
        ("_sample_state", None, "_sample_state returned None but must return positions and vel"),
        ("_sample_state", np.zeros(2), "must return positions and velocities"),
        ("has_terminated", True, "has_terminated returned True but must return whether"),
        ("refresh_observation", np.zeros(4), "write into `self.observation` in place"),
        ("compute_command", np.zeros(1), "write into `command` in place"),
        ("compute_reward", None, "compute_reward returned None but must return a number"),
        ("_initialize_action_space", None, "must set it to a space of gymnasium"),
        ("_initialize_observation_space", None, "must set it to a space of gymnasium"),
    ],
)
def test_methods_that_return_something_else_are_named(method, returned, message):
    kind = type("Mistaken", (RobotEnv,), {method: lambda *arguments: returned})
    with pytest.raises(ConfigError, match=message):
        env = cart(kind)
        env.reset()
        env.step([0.0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: Tracking(JointPositions, 1.0), r"create one, as in JointPositions\(\.\.\.\)"),
        (lambda env: Minimizing("power", 1.0), "Minimizing.quantity is 'power'"),
        (lambda env: Stacked("power", 2), "Stacked.quantity is 'power'"),
        (lambda env: BodyPositions("cart"), 'is the string "cart" but must be a list'),
        (lambda env: OutOfBounds(JointPositions(), "a"), "must be numbers"),
        (lambda env: OutOfBounds(JointPositions(), 1, 0), "the lower one first"),
        (lambda env: OutOfBounds(JointPositions(), 0, grace=1), 'Did you mean "grace_period"'),
        (lambda env: Sum([Survival()], weights=[1, 2]), "1 rewards and 2 weights"),
        (lambda env: ComposedEnv(env, trajectory=3), "trajectory is 3"),
        (lambda env: PDController("pd", 3, kp=1, kd=1), "needs a RobotEnv"),
    ],
)
def test_wrong_parts_are_named(make, message):
    env = cart()
    with pytest.raises(PhysxError, match=message):
        make(env)


def test_numbers_that_do_not_fit_a_quantity_are_named():
    three = (0.0, 0.0, 0.0)
    for options, message in (
        ({"reward": Tracking(JointPositions(), 1.0, target=three, name="pose")}, 'reward "pose"'),
        ({"terminations": OutOfBounds(JointPositions(), three, name="low")}, 'termination "low"'),
    ):
        env = ComposedEnv(RobotEnv("cartpole", 0.02), **options)
        with pytest.raises(ConfigError, match=message):
            env.reset()
            env.step([0.0, 0.0])


def test_lists_of_a_file_are_weights_and_names():
    place = {"cls": "BodyPositions", "kwargs": {"bodies": ["cart", "pole"]}}
    kept = {"cls": "Minimizing", "kwargs": {"quantity": place, "cutoff": 2.0, "name": "place"}}
    total = {"cls": "Sum", "kwargs": {"rewards": [{"cls": "Survival"}, kept], "weights": [1, 3]}}
    wrapper = {"wrapper": {"cls": "ComposedEnv", "kwargs": {"reward": total}}}
    env = build_pipeline({"cls": "physx/Cartpole-v0"}, [wrapper])()
    env.reset(seed=0)
    _, reward, *_, info = env.step(1)
    assert reward == pytest.approx(1.0 + 1.0 + 3 * info["reward_place"])


def test_the_environments_own_action_is_clipped_and_checked_too():
    env = cart()
    env.reset()
    env.action[:] = 1e9
    env.step(env.action)
    assert env.action == env.robot_state.command == env.action_space.high
    env.action[:] = np.nan
    with pytest.raises(ActionError, match="nan"):
        env.step(env.action)
