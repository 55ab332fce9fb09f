"""Factory: collects what an environment draws."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from physx_core.components.scene.consistency import Known
from physx_core.components.scene.event import Event
from physx_core.components.scene.kinds import KINDS, RESETTABLE
from physx_core.components.scene.markers import MarkedMeshes
from physx_core.components.scene.moves import POSE, Moves
from physx_core.components.scene.options import Check, many, number
from physx_core.errors import ConfigError, UnknownOptionError, listed
from physx_core.fields import NO_ARRAY

_REMEMBERED = 1000  # sets of names
_SECONDS = number(-math.inf)
_SEEN_AS = {"markers": "symbols"}
"""Kinds that reach viewers as another kind."""


class Factory:
    """Collects drawing events of an environment.

    Add objects in `Environment.init_visualization`, change them in `Environment.step` or
    `Environment.apply_prediction`; what they changed is shown when they return. Objects are
    identified by their names.
    Lengths are in m, positions in the world frame; orientations are quaternions x, y, z, w.

    All objects in space have ``color`` (a CSS color name, ``"#rrggbb"``, or red, green and blue in
    [0, 1]), ``alpha``, ``visible``, and ``in_view``: False for what the camera need not show, such
    as the ground. Those with a ``scalar_field`` show it in one of matplotlib's colormaps
    (``colormap``), from ``vmin`` to ``vmax`` (by default the extremes so far), next to a
    ``color_bar``.
    """

    def __init__(self) -> None:
        self._objects: dict[str, Known] = {}
        self._meshes = MarkedMeshes()
        self._events: list[Event] = []
        self._moves: Moves | None = None
        self._known_names: dict[tuple[str, ...], str] = {}

    def __bool__(self) -> bool:
        """Return whether what is drawn is visible."""
        return True

    @property
    def has_events(self) -> bool:
        """Whether `take_events` would return any."""
        return bool(self._events) or self._moves is not None

    def take_events(self) -> list[Event]:
        """Return and clear the events since the last call."""
        self._end_moves()
        events, self._events = self._events, []
        return events

    # Objects in space ------------------------------------------------------------------------

    def add_mesh(self, name: str, positions: ArrayLike, cells: ArrayLike, **look: Any) -> str:
        """Add a triangle mesh.

        Args:
            name: Name of the object; also returned.
            positions: Vertices, shape (n, 3), in m.
            cells: Indices of the vertices of each triangle, shape (m, 3).
            look: ``color``, ``alpha``, ``scalar_field`` (n,) shown through ``colormap``,
                ``wireframe``, by default beside the surface of a mesh of few triangles, and the
                ``size`` of its lines: their radius in m.
        """
        return self._add("mesh", name, positions=positions, cells=cells, **look)

    def update_mesh(self, name: str, **changes: Any) -> None:
        """Change ``positions``, ``cells`` or the look of a mesh."""
        self._update("mesh", name, changes)

    def add_points(self, name: str, positions: ArrayLike, **look: Any) -> str:
        """Add points at positions (n, 3) in m; ``size`` is their radius in m, ``labels`` texts."""
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

    def add_symbols(self, name: str, positions: ArrayLike, **look: Any) -> str:
        """Add flat symbols.

        Args:
            name: Name of the object; also returned.
            positions: Centers, shape (n, 3), in m.
            look: ``symbol``: ``circle``, ``cross``, ``diamond``, ``plus``, ``square``, ``star`` or
                ``triangle``; ``orientations``: normals of the symbols, shape (n, 3), by default
                upward; ``size``: their radius in m; ``labels``; ``color``, ``scalar_field`` (n,).
        """
        return self._add("symbols", name, positions=positions, **look)

    def update_symbols(self, name: str, **changes: Any) -> None:
        """Change ``positions``, ``orientations`` or the look of symbols."""
        self._update("symbols", name, changes)

    def add_markers(self, name: str, mesh: str, indices: ArrayLike, **look: Any) -> str:
        """Add symbols on vertices of a mesh, which move and turn with it.

        Args:
            name: Name of the object; also returned.
            mesh: Name of the mesh.
            indices: The marked vertices, shape (n,).
            look: As in `add_symbols`, without ``orientations``.
        """
        return self._add("markers", name, mesh=mesh, indices=indices, **look)

    def update_markers(self, name: str, **changes: Any) -> None:
        """Change the ``indices`` or the look of markers."""
        self._update("markers", name, changes)

    def add_lines(self, name: str, positions: Any, **look: Any) -> str:
        """Add one or more lines.

        Args:
            name: Name of the object; also returned.
            positions: Corners of the line, shape (n, 3), in m; or a list of such arrays.
            look: ``color``, ``alpha``; ``size``: radius in m; ``labels``: a text for each line.
        """
        return self._add("lines", name, positions=positions, **look)

    def update_lines(self, name: str, **changes: Any) -> None:
        """Change ``positions`` or the look of lines."""
        self._update("lines", name, changes)

    def add_box(self, name: str, half_sizes: ArrayLike, **look: Any) -> str:
        """Add a box: half_sizes (3,) in m; ``position`` (3,), ``orientation`` (4,), ``label``."""
        return self._add("box", name, half_sizes=half_sizes, **look)

    def update_box(self, name: str, **changes: Any) -> None:
        """Change ``half_sizes``, ``position``, ``orientation`` or the look of a box."""
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

    def add_cylinder(self, name: str, radius: float, length: float, **look: Any) -> str:
        """Add a cylinder along its z axis, centered: radius and length in m."""
        return self._add("cylinder", name, radius=radius, length=length, **look)

    def update_cylinder(self, name: str, **changes: Any) -> None:
        """Change ``radius``, ``length``, pose or the look of a cylinder."""
        self._update("cylinder", name, changes)

    def add_height_field(
        self, name: str, heights: ArrayLike, spacing: ArrayLike, **look: Any
    ) -> str:
        """Add a surface of heights on a grid.

        Args:
            name: Name of the object; also returned.
            heights: Heights in m, shape (nx, ny): axis 0 is along x, axis 1 along y.
            spacing: Distance between the grid's points along x and y, shape (2,), in m.
            look: ``position`` (3,) of the grid's first point, ``orientation`` (4,); otherwise as
                for a mesh, with ``scalar_field`` (nx, ny).
        """
        return self._add("height_field", name, heights=heights, spacing=spacing, **look)

    def update_height_field(self, name: str, **changes: Any) -> None:
        """Change ``heights``, pose or the look of a height field."""
        self._update("height_field", name, changes)

    def add_slice(self, name: str, values: ArrayLike, spacing: ArrayLike, **look: Any) -> str:
        """Add a plane that shows the values of a grid in colors, such as a slice of a volume.

        Args:
            name: Name of the object; also returned.
            values: Values at the grid's points, shape (nx, ny): axis 0 along x, axis 1 along y.
            spacing: Distance between the grid's points along x and y, shape (2,), in m.
            look: ``position`` (3,) of the grid's first point, ``orientation`` (4,); ``colormap``,
                ``vmin``, ``vmax``, ``color_bar``, ``alpha``.
        """
        return self._add("slice", name, values=values, spacing=spacing, **look)

    def update_slice(self, name: str, **changes: Any) -> None:
        """Change ``values``, pose or the look of a slice."""
        self._update("slice", name, changes)

    def add_volume(self, name: str, values: ArrayLike, spacing: ArrayLike, **look: Any) -> str:
        """Add the values of a 3D grid, as a cloud and in a window of slices.

        Args:
            name: Name of the object; also returned.
            values: Values of the cells, shape (nx, ny, nz).
            spacing: Edges of a cell along x, y and z, shape (3,), in m.
            look: ``position`` (3,) of the grid's lowest corner, ``orientation`` (4,);
                ``colormap``, ``vmin`` (and below: transparent), ``vmax``, ``color_bar``.
        """
        return self._add("volume", name, values=values, spacing=spacing, **look)

    def update_volume(self, name: str, **changes: Any) -> None:
        """Change ``values``, pose or the look of a volume."""
        self._update("volume", name, changes)

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
            bodies: Names of the links that `update_robot` places, in that order.
            package_dirs: Folder of each package that the URDF's mesh names start with.
            look: ``color`` and ``alpha`` replace the URDF's own, for example to show a prediction
                or a reference as a translucent robot; ``poses`` as in `update_robot`.
        """
        return self._add(
            "robot", name, urdf=urdf, bodies=bodies, package_dirs=package_dirs or {}, **look
        )

    def update_robot(self, name: str, **changes: Any) -> None:
        """Place a robot's links: ``poses`` (bodies, 7), x, y, z in m and quaternion x, y, z, w."""
        self._update("robot", name, changes)

    # Windows next to the scene ---------------------------------------------------------------

    def add_image(self, name: str, image: ArrayLike) -> str:
        """Add an image in its own window.

        Args:
            name: Name of the object; also returned.
            image: Gray (height, width), RGB or RGBA (height, width, 3 or 4): uint8, or floats in
                [0, 1].
        """
        return self._add("image", name, image=image)

    def update_image(self, name: str, image: ArrayLike) -> None:
        """Replace an image."""
        self._update("image", name, {"image": image})

    def add_text(self, name: str, content: str) -> str:
        """Add a Markdown text."""
        return self._add("text", name, content=content)

    def update_text(self, name: str, content: str) -> None:
        """Replace a text."""
        self._update("text", name, {"content": content})

    def add_scalars(self, name: str, labels: Sequence[str], **values: Any) -> str:
        """Add a plot over time with one curve for each label; ``unit`` is their unit."""
        return self._add("scalars", name, labels=labels, **values)

    def update_scalars(self, name: str, values: ArrayLike) -> None:
        """Set the curves' next ``values``, shape (labels,)."""
        self._update("scalars", name, {"values": values})

    def add_controls(self, name: str, labels: Sequence[str], **values: Any) -> str:
        """Add sliders, and say which objects can be pulled; `Environment.define_controls` does."""
        return self._add("controls", name, labels=labels, **values)

    def set_view(self, title: str, follow: str | None = None, **camera: ArrayLike) -> None:
        """Set the title of the environment's window and place its camera; call it once.

        Args:
            title: Title of the window.
            follow: Name of an object that the camera follows.
            camera: ``eye`` (3,) and ``target`` (3,), position and target of the camera in m; by
                default it shows all objects.
        """
        self._add("view", "view", title=title, follow=follow, **camera)

    def set_time(self, seconds: float) -> None:
        """Set the simulated time of what is drawn until the next call, in s.

        Viewers play what is drawn in this time; call it before the first object is added, too. If
        `Environment.step_time` is set, this is done automatically.

        Raises:
            ConfigError: If it is not a finite number.
        """
        try:
            plain = {"seconds": _SECONDS(seconds)}
        except ConfigError as error:
            raise ConfigError(f"The simulated time {error}.") from error
        self._events.append(Event("update", "time", ("time",), plain))

    # Any objects -----------------------------------------------------------------------------

    def update_many(self, kind: str, names: Sequence[str], values: Mapping[str, ArrayLike]) -> None:
        """Change several objects of one kind: much cheaper than one by one.

        Args:
            kind: Their kind, for example ``box``.
            names: Their names.
            values: The changed options, each with one entry per name: for boxes, ``position``
                (n, 3) and ``orientation`` (n, 4).
        """
        chosen = tuple(names)
        self._check_names(kind, chosen)
        self._end_moves()
        plain = {
            option: self._checked_rows(kind, chosen, option, value)
            for option, value in values.items()
        }
        if not plain:
            return
        if len(chosen) > 1 and plain.keys() <= POSE.keys():
            self._events.append(Event("update", kind, chosen, plain))
            return
        objects = {name: self._objects[name] for name in chosen}
        meshes, count = self._meshes.copy(), len(self._events)
        try:
            for row, name in enumerate(chosen):
                self._update(kind, name, {option: value[row] for option, value in plain.items()})
        except ConfigError:  # then none of them is changed
            self._objects |= objects
            self._meshes = meshes
            del self._events[count:]
            raise

    def remove(self, *names: str) -> None:
        """Remove objects; their names can be used again.

        Raises:
            ConfigError: If one of them does not exist; then none is removed.
        """
        for name in names:
            known = self._objects.get(name)
            if known is None or known.kind == "view":
                raise ConfigError(f'The factory has no object "{name}" to remove. {self._list()}')
        self._end_moves()
        self._known_names.clear()
        for name in names:
            for each in (*self._meshes.remove(name), name):
                known = self._objects.pop(each, None)
                if known is not None:
                    kind = _SEEN_AS.get(known.kind, known.kind)
                    self._events.append(Event("remove", kind, (each,), {}))

    # Implementation --------------------------------------------------------------------------

    def _list(self) -> str:
        return f"Objects: {listed(self._objects)}."

    def _known(self, kind: str, name: str) -> Known:
        known = self._objects.get(name)
        if known is None or known.kind != kind:
            what = f"is a {known.kind}, not a {kind}" if known else "does not exist"
            raise ConfigError(f'The factory\'s object "{name}" {what}. {self._list()}')
        return known

    def _end_moves(self) -> None:
        if self._moves is not None:
            self._events.append(self._moves.event())
            self._moves = None

    def _add(self, kind: str, name: str, **values: Any) -> str:
        if not isinstance(name, str):
            raise ConfigError(f"The name of an object must be a string, not {name!r}.")
        if name in self._objects:
            raise ConfigError(f'The factory already has an object "{name}".')
        spec = KINDS[kind]
        values = {
            option: value
            for option, value in values.items()
            if value is not None or option in spec.required
        }
        unknown = values.keys() - spec.options.keys()
        if unknown:
            raise UnknownOptionError(f'add_{kind} of "{name}"', unknown, spec.options)
        plain = _plain(name, spec.options, values)
        new = Known(kind).after(name, plain)
        if kind == "markers":
            plain = self._meshes.mark(name, plain)
        elif kind == "mesh":
            self._meshes.add(name, plain["positions"], plain["cells"])
        self._end_moves()
        self._objects[name] = new
        self._events.append(Event("add", _SEEN_AS.get(kind, kind), (name,), plain))
        return name

    def _update(self, kind: str, name: str, changes: Mapping[str, Any]) -> None:
        known, moves = self._objects.get(name), self._moves
        if known is None or known.kind != kind:
            known = self._known(kind, name)
        if moves is not None and moves.kind == kind and moves.add(name, changes):
            return
        if changes.keys() <= POSE.keys() and self._move(kind, name, changes):
            return
        spec = KINDS[kind]
        if not changes.keys() <= spec.changeable.keys():
            unknown = changes.keys() - spec.changeable.keys()
            raise UnknownOptionError(f'update_{kind} of "{name}"', unknown, spec.changeable)
        plain = _plain(name, spec.changeable, changes)
        after, followers = known.after(name, plain), []
        if kind == "markers":
            plain = self._meshes.mark(name, plain)
        elif kind == "mesh":
            followers = self._meshes.change(name, plain)
        self._end_moves()
        self._objects[name] = after
        self._events.append(Event("update", _SEEN_AS.get(kind, kind), (name,), plain))
        self._events += followers

    def _move(self, kind: str, name: str, changes: Mapping[str, Any]) -> bool:
        """Append to the consecutive moves, or begin new ones; False if full checks are needed."""
        options = [option for option in POSE if option in changes]
        if not options or "position" not in KINDS[kind].options:
            return False
        moves = self._moves
        if moves is None or moves.kind != kind or moves.options != options:
            moves = Moves(kind, options)
        try:
            arrays = {option: np.asarray(value) for option, value in changes.items()}
        except NO_ARRAY:
            return False
        if not moves.add(name, arrays):
            return False
        if moves is not self._moves:
            self._end_moves()
            self._moves = moves
        return True

    def _check_names(self, kind: str, names: tuple[str, ...]) -> None:
        """Check that objects are of a kind; the result is remembered."""
        if self._known_names.get(names) == kind:
            return
        if kind not in KINDS or kind == "view":
            raise UnknownOptionError("update_many", [kind], KINDS.keys() - {"view"})
        for name in names:
            self._known(kind, name)
        if len(self._known_names) >= _REMEMBERED:
            self._known_names.clear()
        self._known_names[names] = kind

    def _checked_rows(self, kind: str, names: tuple[str, ...], option: str, value: Any) -> Any:
        """Return the plain values of an option of several objects."""
        check = KINDS[kind].changeable.get(option)
        if check is None:
            known = list(KINDS[kind].changeable)
            raise UnknownOptionError(f"update_many of {kind}", [option], known)
        try:
            return many(check, value, len(names), resettable=option in RESETTABLE)
        except ConfigError as error:
            for name, entry in zip(names, value if np.iterable(value) else (), strict=False):
                _plain(name, {option: check}, {option: entry})
            raise _told(" ".join(names[:1]), option, error) from error


class NullFactory(Factory):
    """The factory of an environment without a visualizer: it accepts everything and is false."""

    def __bool__(self) -> bool:
        """Return False."""
        return False

    def set_time(self, seconds: float) -> None:
        """Do nothing."""

    def update_many(self, kind: str, names: Sequence[str], values: Mapping[str, ArrayLike]) -> None:
        """Do nothing."""

    def remove(self, *names: str) -> None:
        """Do nothing."""

    def _add(self, kind: str, name: str, **values: Any) -> str:
        return name

    def _update(self, kind: str, name: str, changes: Mapping[str, Any]) -> None:
        pass


def _told(name: str, option: str, error: ConfigError) -> ConfigError:
    """Return an error that names the object and its option."""
    text = str(error)
    return ConfigError(f'Object "{name}": {option} {text}{"" if text.endswith(".") else "."}')


def _plain(name: str, checks: Mapping[str, Check], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain values of an object's options."""
    plain: dict[str, Any] = {}
    for option, value in values.items():
        try:
            is_reset = value is None and option in RESETTABLE
            plain[option] = None if is_reset else checks[option](value)
        except ConfigError as error:
            raise _told(name, option, error) from error
    return plain
