"""Evaluation: one recorded episode under a policy."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable
from typing import Any

from physx_core import checks
from physx_core.errors import ConfigError
from physx_gym.visualization.display import has_display
from physx_gym.visualization.playable import Info, Playable

PolicyFn = Callable[[Any, Any, float | None, bool, bool, dict[str, Any]], Any]
"""Takes observation, previous action, reward, terminated, truncated and information; returns an
action. Previous action and reward are None at the start."""


def evaluate(
    env: Playable,
    policy_fn: PolicyFn,
    seed: int | None = None,
    horizon: float | None = None,
    enable_stats: bool = True,
    enable_replay: bool | None = None,
    **kwargs: Any,
) -> tuple[list[float], list[Info]]:
    """Run one episode in evaluation mode, then return to the previous mode.

    It ends when it is terminated or truncated, at the horizon, or on Ctrl-C. The policy is called
    once more with the final state, so that it can record it.

    Args:
        env: The outermost environment of the pipeline; wrappers around it are not used.
        policy_fn: The policy; see `PolicyFn`.
        seed: Seed of the episode; None: continue the sequence.
        horizon: Longest time to simulate, in s; None: until the episode ends.
        enable_stats: Whether to print the number of steps and the total reward.
        enable_replay: Whether to replay it afterward; None: if there is a display.
        kwargs: For the replay.

    Returns:
        Rewards of all steps, and information: one more, as the first is from the reset.
    """
    _check(policy_fn)
    steps = math.inf
    if horizon is not None:
        steps = math.ceil(checks.positive("horizon", horizon) / env.step_dt - 1e-9)
    rewards: list[float] = []
    infos: list[Info] = []
    was_training = env.training
    env.stop()
    env.train(False)
    try:
        observation, info = env.reset(seed=seed)
        infos.append(info)
        action, reward, terminated, truncated = None, None, False, False
        while True:
            action = policy_fn(observation, action, reward, terminated, truncated, info)
            if terminated or truncated or len(rewards) >= steps:
                break
            observation, reward, terminated, truncated, info = env.step(action)
            rewards.append(reward)
            infos.append(info)
    except KeyboardInterrupt:
        pass  # the user has seen enough
    finally:
        env.stop()
        env.train(was_training)
    if enable_stats:
        text = f"steps: {len(rewards)} ({len(rewards) * env.step_dt:g} s)"
        print(f"{text}, total reward: {math.fsum(rewards):g}")  # noqa: T201 - as requested
    if enable_replay or (enable_replay is None and has_display()):
        try:
            env.replay(**kwargs)
        except Exception as error:  # a failing viewer does not invalidate the evaluation
            warnings.warn(f"The episode cannot be replayed: {error}", stacklevel=3)
    return rewards, infos


def _check(policy_fn: Any) -> None:
    """Check that a policy accepts its arguments."""
    try:
        inspect.signature(policy_fn).bind(*[None] * 6)
    except (TypeError, ValueError) as error:
        if callable(policy_fn) and isinstance(error, ValueError):
            return  # implemented in C, without a signature
        raise ConfigError(
            "A policy must accept observation, previous action, reward, terminated, truncated and "
            f"information, and return an action; {policy_fn!r} does not: {error}."
        ) from error
