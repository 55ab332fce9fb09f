"""A study: the same seeds, actions and policies on several engines."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium

from physx_agree.agreement import Agreement
from physx_agree.diagnosis import Diagnosis
from physx_agree.episodes import RETURN, Act, figures_of, record, robot_below
from physx_agree.scores import Score, rankings, scores_by_engine
from physx_core import checks
from physx_core.errors import ConfigError
from physx_gym import Policy, make_env

RANDOM = "random"
"""The policy without a network: actions drawn from the action space, the same on each engine."""

Policies = Mapping[str, Callable[[gymnasium.Env[Any, Any]], Act]]
Maker = Callable[[gymnasium.Env[Any, Any]], Callable[[int], Act]]


def agree(
    task: str | Callable[..., gymnasium.Env[Any, Any]],
    engines: Sequence[Any] = ("dart", "pinocchio", "mujoco"),
    policies: Sequence[str] | Policies = (),
    *,
    seeds: Sequence[int] = range(10_000, 10_010),
    metric: str = RETURN,
    steps: int = 1000,
    env_kwargs: Mapping[str, Any] | None = None,
    trust: bool = False,
) -> Agreement:
    """Compare engines on a task.

    The metric is that of whole episodes. Why the engines part is found out in the beginning of the
    first episode of the first policy: each of its physics steps is repeated on all engines, from
    the state, and under the commands, of the first engine.

    Args:
        task: Id of the environment, ``"module:id"``, ``"module:Class"``, ``"script.py:function"``,
            or a function that makes it; all take the argument `backend`.
        engines: References of the engines; the others are compared with the first.
        policies: Sessions or checkpoints of the policies' networks; or by name functions that take
            the environment and return the one that chooses actions. None: actions drawn at random,
            the same on each engine.
        seeds: Of the episodes.
        metric: ``"return"``, ``"length"``, or a name of the information of steps, whose mean over
            the episode counts.
        steps: How many physics steps of the first episode are compared.
        env_kwargs: Further options of the environment.
        trust: Whether to import whatever the policies' checkpoints name.

    Raises:
        ConfigError: If there are fewer than two engines or no seed, the task has no robot, or its
            information does not have the metric.
        PluginNotFoundError: If an engine is not installed.
    """
    engines, seeds = list(engines), list(seeds)
    if len(engines) < 2:
        raise ConfigError(f"To agree takes two engines at least, not {engines}.")
    if not seeds:
        raise ConfigError("There is no seed: give one at least, and three for intervals.")
    if checks.integer("steps", steps) < 1:
        raise ConfigError(f"steps is {steps} but must be at least 1.")
    options = dict(env_kwargs or {})

    def make(engine: Any) -> gymnasium.Env[Any, Any]:
        given = {**options, "backend": engine}
        return make_env(task, given) if isinstance(task, str) else task(**given)

    makers = _makers(policies, trust)
    names = _names(engines)
    scores: list[Score] = []
    values = {
        name: {label: _values(make(engine), maker, seeds, metric)
               for label, engine in zip(names, engines, strict=True)}
        for name, maker in makers.items()
    }  # fmt: skip
    for name, found in values.items():
        scores += scores_by_engine(name, found)
    first = make(engines[0])
    try:
        episode = record(first, next(iter(makers.values()))(first)(seeds[0]), seeds[0], steps)
    finally:
        first.close()
    labels = list(zip(engines, names, strict=True))
    partings = [
        Diagnosis(make, (labels[0], each), episode, seeds[0]).parting() for each in labels[1:]
    ]
    label = task if isinstance(task, str) else getattr(task, "__qualname__", str(task))
    ranked = tuple(rankings(scores))
    return Agreement(
        label, metric, tuple(names), tuple(seeds), tuple(scores), ranked, tuple(partings)
    )


def _values(
    env: gymnasium.Env[Any, Any], maker: Maker, seeds: Sequence[int], metric: str
) -> list[float]:
    try:
        robot_below(env)
        begin = maker(env)
        return [figures_of(env, begin(seed), seed, metric) for seed in seeds]
    finally:
        env.close()


def _makers(policies: Sequence[str] | Policies, trust: bool) -> dict[str, Maker]:
    """Return by name what makes a policy for an environment, and for each seed its actions."""
    if not policies:
        return {RANDOM: _random}
    if isinstance(policies, Mapping):
        return {name: _whatever_the_seed(make) for name, make in policies.items()}
    return {path: _whatever_the_seed(_network(path, trust)) for path in policies}


def _network(path: str, trust: bool) -> Callable[[gymnasium.Env[Any, Any]], Act]:
    return lambda env: Policy(path, env, trust=trust).act


def _whatever_the_seed(make: Callable[[gymnasium.Env[Any, Any]], Act]) -> Maker:
    def maker(env: gymnasium.Env[Any, Any]) -> Callable[[int], Act]:
        act = make(env)
        return lambda seed: act

    return maker


def _random(env: gymnasium.Env[Any, Any]) -> Callable[[int], Act]:
    def begin(seed: int) -> Act:
        space = copy.deepcopy(env.action_space)
        space.seed(seed)
        return lambda observation: space.sample()

    return begin


def _names(engines: Sequence[Any]) -> list[str]:
    """Return different names of engines."""
    names = [each if isinstance(each, str) else each.__name__ for each in engines]
    return [
        name if names.index(name) == place else f"{name} ({names[: place + 1].count(name)})"
        for place, name in enumerate(names)
    ]
