"""SampleEnv: an environment of physx as a gymnasium environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_core.components import Event
from physx_core.errors import ActionError, ConfigError, EpisodeError, UsageError, listed, nearest
from physx_core.fields import is_finite
from physx_core.rows import RowBuffer, copy_row, infer_shapes
from physx_core.typing import Array, Sample
from physx_core.workers import Instance

REWARD, TERMINATED, TRUNCATED = "reward", "terminated", "truncated"
"""Fields that are no part of the observation but stand for themselves, where there are any."""

_LARGEST_SEED = 1 << 63


class SampleEnv(gymnasium.Env[Any, Any]):
    """An environment of physx, driven from outside in the place of a network.

    The observation is the sample's training fields by name. The action is what a network would
    predict, in physical units: it is given to `apply_prediction` before the step, and
    `get_prediction` within the step answers with it. Which fields a network predicts is not for an
    environment to say, so the user names them; without any the environment runs by itself.

    The reward is the field ``reward``, or 0. An episode ends with the fields ``terminated`` and
    ``truncated``, and is also truncated when the environment calls `new_episode` in the step.
    `reset` makes the environment anew, with its seed, and makes one step without an action, in
    which `get_prediction` answers with zeros.
    Additional fields, and the numbers of the step and of the trajectory, are in `info`.
    """

    def __init__(
        self,
        environment: Any,
        *,
        action_fields: Sequence[str] = (),
        instance_id: int = 1,
        instance_nb: int = 1,
        **env_kwargs: Any,
    ) -> None:
        """Make the environment once, to learn its fields.

        Args:
            environment: The environment's class or reference.
            action_fields: Names of the training fields whose predictions are the action.
            instance_id: Number of the instance, counted from 1.
            instance_nb: How many instances run together.
            env_kwargs: Further arguments of the environment.

        Raises:
            ConfigError: An action field is no training field, or a field is complex.
            PhysxError: The environment cannot be made.
        """
        self._reference, self._arguments = environment, env_kwargs
        self._instance_id, self._instance_nb = instance_id, instance_nb
        if isinstance(action_fields, str):
            action_fields = (action_fields,)
        self._action_fields = tuple(action_fields)
        self._prediction: Sample = {}
        self._parameters: dict[str, Any] = {}
        self._instance: Instance | None = None
        self._columns = RowBuffer(self._learn_fields(), 1)
        fields = {field.name: field for field in self._columns.fields if field.role == "training"}
        self._observed = [n for n in fields if n not in (REWARD, TERMINATED, TRUNCATED)]
        self.observation_space = spaces.Dict({n: _space(fields[n]) for n in self._observed})
        self._actions = {n: _space(fields[n]) for n in action_fields}
        self.action_space = spaces.Dict(self._actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Make the environment anew and return its first sample.

        Args:
            seed: Seed of the environment; None: the next of a stream of seeds.
            options: Nothing is understood.

        Raises:
            UsageError: There are options.
            PhysxError: The environment raised.
        """
        super().reset(seed=seed)
        if options:
            raise UsageError(f"An environment of physx takes no options at reset: {list(options)}.")
        self._open(int(self.np_random.integers(_LARGEST_SEED)) if seed is None else seed)
        observation, _, _, _, info = self._advance()
        return observation, info

    def step(
        self, action: dict[str, Array]
    ) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Apply a prediction and make one step.

        Args:
            action: Field name to value, in the field's physical unit.

        Raises:
            EpisodeError: `reset` was not called.
            ActionError: The action has other fields, or a value is not what its field is.
            PhysxError: The environment raised.
        """
        if self._instance is None:
            raise EpisodeError("reset() comes before step().")
        if action.keys() != self._actions.keys():
            raise ActionError(
                f"An action has the fields {listed(self._actions)}, and this one: {listed(action)}."
            )
        self._prediction = {
            name: _array(name, space, action[name]) for name, space in self._actions.items()
        }
        if self._prediction:
            self._instance.apply(self._prediction)
        return self._advance()

    def close(self) -> None:
        """Close the environment; calling it again does nothing."""
        instance, self._instance = self._instance, None
        if instance is not None:
            instance.close()

    # What the environment may ask: `Services` ---------------------------------------------------

    def predict(self, fields: Sample) -> Sample:
        """Return the action of this step in the place of a network's prediction.

        Raises:
            UsageError: There is no action.
        """
        if not self._action_fields:
            raise UsageError(
                "get_prediction() is answered with the action, and there is none: name the fields "
                "that a network would predict in action_fields."
            )
        return {name: value.copy() for name, value in self._prediction.items()}

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Keep values of the environment as long as this object lives."""
        self._parameters.update(values)

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that the environment kept."""
        return dict(self._parameters)

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Draw nothing."""

    # ----------------------------------------------------------------------------------------

    def _open(self, seed: int) -> Instance:
        self.close()
        instance = Instance(
            self._reference,
            self._arguments,
            instance_id=self._instance_id,
            instance_nb=self._instance_nb,
            seed=[seed],
        )
        try:
            instance.open(self, draw=False)
            self._prediction = self._zeros(instance.fields)
        except BaseException:
            instance.close()
            raise
        self._instance = instance
        return instance

    def _zeros(self, given: Sequence[Field]) -> Sample:
        """Return an action of zeros.

        Raises:
            ConfigError: An action field is no training field.
        """
        fields = {field.name: field for field in given if field.role == "training"}
        for name in self._action_fields:
            if name not in fields:
                raise ConfigError(
                    f'The action field "{name}" is no training field.{nearest(name, fields)} '
                    f"Training fields: {listed(fields)}."
                )
        return {n: np.zeros(fields[n].shape or (), fields[n].dtype) for n in self._action_fields}

    def _learn_fields(self) -> list[Field]:
        """Return the fields with their shapes; where one is open, a first sample tells it."""
        instance = self._open(0)
        try:
            if all(field.shape is not None for field in instance.fields):
                return instance.fields
            return infer_shapes(instance.fields, instance.step())
        finally:
            self.close()

    def _advance(self) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        instance = self._instance
        if instance is None or instance.environment is None:
            raise UsageError("The environment is closed.")
        episode = instance.environment.episode_index
        sample = instance.step()
        self._columns.put(
            0, sample, instance.instance_id, instance.last_episode, instance.last_step
        )
        row = copy_row(self._columns.rows(1), 0)
        observation = {name: row.pop(name) for name in self._observed}
        reward = float(row.pop(REWARD, 0.0))
        terminated = bool(row.pop(TERMINATED, False))
        jumped = instance.environment.episode_index != episode
        return observation, reward, terminated, bool(row.pop(TRUNCATED, False)) or jumped, row


def _array(name: str, space: spaces.Space[Any], value: Any) -> Array:
    """Return the value of an action's field as an array of its own."""
    shape = space.shape or ()
    try:
        array = np.array(value, space.dtype)
    except (TypeError, ValueError) as error:
        raise ActionError(f'The field "{name}" is no array: {error}.', name) from error
    if array.shape != shape:
        raise ActionError(f'The field "{name}" has shape {array.shape}, not {shape}.', name)
    if not is_finite(array):
        raise ActionError(f'The field "{name}" holds NaN or an infinite number.', name)
    return array


def _space(field: Field) -> spaces.Space[Any]:
    """Return the space of a field's values; a boolean one has numbers 0 and 1."""
    dtype, shape = np.dtype(field.dtype), field.shape or ()
    if dtype.kind == "c":
        raise ConfigError(
            f'Field "{field.name}" is complex, which no space of gymnasium can be. Define its '
            "real and imaginary parts."
        )
    if dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, shape, dtype.type)
    if dtype.kind == "b":
        return spaces.Box(0, 1, shape, np.bool_)
    info = np.iinfo(dtype)
    return spaces.Box(info.min, info.max, shape, dtype.type)
