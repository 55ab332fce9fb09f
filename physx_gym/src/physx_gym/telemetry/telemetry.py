"""Telemetry: registered arrays, recorded row by row."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError, EpisodeError
from physx_gym.telemetry.episode_log import TIME, Log
from physx_gym.telemetry.variables import WORD, Variable, words_of

MOST_IN_TRAINING = 100_000
"""Number of latest rows of an episode that are kept in training."""


class Telemetry:
    """Records registered arrays: each `record` copies all of them into one row.

    Variables are read by reference: update them in place. The rows of the last episode are kept
    until the next one begins.
    """

    def __init__(self) -> None:
        self._variables: dict[str, Variable] = {}
        self._fieldnames: dict[str, Any] = {}
        self._new: set[str] = set()
        self._constants: Mapping[str, Any] = {}
        self._path: Path | None = None
        self._table = _Table(())
        self.is_recording = self._is_training = False

    def __getstate__(self) -> dict[str, Any]:
        """Return the registered variables, without what was recorded."""
        return {"variables": self._variables}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the registered variables."""
        Telemetry.__init__(self)
        for name, variable in state["variables"].items():
            self._variables[name], self._fieldnames[name] = variable, variable.fieldnames

    @property
    def fieldnames(self) -> Mapping[str, Any]:
        """Names of the columns of each variable, nested like it; always up to date."""
        return MappingProxyType(self._fieldnames)

    def register(
        self,
        name: str,
        value: Any,
        fieldnames: Any = None,
        namespace: str | None = None,
        *,
        is_eval_only: bool = True,
        unit: str | Sequence[str] = "",
    ) -> None:
        """Record a variable from the next `begin` on.

        Registering the same arrays again does nothing; registering others under a name that was
        registered before the last episode replaces that variable.

        Args:
            name: Name of the variable, with which the names of its columns begin.
            value: An array of float64 or int64, or nested dictionaries and sequences of those.
            fieldnames: Name of each number, nested likewise, with a sequence of strings for each
                array; None: the keys and indices that lead to it.
            namespace: Prefix of the name.
            is_eval_only: Whether to record it in evaluation only.
            unit: Unit of all its numbers, or a sequence of units.

        Raises:
            EpisodeError: If an episode is being recorded in evaluation.
            ConfigError: If the value, its names or its units are invalid, or a name is already
                used.
        """
        if self.is_recording and not self._is_training:
            raise EpisodeError(
                f'The variable "{name}" cannot be registered during an episode: register it '
                "before reset, or call stop first."
            )
        variable = Variable.of(name, value, fieldnames, namespace, unit, is_eval_only)
        known = self._variables.get(variable.name)
        if known is not None and variable.name in self._new and not variable.is_same(known):
            raise ConfigError(
                f'A variable "{variable.name}" is already registered. Choose another name, or a '
                "namespace."
            )
        self._check_columns(variable)
        self._new.add(variable.name)
        self._variables[variable.name] = variable
        self._fieldnames[variable.name] = variable.fieldnames

    def _check_columns(self, variable: Variable) -> None:
        taken = {TIME: "the time"}
        for other in self._variables.values():
            if other.name != variable.name:
                taken |= {name: f'"{other.name}"' for names in other.columns for name in names}
        for name in (name for names in variable.columns for name in names):
            if name in taken:
                raise ConfigError(
                    f'The variable "{variable.name}" has a number "{name}", but that name is '
                    f"already used by {taken[name]}."
                )
            taken[name] = f'"{variable.name}" itself'

    def renew(self) -> None:
        """Allow new arrays to replace the variables registered so far, as after an episode."""
        self._new = set()

    def unregister(self, name: str) -> None:
        """Remove the variable of a name with namespace, if there is one.

        Raises:
            EpisodeError: If an episode is being recorded.
        """
        if self.is_recording:
            raise EpisodeError(f'The variable "{name}" cannot be removed during an episode.')
        self._variables.pop(name, None)
        self._fieldnames.pop(name, None)
        self._new.discard(name)

    # Recording ------------------------------------------------------------------------------

    def begin(
        self,
        path: Path | None = None,
        constants: Mapping[str, Any] | None = None,
        *,
        training: bool = False,
    ) -> None:
        """Start an episode; the rows of the last one are discarded.

        Args:
            path: File to write at the end; None: none.
            constants: Description of the episode: plain data.
            training: Whether to record only what was registered with ``is_eval_only=False``, and
                to keep no more than the latest `MOST_IN_TRAINING` rows; if there is no such
                variable, nothing is recorded.
        """
        self.end()
        self._path, self._constants = path, dict(constants or {})
        chosen = [each for each in self._variables.values() if not (training and each.is_eval_only)]
        most = MOST_IN_TRAINING if training else None
        self._new, self._is_training = set(), training
        if not self._table.restart(chosen, most):
            self._table = _Table(chosen, most)
        self.is_recording = bool(chosen)

    def describe(self, constants: Mapping[str, Any]) -> None:
        """Add to the description of the running episode: plain data."""
        self._constants = {**self._constants, **constants}

    def record(self, time: float) -> None:
        """Record a row: copies of all variables as they are now.

        A second row with the same time replaces the first.

        Args:
            time: Time since the start of the episode, in s.
        """
        if self.is_recording:
            self._table.record(time)

    def rewind(self, time: float) -> None:
        """Discard the rows from a time, in s, onward."""
        if self.is_recording:
            self._table.rewind(time)

    def end(self) -> None:
        """End the episode and write its file; do nothing if none is being recorded."""
        if not self.is_recording:
            return
        self.is_recording, self._new = False, set()
        if self._path is not None and self.rows:
            self.log.write(self._path)

    def discard(self) -> None:
        """End the episode without a file; do nothing if none is being recorded."""
        if self.is_recording:
            self._path = None
            self.end()

    @property
    def rows(self) -> int:
        """Number of rows of the running episode, or of the last one."""
        return self._table.rows

    @property
    def path(self) -> Path | None:
        """File of the running episode, or of the last one."""
        return self._path

    @property
    def log(self) -> Log:
        """Copy of the recording of the running episode so far, or of the last one."""
        constants = {**self._constants, "units": self._table.units}
        return Log(constants, self._table.columns(), self._path)

    @property
    def log_data(self) -> dict[str, Any]:
        """The `log` as ``{"constants": ..., "variables": ...}``; empty without rows."""
        if not self.rows:
            return {}
        log = self.log
        return {"constants": dict(log.constants), "variables": dict(log.variables)}


class _Table:
    """Rows of numbers, copied as words of 8 bytes."""

    def __init__(self, variables: Sequence[Variable], most: int | None = None) -> None:
        """Gather the memory of the variables.

        Args:
            variables: The variables.
            most: Number of latest rows to keep; None: all.
        """
        self._variables = variables
        self.units = {TIME: "s"}
        self._columns: list[tuple[str, np.dtype[Any]]] = []
        for variable in variables:
            pairs = zip(variable.arrays, variable.columns, strict=True)
            own = [(name, array.dtype) for array, names in pairs for name in names]
            known = zip(own, variable.units, strict=True)
            self.units |= {name: unit for (name, _), unit in known if unit}
            self._columns += own
        arrays = [array for variable in variables for array in variable.arrays]
        self._words = words_of(arrays) or [np.empty(0, WORD)]
        self._only = self._words[0] if len(self._words) == 1 else None
        self._times: deque[float] = deque(maxlen=most)
        self._rows: deque[bytes] = deque(maxlen=most)

    @property
    def rows(self) -> int:
        return len(self._times)

    def restart(self, variables: Sequence[Variable], most: int | None) -> bool:
        """Discard all rows if the variables are the same; return whether they are."""
        known = self._variables
        is_same = len(known) == len(variables) and most == self._times.maxlen
        if not is_same or any(a is not b for a, b in zip(known, variables, strict=True)):
            return False
        self._times.clear()
        self._rows.clear()
        return True

    def record(self, time: float) -> None:
        """Copy everything into the next row, or into the last one if that has the same time."""
        words = np.concatenate(self._words) if self._only is None else self._only
        times = self._times
        if times and times[-1] == time:
            self._rows[-1] = words.tobytes()
        else:
            times.append(time)
            self._rows.append(words.tobytes())

    def rewind(self, time: float) -> None:
        """Discard the rows from a time onward."""
        while self._times and self._times[-1] >= time:
            self._times.pop()
            self._rows.pop()

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return copies of the columns by name, each of shape (rows,)."""
        words = np.frombuffer(b"".join(self._rows), WORD)
        values = words.reshape(self.rows, len(self._columns)).T.copy()
        pairs = zip(self._columns, values, strict=True)
        return {TIME: np.array(self._times, np.float64)} | {
            name: column.view(dtype) for (name, dtype), column in pairs
        }
