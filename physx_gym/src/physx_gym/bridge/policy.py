"""A trained network as a policy: from observations to actions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from physx_core import NetworkConfig
from physx_core.errors import ConfigError, UsageError, listed
from physx_core.pipelines import load_learner
from physx_core.typing import Array
from physx_gym.spaces import SpaceFields


class Policy:
    """Acts as a trained network says.

    The network reads fields of the observation, named as `SpaceFields` names them with the prefix
    ``observation``, and predicts those of the action, ``action``; a network with one output and an
    action of one part need no names. A callable::

        policy = Policy("sessions/training", env)
        observation, reward, *_ = env.step(policy(observation))
        env.evaluate(policy.act)                 # where the environment is a `RobotEnv`
    """

    def __init__(
        self,
        session: str | Path,
        env: gymnasium.Env[Any, Any] | gymnasium.vector.VectorEnv[Any, Any, Any],
        *,
        network: NetworkConfig | None = None,
    ) -> None:
        """Load the network.

        Args:
            session: Folder of the session that trained it, or of its checkpoints.
            env: Environment whose spaces it acts in.
            network: Which checkpoint, and what else to change; None: the last one.

        Raises:
            CheckpointError: There is no checkpoint, or it is damaged.
            ConfigError: The network reads what is no part of the observation.
        """
        self._learner = load_learner(session, network)
        if isinstance(env, gymnasium.vector.VectorEnv):
            self._many = True
            observed, acted = env.single_observation_space, env.single_action_space
        else:
            self._many = False
            observed, acted = env.observation_space, env.action_space
        self._observations = SpaceFields(observed, "observation")
        self._actions = SpaceFields(acted, "action")
        known = [field.name for field in self._observations.fields]
        for name in self._learner.network.net_fields:
            if name not in known:
                raise ConfigError(
                    f'The network reads the field "{name}", which is no part of the observation: '
                    f"{listed(known)}."
                )

    def __call__(self, observation: Any) -> Any:
        """Return the action for an observation; for a vector environment, those of all."""
        arrays = self._observations.arrays(observation)
        if not self._many:
            arrays = {name: array[np.newaxis] for name, array in arrays.items()}
        predicted = self._learner.predict(arrays)
        if self._many:
            return self._actions.batch(action_arrays(self._actions, predicted))
        one = {name: values[0] for name, values in action_arrays(self._actions, predicted).items()}
        return self._actions.value(one)

    def act(self, observation: Any, *ignored: Any) -> Any:
        """Return the action for an observation; what else `evaluate` gives is not looked at."""
        return self(observation)


def action_arrays(actions: SpaceFields, prediction: Mapping[str, Any]) -> dict[str, Array]:
    """Return the actions that a network's predictions mean, by field.

    A box's numbers are cut at its bounds. For a choice among n the network gives n numbers, of
    which the largest wins, or one number, which is rounded; for `MultiBinary`, numbers that mean
    yes above 0.5.

    Args:
        actions: The action space.
        prediction: Output name to array of shape (samples, *shape).

    Returns:
        Arrays of shape (samples, *field shape).

    Raises:
        UsageError: The network gives nothing of that name, or another number of values.
    """
    found = {}
    for field, space in zip(actions.fields, actions.leaves, strict=True):
        if field.name in prediction:
            values = np.asarray(prediction[field.name])
        elif len(prediction) == len(actions.fields) == 1:
            values = np.asarray(next(iter(prediction.values())))
        else:
            raise UsageError(
                f'The network predicts {listed(prediction)}, but the action "{field.name}" is '
                "wanted: name it in pred_fields."
            )
        flat = values.reshape(len(values), -1)
        try:
            found[field.name] = _actions_of(space, flat).reshape(len(flat), *(field.shape or ()))
        except ValueError as error:
            raise UsageError(
                f'The network gives {flat.shape[1]} numbers for the action "{field.name}" of '
                f"{space}."
            ) from error
    return found


def _actions_of(space: Any, values: Array) -> Array:
    """Return the elements of a leaf that rows of numbers mean."""
    if isinstance(space, spaces.Discrete):
        count = int(space.n)
        if values.shape[1] == count > 1:
            return np.asarray(space.start + values.argmax(axis=1), space.dtype)
        chosen = np.clip(np.rint(values), space.start, space.start + count - 1)
        return chosen.astype(space.dtype)
    if isinstance(space, spaces.MultiDiscrete):
        counts = space.nvec.ravel()
        if values.shape[1] == counts.sum() != counts.size:
            parts = np.split(values, np.cumsum(counts)[:-1], axis=1)
            choices = np.stack([part.argmax(axis=1) for part in parts], axis=1)
        else:
            choices = np.clip(np.rint(values), 0, counts - 1)
        return np.asarray(choices + space.start.ravel(), space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return (values > 0.5).astype(space.dtype)
    low, high = space.low.ravel(), space.high.ravel()
    whole = np.rint(values) if space.dtype.kind in "iu" else values
    return np.clip(whole, low, high).astype(space.dtype)
