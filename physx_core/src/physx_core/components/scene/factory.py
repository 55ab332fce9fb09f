"""Factory: collects what an environment draws."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from physx_core.components.scene.event import Event
from physx_core.components.scene.geometry import vertex_normals
from physx_core.components.scene.kinds import KINDS, RESETTABLE, Kind
from physx_core.components.scene.options import LARGEST, Check, many
from physx_core.errors import ConfigError, UnknownOptionError, listed
from physx_core.fields import NO_ARRAY
from physx_core.typing import Array

_POSE = {"position": 3, "orientation": 4}
"""Options that many objects change in every step: numbers of each."""
_TURN = _POSE["orientation"]
_REMEMBERED = 1000  # sets of names
_LINKED = {"cells", "color", "heights", "scalar_field", "vmin", "vmax"}
"""Options whose change always needs a look at others."""


@dataclass(slots=True)
class _Object:
    """What later changes of an object are checked against.

    Attributes:
        kind: Its kind.
        lengths: Length of each aligned option that is set.
        limits: Its ``vmin`` and ``vmax``, as far as they are set.
        largest: Largest index among a mesh's cells.
    """

    kind: str
    lengths: dict[str, Any] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)
    largest: int = -1

    def fits(self, changes: Mapping[str, Any], spec: Kind) -> bool:
        """Return whether changes surely fit what is set: they have the same lengths as before."""
        if not changes.keys().isdisjoint(_LINKED):
            return False
        for option in spec.aligned:
            value = changes.get(option)
            if value is not None and len(value) != self.lengths.get(option):
                return False
        return True


class _Moves:
    """Moves of bodies of one kind in a row, which travel as one event."""

    def __init__(self, kind: str, options: Sequence[str]) -> None:
        self.kind, self.options = kind, options
        self._names: list[str] = []
        self._floats: list[float] = []
        self._first, self._second = options[0], options[1] if len(options) == 2 else None
        self._count = sum(_POSE[option] for option in options)

    def add(self, name: str, changes: Mapping[str, Array]) -> bool:
        """Add a move, in few operations; return False if it is not one of these options."""
        if len(changes) != len(self.options):
            return False
        try:
            row = changes[self._first].tolist()
            if self._second is not None:
                more = changes[self._second].tolist()
                if len(more) != _TURN:
                    return False
                row += more
            if len(row) != self._count or not math.hypot(*row) < LARGEST:
                return False
        except (KeyError, AttributeError, TypeError, OverflowError):
            return False
        self._names.append(name)
        self._floats += row
        return True

    def event(self) -> Event:
        """Return one event of all moves."""
        count, begin = len(self._names), 0
        packed = struct.pack(f"{len(self._floats)}f", *self._floats)  # 3 times as fast as NumPy
        rows = np.frombuffer(packed, np.float32).reshape(count, -1)
        values: dict[str, Any] = {}
        for option in self.options:
            end = begin + _POSE[option]
            values[option] = rows[0, begin:end] if count == 1 else rows[:, begin:end]
            begin = end
        return Event("update", self.kind, tuple(self._names), values)


@dataclass(slots=True)
class _Marked:
    """A mesh with markers on it.

    Attributes:
        positions: Its vertices.
        cells: Its triangles.
        indices: The marked vertices, by the markers' names.
    """

    positions: Array
    cells: Array
    indices: dict[str, Array] = field(default_factory=dict)


class Factory:
    """Collects drawing events of an environment.

    Add objects in `Environment.init_visualization`, change them in `Environment.step`, then call
    `Environment.update_visualization`. Objects are identified by their names.
    Lengths are in m, positions in the world frame; orientations are quaternions x, y, z, w.

    All objects in space have ``color`` (a name of CSS, ``"#rrggbb"``, or red, green and blue in
    [0, 1]), ``alpha``, ``visible``, and ``in_view``: False for what the camera need not show, such
    as a ground. Those with a ``scalar_field`` show it in a ``colormap``, one of matplotlib's, from
    ``vmin`` to ``vmax`` (by default the extremes so far), with a ``color_bar`` beside them.
    """

    def __init__(self) -> None:
        self._objects: dict[str, _Object] = {}
        self._meshes: dict[str, _Marked] = {}
        self._events: list[Event] = []
        self._moves: _Moves | None = None
        self._known_names: dict[tuple[str, ...], str] = {}

    def __bool__(self) -> bool:
        """Return whether what is drawn can be seen."""
        return True

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
                ``wireframe``, and the ``size`` of its lines: their radius in m.
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
        """Add a line, or several.

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
            spacing: Distance of the grid's points along x and y, shape (2,), in m.
            look: ``position`` (3,) of the grid's first point, ``orientation`` (4,); else as of a
                mesh, ``scalar_field`` (nx, ny).
        """
        return self._add("height_field", name, heights=heights, spacing=spacing, **look)

    def update_height_field(self, name: str, **changes: Any) -> None:
        """Change ``heights``, pose or the look of a height field."""
        self._update("height_field", name, changes)

    def add_slice(self, name: str, values: ArrayLike, spacing: ArrayLike, **look: Any) -> str:
        """Add a plane that shows the values of a grid, such as a slice of a volume, in colors.

        Args:
            name: Name of the object; also returned.
            values: Values at the grid's points, shape (nx, ny): axis 0 along x, axis 1 along y.
            spacing: Distance of the grid's points along x and y, shape (2,), in m.
            look: ``position`` (3,) of the grid's first point, ``orientation`` (4,); ``colormap``,
                ``vmin``, ``vmax``, ``color_bar``, ``alpha``.
        """
        return self._add("slice", name, values=values, spacing=spacing, **look)

    def update_slice(self, name: str, **changes: Any) -> None:
        """Change ``values``, pose or the look of a slice."""
        self._update("slice", name, changes)

    def add_volume(self, name: str, values: ArrayLike, spacing: ArrayLike, **look: Any) -> str:
        """Add the values of a grid in space, as a cloud and in a window of slices.

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
            bodies: Names of the links that `update_robot` places, in its order.
            package_dirs: Folder of each package that the URDF's mesh names start with.
            look: ``color`` and ``alpha`` replace the URDF's own: a translucent robot for a
                prediction or a reference; ``poses`` as in `update_robot`.
        """
        return self._add(
            "robot", name, urdf=urdf, bodies=bodies, package_dirs=package_dirs or {}, **look
        )

    def update_robot(self, name: str, **changes: Any) -> None:
        """Place a robot's links: ``poses`` (bodies, 7), x, y, z in m and quaternion x, y, z, w."""
        self._update("robot", name, changes)

    # Windows beside the scene ----------------------------------------------------------------

    def add_image(self, name: str, image: ArrayLike) -> str:
        """Add an image in a window of its own.

        Args:
            name: Name of the object; also returned.
            image: Gray (height, width), RGB or RGBA (height, width, 3 or 4): numbers of uint8, or
                floats in [0, 1].
        """
        return self._add("image", name, image=image)

    def update_image(self, name: str, image: ArrayLike) -> None:
        """Replace an image."""
        self._update("image", name, {"image": image})

    def add_text(self, name: str, content: str) -> str:
        """Add a text in Markdown."""
        return self._add("text", name, content=content)

    def update_text(self, name: str, content: str) -> None:
        """Replace a text."""
        self._update("text", name, {"content": content})

    def add_scalars(self, name: str, labels: Sequence[str], **values: Any) -> str:
        """Add a plot over time with one curve for each label; ``unit`` is that of its values."""
        return self._add("scalars", name, labels=labels, **values)

    def update_scalars(self, name: str, values: ArrayLike) -> None:
        """Set the curves' next ``values``, shape (labels,)."""
        self._update("scalars", name, {"values": values})

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

        Viewers play what is drawn in this time; call it before the first object is added, too. With
        `Environment.step_time` this is done.
        """
        self._events.append(Event("update", "time", ("time",), {"seconds": float(seconds)}))

    # Any objects -----------------------------------------------------------------------------

    def update_many(self, kind: str, names: Sequence[str], values: Mapping[str, ArrayLike]) -> None:
        """Change several objects of one kind, which costs much less than one by one.

        Args:
            kind: Their kind, for example ``box``.
            names: Their names.
            values: The changed options, each with one entry for each name: of boxes ``position``
                (n, 3) and ``orientation`` (n, 4).
        """
        chosen = tuple(names)
        self._check_names(kind, chosen)
        self._end_moves()
        plain = {
            option: self._checked_rows(kind, chosen, option, value)
            for option, value in values.items()
        }
        if len(chosen) > 1 and plain.keys() <= _POSE.keys():
            self._events.append(Event("update", kind, chosen, plain))
            return
        for row, name in enumerate(chosen):
            self._update(kind, name, {option: value[row] for option, value in plain.items()})

    def remove(self, *names: str) -> None:
        """Remove objects; their names can be used again."""
        for name in names:
            known = self._objects.get(name)
            if known is None or known.kind == "view":
                raise ConfigError(f'The factory has no object "{name}" to remove. {self._list()}')
        self._end_moves()
        self._known_names.clear()
        for name in names:
            markers = self._meshes.pop(name, None)
            for each in (*(markers.indices if markers else ()), name):
                known = self._objects.pop(each, None)
                for mesh in self._meshes.values():
                    mesh.indices.pop(each, None)
                if known is not None:
                    kind = "symbols" if known.kind == "markers" else known.kind
                    self._events.append(Event("remove", kind, (each,), {}))

    # How -------------------------------------------------------------------------------------

    def _list(self) -> str:
        return f"Objects: {listed(self._objects)}."

    def _known(self, kind: str, name: str) -> _Object:
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
            raise ConfigError(f"The name of an object must be a text, not {name!r}.")
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
            raise UnknownOptionError(f"add_{kind}", unknown, list(spec.options))
        new = _Object(kind)
        plain = self._plain(new, name, spec, spec.options, values)
        self._end_moves()
        if kind == "markers":
            kind, plain = "symbols", self._mark(name, plain)
        elif kind == "mesh":
            self._meshes[name] = _Marked(plain["positions"], plain["cells"])
        self._objects[name] = new
        self._events.append(Event("add", kind, (name,), plain))
        return name

    def _update(self, kind: str, name: str, changes: Mapping[str, Any]) -> None:
        known, moves = self._objects.get(name), self._moves
        if known is None or known.kind != kind:
            known = self._known(kind, name)
        if moves is not None and moves.kind == kind and moves.add(name, changes):
            return
        if changes.keys() <= _POSE.keys() and self._move(kind, name, changes):
            return
        spec = KINDS[kind]
        if not changes.keys() <= spec.changeable.keys():
            unknown = changes.keys() - spec.changeable.keys()
            raise UnknownOptionError(f"update_{kind}", unknown, list(spec.changeable))
        plain = self._plain(known, name, spec, spec.changeable, changes)
        self._end_moves()
        if kind == "markers":
            kind, plain = "symbols", self._mark(name, plain)
        self._events.append(Event("update", kind, (name,), plain))
        if kind == "mesh":
            self._move_markers(name, plain)

    def _move(self, kind: str, name: str, changes: Mapping[str, Any]) -> bool:
        """Add to the moves in a row, or begin others, unless the numbers need a closer look."""
        options = [option for option in _POSE if option in changes]
        if not options or "position" not in KINDS[kind].options:
            return False
        moves = self._moves
        if moves is None or moves.kind != kind or moves.options != options:
            moves = _Moves(kind, options)
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
        """Check that objects are of a kind; what was found is remembered."""
        if self._known_names.get(names) == kind:
            return
        if kind not in KINDS:
            raise UnknownOptionError("update_many", [kind], list(KINDS))
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
            return many(check, value, len(names))
        except ConfigError as error:
            if np.shape(value)[:1] == (len(names),):
                for name, entry in zip(names, value, strict=True):
                    try:
                        check(entry)
                    except ConfigError as wrong:
                        raise _told(name, option, wrong) from wrong
            raise _told(" ".join(names[:1]), option, error) from error

    def _plain(
        self,
        known: _Object,
        name: str,
        spec: Kind,
        checks: Mapping[str, Check],
        values: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Return the plain values of options, if they fit each other and those set before."""
        plain: dict[str, Any] = {}
        for option, value in values.items():
            try:
                is_reset = value is None and option in RESETTABLE
                plain[option] = None if is_reset else checks[option](value)
            except ConfigError as error:
                raise _told(name, option, error) from error
        if known.fits(plain, spec):
            return plain
        after = _Object(known.kind, {**known.lengths}, {**known.limits}, known.largest)
        _align(after, name, spec, plain)
        _check_cells(after, name, plain)
        _check_limits(after, name, plain)
        known.lengths, known.limits = after.lengths, after.limits
        known.largest = after.largest
        return plain

    # Markers ---------------------------------------------------------------------------------

    def _mark(self, name: str, changes: dict[str, Any]) -> dict[str, Any]:
        """Return the changes of markers as those of symbols on the mesh's vertices."""
        if "mesh" in changes:
            mesh = changes.pop("mesh")
            if mesh not in self._meshes:
                raise ConfigError(
                    f'Object "{name}": there is no mesh "{mesh}" to mark. '
                    f"Meshes: {listed(self._meshes)}."
                )
        else:
            mesh = next(each for each, marked in self._meshes.items() if name in marked.indices)
        marked = self._meshes[mesh]
        if "indices" in changes:
            indices = changes.pop("indices")
            if len(indices) and not 0 <= indices.min() <= indices.max() < len(marked.positions):
                raise ConfigError(
                    f'Object "{name}": indices goes from {indices.min()} to {indices.max()}, but '
                    f'the mesh "{mesh}" has the vertices 0 to {len(marked.positions) - 1}.'
                )
            marked.indices[name] = indices
            changes |= _places(marked, indices)
        return changes

    def _move_markers(self, mesh: str, changes: Mapping[str, Any]) -> None:
        """Keep what markers need of a mesh, and move them with it."""
        marked = self._meshes[mesh]
        marked.positions = changes.get("positions", marked.positions)
        marked.cells = changes.get("cells", marked.cells)
        if changes.keys() & {"positions", "cells"}:
            for name, indices in marked.indices.items():
                event = Event("update", "symbols", (name,), _places(marked, indices))
                self._events.append(event)


class NullFactory(Factory):
    """The factory of an environment that nobody looks at: it accepts everything and is false."""

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


def _align(after: _Object, name: str, spec: Kind, plain: Mapping[str, Any]) -> None:
    """Check that options that belong together have the same length."""
    if "color" in plain and "scalar_field" not in plain:
        after.lengths.pop("scalar_field", None)
    changed = False
    for option in spec.aligned:
        if option not in plain:
            continue
        value, changed = plain[option], True
        if option not in spec.required and (value is None or not len(value)):
            after.lengths.pop(option, None)
        else:
            is_grid = after.kind == "height_field"
            after.lengths[option] = value.shape if is_grid else len(value)
    if not changed or len(set(after.lengths.values())) < 2:
        return
    first, *rest = after.lengths
    other = next(option for option in rest if after.lengths[option] != after.lengths[first])
    raise ConfigError(
        f'Object "{name}": {other} has the length {after.lengths[other]}, but {first} has '
        f"{after.lengths[first]}. Give both, of one length."
    )


def _check_cells(after: _Object, name: str, plain: Mapping[str, Any]) -> None:
    """Check that a mesh's cells are of its vertices."""
    if after.kind != "mesh" or not plain.keys() & {"positions", "cells"}:
        return
    if "cells" in plain:
        cells = plain["cells"]
        after.largest = int(cells.max()) if cells.size else -1
        if cells.size and cells.min() < 0:
            raise ConfigError(f'Object "{name}": cells has the negative index {cells.min()}.')
    count = after.lengths["positions"]
    if after.largest >= count:
        raise ConfigError(
            f'Object "{name}": cells has the index {after.largest}, but positions only the '
            f"{count} vertices 0 to {count - 1}."
        )


def _check_limits(after: _Object, name: str, plain: Mapping[str, Any]) -> None:
    """Check that the limits of a colormap are a range."""
    for option in ("vmin", "vmax"):
        if option in plain:
            after.limits[option] = plain[option]
    low, high = after.limits.get("vmin"), after.limits.get("vmax")
    if low is not None and high is not None and low >= high:
        raise ConfigError(f'Object "{name}": vmin is {low:g} but must be less than vmax, {high:g}.')


def _places(marked: _Marked, indices: Array) -> dict[str, Any]:
    """Return positions and normals of the marked vertices."""
    around = marked.cells[np.isin(marked.cells, indices).any(axis=1)]
    normals = vertex_normals(marked.positions, around)
    return {"positions": marked.positions[indices], "orientations": normals[indices]}
