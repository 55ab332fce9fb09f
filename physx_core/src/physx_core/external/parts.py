"""Division: how the ranks of a program share the fields of a sample."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from physx_core.errors import listed
from physx_core.external.messages import MalformedMessageError, Message
from physx_core.fields import Field
from physx_core.typing import Array

_MOST_RANKS = 65536


class Part(NamedTuple):
    """What a rank says before it declares its fields.

    Attributes:
        rank: Its number, from 0.
        ranks: Number of ranks.
        offsets: Where its part of each field begins along the first axis.
    """

    rank: int
    ranks: int
    offsets: tuple[int, ...]


class Piece(NamedTuple):
    """A rank's part of a field: the entries `begin` to `end` - 1 of the first axis."""

    begin: int
    end: int
    rank: int

    def __str__(self) -> str:
        return f"{self.begin} to {self.end - 1} (rank {self.rank})"


def read_part(message: Message) -> Part:
    """Return what a message of the kind ``PART`` says.

    Raises:
        MalformedMessageError: If it does not say it.
    """
    values = message.given.get("part", np.empty(0))
    if values.dtype != np.int64 or values.ndim != 1 or len(values) < 2:
        raise MalformedMessageError("did not say which part it sends.")
    rank, ranks, *offsets = values.tolist()
    if not 0 <= rank < ranks <= _MOST_RANKS:
        raise MalformedMessageError(f"called physx_open_part() in rank {rank} of {ranks}.")
    return Part(rank, ranks, tuple(offsets))


class Division:
    """Joins what the ranks send, and divides what they receive.

    Attributes:
        fields: The whole fields.
    """

    def __init__(self, parts: Sequence[Part], declared: Sequence[Sequence[Field]]) -> None:
        """Find the pieces of each field, by what each rank said and declared, in order of ranks.

        Raises:
            MalformedMessageError: If they overlap, leave a gap, or do not fit together.
        """
        self._pieces: dict[str, list[Piece]] = {}
        owners: dict[str, list[tuple[int, int, Field]]] = {}
        for part, fields in zip(parts, declared, strict=True):
            if len(part.offsets) != len(fields):
                raise MalformedMessageError(f"gave no offset for each field in rank {part.rank}.")
            for offset, field in zip(part.offsets, fields, strict=True):
                if offset < 0:
                    raise MalformedMessageError(
                        f'declared "{field.name}" with the offset {offset} in rank {part.rank}.'
                    )
                owners.setdefault(field.name, []).append((part.rank, offset, field))
        self.fields = [
            each[0][2] if len(each) == 1 else self._join(each) for each in owners.values()
        ]
        self._whole_of = {field.name: field for field in self.fields}

    def _join(self, owners: Sequence[tuple[int, int, Field]]) -> Field:
        """Return the whole field of which several ranks have pieces."""
        first_rank, _, first = owners[0]
        for rank, _, field in owners:
            if not field.shape:
                raise MalformedMessageError(
                    f'declared "{first.name}" in several ranks, although it has no first axis to '
                    f"divide, or an open shape: {listed(str(each[0]) for each in owners)}."
                )
            if (field.shape[1:], field.dtype) != ((first.shape or ())[1:], first.dtype):
                raise MalformedMessageError(
                    f'declared parts of "{first.name}" that differ in more than their first axis: '
                    f"{first.dtype} of shape {first.shape} (rank {first_rank}), {field.dtype} of "
                    f"shape {field.shape} (rank {rank})."
                )
        pieces = [
            Piece(offset, offset + (field.shape or (0,))[0], rank) for rank, offset, field in owners
        ]
        self._pieces[first.name] = pieces
        return Field(
            first.name, (_check(first.name, pieces), *(first.shape or ())[1:]), first.dtype
        )

    def merge(self, messages: Sequence[Message]) -> Message:
        """Return the message that the ranks' messages are together.

        Raises:
            MalformedMessageError: If they do not fit together.
        """
        for rank, message in enumerate(messages):
            if message.kind is not messages[0].kind:
                raise MalformedMessageError(
                    f"sent a message of the kind {messages[0].kind.name} in rank 0, but "
                    f"{message.kind.name} in rank {rank}: all make the same calls."
                )
        names = dict.fromkeys(name for message in messages for name in message.given)
        given = {name: self._gather(name, messages) for name in names}
        return Message(messages[0].kind, given, self._wanted(messages))

    def _gather(self, name: str, messages: Sequence[Message]) -> Array:
        values = {
            rank: each.given[name] for rank, each in enumerate(messages) if name in each.given
        }
        pieces = self._pieces.get(name)
        if pieces is None:
            if len(values) > 1:
                ranks = listed(map(str, values))
                raise MalformedMessageError(
                    f'sent "{name}", of which no rank declared a part, in the ranks {ranks}.'
                )
            return next(iter(values.values()))
        whole = self._whole_of[name].shape or ()
        for begin, end, rank in pieces:
            found, shape = values.get(rank), (end - begin, *whole[1:])
            if found is None or (found.shape != shape and (found.size or end > begin)):
                how = "not at all" if found is None else f"with the shape {found.shape}"
                raise MalformedMessageError(
                    f'sent "{name}" in rank {rank} {how}, but declared a part of the shape {shape}.'
                )
        full = [values[rank] for begin, end, rank in sorted(pieces) if end > begin]
        return np.concatenate(full) if full else np.empty(whole)

    def _wanted(self, messages: Sequence[Message]) -> tuple[Field, ...]:
        """Return the arrays that any rank requests, whole."""
        found: dict[str, Field] = {}
        for rank, message in enumerate(messages):
            for field in message.wanted:
                whole = self._whole(rank, field)
                if found.setdefault(field.name, whole) != whole:
                    raise MalformedMessageError(
                        f'requested "{field.name}" in different types or shapes in its ranks.'
                    )
        return tuple(found.values())

    def _whole(self, rank: int, field: Field) -> Field:
        """Return the whole array of which a rank requests its part, or what it requests."""
        whole = self._whole_of.get(field.name, field)
        piece = self._piece(rank, field.name)
        axes = (whole.shape or ())[1:]
        if piece is None or field.shape != (piece.end - piece.begin, *axes):
            return field
        return Field(field.name, whole.shape, field.dtype)

    def _piece(self, rank: int, name: str) -> Piece | None:
        return next((each for each in self._pieces.get(name, ()) if each.rank == rank), None)

    def divide(self, rank: int, wanted: Field, values: Array) -> Array:
        """Return what a rank receives of a whole array of which it requests its part, or all."""
        piece = self._piece(rank, wanted.name)
        if piece is None or values.shape == wanted.shape:
            return values
        return values[piece.begin : piece.end]


def _check(name: str, pieces: Iterable[Piece]) -> int:
    """Return the size of a field's first axis, of which there are pieces."""
    before: Piece | None = None
    for piece in sorted(pieces):
        end = 0 if before is None else before.end
        if piece.begin == piece.end:
            continue
        if piece.begin < end:
            raise MalformedMessageError(
                f'declared parts of "{name}" that overlap: {before} and {piece}.'
            )
        if piece.begin > end:
            raise MalformedMessageError(
                f'declared parts of "{name}" with a gap: nobody has {end} to {piece.begin - 1}, '
                f"before {piece}."
            )
        before = piece
    return 0 if before is None else before.end
