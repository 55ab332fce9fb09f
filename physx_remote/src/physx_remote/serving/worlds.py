"""Worlds: one or several Gymnasium environments of one kind, for a service to drive."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium

from physx_core import Closeable, PhysxError
from physx_core.components import Environment
from physx_core.errors import ComponentNotFoundError, ConfigError, StateError, UsageError
from physx_core.plugins import available, find, import_module, load
from physx_core.states import Baseline
from physx_remote.serving.sample_env import SampleEnv

_PLUGIN = "gym"
"""The plugin with Gymnasium environments; importing it registers further ids."""
_PREFIX = f"{_PLUGIN}/"

_SERVED = (
    "Pass an RLEnvironment or its class, a Gymnasium environment or a function that returns one, "
    'a physx environment, or a reference such as "gym/CartPole-v1" or "script.py:Class".'
)

Served: TypeAlias = str | gymnasium.Env[Any, Any] | Callable[..., Any]
"""What can be served: see `open_worlds`."""
Transition: TypeAlias = tuple[Any, float, bool, bool, dict[str, Any]]
"""Observation, reward, terminated, truncated, info."""


class Worlds(Closeable):
    """One or several Gymnasium environments with the same spaces. A context manager.

    Errors of the environments pass through; services report them and continue.

    Attributes:
        environments: The environments, by world number.
        name: Name of the environments, for messages.
        observation_space: Space of one world's observations.
        action_space: Space of one world's actions.
    """

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]], name: str = "") -> None:
        """Store the environments.

        Args:
            environments: At least one.
            name: Name of the environments; empty: the id or class of the first one.

        Raises:
            UsageError: If there are none, or their spaces differ.
        """
        if not environments:
            raise UsageError("There must be at least one world.")
        self.environments = list(environments)
        self._is_closed = False
        self._baselines = [_baseline_of(each) for each in environments]
        first = self.environments[0]
        own_name = first.spec.id if first.spec is not None else type(first.unwrapped).__name__
        self.name = name or own_name
        self.observation_space = first.observation_space
        self.action_space = first.action_space
        for number, other in enumerate(self.environments[1:], start=1):
            for kind in ("observation_space", "action_space"):
                if getattr(other, kind) != getattr(first, kind):
                    raise UsageError(
                        f"World {number} has the {kind} {getattr(other, kind)}, but world 0 has "
                        f"{getattr(first, kind)}. Worlds served together must have equal spaces."
                    )

    @property
    def num_worlds(self) -> int:
        """Number of worlds."""
        return len(self.environments)

    def reset(
        self, world: int, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in one world; return its observation and info."""
        return self.environments[world].reset(seed=seed, options=options)

    def step(self, world: int, action: Any) -> Transition:
        """Step one world."""
        observation, reward, terminated, truncated, info = self.environments[world].step(action)
        return observation, float(reward), bool(terminated), bool(truncated), info

    # Snapshots ------------------------------------------------------------------------------

    @property
    def has_snapshots(self) -> bool:
        """Whether the environments' states can be captured and restored."""
        return isinstance(self._baselines[0], Baseline)

    def snapshot(self, world: int) -> Any:
        """Return one world's state, wrappers included: see `physx_core.states`.

        Raises:
            UsageError: If it cannot be captured; the message names the part.
        """
        return self._baseline(world).capture()

    def restore(self, world: int, state: Mapping[str, Any]) -> None:
        """Restore one world to a state that `snapshot` returned.

        Raises:
            UsageError: If it has none, or the state is not one that `snapshot` returned.
        """
        if "created" not in state:
            raise UsageError(f"This state was not returned by snapshot() of {self.name}.")
        self._baseline(world).restore(state)

    def _baseline(self, world: int) -> Baseline:
        found = self._baselines[world]
        if isinstance(found, StateError):
            raise UsageError(f"{self.name} has no snapshots: {found}") from found
        return found

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


class _World:
    """What has an environment, for its state."""

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        self.environment = environment


def _baseline_of(environment: gymnasium.Env[Any, Any]) -> Baseline | StateError:
    try:
        return Baseline(_World(environment))
    except StateError as error:
        return error


def open_worlds(
    environment: Served, num_worlds: int = 1, env_kwargs: Mapping[str, Any] | None = None
) -> Worlds:
    """Create worlds.

    Args:
        environment: A Gymnasium id, such as ``"gym/CartPole-v1"`` or, if it has a version,
            ``"physx/Cartpole-v0"`` or ``"module:id-v0"`` and ``"script.py:id-v0"``, which import
            the module first; a reference to a physx environment, such as ``"toy/spring"``, which
            becomes a `SampleEnv`; ``"package.module:Class"`` or ``"script.py:function"`` of either
            kind, also after ``"gym/"``; a class, or a function that returns an environment; or one
            Gymnasium environment.
        num_worlds: Number of worlds to create.
        env_kwargs: Keyword arguments of each environment, including those of `SampleEnv`.

    Raises:
        ConfigError: If an environment does not accept the arguments.
        UsageError: If several worlds of one existing environment are requested, or a function
            returns something other than an environment.
        PhysxError: If the reference cannot be resolved: see `physx_core.plugins.find`.
    """
    if type(num_worlds) is not int or num_worlds < 1:
        raise ConfigError(f"num_worlds is {num_worlds!r} but must be an integer of at least 1.")
    arguments = dict(env_kwargs or {})
    if isinstance(environment, gymnasium.Env):
        if num_worlds > 1 or arguments:
            raise UsageError(
                "An existing environment is one world and takes no arguments: pass its class, or a "
                "function that returns one."
            )
        return Worlds([environment])
    made: list[gymnasium.Env[Any, Any]] = []
    try:
        for number in range(num_worlds):
            made.append(_make_world(environment, arguments, number, num_worlds))
        return Worlds(made, environment if isinstance(environment, str) else "")
    except BaseException:
        for world in made:
            world.close()
        raise


def is_gymnasium_id(reference: str) -> bool:
    """Return whether a reference is a Gymnasium id: it starts with ``gym/`` or has a version."""
    return reference.startswith(_PREFIX) or reference.rpartition("-v")[2].isdigit()


def _make_world(
    environment: Any, arguments: dict[str, Any], number: int, num_worlds: int
) -> gymnasium.Env[Any, Any]:
    if isinstance(environment, str):
        name = environment.removeprefix(_PREFIX)
        if is_gymnasium_id(name) or (name != environment and ":" not in name):
            return _make_gymnasium(name, arguments)
        environment = find("environment", name)
    if isinstance(environment, type) and issubclass(environment, Environment):
        return SampleEnv(environment, **arguments, instance_id=number + 1, instance_nb=num_worlds)
    if not callable(environment):
        raise UsageError(f"{environment!r} is not an environment. {_SERVED}")
    made = call_with(environment, arguments)
    if isinstance(made, gymnasium.Env):
        return made
    raise UsageError(
        f"{environment!r} returned {made!r:.80}, which is not a Gymnasium environment."
    )


def call_with(maker: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Call a function or class with arguments."""
    try:
        return maker(**arguments)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is not None:
            raise  # the call succeeded, and the code inside it failed
        raise ConfigError(f"{maker!r} does not take these arguments: {error}.") from error


def _make_gymnasium(name: str, arguments: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    place, _, id = name.rpartition(":")
    if place:
        import_module("environment", place)
    elif name not in gymnasium.registry and _PLUGIN in available():
        load(_PLUGIN)
    try:
        return gymnasium.make(id, disable_env_checker=True, **arguments)
    except gymnasium.error.UnregisteredEnv as error:
        place = 'Gymnasium (ids of other packages are written "package:id")'
        raise ComponentNotFoundError("environment", name, place, gymnasium.registry) from error
    except (gymnasium.error.Error, ModuleNotFoundError, TypeError) as error:
        if isinstance(error, PhysxError):
            raise
        raise ConfigError(f"Gymnasium cannot create {name}: {error}") from error
