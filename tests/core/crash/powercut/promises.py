"""What must be read back, and what is: the simplest model of a dataset's promises.

Each number that a history stores tells its row, how often the row was updated before, and its place
in the row: whatever is read back can be decoded, and nothing else looks like it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import Dataset, Field, PhysxError
from physx_core.errors import DatasetNotFoundError

VERSIONS = 16
"""How many versions of a row there can be."""

Array = np.ndarray


MOST = 3
"""How many entries of a free axis a row has at most; row r has 1 + r % MOST."""


# Numbers ----------------------------------------------------------------------------------------


def width(of: Field) -> int:
    """Return how many numbers a row of a field has at most."""
    return int(np.prod(of.entry_shape)) * (MOST if of.free_axis else 1)


def encode(of: Field, rows: Array, version: int) -> Array:
    """Return the values of rows in one version, shape (rows, *field shape)."""
    most = width(of)
    token = (np.asarray(rows, np.int64) * VERSIONS + version)[:, None] * most
    if of.free_axis:
        values = (token + np.arange(most)).astype(of.dtype).reshape(-1, MOST, *of.entry_shape)
        cut = (each[: 1 + row % MOST] for each, row in zip(values, rows, strict=True))
        return np.fromiter(cut, object, len(rows))
    return (token + np.arange(most)).astype(of.dtype).reshape(len(rows), *of.shape)


@dataclass(frozen=True)
class Decoded:
    """What values say of themselves.

    Attributes:
        rows: The row of each, shape (rows,).
        versions: The version of each number, shape (rows, width).
    """

    rows: Array
    versions: Array


def decode(of: Field, values: Array) -> Decoded | str:
    """Return what values say, or what is wrong with them."""
    if of.free_axis:
        return _decode_free(of, values)
    width = int(np.prod(of.shape))
    given = values.reshape(len(values), width)
    with np.errstate(invalid="ignore"):
        whole = given.astype(np.int64)
    numbers, places = np.divmod(whole, max(1, width))
    rows, versions = np.divmod(numbers, VERSIONS)
    fine = (whole == given) & (places == np.arange(width)) & (rows == rows[:, :1]) & (rows > 0)
    if not fine.all():
        bad = int(np.flatnonzero(~fine.all(axis=1))[0])
        return f"row {bad} of {len(values)} was never written: {values[bad].ravel()[:6]}"
    return Decoded(rows[:, 0] if width else rows.reshape(-1), versions.astype(np.int8))


def _decode_free(of: Field, values: Array) -> Decoded | str:
    """Return what values of a free axis say; the versions of missing numbers are the first's."""
    most = width(of)
    rows, versions = np.zeros(len(values), np.int64), np.zeros((len(values), most), np.int8)
    for place, value in enumerate(values):
        given = value.ravel()
        with np.errstate(invalid="ignore"):
            whole = given.astype(np.int64)
        numbers, places = np.divmod(whole, most)
        found, version = np.divmod(numbers, VERSIONS)
        fine = len(given) and found[0] > 0 and (whole == given).all() and (found == found[0]).all()
        if not (
            fine
            and np.array_equal(places, np.arange(len(given)))
            and value.shape == (1 + found[0] % MOST, *of.entry_shape)
        ):
            return f"row {place} of {len(values)} was never written: {given[:6]}"
        rows[place], versions[place] = found[0], version[0]
        versions[place, : len(given)] = version
    return Decoded(rows, versions)


# What is read -----------------------------------------------------------------------------------


@dataclass
class Seen:
    """What a dataset gives out.

    Attributes:
        error: Why it cannot be read; empty if it can.
        missing: Whether there is no dataset at all.
        info: Its info.
        fields: Mode to its fields.
        values: Mode to field's name to values.
        decoded: Mode to what its values say, by field; or what is wrong.
        wrong: What is wrong with any value; empty if nothing is.
    """

    error: str = ""
    missing: bool = False
    info: dict[str, Any] = field(default_factory=dict)
    fields: dict[str, dict[str, Field]] = field(default_factory=dict)
    values: dict[str, dict[str, Array]] = field(default_factory=dict)
    decoded: dict[str, dict[str, Decoded]] = field(default_factory=dict)
    wrong: str = ""

    def rows(self, mode: str) -> Array:
        """Return the rows of a mode, in order."""
        for found in self.decoded.get(mode, {}).values():
            return found.rows
        return np.zeros(0, np.int64)

    def difference(self, other: Seen) -> str:
        """Return how another look at the same dataset differs; empty if it does not."""
        if self.error or other.error:
            return f"{self.error or 'it could be read'}; then: {other.error or 'it can be read'}"
        for mode in self.values.keys() | other.values.keys():
            mine, others = self.values.get(mode, {}), other.values.get(mode, {})
            for name in mine.keys() | others.keys():
                one, two = mine.get(name), others.get(name)
                if one is None or two is None or not _equal(one, two):
                    lengths = [None if part is None else len(part) for part in (one, two)]
                    return f"{mode}/{name} was read otherwise before: {lengths} rows"
        return ""


def _equal(one: Array, two: Array) -> bool:
    """Return whether rows are equal."""
    if one.dtype != object:
        return bool(np.array_equal(one, two))
    return len(one) == len(two) and all(map(np.array_equal, one, two))


def look(folder: Path) -> Seen:
    """Open a dataset for reading and read everything."""
    try:
        with Dataset.open(folder) as dataset:
            return read(dataset)
    except DatasetNotFoundError as error:
        return Seen(error=str(error), missing=True)
    except PhysxError as error:
        return Seen(error=str(error))
    except Exception as error:
        return Seen(error=f"raw {type(error).__name__}: {error}")


def read(dataset: Dataset) -> Seen:
    """Read everything of an open dataset, and decode it."""
    seen = Seen(info=dataset.info)
    for mode in dataset.modes:
        seen.fields[mode] = dataset.fields(mode)
        view = dataset[mode]
        total = dataset.num_samples(mode)
        seen.values[mode], seen.decoded[mode] = {}, {}
        for name, of in seen.fields[mode].items():
            if of.shape is None:
                continue
            values = seen.values[mode][name] = view[name][:]
            if len(values) != total:
                seen.wrong = f"{mode}/{name} has {len(values)} rows, not {total}"
            if 0 in of.shape:
                continue
            found = decode(of, values)
            if isinstance(found, str):
                seen.wrong = f"{mode}/{name}: {found}"
            else:
                seen.decoded[mode][name] = found
    return seen


# What is promised -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stream:
    """Rows that are read in the order in which one writer wrote them, without a gap.

    Attributes:
        rows: All that may be there, shape (rows,).
        kept: How many of them survive a power cut.
        stored: How many of them survive the process.
    """

    rows: Array
    kept: int
    stored: int


@dataclass(frozen=True)
class ModePromise:
    """What must be there of a mode.

    Attributes:
        fields: Its fields.
        streams: Its rows, by writer.
        certain: Whether the mode must be there, even without rows.
    """

    fields: tuple[Field, ...]
    streams: tuple[Stream, ...]
    certain: bool


@dataclass(frozen=True)
class World:
    """One of the things that may be there while a call is at work that does all or nothing.

    Attributes:
        modes: What must be there by mode.
        info: The info.
    """

    modes: Mapping[str, ModePromise]
    info: Mapping[str, Any]


@dataclass(frozen=True)
class Versions:
    """Versions that the numbers of a field may have, shape (rows, width); others have the first.

    Attributes:
        kept: The least ones after a power cut.
        stored: The least ones after the end of the process.
        newest: The largest ones.
    """

    kept: Array
    stored: Array
    newest: Array


@dataclass(frozen=True)
class Promise:
    """What must be there at one moment.

    Attributes:
        worlds: What may be there.
        versions: Versions by mode and field.
        made: Whether the dataset must be there.
        call: The call at work, for messages.
    """

    worlds: tuple[World, ...]
    versions: Mapping[tuple[str, str], Versions]
    made: bool
    call: str

    def broken(self, seen: Seen, *, power: bool) -> str:
        """Return how something seen breaks the promise; empty if it does not.

        Args:
            seen: What a dataset gives out.
            power: Whether the power was cut; otherwise only the process ended.
        """
        if not self.made and seen.missing:
            return ""
        if seen.error:
            return f"it cannot be read: {seen.error}"
        if seen.wrong:
            return seen.wrong
        for mode, fields in seen.decoded.items():
            problem = self._torn(mode, fields, power)
            if problem:
                return problem
        problems = [_differs(world, seen, power) for world in self.worlds]
        return "" if "" in problems else "; or ".join(dict.fromkeys(problems))

    def _torn(self, mode: str, fields: Mapping[str, Decoded], power: bool) -> str:
        """Return whether fields have other rows than others, or versions that cannot be."""
        rows = None
        for name, found in fields.items():
            if rows is not None and not np.array_equal(rows, found.rows):
                return f"{mode}/{name} has other rows than the fields before it"
            rows = found.rows
            limits = self.versions.get((mode, name))
            if limits is None:
                if found.versions.any():
                    return f"{mode}/{name} has versions that were never written"
                continue
            least = limits.kept if power else limits.stored
            known = rows < len(least)
            now, places = found.versions[known], rows[known]
            old = (now < least[places]).any(axis=1)
            if old.any():
                where = int(np.flatnonzero(old)[0])
                return (
                    f"{mode}/{name}: the update of row {places[where]} is lost: "
                    f"{now[where][:4]} < {least[places][where][:4]}"
                )
            if (now > limits.newest[places]).any() or found.versions[~known].any():
                return f"{mode}/{name} has versions that were never written"
        return ""


def _differs(world: World, seen: Seen, power: bool) -> str:
    """Return how what is seen differs from what may be there; empty if it does not."""
    if seen.info != dict(world.info):
        return f"its info is {seen.info}, not {dict(world.info)}"
    for name in seen.fields.keys() - world.modes.keys():
        return f"there is a mode {name}"
    for name, mode in world.modes.items():
        if name not in seen.fields:
            needed = any(s.kept if power else s.stored for s in mode.streams)
            if mode.certain or needed:
                return f"mode {name} is gone"
            continue
        problem = _other_fields(mode, seen.fields[name]) or _other_rows(
            mode.streams, seen.rows(name), power
        )
        if problem:
            return f"mode {name}: {problem}"
    return ""


def _other_fields(mode: ModePromise, found: Mapping[str, Field]) -> str:
    wanted = {of.name: of for of in mode.fields}
    shaped = {n: replace(of, shape=wanted[n].shape) for n, of in found.items() if n in wanted}
    if shaped != wanted or len(found) != len(wanted):
        return f"its fields are {list(found.values())}, not {list(wanted.values())}"
    return ""


def _other_rows(streams: Sequence[Stream], rows: Array, power: bool) -> str:
    """Return how rows differ from what the writers wrote; empty if they do not."""
    left = len(rows)
    for stream in streams:
        least = stream.kept if power else stream.stored
        mine = rows
        if len(streams) > 1:
            mine = rows[np.isin(rows, stream.rows)]
        left -= len(mine)
        if len(mine) < least:
            return f"{len(mine)} rows are there, but {least} were promised"
        if len(mine) > len(stream.rows) or not np.array_equal(mine, stream.rows[: len(mine)]):
            return f"its {len(mine)} rows are not the first ones of {len(stream.rows)}"
    return "" if not left else f"{left} rows are from elsewhere"
