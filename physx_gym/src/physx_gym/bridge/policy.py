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
    """Chooses actions with a trained network.

    The network reads fields of the observation, named by `SpaceFields` with the prefix
    ``observation``, and predicts those of the action, with the prefix ``action``; if the network
    has one output and the action one part, the name does not matter. Policies are callable::

        policy = Policy("sessions/training", env)
        observation, reward, *_ = env.step(policy(observation))
        env.evaluate(policy.act)                 # if the environment is a `RobotEnv`
    """

    def __init__(
        self,
        session: str | Path,
        env: gymnasium.Env[Any, Any] | gymnasium.vector.VectorEnv[Any, Any, Any],
        *,
        network: NetworkConfig | None = None,
        trust: bool = False,
    ) -> None:
        """Load the network.

        Args:
            session: Folder of the session that trained it, or of its checkpoints.
            env: Environment whose spaces the policy is for.
            network: Which checkpoint to load, and other overrides; None: the last checkpoint.
            trust: Whether to import whatever the checkpoint names; see `load_learner`.

        Raises:
            CheckpointError: If there is no checkpoint, or it is damaged.
            ConfigError: If the network reads a field that the observation does not have.
        """
        self._learner = load_learner(session, network, trust=trust)
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
                    f'The network reads the field "{name}", which is not part of the observation: '
                    f"{listed(known)}."
                )

    def __call__(self, observation: Any) -> Any:
        """Return the action for an observation; for a vector environment, a batch of actions."""
        arrays = self._observations.arrays(observation)
        if self._many:
            predicted = self._learner.predict(arrays)
            return self._actions.batch(action_arrays(self._actions, predicted))
        batch = {name: array[np.newaxis] for name, array in arrays.items()}
        return single_action(self._actions, self._learner.predict(batch))

    def act(self, observation: Any, *ignored: Any) -> Any:
        """Return the action for an observation; further arguments of `evaluate` are ignored."""
        return self(observation)


def single_action(actions: SpaceFields, prediction: Mapping[str, Any]) -> Any:
    """Return the action given by a network's predictions for one sample."""
    arrays = action_arrays(actions, prediction)
    return actions.value({name: values[0] for name, values in arrays.items()})


def action_arrays(actions: SpaceFields, prediction: Mapping[str, Any]) -> dict[str, Array]:
    """Return the actions given by a network's predictions, by field.

    The values of a box are clipped to its bounds. For a choice among n, the network outputs n
    values, of which the largest wins, or one value, which is rounded; for `MultiBinary`, values
    above 0.5 count as 1.

    Args:
        actions: The action space.
        prediction: Output name to array of shape (samples, *shape).

    Returns:
        Arrays of shape (samples, *field shape).
    """
    found = {}
    for field, space in zip(actions.fields, actions.leaves, strict=True):
        if field.name in prediction:
            values = np.asarray(prediction[field.name])
        elif len(prediction) == len(actions.fields) == 1:
            values = np.asarray(next(iter(prediction.values())))
        else:
            raise UsageError(
                f'The network predicts {listed(prediction)}, but not the action "{field.name}": '
                "name it in pred_fields."
            )
        flat = values.reshape(len(values), -1)
        try:
            found[field.name] = _to_actions(space, flat).reshape(len(flat), *(field.shape or ()))
        except ValueError as error:
            raise UsageError(
                f'The network predicts {flat.shape[1]} values for the action "{field.name}" of '
                f"{space}."
            ) from error
    return found


def _to_actions(space: Any, values: Array) -> Array:
    """Return the elements of a leaf space given by rows of values."""
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
