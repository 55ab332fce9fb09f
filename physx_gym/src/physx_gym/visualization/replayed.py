"""Drawings of a replay besides the world: the environment's own, contacts, paths, and plots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from physx_core.components import Factory
from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.errors import LogError
from physx_gym.telemetry.episode_log import Log
from physx_gym.visualization.plotting import Groups, label_of
from physx_sim import Layout

_LONG = 0.5  # length of a strong force's arrow, as a fraction of the size of what moves
_THIN = 0.006  # radius of an arrow, likewise
_STRONG = 95  # percentile of the forces whose arrow has that length
_SHORT = 0.2  # m, the smallest size of what moves


def row_at(times: Vector, time: float) -> int:
    """Return the last row up to a time; the first if there is none."""
    return max(int(np.searchsorted(times, time + 1e-9, "right")) - 1, 0)


class Scene:
    """Draws what `RobotEnv._draw` drew in the episode, and its changes."""

    def __init__(self, factory: Factory, log: Log) -> None:
        scene = log.constants.get("scene")
        scene = scene if isinstance(scene, Mapping) else {}
        self._factory, self._label = factory, log.label
        self._added, self._changes = scene.get("added", ()), list(scene.get("changes", ()))
        self._kinds: dict[str, str] = {}
        self._begin = float(log.time[0])

    def draw(self, time: float) -> None:
        """Draw its state at a time after the start, in s."""
        try:
            for each in self._added:
                self._kinds[each["name"]] = each["kind"]
                self._call("add", each["name"], each["values"])
            self._added = ()
            while self._changes and self._changes[0][0] - self._begin <= time + 1e-9:
                _, name, changes = self._changes.pop(0)
                self._call("update", name, changes)
        except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise LogError(
                f'What was drawn in the log "{self._label}" cannot be drawn again: {error}'
            ) from error

    def _call(self, action: str, name: str, values: Mapping[str, Any]) -> None:
        getattr(self._factory, f"{action}_{self._kinds[name]}")(name, **values)


class Moved:
    """Where static objects were, and which objects were hidden, in the episode."""

    def __init__(self, log: Log, layout: Layout) -> None:
        """Read it from a log.

        Args:
            log: The log.
            layout: Names of everything in its world.
        """
        scene = log.constants.get("scene")
        rows = scene.get("moved", ()) if isinstance(scene, Mapping) else ()
        places = {name: place for place, name in enumerate(layout.names)}
        self.hidden: set[str] = set()
        self._begin, self._poses = float(log.time[0]), dict[int, Vector]()
        try:
            self._changes = [
                (float(time), places[name], str(name), np.array(pose, np.float64), bool(hidden))
                for time, name, pose, hidden in rows
            ]
            if any(len(pose) not in (0, 7) for *_, pose, _ in self._changes):
                raise ValueError("a pose has not 7 numbers")
        except (KeyError, TypeError, ValueError) as error:
            raise LogError(
                f'The moved objects of the log "{log.label}" cannot be read: {error}'
            ) from error

    def move(self, poses: Vector, time: float) -> None:
        """Replace the poses of static objects, and update `hidden`.

        Args:
            poses: Of everything in `Layout.names`, shape (names, 7).
            time: Since the start, in s; not before that of the last call.
        """
        while self._changes and self._changes[0][0] - self._begin <= time + 1e-9:
            _, place, name, pose, hidden = self._changes.pop(0)
            (self.hidden.add if hidden else self.hidden.discard)(name)
            if len(pose):
                self._poses[place] = pose
        for place, pose in self._poses.items():
            poses[place] = pose


class Contacts:
    """Draws the forces at contacts as arrows."""

    def __init__(self, factory: Factory, log: Log, size: float) -> None:
        """Choose the scale.

        Args:
            factory: Factory to draw with.
            log: The log.
            size: Size of what moves, in m.
        """
        self._factory = factory
        contacts = log.contacts[np.isfinite(log.contacts).all(axis=1)]
        self._points, forces = contacts[:, 1:4], contacts[:, 4:7]
        strong = np.percentile(np.linalg.norm(forces, axis=1), _STRONG) if len(forces) else 0.0
        self._arrows = forces * (_LONG * max(size, _SHORT) / max(float(strong), 1e-9))
        self._times, self._begins = np.unique(contacts[:, 0], return_index=True)
        self._ends = np.append(self._begins[1:], len(contacts))
        self._rows = log.time
        self._width = _THIN * max(size, _SHORT)
        self._is_drawn = False

    def draw(self, time: float) -> None:
        """Draw the contacts of the last step up to a time after the start, in s."""
        moment = float(self._rows[0]) + time
        place = int(np.searchsorted(self._times, moment + 1e-9, "right")) - 1
        found = slice(0, 0)
        if place >= 0 and self._times[place] >= self._rows[row_at(self._rows, moment)] - 0.05:
            found = slice(self._begins[place], self._ends[place])
        shown = {"positions": self._points[found], "vectors": self._arrows[found]}
        if self._is_drawn:
            self._factory.update_arrows("contacts", **shown)
        else:
            self._factory.add_arrows("contacts", color="red", size=self._width, **shown)
        self._is_drawn = True


class Line:
    """Draws the path of a body."""

    def __init__(self, factory: Factory, body: str, points: Vector) -> None:
        self._factory, self._body, self._points = factory, body, points
        self._is_drawn = False

    def draw(self, time: float) -> None:
        """Draw the whole path."""
        if not self._is_drawn:
            self._factory.add_lines(f"path of {self._body}", self._points, color="gold")
        self._is_drawn = True


def _short(group: str, robot: str) -> str:
    """Return the title of a group: the informative parts of its name, as tabs are narrow."""
    parts = [part for part in group.split(".") if part not in ("state", "sensor", robot)]
    return ".".join(parts)


class Plots:
    """Plots groups of columns, with separate plots for different units."""

    def __init__(self, factory: Factory, log: Log, groups: Groups) -> None:
        self._factory = factory
        self._times = log.time - log.time[0]
        self._row = 0
        self._plots: list[tuple[str, list[str], str, Vector]] = []
        only = next(iter(log.constants.get("parts", ())), "")
        for group, names in groups.items():
            title = _short(group, only if len(log.constants.get("parts", ())) == 1 else "")
            own = [name for name in names if name in log.variables]
            units = dict.fromkeys(log.units.get(name, "") for name in own)
            for number, unit in enumerate(units, 1):
                of_unit = [name for name in own if log.units.get(name, "") == unit]
                values = np.stack([log.variables[name] for name in of_unit], axis=1)
                labels = [label_of(name, group) for name in of_unit]
                plot = f"{title} {number}" if number > 1 else title
                self._plots.append((plot, labels, unit, values))

    def rows_until(self, time: float) -> Iterator[float]:
        """Plot the rows up to a time after the start, in s, and yield the time of each."""
        if self._row == 0:
            for name, labels, unit, _ in self._plots:
                self._factory.add_scalars(name, labels, unit=unit)
        last = row_at(self._times, time) if self._plots else -1
        while self._row <= last:
            for name, _, _, values in self._plots:
                self._factory.update_scalars(name, values[self._row])
            self._row += 1
            yield min(float(self._times[self._row - 1]), time)
