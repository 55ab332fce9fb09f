"""Worlds: what a service drives, one or several gymnasium environments of one kind."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium

from physx_core import Closeable, PhysxError
from physx_core.components import Environment
from physx_core.errors import ComponentNotFoundError, ConfigError, UsageError
from physx_core.plugins import resolve
from physx_remote.serving.sample_env import SampleEnv

GYMNASIUM = "gym/"
"""Beginning of a reference whose rest is an id of gymnasium."""

_SERVED = (
    "What can be served: an RLEnvironment or its class, an environment of Gymnasium or a function "
    'that makes one, an environment of physx, or a reference such as "gym/CartPole-v1" or '
    '"script.py:Class".'
)

_OWN, _OWN_MODULE = "physx/", "physx_gym"  # who imports the module registers the ids

Served: TypeAlias = str | gymnasium.Env[Any, Any] | Callable[..., Any]
"""What can be served: see `open_worlds`."""
Transition: TypeAlias = tuple[Any, float, bool, bool, dict[str, Any]]
"""Observation, reward, terminated, truncated, info."""


class Worlds(Closeable):
    """One or several gymnasium environments with the same spaces. A context manager.

    What an environment raises passes through: whoever serves the worlds reports it and lives on.

    Attributes:
        environments: The environments, by number of the world.
        name: What they are, for messages.
        observation_space: Space of one world's observations.
        action_space: Space of one world's actions.
    """

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]], name: str = "") -> None:
        """Keep the environments.

        Args:
            environments: At least one.
            name: What they are; empty: what the first one calls itself.

        Raises:
            UsageError: There is none, or their spaces differ.
        """
        if not environments:
            raise UsageError("There must be at least one world.")
        self.environments = list(environments)
        self._is_closed = False
        first = self.environments[0]
        own_name = first.spec.id if first.spec is not None else type(first.unwrapped).__name__
        self.name = name or own_name
        self.observation_space = first.observation_space
        self.action_space = first.action_space
        for number, other in enumerate(self.environments[1:], start=1):
            for kind in ("observation_space", "action_space"):
                if getattr(other, kind) != getattr(first, kind):
                    raise UsageError(
                        f"World {number} has the {kind} {getattr(other, kind)}, and world 0 has "
                        f"{getattr(first, kind)}. Worlds that are served together need the same."
                    )

    @property
    def num_worlds(self) -> int:
        """How many worlds there are."""
        return len(self.environments)

    def reset(
        self, world: int, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of one world; return its observation and info."""
        return self.environments[world].reset(seed=seed, options=options)

    def step(self, world: int, action: Any) -> Transition:
        """Make one step of one world."""
        observation, reward, terminated, truncated, info = self.environments[world].step(action)
        return observation, float(reward), bool(terminated), bool(truncated), info

    # Snapshots ------------------------------------------------------------------------------

    @property
    def has_snapshots(self) -> bool:
        """Whether the environments can be put back to where they were."""
        return self._keeper(0) is not None

    def snapshot(self, world: int) -> Any:
        """Return one world's state.

        Raises:
            UsageError: The environment has no method `snapshot`.
        """
        keeper = self._required_keeper(world)
        elapsed = [limit._elapsed_steps for limit in self._limits(world)]
        return {"environment": keeper.snapshot(), "elapsed_steps": elapsed}

    def restore(self, world: int, state: Mapping[str, Any]) -> None:
        """Put one world back to a state that `snapshot` returned.

        Raises:
            UsageError: The environment has no method `restore`, or the state is none of these.
        """
        limits = self._limits(world)
        if set(state) != {"environment", "elapsed_steps"} or len(state["elapsed_steps"]) != len(
            limits
        ):
            raise UsageError(f"This is no state that snapshot() of {self.name} returned.")
        self._required_keeper(world).restore(state["environment"])
        for limit, elapsed in zip(limits, state["elapsed_steps"], strict=True):
            limit._elapsed_steps = elapsed

    def _keeper(self, world: int) -> Any:
        """Return the outermost part of an environment that has snapshots, or None."""
        found = (env for env in self._parts(world) if hasattr(env, "snapshot"))
        return next(found, None)

    def _required_keeper(self, world: int) -> Any:
        keeper = self._keeper(world)
        if keeper is None:
            raise UsageError(
                f"{self.name} has no snapshots: its environment defines no snapshot()."
            )
        return keeper

    def _limits(self, world: int) -> list[Any]:
        """Return the wrappers that count steps."""
        limit = gymnasium.wrappers.TimeLimit
        return [env for env in self._parts(world) if isinstance(env, limit)]

    def _parts(self, world: int) -> list[gymnasium.Env[Any, Any]]:
        """Return an environment's wrappers from outside inwards, and what they wrap."""
        parts = [self.environments[world]]
        while isinstance(parts[-1], gymnasium.Wrapper):
            parts.append(parts[-1].env)
        return parts

    # ----------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the environments; the first error is raised once all of them are closed.

        Calling it again does nothing.
        """
        if self._is_closed:
            return
        self._is_closed = True
        with contextlib.ExitStack() as stack:
            for environment in self.environments:
                stack.callback(environment.close)


def open_worlds(
    environment: Served, num_worlds: int = 1, env_kwargs: Mapping[str, Any] | None = None
) -> Worlds:
    """Make the worlds that a user names.

    Args:
        environment: ``"gym/CartPole-v1"``: the id ``CartPole-v1`` of gymnasium; an id that has a
            version, such as ``"physx/Cartpole-v0"``; a reference of a physx environment, such as
            ``"toy/spring"``, which is served as `SampleEnv` does; ``"package.module:Class"`` or
            ``"script.py:Class"`` of either kind; a class, a function that makes an environment; or
            one gymnasium environment.
        num_worlds: How many worlds to make.
        env_kwargs: Keyword arguments of each environment; `SampleEnv` takes its own from them.

    Raises:
        ConfigError: An environment does not take the arguments.
        UsageError: One environment shall be several worlds, or what was made is no environment.
        PhysxError: The reference leads nowhere: see `physx_core.plugins.resolve`.
    """
    if type(num_worlds) is not int or num_worlds < 1:
        raise ConfigError(f"num_worlds is {num_worlds!r} but must be a whole number, at least 1.")
    arguments = dict(env_kwargs or {})
    if isinstance(environment, gymnasium.Env):
        if num_worlds > 1 or arguments:
            raise UsageError(
                "An environment that is made already is one world and takes no arguments. "
                "Give the class, or a function that makes one."
            )
        return Worlds([environment])
    made: list[gymnasium.Env[Any, Any]] = []
    try:
        for number in range(num_worlds):
            made.append(_world(environment, arguments, number, num_worlds))
        return Worlds(made, environment if isinstance(environment, str) else "")
    except BaseException:
        for opened in made:
            opened.close()
        raise


def _world(
    environment: Any, arguments: dict[str, Any], number: int, num_worlds: int
) -> gymnasium.Env[Any, Any]:
    if isinstance(environment, str):
        if environment.startswith(GYMNASIUM):
            return _of_gymnasium(environment.removeprefix(GYMNASIUM), arguments)
        if ":" not in environment and environment.rpartition("-v")[2].isdigit():
            return _of_gymnasium(environment, arguments)
        environment = resolve("environment", environment)
    if isinstance(environment, type) and issubclass(environment, Environment):
        return SampleEnv(environment, **arguments, instance_id=number + 1, instance_nb=num_worlds)
    if not callable(environment):
        raise UsageError(f"{environment!r} is no environment. {_SERVED}")
    made = called(environment, arguments)
    if isinstance(made, gymnasium.Env):
        return made
    raise UsageError(f"{environment!r} made {made!r:.80}, which is no gymnasium environment.")


def called(maker: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Return what a function or class makes of the arguments.

    Raises:
        ConfigError: It does not take them.
    """
    try:
        return maker(**arguments)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is not None:
            raise  # not the call failed, but what was called
        raise ConfigError(f"{maker!r} does not take these arguments: {error}.") from error


def _of_gymnasium(name: str, arguments: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    place = f"{_OWN_MODULE}:{name}" if name.startswith(_OWN) else name
    try:
        return gymnasium.make(place, disable_env_checker=True, **arguments)
    except gymnasium.error.UnregisteredEnv as error:
        known = gymnasium.registry
        raise ComponentNotFoundError("environment", name, "gymnasium", known) from error
    except (gymnasium.error.Error, TypeError) as error:
        if isinstance(error, PhysxError):
            raise
        raise ConfigError(f"gymnasium cannot make {name}: {error}") from error
