"""Telemetry: registered arrays, recorded row by row."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError, EpisodeError
from physx_gym.telemetry.episode_log import TIME, Log
from physx_gym.telemetry.variables import WORD, Variable, words_of

_BLOCK = 1024  # rows that are allocated at once


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
        self.is_recording = False

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
            name: Name of the variable, which begins the names of its columns.
            value: An array of float64 or int64, or dictionaries and sequences of such, nested.
            fieldnames: Name of each number, nested likewise, with a sequence of strings for each
                array; None: the keys and indices that lead to it.
            namespace: Prefix of the name.
            is_eval_only: Whether it is left out in training.
            unit: Unit of all its numbers, or a sequence of units.
        """
        if self.is_recording:
            raise EpisodeError(
                f'The variable "{name}" cannot be registered while an episode runs: register it '
                "before reset, or call stop first."
            )
        variable = Variable.of(name, value, fieldnames, namespace, unit, is_eval_only)
        known = self._variables.get(variable.name)
        if known is not None and variable.name in self._new and not variable.is_same(known):
            raise ConfigError(
                f'A variable "{variable.name}" is registered already. Choose another name, or a '
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
                    f'The variable "{variable.name}" has a number "{name}", but that is the name '
                    f"of a number of {taken[name]}."
                )
            taken[name] = f'"{variable.name}" too'

    def unregister(self, name: str) -> None:
        """Remove a variable, if there is one of a name with namespace."""
        if self.is_recording:
            raise EpisodeError(f'The variable "{name}" cannot be removed while an episode runs.')
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
            training: Whether to record only what was registered with ``is_eval_only=False``; if
                there is none, nothing is recorded.
        """
        self.end()
        self._path, self._constants = path, dict(constants or {})
        chosen = [each for each in self._variables.values() if not (training and each.is_eval_only)]
        self._table, self._new = _Table(chosen), set()
        self.is_recording = bool(chosen)

    def record(self, time: float) -> None:
        """Record a row: copies of all variables as they are now.

        A second row of the same time replaces the first.

        Args:
            time: Time since the start of the episode, in s.
        """
        if self.is_recording:
            self._table.record(time)

    def rewind(self, time: float) -> None:
        """Discard the rows from a time, in s, on."""
        if self.is_recording:
            self._table.rewind(time)

    def end(self) -> None:
        """End the episode and write its file; nothing happens if none is being recorded."""
        if not self.is_recording:
            return
        self.is_recording, self._new = False, set()
        if self._path is not None and self.rows:
            self.log.write(self._path)

    def discard(self) -> None:
        """End the episode without a file; nothing happens if none is being recorded."""
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
        """Copy of what was recorded of the running episode, up to now, or of the last one."""
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

    def __init__(self, variables: Sequence[Variable]) -> None:
        """Gather the memory of the variables."""
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
        self._times: list[float] = []
        self._blocks: list[NDArray[np.int64]] = []
        self._last = np.empty(0, WORD)  # row of the last time
        self._free: Iterator[NDArray[np.int64]] = iter(())  # unused rows of the last block

    @property
    def rows(self) -> int:
        return len(self._times)

    def record(self, time: float) -> None:
        """Copy everything into the next row, or into the last one if that has the same time."""
        times = self._times
        if not times or times[-1] != time:
            row = next(self._free, None)
            if row is None:
                self._blocks.append(np.empty((_BLOCK, len(self._columns)), WORD))
                self._free = iter(self._blocks[-1])
                row = next(self._free)
            self._last = row
            times.append(time)
        np.concatenate(self._words, out=self._last)

    def rewind(self, time: float) -> None:
        """Discard the rows from a time on."""
        kept = bisect.bisect_left(self._times, time)
        del self._times[kept:], self._blocks[-(-kept // _BLOCK) :]
        self._free = iter(())
        if kept:
            begin = kept - (len(self._blocks) - 1) * _BLOCK
            self._last, self._free = self._blocks[-1][begin - 1], iter(self._blocks[-1][begin:])

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return copies of the columns by name, each of shape (rows,)."""
        values = np.empty((len(self._columns), self.rows), WORD)
        begin = 0
        for block in self._blocks:
            part = block[: self.rows - begin]
            values[:, begin : begin + len(part)] = part.T
            begin += len(part)
        pairs = zip(self._columns, values, strict=True)
        return {TIME: np.array(self._times, np.float64)} | {
            name: column.view(dtype) for (name, dtype), column in pairs
        }
