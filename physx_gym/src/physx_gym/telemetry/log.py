"""Logs: what was recorded of an episode, in memory and in an HDF5 file.

The file has one group for each type of numbers, ``float64`` and ``int64``, with the dataset
``values`` of shape (rows, columns) in one piece, and the datasets ``names`` and ``units`` of its
columns; the dataset ``constants`` is a JSON text. The first column is the time.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ComponentNotFoundError, LogError, nearest
from physx_core.files import replace
from physx_core.simulation import World
from physx_gym.tasks.trajectory import Trajectory
from physx_gym.telemetry.plain_description import to_plain, world_of

TIME = "time"
"""Column of the time since the episode's begin, in s."""
FORMAT = "physx log"
VERSION = 1
POSITIONS, VELOCITIES = "state.q", "state.v"
"""Variables of the world's positions and velocities."""

Column = NDArray[Any]


@dataclass(frozen=True)
class Log:
    """What was recorded of an episode.

    Attributes:
        constants: What was true of the whole episode: the world, its state's layout, options, seed,
            units of columns.
        variables: The columns by name, each of shape (rows,); ``"time"`` is the first.
        path: File that it is from, or that it goes to; None: none.
    """

    constants: Mapping[str, Any]
    variables: Mapping[str, Column]
    path: Path | None = None

    @property
    def time(self) -> NDArray[np.float64]:
        """Time since the episode's begin, shape (rows,), in s."""
        return self.column(TIME)

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the columns that have one."""
        units: Mapping[str, str] = self.constants.get("units", {})
        return units

    @property
    def label(self) -> str:
        """What the log is called beside others."""
        return self.path.stem if self.path else str(self.constants.get("environment", "episode"))

    def column(self, name: str) -> Column:
        """Return a column.

        Raises:
            LogError: There is none of that name.
        """
        if name not in self.variables:
            raise LogError(
                f'The log {self._where} has no column "{name}".{nearest(name, self.variables)} '
                f"It has {len(self.variables)}."
            )
        return self.variables[name]

    def trajectory(self, robot: str | None = None) -> Trajectory:
        """Return how a robot or object moved.

        Args:
            robot: Its name; None: everything in the world.

        Raises:
            ComponentNotFoundError: There is nothing of that name in the world.
            LogError: States were not recorded.
        """
        parts = self.constants.get("parts", {})
        if robot is not None and robot not in parts:
            raise ComponentNotFoundError("robot or object", robot, f"The log {self._where}", parts)
        kinds = zip((POSITIONS, VELOCITIES), ("positions", "velocities"), strict=True)
        positions, velocities = (
            self._states(variable, parts.get(robot, {}).get(kind)) for variable, kind in kinds
        )
        return Trajectory(self.time, positions, velocities)

    def _states(self, variable: str, place: Any) -> NDArray[np.float64]:
        """Return a state's columns, or those from one place to another."""
        names = [name for name in self.variables if name.startswith(f"{variable}.")]
        found = [self.variables[name] for name in names[slice(*(place or (None,)))]]
        if not found:
            raise LogError(
                f"The log {self._where} holds no states. They are recorded in evaluation mode: "
                "call eval() before reset."
            )
        return np.stack(found, axis=1)

    def world(self) -> World:
        """Return the world that was simulated, made of its description.

        Raises:
            LogError: The log holds none, or what it holds makes no sense.
        """
        return world_of(self.constants.get("world"), self._where)

    @property
    def _where(self) -> str:
        return str(self.path) if self.path else "of this episode"

    def write(self, path: str | Path) -> None:
        """Write the log to a file, which is there as a whole or not at all.

        Raises:
            LogError: It cannot be written, or the constants are no plain data.
        """
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace(path, self._content(), sync=False)
        except (OSError, TypeError, ValueError) as error:
            raise LogError(f"The log {path} cannot be written: {error}.") from error

    def _content(self) -> bytes:
        import h5py

        image = io.BytesIO()
        with h5py.File(image, "w") as file:
            file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
            constants = {key: each for key, each in self.constants.items() if key != "units"}
            text = json.dumps(to_plain(constants)).encode()
            file.create_dataset("constants", data=np.frombuffer(text, np.uint8))
            for dtype in ("float64", "int64"):
                names = [key for key, each in self.variables.items() if each.dtype == dtype]
                if not names:
                    continue
                group = file.create_group(dtype)
                values = np.stack([self.variables[name] for name in names], axis=1)
                group.create_dataset("values", data=values)
                group.create_dataset("names", data=_texts(names))
                group.create_dataset("units", data=_texts(self.units.get(n, "") for n in names))
        return image.getvalue()


def _texts(texts: Iterable[str]) -> NDArray[np.bytes_]:
    """Return texts as an array of fixed width, which HDF5 stores in one piece."""
    found = [text.encode() for text in texts]
    return np.array(found, f"S{max(1, *map(len, found), 1)}")
