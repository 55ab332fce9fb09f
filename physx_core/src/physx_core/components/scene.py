"""The scene: what an environment draws, as plain events that travel to any viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from physx_core.errors import ConfigError, UnknownOptionError, listed
from physx_core.fields import NO_ARRAY
from physx_core.typing import Array


@dataclass(frozen=True)
class Event:
    """One object that is added or changed.

    Attributes:
        action: ``add`` or ``update``.
        kind: Kind of the object, for example ``mesh``.
        name: The object's name, unique in its environment.
        values: Options that are set: copies of arrays, and plain data.
    """

    action: Literal["add", "update"]
    kind: str
    name: str
    values: Mapping[str, Any]


ARRAYS: dict[str, tuple[tuple[int | None, ...], type]] = {
    "positions": ((None, 3), np.float32),
    "vectors": ((None, 3), np.float32),
    "cells": ((None, 3), np.int32),
    "scalar_field": ((None,), np.float32),
    "half_sizes": ((3,), np.float32),
    "position": ((3,), np.float32),
    "orientation": ((4,), np.float32),
    "poses": ((None, 7), np.float64),
    "values": ((None,), np.float64),
    "eye": ((3,), np.float32),
    "target": ((3,), np.float32),
}
"""Array options: shape (None: any number) and type."""

_LOOK = ("color", "alpha")
_POSE = ("position", "orientation")
KINDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "mesh": (("positions", "cells"), (*_LOOK, "scalar_field", "colormap", "wireframe")),
    "points": (("positions",), (*_LOOK, "scalar_field", "colormap", "size")),
    "arrows": (("positions", "vectors"), (*_LOOK, "scalar_field", "colormap", "size")),
    "lines": (("positions",), (*_LOOK, "size")),
    "box": (("half_sizes",), (*_LOOK, *_POSE, "wireframe")),
    "sphere": (("radius",), (*_LOOK, *_POSE, "wireframe")),
    "capsule": (("radius", "length"), (*_LOOK, *_POSE, "wireframe")),
    "text": (("content",), (*_LOOK,)),
    "scalars": (("labels",), ("values", "unit")),
    "robot": (("urdf", "bodies"), (*_LOOK, "package_dirs", "poses")),
    "view": (("title",), ("eye", "target", "follow")),
}
"""Kinds of objects: required and optional options when adding one."""

_FIXED = frozenset(
    {"cells", "colormap", "labels", "urdf", "bodies", "package_dirs", "half_sizes", "unit"}
)
"""Options that cannot be changed after adding."""


class Factory:
    """Collects drawing events of an environment.

    Add objects in `Environment.init_visualization`, change them in `Environment.step`, then call
    `Environment.update_visualization`. Objects are identified by their names.
    Lengths are in m, positions in the world frame; orientations are quaternions x, y, z, w.
    """

    def __init__(self) -> None:
        self._kinds: dict[str, str] = {}
        self._events: list[Event] = []

    def __bool__(self) -> bool:
        """Return whether what is drawn can be seen."""
        return True

    def take_events(self) -> list[Event]:
        """Return and clear the events since the last call."""
        events, self._events = self._events, []
        return events

    def add_mesh(self, name: str, positions: ArrayLike, cells: ArrayLike, **look: Any) -> str:
        """Add a triangle mesh.

        Args:
            name: Name of the object; also returned.
            positions: Vertices, shape (n, 3), in m.
            cells: Indices of the vertices of each triangle, shape (m, 3).
            look: ``color``, ``alpha``, ``scalar_field`` (n,) shown through ``colormap``,
                ``wireframe``.
        """
        return self._add("mesh", name, positions=positions, cells=cells, **look)

    def update_mesh(self, name: str, **changes: Any) -> None:
        """Change ``positions`` or the look of a mesh."""
        self._update("mesh", name, changes)

    def add_points(self, name: str, positions: ArrayLike, **look: Any) -> str:
        """Add points at positions (n, 3) in m; ``size`` is their radius in m."""
        return self._add("points", name, positions=positions, **look)

    def update_points(self, name: str, **changes: Any) -> None:
        """Change ``positions`` or the look of points."""
        self._update("points", name, changes)

    def add_arrows(self, name: str, positions: ArrayLike, vectors: ArrayLike, **look: Any) -> str:
        """Add arrows from positions (n, 3) along vectors (n, 3), both in m."""
        return self._add("arrows", name, positions=positions, vectors=vectors, **look)

    def update_arrows(self, name: str, **changes: Any) -> None:
        """Change ``positions``, ``vectors`` or the look of arrows."""
        self._update("arrows", name, changes)

    def add_lines(self, name: str, positions: ArrayLike, **look: Any) -> str:
        """Add a line through positions (n, 3) in m; ``size`` is its radius in m."""
        return self._add("lines", name, positions=positions, **look)

    def update_lines(self, name: str, **changes: Any) -> None:
        """Change ``positions`` or the look of a line."""
        self._update("lines", name, changes)

    def add_box(self, name: str, half_sizes: ArrayLike, **look: Any) -> str:
        """Add a box: half_sizes (3,) in m; ``position`` (3,), ``orientation`` (4,)."""
        return self._add("box", name, half_sizes=half_sizes, **look)

    def update_box(self, name: str, **changes: Any) -> None:
        """Change ``position``, ``orientation`` or the look of a box."""
        self._update("box", name, changes)

    def add_sphere(self, name: str, radius: float, **look: Any) -> str:
        """Add a sphere: radius in m; ``position`` (3,)."""
        return self._add("sphere", name, radius=radius, **look)

    def update_sphere(self, name: str, **changes: Any) -> None:
        """Change ``radius``, ``position`` or the look of a sphere."""
        self._update("sphere", name, changes)

    def add_capsule(self, name: str, radius: float, length: float, **look: Any) -> str:
        """Add a capsule along its z axis, centered: radius and cylinder length in m."""
        return self._add("capsule", name, radius=radius, length=length, **look)

    def update_capsule(self, name: str, **changes: Any) -> None:
        """Change ``radius``, ``length``, pose or the look of a capsule."""
        self._update("capsule", name, changes)

    def add_text(self, name: str, content: str, **look: Any) -> str:
        """Add a text in Markdown."""
        return self._add("text", name, content=content, **look)

    def update_text(self, name: str, **changes: Any) -> None:
        """Change the ``content`` of a text."""
        self._update("text", name, changes)

    def add_scalars(self, name: str, labels: Sequence[str], **values: Any) -> str:
        """Add a plot over time with one curve for each label; ``unit`` is that of its values."""
        return self._add("scalars", name, labels=list(labels), **values)

    def update_scalars(self, name: str, values: ArrayLike) -> None:
        """Set the curves' next ``values``, shape (labels,)."""
        self._update("scalars", name, {"values": values})

    def add_robot(
        self,
        name: str,
        urdf: str,
        bodies: Sequence[str],
        *,
        package_dirs: Mapping[str, str] | None = None,
        **look: Any,
    ) -> str:
        """Add a robot drawn from the visual shapes of its URDF.

        Args:
            name: Name of the object; also returned.
            urdf: Path of the URDF file.
            bodies: Names of the links that `update_robot` places, in its order.
            package_dirs: Folder of each package that the URDF's mesh names start with.
            look: ``color`` and ``alpha`` replace the URDF's own: a translucent robot for a
                prediction or a reference; ``poses`` as in `update_robot`.
        """
        return self._add(
            "robot",
            name,
            urdf=str(urdf),
            bodies=list(bodies),
            package_dirs=dict(package_dirs or {}),
            **look,
        )

    def update_robot(self, name: str, **changes: Any) -> None:
        """Place a robot's links: ``poses`` (bodies, 7), x, y, z in m and quaternion x, y, z, w."""
        self._update("robot", name, changes)

    def set_view(self, title: str, follow: str | None = None, **camera: ArrayLike) -> None:
        """Set the title of the environment's window and place its camera; call it once.

        Args:
            title: Title of the window.
            follow: Name of an object that the camera follows.
            camera: ``eye`` (3,) and ``target`` (3,), position and target of the camera in m; by
                default it shows all objects.
        """
        wanted = {} if follow is None else {"follow": follow}
        self._add("view", "view", title=title, **wanted, **camera)

    def set_time(self, seconds: float) -> None:
        """Set the simulated time of what is drawn until the next call, in s.

        Viewers play what is drawn in this time; call it before the first object is added, too. With
        `Environment.step_time` this is done.
        """
        self._events.append(Event("update", "time", "time", {"seconds": float(seconds)}))

    def _add(self, kind: str, name: str, **values: Any) -> str:
        if name in self._kinds:
            raise ConfigError(f'The factory already has an object "{name}".')
        needed, optional = KINDS[kind]
        unknown = values.keys() - {*needed, *optional}
        if unknown:
            raise UnknownOptionError(f"add_{kind}", unknown, (*needed, *optional))
        self._kinds[name] = kind
        self._events.append(Event("add", kind, name, _to_plain(name, values)))
        return name

    def _update(self, kind: str, name: str, changes: Mapping[str, Any]) -> None:
        known = self._kinds.get(name)
        if known != kind:
            what = f"is a {known}, not a {kind}" if known else "does not exist"
            raise ConfigError(
                f'The factory\'s object "{name}" {what}. Objects: {listed(self._kinds)}.'
            )
        allowed = [option for part in KINDS[kind] for option in part if option not in _FIXED]
        unknown = changes.keys() - set(allowed)
        if unknown:
            raise UnknownOptionError(f"update_{kind}", unknown, allowed)
        self._events.append(Event("update", kind, name, _to_plain(name, changes)))


class NullFactory(Factory):
    """The factory of an environment that nobody looks at: it accepts everything and is false."""

    def __bool__(self) -> bool:
        """Return False."""
        return False

    def set_time(self, seconds: float) -> None:
        """Do nothing."""

    def _add(self, kind: str, name: str, **values: Any) -> str:
        return name

    def _update(self, kind: str, name: str, changes: Mapping[str, Any]) -> None:
        pass


def _to_plain(owner: str, values: Mapping[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for name, value in values.items():
        if name not in ARRAYS:
            plain[name] = value
            continue
        shape, dtype = ARRAYS[name]
        try:
            array: Array = np.array(value, dtype=dtype)
        except NO_ARRAY as error:
            raise ConfigError(f'Object "{owner}": {name} is not an array: {error}.') from error
        fits = array.ndim == len(shape) and all(
            want in (None, have) for want, have in zip(shape, array.shape, strict=True)
        )
        if not fits:
            wanted = str(shape).replace("None", "n")
            raise ConfigError(
                f'Object "{owner}": {name} has shape {array.shape}, expected {wanted}.'
            )
        plain[name] = array
    return plain
