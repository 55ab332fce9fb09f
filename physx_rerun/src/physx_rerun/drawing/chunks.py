"""ChunkBuilder: gathers the rows drawn since the last flush into columns.

One call of Rerun for each object and step costs some 100 µs; the same as columns of many steps
costs a few µs and stores far less.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from physx_core.typing import Array

Times = Mapping[str, float]
"""Timeline to position: the timelines `TIME` and `SIM_TIME` in s, all others counted."""

TIME = "time"
"""Timeline of the seconds since the run began."""

SIM_TIME = "sim_time"
"""Timeline of the simulated time."""


@dataclass(frozen=True)
class Chunk:
    """Rows of one entity, ready to send.

    Attributes:
        entity: Path of the entity.
        indexes: One column for each timeline; none: the row is valid at all times.
        columns: One column for each component.
        nbytes: Size of the components in bytes.
    """

    entity: str
    indexes: list[rr.TimeColumn]
    columns: list[Any]
    nbytes: int = 0

    @property
    def is_static(self) -> bool:
        """Whether it is valid at all times."""
        return not self.indexes

    def send(self, stream: rr.RecordingStream) -> None:
        """Write the rows to a stream."""
        stream.send_columns(self.entity, self.indexes, self.columns)


@dataclass
class _Block:
    times: list[Times] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    values: dict[str, list[Any]] = field(default_factory=dict)


class ChunkBuilder:
    """Collects rows and combines them into few chunks.

    Attributes:
        nbytes: Size of the collected arrays in bytes.
    """

    def __init__(self) -> None:
        self.nbytes = 0
        self._whole: list[Chunk] = []
        self._blocks: dict[tuple[Any, ...], _Block] = {}

    def add_static(self, entity: str, *archetypes: Any) -> None:
        """Add components that are valid at all times.

        Args:
            entity: Path of the entity.
            archetypes: Instances of Rerun archetypes.
        """
        self._whole.append(Chunk(entity, [], _components(archetypes)))

    def add_archetype(self, entity: str, archetype: Any, times: Times) -> None:
        """Add one row of an archetype that cannot be combined into columns, such as a tensor."""
        block = _Block([times], [1])
        indexes = [_index(timeline, block) for timeline in times]
        self._whole.append(Chunk(entity, indexes, _components([archetype])))

    def add(self, entity: str, archetype: type[Any], times: Times, **values: Any) -> None:
        """Add one row.

        Args:
            entity: Path of the entity.
            archetype: A Rerun archetype.
            times: Position of the row on the timelines.
            values: The archetype's fields: arrays or lists whose first axis is that of instances.
        """
        self._put(entity, archetype, times, values, 1, "row")

    def add_many(self, entity: str, archetype: type[Any], times: Times, **values: Any) -> None:
        """Add several rows of the same time; the first axis of the values is that of rows."""
        count = len(next(iter(values.values())))
        self._put(entity, archetype, times, values, count, "rows")

    def _put(
        self,
        entity: str,
        archetype: type[Any],
        times: Times,
        values: Mapping[str, Any],
        count: int,
        form: str,
    ) -> None:
        key = (entity, archetype, form, tuple(values), tuple(times))
        block = self._blocks.setdefault(key, _Block())
        block.times.append(times)
        block.counts.append(count)
        for name, value in values.items():
            block.values.setdefault(name, []).append(value)
            self.nbytes += value.nbytes if isinstance(value, np.ndarray) else 50 * len(value)

    def pop_chunks(self) -> list[Chunk]:
        """Return and clear everything as chunks, static ones first."""
        chunks, self._whole = self._whole, []
        blocks, self._blocks = self._blocks, {}
        self.nbytes = 0
        for (entity, archetype, form, _, timelines), block in blocks.items():
            indexes = [_index(name, block) for name in timelines]
            columns = [
                column
                for name, values in block.values.items()
                for column in _columns(archetype, name, values, form)
            ]
            nbytes = sum(column.as_arrow_array().nbytes for column in columns)
            chunks.append(Chunk(entity, indexes, columns, nbytes))
        return chunks


def _components(archetypes: Iterable[Any]) -> list[Any]:
    return [
        batch.partition([_length(batch)])
        for archetype in archetypes
        for batch in archetype.as_component_batches()
    ]


def _length(batch: Any) -> int:
    return len(batch.as_arrow_array())


def _index(timeline: str, block: _Block) -> rr.TimeColumn:
    positions = np.repeat([times[timeline] for times in block.times], block.counts)
    if timeline in (TIME, SIM_TIME):
        return rr.TimeColumn(timeline, duration=positions)
    return rr.TimeColumn(timeline, sequence=positions.astype(np.int64))


def _columns(archetype: type[Any], name: str, values: list[Any], form: str) -> Any:
    joined: Array | list[Any]
    if isinstance(values[0], np.ndarray):
        joined = np.concatenate(values)
    else:
        joined = [item for value in values for item in value]
    columns = archetype.columns(**{name: joined})
    return columns if form == "rows" else columns.partition([len(value) for value in values])
