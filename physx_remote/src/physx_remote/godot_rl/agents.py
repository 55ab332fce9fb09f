"""Agents: worlds as the agents of a godot-rl trainer."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, TypeAlias

import gymnasium
import numpy as np

from physx_core.errors import ActionError, nearest
from physx_remote.errors import RequestError
from physx_remote.godot_rl.json_spaces import ActionReader, ObservationWriter
from physx_remote.serving.json_data import to_json_data
from physx_remote.serving.worlds import Worlds

Answer: TypeAlias = Generator[float, None, dict[str, Any]]
"""Work that yields the time in s until it resumes, and returns the answer."""
_Moved: TypeAlias = tuple[dict[str, Any], float, bool, dict[str, Any]]

_POLICY = "shared_policy"
_NOT_CALLED = ("close", "reset", "step")


class Agents:
    """Worlds as the agents of a trainer, one agent per world.

    When an agent's episode ends, the next one starts immediately, and the answer contains the first
    observation of the new episode. The last observation of the old one is in the info as
    ``terminal_observation``, along with ``terminated``, ``truncated`` and ``TimeLimit.truncated``.

    Attributes:
        requests: Type of a message to the method that answers it.
    """

    def __init__(self, worlds: Worlds, action_repeat: int, seed: int | None) -> None:
        """Store the worlds.

        Args:
            worlds: One world per agent.
            action_repeat: Environment steps per step of the trainer.
            seed: Seed of the first episodes; None: unseeded.
        """
        self._worlds = worlds
        self._observations = ObservationWriter(worlds.observation_space)
        self._actions = ActionReader(worlds.action_space)
        self._action_repeat = action_repeat
        self._seed = seed
        self._is_begun = False
        self.requests: dict[str, Callable[[dict[str, Any]], Answer]] = {
            "env_info": self._describe,
            "reset": self._reset,
            "action": self._act,
            "call": self._call,
        }

    def _describe(self, message: dict[str, Any]) -> Answer:
        yield 0.0
        count = self._worlds.num_worlds
        return {
            "type": "env_info",
            "observation_space": [self._observations.description] * count,
            "action_space": [self._actions.description] * count,
            "n_agents": count,
            "agent_policy_names": [_POLICY] * count,
        }

    def _reset(self, message: dict[str, Any]) -> Answer:
        """Start new episodes in all worlds; the key ``seed`` is an extension of physx."""
        seed = message.get("seed")
        if seed is not None:
            if type(seed) is not int or seed < 0:
                raise RequestError(f"The seed is {seed!r} but must be a non-negative integer.")
            self._seed = seed
        begun = yield from self._begin_episodes()
        return {"type": "reset", "obs": [seen for seen, _ in begun], "info": [i for _, i in begun]}

    def _begin_episodes(self) -> Generator[float, None, list[tuple[Any, Any]]]:
        """Start new episodes in all worlds; return each agent's observation and info."""
        self._is_begun = False
        seed, self._seed = self._seed, None
        begun = []
        for world in range(self._worlds.num_worlds):
            begin = self._worlds.reset
            observation, info = self._call_in(world, begin, world, _seed_of(seed, world))
            begun.append((self._observations.write(observation), to_json_data(info)))
            yield 0.0
        self._is_begun = True
        return begun

    def _act(self, message: dict[str, Any]) -> Answer:
        actions = self._read(message.get("action"))
        if not self._is_begun:
            yield from self._begin_episodes()
        self._is_begun = False  # after a failure, the worlds are no longer in step
        answer: dict[str, Any] = {"type": "step", "obs": [], "reward": [], "done": [], "info": []}
        for world, action in enumerate(actions):
            seen, reward, is_done, told = yield from self._move(world, action)
            answer["obs"].append(seen)
            answer["reward"].append(reward)
            answer["done"].append(is_done)
            answer["info"].append(told)
        self._is_begun = True
        return answer

    def _move(self, world: int, action: Any) -> Generator[float, None, _Moved]:
        """Repeat one agent's action, and start its next episode if this one ends."""
        reward, terminated, truncated, left = 0.0, False, False, self._action_repeat
        while left and not (terminated or truncated):
            moved = self._call_in(world, self._worlds.step, world, action)
            observation, part, terminated, truncated, info = moved
            reward += part
            left -= 1
            yield 0.0
        told = to_json_data(info) if info else {}
        told.update(terminated=terminated, truncated=truncated)
        seen = self._observations.write(observation)
        is_done = terminated or truncated
        if is_done:
            told["terminal_observation"] = seen
            told["TimeLimit.truncated"] = truncated and not terminated
            observation, _ = self._call_in(world, self._worlds.reset, world)
            seen = self._observations.write(observation)
        return seen, reward, is_done, told

    def _read(self, given: Any) -> list[Any]:
        """Return the agents' actions; all are validated before any agent moves."""
        count = self._worlds.num_worlds
        if not isinstance(given, list) or len(given) != count:
            has = len(given) if isinstance(given, list) else type(given).__name__
            raise RequestError(
                f'"action" must be a list of {count} actions, one per agent, not {has}.'
            )
        actions = []
        for agent, action in enumerate(given):
            try:
                actions.append(self._actions.read(action))
            except ActionError as error:
                raise ActionError(f"Agent {agent}: {error}", error.entry) from error
        return actions

    def _call(self, message: dict[str, Any]) -> Answer:
        name = message.get("method")
        if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
            raise RequestError(f'"method" is {name!r}, which is not the name of a public method.')
        if name in _NOT_CALLED:
            raise RequestError(f'"{name}" has its own message type and cannot be called.')
        methods = [self._method(environment, name) for environment in self._worlds.environments]
        returns = []
        for world, method in enumerate(methods):
            returns.append(to_json_data(self._call_in(world, method)))
            yield 0.0
        return {"type": "call", "returns": returns}

    def _method(self, environment: gymnasium.Env[Any, Any], name: str) -> Any:
        method: Any = None
        if environment.has_wrapper_attr(name):
            method = environment.get_wrapper_attr(name)
        if callable(method):
            return method
        known = [n for n in dir(environment.unwrapped) if not n.startswith("_")]
        raise RequestError(f'{self._worlds.name} has no method "{name}".{nearest(name, known)}')

    def _call_in(self, world: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call the environment's code; errors name the agent."""
        try:
            return function(*arguments)
        except Exception as error:
            error.add_note(f"in the world of agent {world}")
            raise


def _seed_of(seed: int | None, world: int) -> int | None:
    """Return the seed of one world; world 0 gets the seed itself."""
    if seed is None or world == 0:
        return seed
    return int(np.random.SeedSequence(seed, spawn_key=(world,)).generate_state(1)[0])
