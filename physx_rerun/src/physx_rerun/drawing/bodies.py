"""Bodies: the frames of one instance's rigid bodies, which move every step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr

from physx_core.rotations import rotate_rows, to_matrix_rows
from physx_core.typing import Array
from physx_rerun.drawing.chunks import Chunk, Times, columns_of, indexes_of
from physx_rerun.drawing.framing import Frame, extremes

_BLOCK_ROWS = 2000
"""Rows per chunk. Rerun's compression only finds repetitions within 64 KiB: a column's offsets
repeat those of the previous column."""
_UPRIGHT = np.array([0, 0, 0, 1], np.float32)


@dataclass(slots=True)
class _Move:
    """A move of some bodies at one time, one row each; None: position or orientation is kept."""

    times: Times
    places: Array
    positions: Array | None
    orientations: Array | None


class Bodies:
    """Poses of bodies, collected in columns.

    A pose is x, y, z in m and a quaternion x, y, z, w, in the world frame.
    """

    def __init__(self, entity: str) -> None:
        """Start without bodies.

        Args:
            entity: Path of the entity with all poses; its parent is the world.
        """
        self._entity = entity
        self._frames: list[str] = []
        self._positions = np.zeros((0, 3), np.float32)
        self._orientations = np.zeros((0, 4), np.float32)
        self._boxes: dict[int, Array] = {}
        self._radii: dict[int, float] = {}
        self._moves: list[_Move] = []
        self._named: tuple[Array, pa.Array] = (np.zeros(0, np.int64), pa.array([], pa.utf8()))

    def add(self, frames: Sequence[str]) -> Array:
        """Add bodies at the origin, by the names of their frames, and return their indices."""
        first, count = len(self._frames), len(frames)
        self._frames += frames
        self._positions = np.concatenate([self._positions, np.zeros((count, 3), np.float32)])
        self._orientations = np.concatenate([self._orientations, np.tile(_UPRIGHT, (count, 1))])
        return np.arange(first, first + count)

    def set_box(self, place: int, corners: Array) -> None:
        """Set the points around a body that stay in view, in its frame, shape (n, 3)."""
        box = np.stack(extremes(corners))
        self._boxes[place] = box
        self._radii[place] = float(np.linalg.norm(np.abs(box).max(axis=0)))

    def move(self, places: Array, times: Times, values: Mapping[str, Array]) -> None:
        """Move bodies.

        Args:
            places: Indices of the bodies, shape (n,).
            times: Time of the row.
            values: ``position`` (n, 3), ``orientation`` (n, 4), or both.
        """
        positions, orientations = values.get("position"), values.get("orientation")
        if len(places) == 1:
            positions = None if positions is None else positions.reshape(1, 3)
            orientations = None if orientations is None else orientations.reshape(1, 4)
        self._moves.append(_Move(times, places, positions, orientations))

    def in_world(self, place: int, points: Array) -> Array:
        """Transform points, shape (n, 3), from a body's frame to the world frame."""
        position, orientation = self._positions[place], self._orientations[place]
        for move in self._moves:
            for row in np.flatnonzero(move.places == place):
                if move.positions is not None:
                    position = move.positions[row]
                if move.orientations is not None:
                    orientation = move.orientations[row]
        return rotate_rows(orientation.astype(np.float64), points) + position

    def pop(self, frame: Frame | None) -> list[Chunk]:
        """Return and clear the rows since the last call.

        Args:
            frame: The camera's view, which is informed of the bodies' positions; None: no view.
        """
        moves, self._moves = self._moves, []
        chunks = []
        for same in _blocks(moves):
            places, positions, orientations = self._rows(same)
            indexes = indexes_of([move.times for move in same], [len(m.places) for m in same])
            columns = columns_of(
                rr.Transform3D,
                translation=positions,
                quaternion=orientations,
                child_frame=self._names(places),
            )
            chunks.append(Chunk.of(self._entity, indexes, columns))
            if frame is not None:
                self._tell(frame, places, positions, orientations)
        return chunks

    def _rows(self, moves: Sequence[_Move]) -> tuple[Array, Array, Array]:
        """Return the indices, positions and orientations of moves, concatenated."""
        if any(move.positions is None or move.orientations is None for move in moves):
            for move in moves:  # kept parts come from earlier moves
                if move.positions is not None:
                    self._positions[move.places] = move.positions
                if move.orientations is not None:
                    self._orientations[move.places] = move.orientations
                move.positions = self._positions[move.places]
                move.orientations = self._orientations[move.places]
        places = np.concatenate([move.places for move in moves])
        positions = np.concatenate([move.positions for move in moves])
        orientations = np.concatenate([move.orientations for move in moves])
        self._positions[places], self._orientations[places] = positions, orientations
        return places, positions, orientations

    def _names(self, places: Array) -> pa.Array:
        """Return the names of frames; usually the same bodies move in the same order as before."""
        known, names = self._named
        if not np.array_equal(known[: len(places)], places):
            names = pa.array(self._frames, pa.utf8()).take(pa.array(places))
            self._named = places, names
        return names[: len(places)]

    def _tell(self, frame: Frame, places: Array, positions: Array, orientations: Array) -> None:
        """Inform a view of the bodies' positions, unless it is certain to show them."""
        if not self._boxes:
            return
        if len(self._boxes) < len(self._frames):
            seen = np.isin(places, list(self._boxes))
            places, positions, orientations = places[seen], positions[seen], orientations[seen]
            if not len(places):
                return
        radius = max(self._radii.values())
        low, high = extremes(positions)
        if frame.shows(low - radius, high + radius):
            return
        boxes = np.zeros((len(self._frames), 2, 3), np.float32)
        for place, box in self._boxes.items():
            boxes[place] = box
        centers, halves = boxes.mean(axis=1)[places], 0.5 * np.ptp(boxes, axis=1)[places]
        turns = to_matrix_rows(orientations)
        middles = positions + np.einsum("nij,nj->ni", turns, centers)
        reach = np.einsum("nij,nj->ni", np.abs(turns), halves)
        frame.see(*extremes(np.concatenate([middles - reach, middles + reach])))


def _blocks(moves: Iterable[_Move]) -> Iterator[list[_Move]]:
    """Yield moves in blocks with the same timelines that do not have too many rows."""
    block: list[_Move] = []
    count = 0
    for move in moves:
        if block and (count >= _BLOCK_ROWS or len(move.times) != len(block[0].times)):
            yield block
            block, count = [], 0
        block.append(move)
        count += len(move.places)
    if block:
        yield block
