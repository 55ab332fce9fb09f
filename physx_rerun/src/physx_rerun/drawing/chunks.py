"""ChunkBuilder: collects the rows drawn since the last flush in columns.

A call to Rerun for each object and step costs some 100 µs; the same data as columns of many steps
cost a few µs and far less space.
"""

from __future__ import annotations

import itertools
import string
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from physx_core.typing import Array

Times = Mapping[str, float]
"""Timeline to position: the timelines `TIME` and `SIM_TIME` in s, all others as integers."""

TIME = "time"
"""Timeline of the seconds since the start of the run."""

SIM_TIME = "sim_time"
"""Timeline of the simulated time."""


@dataclass(frozen=True)
class Chunk:
    """Rows of one entity, ready to send.

    Attributes:
        entity: Path of the entity.
        indexes: One column for each timeline; empty: the row is valid at all times.
        columns: One column for each component.
        nbytes: Size of the components in bytes.
    """

    entity: str
    indexes: list[rr.TimeColumn]
    columns: list[Any]
    nbytes: int = 0

    @property
    def is_static(self) -> bool:
        """Whether the rows are valid at all times."""
        return not self.indexes

    @classmethod
    def of(cls, entity: str, indexes: list[rr.TimeColumn], columns: list[Any]) -> Chunk:
        """Return a chunk with the given columns."""
        nbytes = sum(column.component_batch.as_arrow_array().nbytes for column in columns)
        return cls(entity, indexes, columns, nbytes)

    def send(self, stream: rr.RecordingStream) -> None:
        """Write the rows to a stream."""
        stream.send_columns(self.entity, self.indexes, self.columns)


@dataclass
class _Block:
    values: dict[str, list[Any]]
    times: list[Times] = field(default_factory=list)


class ChunkBuilder:
    """Collects rows and combines them into few chunks.

    Attributes:
        nbytes: Size of the collected arrays in bytes.
        sources: Functions that return and clear further chunks.
    """

    def __init__(self) -> None:
        self.nbytes = 0
        self.sources: list[Callable[[], Iterable[Chunk]]] = []
        self._frames = map("".join, _short_words())
        self._whole: list[Chunk] = []
        self._blocks: dict[tuple[Any, ...], _Block] = {}
        self._at: Times = {}
        self._keys_at: dict[str, list[tuple[Any, ...]]] = {}  # keys of the blocks by entity

    def add_static(self, entity: str, *archetypes: Any) -> None:
        """Add components that are valid at all times.

        Args:
            entity: Path of the entity.
            archetypes: Instances of Rerun archetypes.
        """
        self._whole.append(Chunk(entity, [], _components(archetypes)))

    def add_archetype(self, entity: str, archetype: Any, times: Times) -> None:
        """Add one row of an archetype that cannot be combined into columns, such as a tensor."""
        columns = _components([archetype])
        self._whole.append(Chunk.of(entity, indexes_of([times], [1]), columns))

    def add(self, entity: str, archetype: type[Any], times: Times, **values: Any) -> None:
        """Add one row.

        Args:
            entity: Path of the entity.
            archetype: A Rerun archetype.
            times: Position of the row on the timelines.
            values: The archetype's fields: arrays or lists whose first axis is the instances.
        """
        key = (entity, archetype, tuple(values), tuple(times))
        if archetype is not rr.Scalars:  # whose rows all have the same fields
            self._keep_order(key, times)
        block = self._blocks.get(key)
        if block is None:
            block = self._blocks[key] = _Block({name: [] for name in values})
        block.times.append(times)
        for name, value in values.items():
            block.values[name].append(value)
            self.nbytes += value.nbytes if isinstance(value, np.ndarray) else 50 * len(value)

    def _keep_order(self, key: tuple[Any, ...], times: Times) -> None:
        """End blocks that must not get the row: of rows at the same time, the last one counts."""
        if times is not self._at:
            self._at = times
            self._keys_at.clear()
        entity, archetype, names, _ = key
        before = self._keys_at.setdefault(entity, [])
        if archetype is rr.Clear:
            inner = f"{entity}/"
            for other in list(self._blocks):
                if other[0] == entity or other[0].startswith(inner):
                    self._end(other)
        for other in before:
            if other != key and not set(names).isdisjoint(other[2]):
                self._end(key)
                break
        before.append(key)

    def _end(self, key: tuple[Any, ...]) -> None:
        """Make a chunk of a block, so later rows come after it."""
        block = self._blocks.pop(key, None)
        if block is not None:
            self._whole.append(_chunk_of(key, block))

    def next_frame(self) -> str:
        """Return a name for another frame, as short as possible: each row of a pose contains it."""
        return next(self._frames)

    def pop_chunks(self) -> list[Chunk]:
        """Return and clear everything as chunks, static ones first."""
        chunks, self._whole = self._whole, []
        blocks, self._blocks = self._blocks, {}
        self.nbytes = 0
        chunks += [_chunk_of(key, block) for key, block in blocks.items()]
        chunks.sort(key=lambda chunk: not chunk.is_static)
        for source in self.sources:
            chunks += source()
        return chunks


def _chunk_of(key: tuple[Any, ...], block: _Block) -> Chunk:
    entity, archetype, _, _ = key
    columns = [
        column
        for name, values in block.values.items()
        for column in _columns(archetype, name, values)
    ]
    return Chunk.of(entity, indexes_of(block.times, [1] * len(block.times)), columns)


def _short_words() -> Iterator[tuple[str, ...]]:
    letters = string.ascii_letters + string.digits
    return itertools.chain.from_iterable(
        itertools.product(letters, repeat=length) for length in itertools.count(1)
    )


def _components(archetypes: Iterable[Any]) -> list[Any]:
    return [
        batch.partition([_length(batch)])
        for archetype in archetypes
        for batch in archetype.as_component_batches()
    ]


def _length(batch: Any) -> int:
    return len(batch.as_arrow_array())


def indexes_of(times: Sequence[Times], counts: Sequence[int]) -> list[rr.TimeColumn]:
    """Return a column for each timeline.

    Args:
        times: Positions on the timelines, in order.
        counts: Number of rows at each of them.
    """
    columns = []
    for timeline in times[0]:
        positions = np.repeat([each[timeline] for each in times], counts)
        if timeline in (TIME, SIM_TIME):
            columns.append(rr.TimeColumn(timeline, duration=positions))
        else:
            columns.append(rr.TimeColumn(timeline, sequence=positions.astype(np.int64)))
    return columns


def columns_of(
    archetype: type[Any], lengths: Sequence[int] | None = None, /, **values: Any
) -> list[rr.ComponentColumn]:
    """Return the columns of an archetype's fields.

    Args:
        archetype: The archetype.
        lengths: Number of instances in each row; None: one.
        values: The fields: arrays or lists of all instances of all rows.
    """
    return [
        rr.ComponentColumn(batch.component_descriptor(), batch, lengths=lengths)
        for batch in archetype.from_fields(**values).as_component_batches()
    ]


def _columns(archetype: type[Any], name: str, values: list[Any]) -> list[rr.ComponentColumn]:
    joined: Array | list[Any]
    if isinstance(values[0], np.ndarray):
        joined = np.concatenate(values)
    else:
        joined = [item for value in values for item in value]
    return columns_of(archetype, [len(value) for value in values], **{name: joined})
