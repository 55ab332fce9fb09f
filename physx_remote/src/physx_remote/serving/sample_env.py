"""SampleEnv: a physx environment as a Gymnasium environment."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_core.components import Event
from physx_core.errors import (
    ActionError,
    ConfigError,
    EpisodeError,
    SampleError,
    StateError,
    UsageError,
    listed,
    nearest,
)
from physx_core.fields import is_finite
from physx_core.rows import RowBuffer, copy_row, infer_shapes
from physx_core.typing import Array, Sample
from physx_core.workers import Instance

REWARD, TERMINATED, TRUNCATED = "reward", "terminated", "truncated"
"""Fields with their own meaning, which are not part of the observation."""

_LARGEST_SEED = 1 << 63


class SampleEnv(gymnasium.Env[Any, Any]):
    """A physx environment, driven by actions in place of a network's predictions.

    The observation consists of the sample's training fields by name. The action is what a network
    would predict, in physical units: it is passed to `apply_prediction` before the step, and
    returned by `get_prediction` within the step. An environment does not know which fields a
    network predicts, so the user names them; otherwise, the environment takes no action.

    The reward is the field ``reward``, or 0. An episode ends with the fields ``terminated`` and
    ``truncated``, and is also truncated if the environment calls `new_episode` in the step.
    `reset` recreates the environment with its seed and makes one step without an action, in which
    `get_prediction` returns zeros. Additional fields, and the numbers of the step and of the
    trajectory, are in `info`.
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
        """Create the environment once to determine its fields.

        Args:
            environment: The environment's class or reference.
            action_fields: Names of the training fields whose predictions are the action.
            instance_id: Number of the instance, from 1.
            instance_nb: Number of instances that run together.
            env_kwargs: Further arguments of the environment.

        Raises:
            ConfigError: If an action field is not a training field, or a field is complex.
            PhysxError: If the environment cannot be created.
        """
        self._reference, self._arguments = environment, env_kwargs
        self._instance_id, self._instance_nb = instance_id, instance_nb
        if isinstance(action_fields, str):
            action_fields = (action_fields,)
        self._action_fields = tuple(action_fields)
        self._prediction: Sample = {}
        self._parameters: dict[str, Any] = {}
        self._instance: Instance | None = None
        self._untracked: StateError | None = None
        self._seed = 0
        self._row = RowBuffer(self._find_fields(), 1)
        fields = {field.name: field for field in self._row.fields if field.role == "training"}
        self._observed = [n for n in fields if n not in (REWARD, TERMINATED, TRUNCATED)]
        self.observation_space = spaces.Dict({n: _space(fields[n]) for n in self._observed})
        self._actions = {n: fields[n] for n in action_fields}
        self.action_space = spaces.Dict({n: _space(f) for n, f in self._actions.items()})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Recreate the environment and return its first sample.

        Args:
            seed: Seed of the environment; None: the next one of a sequence of seeds.
            options: Must be empty.

        Raises:
            UsageError: If there are options.
            PhysxError: If the environment raises.
        """
        super().reset(seed=seed)
        if options:
            raise UsageError(f"A physx environment takes no reset options: {list(options)}.")
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
            EpisodeError: If `reset` was not called.
            ActionError: If the action has other fields, or a value does not fit its field.
            PhysxError: If the environment raises.
        """
        if self._instance is None:
            raise EpisodeError("Call reset() before step().")
        if action.keys() != self._actions.keys():
            raise ActionError(
                f"An action has the fields {listed(self._actions)}, not {listed(action)}."
            )
        self._prediction = {
            name: _to_array(field, action[name]) for name, field in self._actions.items()
        }
        if self._prediction:
            self._instance.apply(self._prediction)
        return self._advance()

    def snapshot(self) -> dict[str, Any]:
        """Return everything that `restore` needs to go on exactly from here.

        Raises:
            EpisodeError: If `reset` was not called.
            StateError: If a part of the environment cannot be captured; it is named.
        """
        if self._instance is None:
            raise EpisodeError("Call reset() before snapshot().")
        if self._untracked is not None:
            raise self._untracked
        return {
            "instance": self._instance.get_state(),
            "seed": self._seed,
            "prediction": {name: value.copy() for name, value in self._prediction.items()},
            "parameters": dict(self._parameters),
            "random": copy.deepcopy(self.np_random.bit_generator.state),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a snapshot, also of another environment with the same arguments."""
        self._open(state["seed"]).set_state(state["instance"])
        self._prediction, self._parameters = dict(state["prediction"]), dict(state["parameters"])
        self.np_random.bit_generator.state = state["random"]

    def close(self) -> None:
        """Close the environment; calling it again does nothing."""
        instance, self._instance = self._instance, None
        if instance is not None:
            instance.close()

    # `Services` of the environment --------------------------------------------------------------

    def predict(self, fields: Sample) -> Sample:
        """Return the action of this step in place of a network's prediction.

        Raises:
            UsageError: If there are no action fields.
        """
        if not self._action_fields:
            raise UsageError(
                "get_prediction() returns the action, but there is none: list the fields that a "
                "network would predict in action_fields."
            )
        return {name: value.copy() for name, value in self._prediction.items()}

    def touch(self, instance_id: int) -> Sequence[float]:
        """Do nothing."""
        return ()

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Store values of the environment for the lifetime of this object."""
        self._parameters.update(values)

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that the environment saved."""
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
            self._track(instance)
            self._prediction = self._zeros(instance.fields)
        except BaseException:
            instance.close()
            raise
        self._instance, self._seed = instance, seed
        return instance

    def _track(self, instance: Instance) -> None:
        """Prepare snapshots; if there can be none, remember why."""
        self._untracked = None
        try:
            instance.track_states()
        except StateError as error:
            self._untracked = error

    def _zeros(self, given: Sequence[Field]) -> Sample:
        """Return an action of zeros."""
        fields = {field.name: field for field in given if field.role == "training"}
        for name in self._action_fields:
            if name not in fields:
                raise ConfigError(
                    f'The action field "{name}" is not a training field.{nearest(name, fields)} '
                    f"Training fields: {listed(fields)}."
                )
        return {n: np.zeros(fields[n].shape or (), fields[n].dtype) for n in self._action_fields}

    def _find_fields(self) -> list[Field]:
        """Return the fields with their shapes; undeclared shapes are taken from a first sample."""
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
        self._row.clear()
        self._row.put(sample, instance.instance_id, instance.last_episode, instance.last_step)
        row = copy_row(self._row.take(), 0)
        observation = {name: row.pop(name) for name in self._observed}
        reward = float(row.pop(REWARD, 0.0))
        terminated = bool(row.pop(TERMINATED, False))
        jumped = instance.has_ended or instance.environment.episode_index != episode
        return observation, reward, terminated, bool(row.pop(TRUNCATED, False)) or jumped, row


def _to_array(field: Field, value: Any) -> Array:
    """Return the value of an action's field as a new array."""
    try:
        array = field.convert(value)
    except SampleError as error:
        raise ActionError(str(error), field.name) from error
    if not is_finite(array):
        raise ActionError(str(field.not_finite()), field.name)
    return array.copy()


def _space(field: Field) -> spaces.Space[Any]:
    """Return the space of a field's values; booleans are 0 and 1."""
    dtype, shape = np.dtype(field.dtype), field.shape or ()
    if dtype.kind == "c":
        raise ConfigError(
            f'Field "{field.name}" is complex, but Gymnasium has no space for complex numbers. '
            "Define its real and imaginary parts."
        )
    if dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, shape, dtype.type)
    if dtype.kind == "b":
        return spaces.Box(0, 1, shape, np.bool_)
    info = np.iinfo(dtype)
    return spaces.Box(info.min, info.max, shape, dtype.type)
