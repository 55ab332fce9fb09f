"""Evaluating: an episode under a policy, recorded, with its rewards."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from physx_core import checks
from physx_core.errors import ConfigError
from physx_gym.show.display import has_display

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import Info, PipelineEnv

PolicyFn = Callable[[Any, Any, float | None, bool, bool, dict[str, Any]], Any]
"""Takes observation, previous action, reward, terminated, truncated and information; returns an
action. Previous action and reward are None at the beginning."""


def evaluate(
    env: PipelineEnv,
    policy_fn: PolicyFn,
    seed: int | None = None,
    horizon: float | None = None,
    enable_stats: bool = True,
    enable_replay: bool | None = None,
    **kwargs: Any,
) -> tuple[list[float], list[Info]]:
    """Run one episode in evaluation mode, and go back to the mode there was before.

    It ends when it is terminated or truncated, at the horizon, or with Ctrl-C. The policy is asked
    once more at the state that ends it, so that it can keep what it saw.

    Args:
        env: Top of the pipeline; what is around it takes no part.
        policy_fn: The policy; see `PolicyFn`.
        seed: Of the episode; None: go on with what is there.
        horizon: Longest time to simulate, in s; None: until the episode ends.
        enable_stats: Whether to print number of steps and total reward.
        enable_replay: Whether to replay it afterwards; None: where there is a display.
        kwargs: For the replay.

    Returns:
        Rewards of all steps, and information: one more, as the first is that of the reset.

    Raises:
        ConfigError: The horizon is not positive, or the policy does not take what it is asked with.
    """
    _check(policy_fn)
    steps = math.inf
    if horizon is not None:
        steps = math.ceil(checks.positive("horizon", horizon) / env.step_dt - 1e-9)
    rewards: list[float] = []
    infos: list[Info] = []
    base = env.unwrapped
    was_training = base.training
    base.stop()
    base.eval()
    try:
        _run(env, policy_fn, seed, steps, rewards, infos)
    except KeyboardInterrupt:
        pass  # who watches has seen enough
    finally:
        base.stop()
        base.train(was_training)
    if enable_stats:
        text = f"steps: {len(rewards)} ({len(rewards) * env.step_dt:g} s)"
        print(f"{text}, total reward: {math.fsum(rewards):g}")  # noqa: T201 - what was asked for
    if enable_replay or (enable_replay is None and has_display()):
        _replay(env, kwargs)
    return rewards, infos


def _check(policy_fn: Any) -> None:
    """Check that a policy can be asked.

    Raises:
        ConfigError: It cannot.
    """
    try:
        inspect.signature(policy_fn).bind(*[None] * 6)
    except (TypeError, ValueError) as error:
        if callable(policy_fn) and isinstance(error, ValueError):
            return  # made in C: it says itself what it does not take
        raise ConfigError(
            "The policy is called with observation, previous action, reward, terminated, truncated "
            f"and information, and returns an action; {policy_fn!r} cannot be: {error}."
        ) from error


def _run(
    env: PipelineEnv,
    policy_fn: PolicyFn,
    seed: int | None,
    steps: float,
    rewards: list[float],
    infos: list[Info],
) -> None:
    observation, info = env.reset(seed=seed)
    infos.append(info)
    action, reward, terminated, truncated = None, None, False, False
    while True:
        action = policy_fn(observation, action, reward, terminated, truncated, info)
        if terminated or truncated or len(rewards) >= steps:
            return
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        infos.append(info)


def _replay(env: PipelineEnv, options: dict[str, Any]) -> None:
    """Replay the episode; a viewer that fails takes nothing from the evaluation."""
    try:
        env.unwrapped.replay(**options)
    except Exception as error:  # whatever a viewer may raise
        warnings.warn(f"The episode cannot be replayed: {error}", stacklevel=3)
