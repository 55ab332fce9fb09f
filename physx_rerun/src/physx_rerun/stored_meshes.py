"""Draws stored meshes of any size, one for each row, colored by the values on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from physx_core import Dataset, Field, Normalization
from physx_core.typing import Array, Index
from physx_rerun.drawing import colors
from physx_rerun.drawing.framing import Frame, extremes
from physx_rerun.drawing.surfaces import edges_of

TIMELINE = "row"
"""Timeline of the recording: the number of the row in its mode."""
_COLORMAP = "viridis"
_SEEN = 16  # rows from which the view of a window is found
_PLAIN = (150, 160, 175)
_SIDE = (110, 110, 110)
_THIN = rr.Radius.ui_points(0.4)
_RADIUS = rr.Radius.ui_points(3.0)
_MOST_MESHES = 6
"""Components of fields that are drawn, each on a mesh of its own."""
_SIDES = ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0))
"""Corners of the sides of a tetrahedron, seen from outside."""


@dataclass(frozen=True)
class StoredMesh:
    """One number for each point or cell of a mesh that has another size in each row.

    Attributes:
        mode: The mode of the rows.
        points: The points, shape (axis, 2) or (axis, 3).
        cells: Which of them each cell joins, shape (other axis, 2, 3 or 4); None: it is a cloud.
        field: What colors it; None: nothing does.
        component: Number of the component of its values, flat.
        limits: Values of the first and last color.
        once: Names of those of these fields that the episode of a row has.
    """

    mode: str
    points: Field
    cells: Field | None
    field: Field | None
    component: int
    limits: tuple[float, float]
    once: frozenset[str]

    @property
    def name(self) -> str:
        """Name of the entity, as the field is called that colors it."""
        field = self.field or self.points
        several = field.entry_shape not in ((), (1,)) and self.field is not None
        return f"{field.name}_{self.component}" if several else field.name

    @property
    def title(self) -> str:
        """Name, unit, and range of the colors."""
        if self.field is None:
            return self.name
        unit = f" {self.field.unit}" if self.field.unit else ""
        return f"{self.name}: {self.limits[0]:.3g} to {self.limits[1]:.3g}{unit}"

    def entity(self, instance: int) -> str:
        """Return the path of the entity for the rows of one instance."""
        parts = (self.mode, f"env_{instance}", self.name)
        return "/".join(map(rr.escape_entity_path_part, parts))

    @property
    def names(self) -> Iterator[str]:
        """Names of the fields that it is drawn from."""
        yield from (of.name for of in (self.points, self.cells, self.field) if of is not None)

    def draw(self, values: Mapping[str, Array]) -> list[rr.AsComponents]:
        """Return what shows the values of one row, by the names of fields."""
        points = np.asarray(values[self.points.name], np.float32)
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        cells = values[self.cells.name] if self.cells is not None else np.empty((0, 1), np.int64)
        shades = np.tile(colors.pack_rgba(np.array([*_PLAIN, 255]) / 255), len(points))
        if self.field is not None:
            numbers = values[self.field.name].reshape(len(values[self.field.name]), -1)
            shades = colors.map_values(numbers[:, self.component], self.limits, _COLORMAP, 1.0)
        if cells.shape[1] < 3:
            return self._lines(points, cells, shades)
        if self._is_by_cell:  # its corners are no other cell's
            points, shades = points[cells.reshape(-1)], np.repeat(shades, cells.shape[1])
            cells = np.arange(cells.size).reshape(-1, cells.shape[1])
        triangles = _triangles(cells, self.points.entry_shape[0])
        sides = rr.LineStrips3D(points[edges_of(triangles)], colors=_SIDE, radii=_THIN)
        surface = rr.Mesh3D(
            vertex_positions=points, triangle_indices=triangles, vertex_colors=shades
        )
        return [surface, sides]

    @property
    def _is_by_cell(self) -> bool:
        return self.field is not None and self.field.free_axis != self.points.free_axis

    def _lines(self, points: Array, cells: Array, shades: Array) -> list[rr.AsComponents]:
        dots, lines = (None, shades) if self._is_by_cell else (shades, None)
        found: list[rr.AsComponents] = [rr.Points3D(points, colors=dots, radii=_RADIUS)]
        if cells.shape[1] == 2:
            found.append(rr.LineStrips3D(points[cells], colors=lines))
        return found


def find_meshes(dataset: Dataset, mode: str) -> list[StoredMesh]:
    """Return what to draw of the fields of a mode that have free axes."""
    own, once = dataset.fields(mode), dataset.episode_fields
    if dataset.recorded_episodes(mode) is None:
        once = {}
    known = {**once, **own}
    clouds, found = _points(known), []
    scales = dataset.normalization_of(mode) if clouds else {}
    for points in clouds:
        cells = _cells(known, points)
        axes = {points.free_axis, "" if cells is None else cells.free_axis} - {""}
        colored: list[tuple[Field | None, int, tuple[float, float]]] = [
            (field, component, limits)
            for field in own.values()
            if field.free_axis in axes and field.name in scales and field is not points
            for component, limits in enumerate(_limits(field, scales[field.name]))
        ]
        for which in colored[:_MOST_MESHES] or [(None, 0, (0.0, 1.0))]:
            mesh = StoredMesh(mode, points, cells, *which, frozenset(once.keys() - own.keys()))
            found.append(mesh)
    return found


def _limits(field: Field, scale: Normalization) -> list[tuple[float, float]]:
    """Return the smallest and largest value of each component."""
    if scale.minimum is None or scale.maximum is None:
        return []
    ends = (scale.minimum, scale.maximum)
    low, high = (np.broadcast_to(each, field.entry_shape).reshape(-1).tolist() for each in ends)
    return list(zip(low, high, strict=True))


def write_meshes(
    stream: rr.RecordingStream,
    dataset: Dataset,
    meshes: Sequence[StoredMesh],
    rows: Index,
    owners: Index,
) -> None:
    """Write some rows.

    Args:
        stream: The recording.
        dataset: The dataset.
        meshes: What to draw, all of one mode.
        rows: Numbers of the rows, shape (n,).
        owners: Numbers of their instances, shape (n,).
    """
    values = {name: _read(dataset, mesh, name, rows) for mesh in meshes for name in mesh.names}
    for place, (row, owner) in enumerate(zip(rows.tolist(), owners.tolist(), strict=True)):
        stream.set_time(TIMELINE, sequence=row)
        for mesh in meshes:
            for shown in mesh.draw({name: values[name][place] for name in mesh.names}):
                stream.log(mesh.entity(owner), shown)


def views_of(
    dataset: Dataset, meshes: Sequence[StoredMesh], instances: Sequence[int]
) -> Iterator[rrb.View]:
    """Yield a window for each mesh of each instance."""
    for instance in instances:
        for mesh in meshes:
            whose = f"instance {instance}: " if len(instances) > 1 else ""
            yield _view(dataset, mesh, instance, whose + mesh.title)


def _view(dataset: Dataset, mesh: StoredMesh, instance: int, name: str) -> rrb.View:
    """Return a window of a mesh; one in the plane is seen from above."""
    rows = np.linspace(0, dataset.num_samples(mesh.mode) - 1, _SEEN, dtype=np.intp)
    points = np.concatenate(list(_read(dataset, mesh, mesh.points.name, rows)))
    frame = Frame()
    if len(points):
        frame.see(*extremes(np.pad(points, ((0, 0), (0, 3 - points.shape[1])))))
    position, target, distance = frame.camera()
    up = (0.0, 0.0, 1.0)
    if mesh.points.entry_shape == (2,):
        position, up = target + np.array([0.0, 0.0, distance]), (0.0, 1.0, 0.0)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=up
    )
    return rrb.Spatial3DView(
        origin=mesh.entity(instance),
        name=name,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )


def _read(dataset: Dataset, mesh: StoredMesh, name: str, rows: Index) -> Array:
    """Return values of rows, or of their episodes."""
    if name in mesh.once:
        return dataset.episode_values(mesh.mode, name, rows)
    return dataset[mesh.mode][name][rows]


def _points(fields: Mapping[str, Field]) -> list[Field]:
    """Return the points of each free axis: its first field that can be."""
    found: dict[str, Field] = {}
    for field in fields.values():
        if field.free_axis and field.entry_shape in ((2,), (3,)) and field.numpy_dtype.kind == "f":
            found.setdefault(field.free_axis, field)
    return list(found.values())


def _cells(fields: Mapping[str, Field], points: Field) -> Field | None:
    """Return the field with the largest cells of points; None: there is none."""
    found = [
        field
        for field in fields.values()
        if field.free_axis
        and field.indexes == points.free_axis
        and field.entry_shape in ((2,), (3,), (4,))
    ]
    return max(found, key=lambda field: field.entry_shape, default=None)


def _triangles(cells: Array, dimension: int) -> Array:
    """Return the triangles of a surface: of quadrilaterals in the plane, of tetrahedra in space."""
    if cells.shape[1] == 3:
        return cells
    if dimension == 2:
        return np.concatenate([cells[:, :3], cells[:, [0, 2, 3]]])
    sides = np.concatenate([cells[:, side] for side in _SIDES])
    _, first, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer: Array = sides[first[count == 1]]
    return outer
