"""``physx evaluate``: run episodes of an environment under a saved policy, on any engine."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import gymnasium
import numpy as np
import tyro

from physx_core.cli import argument_registry, show, show_table
from physx_core.components import Evaluation
from physx_core.errors import ConfigError
from physx_gym.bridge.make_env import make_env
from physx_gym.bridge.plain import PlainEnv
from physx_gym.bridge.policy import Policy
from physx_gym.env.robot_env import RobotEnv
from physx_gym.visualization.replaying import replay

SPEED = "x_velocity"
"""Name, in information, of the velocity in the direction of walking, in m/s."""
SUCCESS = "is_success"
"""Name, in information, of whether the goal of a task is reached."""


@dataclass
class Evaluate:
    """Run episodes under a saved policy, and report rewards, lengths, speeds and success."""

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    """Session or checkpoint of the policy's network."""
    env: str
    """Id of the environment, "module:id", "module:Class", or "script.py:function"."""
    backend: str | None = None
    """Engine; by default the environment's own."""
    episodes: int = 20
    """Number of episodes."""
    seed: int = 10_000
    """Seed of the first episode; each further episode adds 1."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Further options of the environment."""
    json: bool = False
    """Print JSON with the figures of each episode instead of a table."""
    replay: str | None = None
    """Write a viewer recording of the first episode to this file (.rrd)."""
    film: str | None = None
    """Write a film of the first episode to this file (.mp4, .gif, .webp)."""
    trust: bool = False
    """Import whatever the checkpoint names, not only components of installed plugins."""


def run(words: Sequence[str]) -> None:
    """Print the figures, and write the requested files."""
    with argument_registry():
        options = tyro.cli(Evaluate, args=words, prog="physx evaluate")
    if options.episodes < 1:
        raise ConfigError(f"--episodes is {options.episodes} but must be at least 1.")
    backend = {} if options.backend is None else {"backend": options.backend}
    env = make_env(options.env, options.env_kwargs | backend)
    try:
        act = Policy(options.policy, env, trust=options.trust).act
        seeds = range(options.seed, options.seed + options.episodes)
        found, recording = _evaluate_all(env, act, seeds, options)
        if options.json:
            given = {"env": options.env, "backend": options.backend, "policy": options.policy}
            show(json.dumps(given | {"summary": summary(found), "episodes": found}))
        else:
            where = "" if options.backend is None else f" on {options.backend}"
            show(f"{options.env}{where}: {len(found)} episodes, seeds {seeds[0]} to {seeds[-1]}\n")
            print_table(summary(found))
        if options.replay is not None:
            show(f"recording: {replay(recording, path=options.replay)}")
        if options.film is not None:
            show(f"film: {replay(recording, record_video_path=options.film)}")
    finally:
        env.close()


def evaluate(
    env: gymnasium.Env[Any, Any], act: Callable[[Any], Any], seeds: Sequence[int]
) -> list[dict[str, float]]:
    """Run an episode for each seed, and return its figures by name.

    ``reward`` is the sum of the rewards and ``length`` the number of steps. If the information of
    steps contains them, ``speed`` is the mean velocity along x in m/s, and ``success`` is 1 if the
    goal is reached at the end, otherwise 0.

    Args:
        env: The environment.
        act: Returns the action for an observation.
        seeds: Seeds of the episodes.
    """
    found = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        rewards, speeds, over = [], [], False
        info: dict[str, Any] = {}
        while not over:
            observation, reward, terminated, truncated, info = env.step(act(observation))
            rewards.append(float(reward))
            if SPEED in info:
                speeds.append(float(info[SPEED]))
            over = terminated or truncated
        figures = {"seed": seed, "reward": math.fsum(rewards), "length": len(rewards)}
        if speeds:
            figures["speed"] = math.fsum(speeds) / len(speeds)
        if SUCCESS in info:
            figures["success"] = float(info[SUCCESS])
        found.append(figures)
    return found


def summary(episodes: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return mean, standard deviation, smallest and largest value of each figure of episodes."""
    found = {}
    for name in episodes[0]:
        if name != "seed":
            values = np.array([episode[name] for episode in episodes])
            found[name] = {
                "mean": float(values.mean()),
                "std": float(values.std()),
                "min": float(values.min()),
                "max": float(values.max()),
            }
    return found


def print_table(figures: dict[str, dict[str, float]]) -> None:
    """Print what `summary` returned."""
    units, numbers = {"length": "steps", "speed": "m/s"}, ("mean", "std", "min", "max")
    lines = [
        [name, *(f"{value:.4g}" for value in values.values()), units.get(name, "")]
        for name, values in figures.items()
    ]
    show_table(["", *numbers, "unit"], lines, numbers=numbers)


def robot_of(env: gymnasium.Env[Any, Any]) -> RobotEnv | None:
    """Return the robot's environment below all wrappers, or None if there is none."""
    base = env.unwrapped
    while isinstance(base, PlainEnv):
        base = base.env.unwrapped
    return base if isinstance(base, RobotEnv) else None


def evaluate_recorded(
    env: gymnasium.Env[Any, Any], act: Callable[[Any], Any], seed: int
) -> tuple[dict[str, float], dict[str, Any]]:
    """Run an episode, and return its figures and the recording of it, as `RobotEnv.log_data`.

    The wrappers act on the policy's actions, and may act more or less often than it, or end the
    episode; what is recorded is what the robot below them did.

    Args:
        env: The environment, with a `RobotEnv` below its wrappers.
        act: Returns the action for an observation.
        seed: Seed of the episode.

    Raises:
        ConfigError: If there is no robot.
    """
    robot = robot_of(env)
    if robot is None:
        raise ConfigError(f"{env} is not a RobotEnv, so its episodes are not recorded.")
    robot.stop()
    was_training = robot.training
    robot.eval()
    try:
        (figures,) = evaluate(env, act, [seed])
    finally:
        robot.stop()
        robot.train(was_training)
    return figures, robot.log_data


def _evaluate_all(
    env: gymnasium.Env[Any, Any], act: Callable[[Any], Any], seeds: range, options: Evaluate
) -> tuple[list[dict[str, float]], dict[str, Any]]:
    """Run episodes in evaluation mode; return their figures, and a recording to be shown."""
    robot = robot_of(env)
    if robot is not None:
        robot.eval()
    if options.replay is None and options.film is None:
        return evaluate(env, act, seeds), {}
    first, recording = evaluate_recorded(env, act, seeds[0])
    return [first, *evaluate(env, act, seeds[1:])], recording


def _is_policy(fields: Sequence[str]) -> bool:
    """Return whether a network's fields are parts of an observation and of an action."""
    return bool(fields) and all(name.startswith(("observation", "action")) for name in fields)


EVALUATION = Evaluation(_is_policy, run)
