"""Any Gymnasium environment as an environment of physx."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from physx_core import Field
from physx_core.components import Environment
from physx_core.errors import ConfigError
from physx_core.plugins import resolve
from physx_gym.bridge.making import make_env
from physx_gym.bridge.policy import action_arrays
from physx_gym.spaces import SpaceFields


class GymEnvironment(Environment):
    """Stores the transitions of a Gymnasium environment: ``"gym/CartPole-v1"``.

    One sample is one transition: ``observation``, ``action``, ``reward``, ``next_observation``,
    ``terminated`` and ``truncated``. Spaces of several parts become a field for each, for example
    ``observation_states_agent_q``. Episodes are trajectories: `Dataset.episodes` finds them. Where
    stored samples are replayed, the stored actions are made again.
    """

    def __init__(
        self, *, id: str, policy: str | Callable[..., Any] = "random", **kwargs: Any
    ) -> None:
        """Keep what the environment is made from.

        Args:
            id: Its id in Gymnasium, ``"package.module:Class"`` or ``"script.py:Class"``.
            policy: Who acts: ``"random"``, evenly within the action space; ``"network"``, the
                network of the run; or ``"package.module:function"``, which is called with the
                observation.
            kwargs: Those of `Environment`; all others are the Gymnasium environment's own.
        """
        own = {
            name: kwargs.pop(name)
            for name in ("instance_id", "instance_nb", "seed")
            if name in kwargs
        }
        super().__init__(**own)
        self._id, self._options, self._chosen = id, kwargs, policy
        self._observation: Any = None

    def create(self) -> None:
        """Make the environment.

        Raises:
            ConfigError: There is no such environment or policy, or a space has no fixed shape.
        """
        self.env = make_env(self._id, self._options)
        self._observations = SpaceFields(self.env.observation_space, "observation")
        self._next = SpaceFields(self.env.observation_space, "next_observation")
        self._actions = SpaceFields(self.env.action_space, "action")
        self._policy = self._acting()
        self._first_seed: int | None = int(self.rng.integers(1 << 31))
        self.env.action_space.seed(int(self.rng.integers(1 << 31)))

    def init_database(self) -> None:
        """Define the fields of a transition."""
        self.define_training_fields(
            [
                *self._observations.fields,
                *self._actions.fields,
                Field("reward", ()),
                *self._next.fields,
                Field("terminated", (), "bool"),
                Field("truncated", (), "bool"),
            ]
        )

    def step(self) -> None:
        """Make one transition; begin a new episode where the last one ended."""
        if self._observation is None:
            self._observation, _ = self.env.reset(seed=self._first_seed)
            self._first_seed = None
        before = self._observations.arrays(self._observation)
        action = self._policy(self._observation)
        # Copies: an environment may hand out the same array again and again.
        sample = {name: array.copy() for name, array in before.items()}
        observation, reward, terminated, truncated, _ = self.env.step(action)
        self.set_training_data(
            **sample,
            **self._actions.arrays(action),
            **self._next.arrays(observation),
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
        )
        self._observation = observation
        if terminated or truncated:
            self._observation = None
            self.new_episode()

    def close(self) -> None:
        """Close the environment."""
        env: gymnasium.Env[Any, Any] | None = getattr(self, "env", None)
        if env is not None:
            env.close()

    # Acting ---------------------------------------------------------------------------------

    def _acting(self) -> Callable[[Any], Any]:
        chosen = self._chosen
        act: Callable[[Any], Any]
        if chosen == "random":
            act = self._sampled
        elif chosen == "network":
            act = self._ask_network
        elif isinstance(chosen, str) and ":" not in chosen:
            raise ConfigError(
                f'policy is "{chosen}" but must be "random", "network" or '
                '"package.module:function".'
            )
        else:
            act = resolve("environment", chosen) if isinstance(chosen, str) else chosen
        return lambda observation: self._stored_action() if self.sample else act(observation)

    def _sampled(self, observation: Any) -> Any:
        return self.env.action_space.sample()

    def _ask_network(self, observation: Any) -> Any:
        predicted = self.get_prediction(**self._observations.arrays(observation))
        batch = {name: np.asarray(values)[np.newaxis] for name, values in predicted.items()}
        arrays = action_arrays(self._actions, batch)
        return self._actions.value({name: values[0] for name, values in arrays.items()})

    def _stored_action(self) -> Any:
        return self._actions.value(
            {f.name: (self.sample or {})[f.name] for f in self._actions.fields}
        )
