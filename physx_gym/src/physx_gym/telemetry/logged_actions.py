"""The actions of a recorded episode, as a policy that makes the same episode again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from physx_core.typing import Array
from physx_gym.errors import LogError
from physx_gym.simulator.simulator import Simulator
from physx_gym.telemetry.episode_log import Log
from physx_gym.telemetry.log_file import read_log

_ACTION = "action"
_EXTENSION = ".h5"
_SPEC = "spec"
_WITHOUT = "render_mode"  # which no state depends on


class LoggedActions:
    """The actions of a log, in their order; what they lead to is compared with its states.

    Attributes:
        seed: Seed of the episode.
        compares: Whether states are compared, in all bits: until something is changed.
    """

    def __init__(self, path: str | Path, simulator: Simulator, space: gymnasium.Space[Any]) -> None:
        """Read a log.

        Args:
            path: A log.
            simulator: The simulator of the environment that recorded it, made again.
            space: Its actions.

        Raises:
            LogError: If it is no log, or lacks the seed, actions or states.
        """
        self._path, self._simulator = path, simulator
        log = _read(path)
        seed, step = log.constants.get("seed"), log.constants.get("step_dt")
        if not isinstance(seed, int) or not isinstance(step, float) or not step > 0:
            raise self._error("lacks the seed or the duration of a step")
        times = log.time / step
        rows = np.flatnonzero(np.abs(times - times.round()) < 1e-6)  # the others are within steps
        self._actions = self._read_actions(log, space)[rows]
        motion = log.trajectory()
        self._states = motion.positions[rows], motion.velocities[rows]
        self.seed, self.compares, self._row = seed, True, 0

    def _read_actions(self, log: Log, space: gymnasium.Space[Any]) -> Array:
        """Return the actions, shape (rows, ...)."""
        columns = [
            values
            for name, values in log.variables.items()
            if name == _ACTION or name.startswith(f"{_ACTION}.")
        ]
        if space.shape is None or space.dtype is None or len(columns) != np.prod(space.shape):
            raise self._error(f"has {len(columns)} columns of actions, which are not of {space}")
        return np.stack(columns, axis=1).astype(space.dtype).reshape(-1, *space.shape)

    def begin(self) -> None:
        """Begin again, at the first state.

        Raises:
            LogError: If the simulation is in another state.
        """
        self._row = 0
        self._compare()

    def __call__(self, observation: Any) -> Any:
        """Return the next action."""
        action = self._actions[self._row]
        self._row += 1
        return action[()]

    def is_over(self) -> bool:
        """Return whether that was the last action.

        Raises:
            LogError: If the simulation is in another state than the log.
        """
        self._compare()
        return self._row == len(self._actions) - 1

    def _compare(self) -> None:
        reached = self._simulator.positions, self._simulator.velocities
        for now, logged in zip(reached, self._states, strict=True):
            if self.compares and not np.array_equal(now, logged[self._row]):
                raise self._error(
                    f"has another state after {self._row} steps than this environment: was it "
                    "made with the same arguments, on the same engine"
                )

    def _error(self, what: str) -> LogError:
        return LogError(f"{self._path} {what}.")


def describe_spec(spec: EnvSpec | None) -> dict[str, Any] | None:
    """Return what ``gymnasium.make`` was given, for a log; None if that is not plain data."""
    if spec is None:
        return None
    given = {name: value for name, value in spec.kwargs.items() if name != _WITHOUT}
    try:
        json.dumps(given)
    except (TypeError, ValueError):
        return None
    return {"id": spec.id, "kwargs": given}


def logged_environment(path: str | Path) -> dict[str, Any]:
    """Return the ``id`` and the arguments of a log's environment.

    Raises:
        LogError: If it is no log, or names no registered environment, or code.
    """
    advice = (
        "Name the environment yourself, and branch off its session: physx generate gym/ID "
        f"--environment.env-kwargs policy={path} --episodes 1"
    )
    spec = _read(path).constants.get(_SPEC)
    if not isinstance(spec, dict) or not isinstance(spec.get("kwargs"), dict):
        raise LogError(
            f"{path} does not say how its environment was made: only gymnasium.make leaves that in "
            f"a log, if all arguments are plain data. {advice}"
        )
    id, given = str(spec.get("id")), spec["kwargs"]
    if id not in gymnasium.registry:
        raise LogError(f'{path} is of the environment "{id}", which is not registered. {advice}')
    if ":" in json.dumps(given, separators=(",", "=")):  # a text in it, as in "module:Class"
        raise LogError(
            f"{path} has arguments of {id} that may name code, which is not imported. {advice}"
        )
    return {**given, "id": id}


def _read(path: str | Path) -> Log:
    if Path(path).suffix != _EXTENSION:
        raise LogError(
            f"{path} is no log of physx ({_EXTENSION}): it lacks the seed, the actions and the "
            "states of a simulation, without which none can be simulated again. Environments "
            'record them in evaluation mode: env.reset(options={"log_path": FILE}). For logs of '
            "real robots, there is physx identify."
        )
    return read_log(path)
