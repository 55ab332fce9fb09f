"""Checks of subclasses of environments: their options, spaces, and returned values."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium

from physx_core.errors import ConfigError, UnknownArgumentError, UnknownOptionError
from physx_gym.visualization.display import has_display


def construct_next(
    kind: type[Any], env: Any, options: Mapping[str, Any], known: Iterable[str]
) -> None:
    """Call the constructor of the next class in the method resolution order of an environment.

    Args:
        kind: The preceding class.
        env: The environment.
        options: Options of the constructor.
        known: Options that the preceding class accepted besides those in its signature.
    """
    order = type(env).__mro__
    place = order.index(kind) + 1
    accepting = [each for each in order[place:-1] if "__init__" in vars(each)]
    if options and not accepting:
        raise UnknownArgumentError(type(env).__name__, options, {*_options(order[:place]), *known})
    super(kind, env).__init__(**options)


def _options(kinds: Sequence[type[Any]]) -> list[str]:
    """Return the options of the first of some classes; of the others, those with a default."""
    found: dict[str, None] = {}
    for each in (kind for kind in kinds if "__init__" in vars(kind)):
        first, passes_on = not found, False
        for one in [*inspect.signature(vars(each)["__init__"]).parameters.values()][1:]:
            if one.kind in (one.VAR_KEYWORD, one.VAR_POSITIONAL):
                passes_on = True
            elif first or one.default is not one.empty:
                found[one.name] = None
        if not passes_on:
            break
    return list(found)


_PAIRS = {
    "_sample_state": "positions and velocities",
    "has_terminated": "whether the episode is terminated, and whether it is truncated",
}


def check_mode(mode: Any, modes: Sequence[str]) -> None:
    """Check a render mode; None: whichever is possible."""
    if mode is not None and mode not in modes:
        raise UnknownOptionError("render_mode", [str(mode)], modes)


def metadata_of(kind: type[Any], step_dt: float) -> dict[str, Any]:
    """Return the metadata of a class of environments, with the modes possible on this machine.

    Args:
        kind: The class.
        step_dt: Time of a step, in s.
    """
    modes = [mode for mode in kind.metadata["render_modes"] if mode != "human" or has_display()]
    frames = max(1, round(1 / step_dt))
    return {"render_fps": frames, **kind.metadata, "render_modes": modes}


def check_pair(env: Any, method: str, found: Any) -> tuple[Any, Any]:
    """Return a method's result after checking that it is a pair."""
    if not isinstance(found, (tuple, list)) or len(found) != 2:
        raise ConfigError(
            f"{type(env).__name__}.{method} returned {found!r} but must return {_PAIRS[method]}."
        )
    return found[0], found[1]


def check_number(env: Any, reward: Any) -> float:
    """Return a reward as a number."""
    try:
        return float(reward)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{type(env).__name__}.compute_reward returned {reward!r} but must return a number."
        ) from error


def check_spaces(env: Any) -> None:
    """Check that an environment has its spaces."""
    for kind in ("action_space", "observation_space"):
        space = getattr(env, kind, None)
        if not isinstance(space, gymnasium.Space):
            raise ConfigError(
                f"{type(env).__name__}.{kind} is {space!r}: _initialize_{kind} must set it to a "
                "space of gymnasium.spaces."
            )


OF_TRAINERS = frozenset(
    {
        *("observation", "action", "reward", "done", "terminated", "truncated", "next"),  # TorchRL
        *("episode", "final_obs", "final_info"),  # Gymnasium
        *("terminal_observation", "TimeLimit.truncated"),  # stable-baselines3
    }
)
"""Names in information that trainers and wrappers write themselves, or beside it in one table."""


def check_info(outermost: Any, info: Mapping[str, Any]) -> None:
    """Check that no name in information is one of trainers.

    Args:
        outermost: The pipeline that wrote it.
        info: The information.
    """
    if OF_TRAINERS.isdisjoint(info):
        return
    name = min(OF_TRAINERS & info.keys())
    kinds = " or ".join(dict.fromkeys(type(each).__name__ for each in outermost.layers[::-1]))
    raise ConfigError(
        f'{kinds} wrote info["{name}"], but trainers keep what is theirs under that name, and '
        f'would replace one by the other: choose another, such as "my_{name}".'
    )


def not_written(env: Any, method: str, where: str) -> ConfigError:
    """Return the error for a method that returned what it should have written."""
    return ConfigError(
        f"{type(env).__name__}.{method} returned a value, which is not used: write into "
        f"`{where}` in place, and return nothing."
    )
