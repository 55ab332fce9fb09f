"""Rows: what a client sends after a step, and the environments' arrays in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from physx_core import Field
from physx_core.typing import Array, Batch
from physx_gym.vector.batch import INFO_BYTES, EnvArrays

ROW = "row"
"""Name of the field that holds the bytes of a row."""
_FINAL = "final "


class RowLayout:
    """Layout of a row, which has a record for each environment of a client.

    Attributes:
        dtype: Type of a record.
        field: The row as a field of bytes. Rows of clients with fewer environments are zero-padded.
    """

    def __init__(self, observations: Sequence[Field], share: int, *, has_finals: bool) -> None:
        """Compute the layout.

        Args:
            observations: Fields of an observation.
            share: Largest number of environments of a client.
            has_finals: Whether last observations are sent.
        """
        seen = [(each.name, each.dtype, each.shape or ()) for each in observations]
        finals = [(_FINAL + name, *rest) for name, *rest in seen if has_finals]
        self._observations = [name for name, *_ in seen]
        self._has_finals = has_finals
        records: list[Any] = [
            *seen,
            *finals,
            ("rewards", "float64"),
            ("terminated", "bool"),
            ("truncated", "bool"),
            ("kinds", "int16"),
            ("infos", "uint8", (INFO_BYTES,)),
        ]
        self.dtype = np.dtype(records, align=True)
        self.field = Field(ROW, (share * self.dtype.itemsize,), "uint8")

    def arrays(self, row: Array, actions: Batch, first: int) -> EnvArrays:
        """Return the arrays in a row.

        Args:
            row: Bytes of whole records.
            actions: Arrays for the actions of the client's environments.
            first: Number of the first of them.
        """
        records = row.view(self.dtype)
        seen = {name: records[name] for name in self._observations}
        finals = {n: records[_FINAL + n] for n in self._observations if self._has_finals}
        names = ("rewards", "terminated", "truncated", "kinds", "infos")
        return EnvArrays(first, actions, seen, finals, *(records[name] for name in names))


def copy_results(source: EnvArrays, target: EnvArrays) -> None:
    """Copy the results of a client's environments into the arrays of all environments."""
    for theirs, ours in _pairs(source, target):
        first = source.first - target.first
        ours[first : first + len(theirs)] = theirs


def _pairs(source: EnvArrays, target: EnvArrays) -> Iterator[tuple[Array, Array]]:
    for name in source.observations:
        yield source.observations[name], target.observations[name]
    for name in source.finals:
        yield source.finals[name], target.finals[name]
    for name in ("rewards", "terminated", "truncated", "kinds", "infos"):
        yield getattr(source, name), getattr(target, name)
