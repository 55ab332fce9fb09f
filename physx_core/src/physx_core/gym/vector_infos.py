"""Infos of several environments as columns: one array of numbers for each name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

_PLAIN = (float, int, bool)


def columns_of(infos: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return arrays of shape (infos,), nested as the infos are; None: they are not all alike.

    Infos are alike if they have the same names, at least one, and numbers of the same types.
    """
    first, found = infos[0], {}
    differ = any(info.keys() != first.keys() for info in infos)
    if differ or not first or "final_obs" in first:
        return None
    for name, value in first.items():
        kind, values = type(value), [info[name] for info in infos]
        if any(type(each) is not kind for each in values):
            return None
        if kind is dict:
            column = columns_of(values)
        elif kind in _PLAIN or issubclass(kind, np.number):
            column = _column(values)
        else:
            return None
        if column is None:
            return None
        found[name] = column
    return found


def _column(values: list[Any]) -> Any:
    try:
        return np.array(values, type(values[0]))
    except OverflowError:
        return None


def numbers_of(columns: Mapping[str, Any]) -> bytes:
    """Return the numbers of columns alone, for one who knows columns of the same layout."""
    return b"".join(array.tobytes() for array in _arrays(columns))


def layout_of(columns: Mapping[str, Any]) -> list[Any]:
    """Return what makes columns of the same names and types equal, whatever their numbers are."""
    return [
        (name, layout_of(column) if isinstance(column, dict) else column.dtype)
        for name, column in columns.items()
    ]


def with_numbers(columns: Mapping[str, Any], numbers: bytes) -> dict[str, Any]:
    """Return columns with the layout of others and with the numbers of `numbers_of`.

    Raises:
        ValueError: There are more or fewer numbers.
    """
    if sum(array.nbytes for array in _arrays(columns)) != len(numbers):
        raise ValueError(f"{len(numbers)} bytes are not the numbers of {list(columns)}")
    return _filled(columns, numbers, [0])


def _filled(columns: Mapping[str, Any], numbers: bytes, read: list[int]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, column in columns.items():
        if isinstance(column, dict):
            found[name] = _filled(column, numbers, read)
        else:
            found[name] = np.frombuffer(numbers, column.dtype, column.size, read[0])
            read[0] += column.nbytes
    return found


def _arrays(columns: Mapping[str, Any]) -> Iterator[Any]:
    for column in columns.values():
        if isinstance(column, dict):
            yield from _arrays(column)
        else:
            yield column


def rows_of(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the infos that columns were made of."""
    rows = [
        rows_of(column)
        if isinstance(column, dict)
        else column.tolist()
        if column.dtype in _PLAIN
        else list(column)
        for column in columns.values()
    ]
    return [dict(zip(columns, values, strict=True)) for values in zip(*rows, strict=True)]


def joined(shares: Sequence[dict[str, Any]], count: int) -> dict[str, Any] | None:
    """Return columns of several clients as Gymnasium's infos of a vector environment.

    Args:
        shares: The columns of each client.
        count: How many environments they are of, together.

    Returns:
        Each name with its array, shape (count,), and ``_name`` with which environments have it;
        None: the columns are not all alike.
    """
    first = shares[0]
    if any(share.keys() != first.keys() for share in shares):
        return None
    found: dict[str, Any] = {}
    for name, value in first.items():
        parts = [share[name] for share in shares]
        kinds = {None if isinstance(part, dict) else part.dtype for part in parts}
        if len(kinds) > 1:
            return None
        whole = joined(parts, count) if isinstance(value, dict) else np.concatenate(parts)
        if whole is None:
            return None
        found[name], found[f"_{name}"] = whole, np.ones(count, np.bool_)
    return found
