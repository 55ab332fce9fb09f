"""Draws the rows of a dataset as point clouds, curves and arrays."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from physx_core import Dataset, Field
from physx_core.dataset import EPISODES
from physx_core.errors import printable
from physx_core.typing import Array
from physx_rerun.drawing import colors
from physx_rerun.drawing.legends import legend
from physx_rerun.stored_meshes import TIMELINE, StoredMesh, find_meshes, views_of, write_meshes

LIMIT_BYTES = 500_000_000
"""Size of the rows after which the rest of a mode is omitted."""
_BLOCK_BYTES = 8_000_000
_MOST_CURVES = 32
_MOST_ARRAYS = 2000  # Rerun accepts them only one by one
_MOST_INSTANCES = 4  # with separate windows
_RADIUS = rr.Radius.ui_points(3.0)
_BOOKKEEPING = ("env_id", "episode", "step")


@dataclass(frozen=True)
class _Column:
    """A field of a mode that can be drawn.

    Attributes:
        mode: The mode.
        field: The field.
        shape: The field's shape.
    """

    mode: str
    field: Field
    shape: tuple[int, ...]

    def entity(self, instance: int) -> str:
        """Return the path of the entity for the rows of one instance."""
        parts = (self.mode, f"env_{instance}", self.field.name)
        return "/".join(map(rr.escape_entity_path_part, parts))

    @property
    def title(self) -> str:
        """Name and unit."""
        unit = f" [{self.field.unit}]" if self.field.unit else ""
        return self.field.name + unit

    @property
    def is_curve(self) -> bool:
        """Whether the field consists of a few numbers."""
        return len(self.shape) < 2 and math.prod(self.shape) <= _MOST_CURVES

    def is_cloud(self, dimension: int) -> bool:
        """Whether the field consists of points of this dimension."""
        return len(self.shape) == 2 and self.shape[1] == dimension

    def write_look(self, stream: rr.RecordingStream, instance: int) -> None:
        """Write what is constant in all rows."""
        entity = self.entity(instance)
        if self.is_curve:
            count = math.prod(self.shape)
            indices = [f" {index}" for index in range(count)] if self.shape else [""]
            names = [f"{instance}: {self.field.name}{index}" for index in indices]
            shades = colors.curves(count, (instance - 1) * count)
            stream.log(entity, rr.SeriesLines(names=names, colors=shades), static=True)
        elif self.is_cloud(3):
            stream.log(entity, rr.Points3D.from_fields(radii=_RADIUS), static=True)

    def write(self, stream: rr.RecordingStream, instance: int, rows: Array, values: Array) -> None:
        """Write the values of some rows."""
        entity, length = self.entity(instance), self.shape[0] if self.shape else 1
        if self.is_curve:
            columns = rr.Scalars.columns(scalars=values.ravel().astype(np.float64))
        elif self.is_cloud(3):
            columns = rr.Points3D.columns(positions=values.reshape(-1, 3).astype(np.float32))
        elif self.is_cloud(2):
            columns = rr.Points2D.columns(positions=values.reshape(-1, 2).astype(np.float32))
        else:
            for row, value in zip(rows[rows < _MOST_ARRAYS], values, strict=False):
                stream.set_time(TIMELINE, sequence=int(row))
                stream.log(entity, rr.Tensor(np.asarray(value, np.float32)))
            return
        index = rr.TimeColumn(TIMELINE, sequence=rows)
        stream.send_columns(entity, [index], columns.partition([length] * len(rows)))


def write_dataset(directory: Path, stream: rr.RecordingStream) -> None:
    """Write the rows of a dataset to a recording, with a layout of windows.

    The field ``points`` of the second instance in the mode ``training`` is the entity
    ``training/env_2/points``. Fields are drawn according to their shapes: (n, 3) and (n, 2) as
    points, a few numbers as curves, and the first rows of all others as arrays. Of free axes with
    points and, by `Field.indexes`, cells, each row or episode has its own mesh, colored by the
    values on it: one window for each number of them.

    Args:
        directory: The folder of the dataset or its session.
        stream: The recording.

    Raises:
        PhysxError: If there is no dataset, or it cannot be read.
    """
    stream.set_log_time_enabled(False)
    with Dataset.open(directory) as dataset:
        tabs = []
        modes = sorted(dataset.modes, key=EPISODES.__eq__)  # the table of episodes comes last
        for mode in filter(dataset.num_samples, modes):
            columns, meshes = _columns(dataset, mode), find_meshes(dataset, mode)
            instances = _write_mode(dataset, mode, columns, meshes, stream)
            views = views_of(dataset, meshes, instances[:_MOST_INSTANCES])
            tabs.append(rrb.Grid(*views, *_views(columns, instances), name=mode))
        if tabs:
            stream.send_blueprint(rrb.Blueprint(rrb.Tabs(*tabs), collapse_panels=True))


def _columns(dataset: Dataset, mode: str) -> list[_Column]:
    return [
        _Column(mode, field, field.shape)
        for field in dataset.fields(mode).values()
        if field.shape is not None
        and not field.free_axis
        and np.dtype(field.dtype).kind in "biuf"
        and field.name not in _BOOKKEEPING
    ]


def _write_mode(
    dataset: Dataset,
    mode: str,
    columns: Sequence[_Column],
    meshes: Sequence[StoredMesh],
    stream: rr.RecordingStream,
) -> list[int]:
    """Write the rows of a mode and return the numbers of their instances."""
    view, count, known = dataset[mode], dataset.num_samples(mode), set[int]()
    row_bytes = max(1, dataset.rows(mode).row_nbytes)
    shown = min(count, max(1, LIMIT_BYTES // row_bytes))
    if shown < count:
        text = f"physx: only the first {shown} of {count} rows of the mode {mode} are shown\n"
        sys.stderr.write(printable(text))
    block = max(1, _BLOCK_BYTES // row_bytes)
    for first in range(0, shown, block):
        last = min(first + block, shown)
        rows = np.arange(first, last)
        has_owners = "env_id" in dataset.fields(mode)
        owners = np.asarray(view["env_id"][first:last]) if has_owners else np.ones_like(rows)
        values = {column: np.asarray(view[column.field.name][first:last]) for column in columns}
        for instance in map(int, np.unique(owners)):
            mine = owners == instance
            for column in columns:
                if instance not in known:
                    column.write_look(stream, instance)
                column.write(stream, instance, rows[mine], values[column][mine])
            known.add(instance)
        write_meshes(stream, dataset, meshes, rows, owners)
    return sorted(known)


def _views(columns: Sequence[_Column], instances: Sequence[int]) -> Iterator[rrb.View]:
    """Yield a window for each scene, plot and array of a mode."""
    instances = instances[:_MOST_INSTANCES]
    for instance in instances:
        for dimension, view in ((3, rrb.Spatial3DView), (2, rrb.Spatial2DView)):
            clouds = [column.entity(instance) for column in columns if column.is_cloud(dimension)]
            if clouds:
                origin = clouds[0].rpartition("/")[0]
                yield view(origin=origin, contents=clouds, name=f"instance {instance}")
    for column in columns:
        if column.is_curve:
            entities = [column.entity(instance) for instance in instances]
            shown = legend(math.prod(column.shape) * len(entities))
            yield rrb.TimeSeriesView(contents=entities, name=column.title, plot_legend=shown)
        elif not column.is_cloud(3) and not column.is_cloud(2):
            for instance in instances:
                name = f"instance {instance}: {column.title}"
                yield rrb.TensorView(origin=column.entity(instance), name=name)
