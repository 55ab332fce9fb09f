"""GymnasiumScene: a Gymnasium environment that answers godot-gym's requests."""

from __future__ import annotations

import json
from typing import Any

from physx_core.errors import UsageError
from physx_remote.errors import RequestError
from physx_remote.godot_gym.environment import RLEnvironment, Stepping
from physx_remote.godot_gym.messages import fill
from physx_remote.godot_gym.parts import RLAgent, RLEnvWorld
from physx_remote.godot_gym.wire import OUTCOME, gymnasium_messages, observation_fields
from physx_remote.serving.json_data import to_json_data
from physx_remote.serving.spaces import SpaceTree, from_json
from physx_remote.serving.worlds import Worlds


class GymnasiumScene(RLEnvironment):
    """Serves one Gymnasium environment as an `RLEnvironment`.

    ``action`` makes `repeat_action` steps of the environment, 1 by default, or fewer if the episode
    ends; their rewards are summed. The agent's data are the leaves of the observation, in the
    fields of `observation_fields`. The world's data are ``reward``, ``terminated``, ``truncated``
    and ``info`` of the last action. ``reset`` takes an object with ``seed`` and ``options``. There
    is no automatic reset: the last observation of an episode remains until the client resets.
    """

    def __init__(self, worlds: Worlds) -> None:
        """Wrap the only world."""
        super().__init__()
        if worlds.num_worlds != 1:
            raise UsageError(
                f'The protocol "godot-gym" serves one world, but there are {worlds.num_worlds}. '
                'Use the protocol "physx" for several.'
            )
        self.worlds = worlds
        self.repeat_action = 1
        self.observation_space, self.action_space = worlds.observation_space, worlds.action_space
        self._tree = SpaceTree(worlds.observation_space)
        self.messages = gymnasium_messages(self._tree)

    def _ready(self) -> None:
        """Set the agent and the world."""
        self.agent, self.world = _GymnasiumAgent(self._tree), _GymnasiumWorld()

    def _step(self, action: Any) -> Stepping:
        """Make `repeat_action` steps of the environment."""
        agent, outcome = self._parts()
        if not outcome.is_running:
            raise RequestError("No episode is running: reset first.")
        taken = from_json(self.worlds.action_space, action)
        total = 0.0
        for left in reversed(range(self.repeat_action)):
            agent.observation, reward, terminated, truncated, info = self.worlds.step(0, taken)
            total += reward
            outcome.set(total, terminated, truncated, info)
            if terminated or truncated or not left:
                return
            if self.communication.is_abandoned:
                raise RequestError("The client left in the middle of a step.")
            yield 0.0

    def _reset(self) -> None:
        """Start an episode."""
        agent, outcome = self._parts()
        value = self.reset_request if isinstance(self.reset_request, dict) else {}
        seed, options = value.get(self.SEED_KEY), value.get("options")
        if options is not None and not isinstance(options, dict):
            raise RequestError(f"Reset options must be a JSON object, not {options!r:.60}.")
        agent.observation, info = self.worlds.reset(0, seed, options)
        outcome.set(0.0, False, False, info)

    def close(self) -> None:
        """Close all connections and the environment."""
        super().close()
        self.worlds.close()

    def _parts(self) -> tuple[_GymnasiumAgent, _GymnasiumWorld]:
        agent, world = self._required_agent(), self._required_world()
        if not isinstance(agent, _GymnasiumAgent) or not isinstance(world, _GymnasiumWorld):
            raise UsageError("The agent and world of a Gymnasium environment cannot be replaced.")
        return agent, world


class _GymnasiumAgent(RLAgent):
    """The observation of a Gymnasium environment.

    Attributes:
        observation: The last one; None before the first reset.
    """

    def __init__(self, tree: SpaceTree) -> None:
        self.observation: Any = None
        self._tree, self._names = tree, observation_fields(tree)

    def get_data(self, request: Any, storage: Any) -> None:
        """Write the whole observation, regardless of the requested names."""
        if self.observation is None:
            raise RequestError("There is no observation yet: reset first.")
        fill(storage, **dict(zip(self._names, self._tree.split(self.observation), strict=True)))


class _GymnasiumWorld(RLEnvWorld):
    """The result of the last action in a Gymnasium environment.

    Attributes:
        is_running: Whether an episode has started and is not over.
    """

    def __init__(self) -> None:
        self.is_running = False
        self._values: dict[str, Any] = {}

    def set(self, reward: float, terminated: bool, truncated: bool, info: Any) -> None:
        """Store the result of an action."""
        self.is_running = not (terminated or truncated)
        text = json.dumps(to_json_data(info)) if info else ""
        self._values = dict(zip(OUTCOME, (reward, terminated, truncated, text), strict=True))

    def get_data(self, request: Any, storage: Any) -> None:
        """Write the requested values; unknown names are ignored."""
        names = request if isinstance(request, list) and request else list(OUTCOME)
        fill(storage, **{name: value for name, value in self._values.items() if name in names})
