"""Logs of episodes, in memory and in HDF5 files.

A file has one group for each type of numbers, ``float64`` and ``int64``, with the contiguous
dataset ``values`` of shape (rows, columns), and the datasets ``names`` and ``units`` of its
columns; the dataset ``constants`` is a JSON text. The first column is the time. The dataset
``contacts``, which may be missing, has the columns time, point (3) and force (3).
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

from physx_core.errors import ComponentNotFoundError, nearest
from physx_core.files import replace
from physx_gym.errors import LogError
from physx_gym.tasks.trajectory import Trajectory
from physx_gym.telemetry.plain_description import to_plain, world_of
from physx_sim import World

TIME = "time"
"""Column of the time since the start of the episode, in s."""
FORMAT = "physx log"
VERSION = 1
POSITIONS, VELOCITIES = "state.q", "state.v"
"""Names of the variables of the world's positions and velocities."""

Column = NDArray[Any]


@dataclass(frozen=True)
class Log:
    """The record of an episode.

    Attributes:
        constants: Description of the episode: the world, the layout of its state, options, seed,
            units of columns, what was drawn, contacts.
        variables: The columns by name, each of shape (rows,); ``"time"`` is the first.
        path: The file of the log; None if there is none.
    """

    constants: Mapping[str, Any]
    variables: Mapping[str, Column]
    path: Path | None = None

    @property
    def time(self) -> NDArray[np.float64]:
        """Time since the start of the episode, shape (rows,), in s."""
        return self.column(TIME)

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the columns that have one."""
        units: Mapping[str, str] = self.constants.get("units", {})
        return units

    @property
    def contacts(self) -> NDArray[np.float64]:
        """Contacts after each step, shape (contacts, 7).

        Each row has the time in s, the point in m, and the force in N, in the world frame.
        """
        return np.asarray(self.constants.get("contacts", np.zeros((0, 7))), np.float64)

    @property
    def label(self) -> str:
        """Name of the log in comparisons."""
        return self.path.stem if self.path else str(self.constants.get("environment", "episode"))

    def column(self, name: str) -> Column:
        """Return a column.

        Raises:
            LogError: If there is no column of that name.
        """
        if name not in self.variables:
            raise LogError(
                f'The log {self._where} has no column "{name}".{nearest(name, self.variables)} '
                f"It has {len(self.variables)} columns."
            )
        return self.variables[name]

    def trajectory(self, robot: str | None = None) -> Trajectory:
        """Return the motion of a robot or object.

        Args:
            robot: Its name; None: everything in the world.

        Raises:
            ComponentNotFoundError: If there is nothing of that name in the world.
            LogError: If states were not recorded.
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
        """Return the columns of a state, or those within a range."""
        names = [name for name in self.variables if name.startswith(f"{variable}.")]
        found = [self.variables[name] for name in names[slice(*(place or (None,)))]]
        if not found:
            raise LogError(
                f"The log {self._where} contains no states. They are recorded in evaluation mode: "
                "call eval() before reset."
            )
        return np.stack(found, axis=1)

    def world(self) -> World:
        """Return the simulated world, rebuilt from its description.

        Files of robots and meshes are loaded from their paths, or else from the log's folder.

        Raises:
            LogError: If the log does not contain a valid world.
        """
        folder = self.path.absolute().parent if self.path else None
        return world_of(self.constants.get("world"), self._where, folder)

    @property
    def _where(self) -> str:
        return str(self.path) if self.path else "of this episode"

    def write(self, path: str | Path) -> None:
        """Write the log to a file atomically.

        Raises:
            LogError: If it cannot be written, or the constants are not plain data.
        """
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace(path, self._content(), wait=False)
        except (OSError, TypeError, ValueError) as error:
            raise LogError(f"The log {path} cannot be written: {error}.") from error

    def _content(self) -> bytes:
        import h5py

        image = io.BytesIO()
        with h5py.File(image, "w") as file:
            file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
            apart = ("units", "contacts")
            constants = {key: each for key, each in self.constants.items() if key not in apart}
            text = json.dumps(to_plain(constants)).encode()
            file.create_dataset("constants", data=np.frombuffer(text, np.uint8))
            if len(self.contacts):
                file.create_dataset("contacts", data=self.contacts)
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
    """Return strings as a fixed-width array, which HDF5 stores contiguously."""
    found = [text.encode() for text in texts]
    return np.array(found, f"S{max(1, *map(len, found), 1)}")
