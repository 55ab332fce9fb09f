"""``physx evaluate``: run episodes of an environment under a saved policy, on any engine."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
import tyro
from gymnasium import spaces

from physx_core import checkpoint
from physx_core.cli import options_from, show, show_table
from physx_core.components import Evaluation
from physx_core.errors import ConfigError, SessionError
from physx_core.results import PolicyResult, Result, read_results, store_result
from physx_gym.bridge.make_env import make_env
from physx_gym.bridge.plain import PlainEnv
from physx_gym.bridge.policy import Policy
from physx_gym.env.robot_env import RobotEnv
from physx_gym.visualization.replaying import replay

SPEED = "x_velocity"
"""Name, in information, of the velocity in the direction of walking, in m/s."""
SUCCESS = "is_success"
"""Name, in information, of whether the goal of a task is reached."""
_LAST = -1


@dataclass
class Evaluate:
    """Run episodes under a saved policy, and report rewards, lengths, speeds and success.

    They are compared with those of actions that are zero, and of random ones. The session keeps the
    result, one for each environment and engine.
    """

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
    rivals: Literal["all", "none"] = "all"
    """Whether to run the same episodes with zero and with random actions as well."""
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
    options = options_from(Evaluate, words, "evaluate")
    if options.episodes < 1:
        raise ConfigError(f"--episodes is {options.episodes} but must be at least 1.")
    backend = {} if options.backend is None else {"backend": options.backend}
    begin = time.monotonic()
    env = make_env(options.env, options.env_kwargs | backend)
    try:
        act = Policy(options.policy, env, trust=options.trust).act
        seeds = range(options.seed, options.seed + options.episodes)
        found, recording = _evaluate_all(env, act, seeds, options)
        film = options.film and replay(recording, record_video_path=options.film)
        rivals = {} if options.rivals == "none" else rewards_without_policy(env, seeds)
        result = _result(options, found, rivals, film)
        _store(Path(options.policy), result, time.monotonic() - begin)
        if options.json:
            given = {"env": options.env, "backend": options.backend, "policy": options.policy}
            known = {name: asdict(each) for name, each in result.rivals.items()}
            figures = {"summary": summary(found), "episodes": found, "rivals": known}
            print(json.dumps(given | figures))
        else:
            where = "" if options.backend is None else f" on {options.backend}"
            show(f"{options.env}{where}: {len(found)} episodes, seeds {seeds[0]} to {seeds[-1]}\n")
            print_table(summary(found))
            for line in result.lines("")[1:]:
                show(line.strip())
        if options.replay is not None:
            show(f"recording: {replay(recording, path=options.replay)}")
        if film:
            show(f"film: {film}")
    finally:
        env.close()


def _result(
    options: Evaluate,
    episodes: Sequence[dict[str, float]],
    rivals: Mapping[str, Sequence[float]],
    film: str | Path | None,
) -> PolicyResult:
    session, place = Path(options.policy).resolve(), Path(film).resolve() if film else None
    if place is not None and place.is_relative_to(session):  # wherever the session goes
        place = place.relative_to(session)
    figures = {name: [episode[name] for episode in episodes] for name in episodes[0]}
    network = checkpoint.find(Path(options.policy), None, _LAST).path.name
    return PolicyResult.of(
        options.env, options.backend or "", network, figures, rivals, film=str(place or "")
    )  # fmt: skip


def _store(session: Path, found: PolicyResult, seconds: float) -> None:
    """Keep a result in its session, beside those of the same network on other engines."""
    if not (session / "network").is_dir():  # a checkpoint's own folder
        return
    name = f"{found.environment} on {found.backend}" if found.backend else found.environment
    with contextlib.suppress(SessionError):  # of somebody else, who may only read it
        former = read_results(session).get("evaluation")
        known = {} if former is None else dict(former.policies)
        known = {label: each for label, each in known.items() if each.network == found.network}
        policies = dict(sorted({**known, name: found}.items()))
        result = Result("evaluation", str(session), seconds, policies=policies)
        store_result(session, result)


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


def rewards_without_policy(
    env: gymnasium.Env[Any, Any], seeds: Sequence[int]
) -> dict[str, list[float]]:
    """Return the rewards of episodes with zero and with random actions, by the actions' name.

    Args:
        env: The environment.
        seeds: Seeds of the episodes, and of the random actions.
    """
    zero = _zero(env.action_space)
    acts = {"zero actions": lambda _: zero, "random actions": lambda _: env.action_space.sample()}
    found: dict[str, list[float]] = {name: [] for name in acts}
    for name, act in acts.items():
        for seed in seeds:
            env.action_space.seed(seed)
            found[name].append(evaluate(env, act, [seed])[0]["reward"])
    return found


def _zero(space: gymnasium.Space[Any]) -> Any:
    """Return the action nearest to zero, or the first of several choices."""
    match space:
        case spaces.Box():
            return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        case spaces.Discrete() | spaces.MultiDiscrete():
            return space.start
        case spaces.MultiBinary():
            return np.zeros(space.shape, space.dtype)
        case spaces.Dict():
            return {name: _zero(part) for name, part in space.items()}
        case spaces.Tuple():
            return tuple(map(_zero, space))
        case _:
            space.seed(0)
            return space.sample()


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
