"""Which rows an edited dataset has, with the fields that are derived from them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from physx_core.dataset import (
    EPISODES,
    Dataset,
    Trajectories,
    find_trajectories,
    rows_per_block,
)
from physx_core.errors import ConfigError, DatasetError, listed, nearest
from physx_core.fields import NUMBERS, RESERVED, Field, free_axes
from physx_core.plugins import import_component
from physx_core.typing import Array, Batch, Index
from physx_core.views import Batches, Part, View
from physx_formats.errors import ExchangeError
from physx_formats.table import BLOCK, Advance
from physx_formats.transfer.episodes import EpisodeCopier, copy_stream

Function: TypeAlias = "str | Callable[[Mapping[str, Array]], Any]"
"""Computes something of the fields of a trajectory: itself, or a reference."""


class EditedMode:
    """The rows of one mode.

    Attributes:
        fields: Its fields, with those that are derived.
        count: Number of its rows.
    """

    def __init__(self, source: Dataset, name: str, folder: Path) -> None:
        self._source, self._name, self._folder = source, name, folder
        self._rows = source.rows(name)
        self.fields, self.count = dict(self._rows.fields), self._rows.count
        self._derived: dict[str, Array] = {}

    @cached_property
    def _trajectories(self) -> Trajectories | None:
        """Those that its rows belong to; None if none are known, or if each has one row."""
        try:
            found = find_trajectories(self._rows)
        except DatasetError:
            return None
        return found if (found.rows > 1).any() else None

    def derive(self, given: Function) -> None:
        """Compute further fields, into files."""
        function, what = _function(given)
        derived: dict[str, Array] = {}
        fields = dict(self.fields)
        for numbers in self._pieces():
            found = function(_Columns(self, numbers))
            if not isinstance(found, Mapping) or not found:
                raise ExchangeError(f"{what} returned {found!r:.80}, not arrays by field name.")
            for name, given in found.items():
                known = fields.get(name)
                is_free = known.free_axis if known is not None else free_axes(fields.values())
                values = _as_rows(given) if is_free else np.asarray(given)
                if name not in derived:
                    fields[name], derived[name] = self._begin(name, values, numbers)
                field = fields[name]
                if values.shape != (len(numbers), *field.row_kind[0]):
                    raise ExchangeError(
                        f'{what} returned "{name}" of shape {values.shape} for {len(numbers)} '
                        f"rows of {field.shape}."
                    )
                derived[name][numbers] = field.convert(values, axes=1)
            if derived.keys() - found.keys():
                lacks = min(derived.keys() - found.keys())
                raise ExchangeError(f'{what} did not return "{lacks}" for each trajectory.')
        self._derived, self.fields = derived, fields

    def _begin(self, name: str, values: Array, numbers: Index) -> tuple[Field, Array]:
        """Return a derived field, and room for its values, given those of some rows."""
        known = self.fields.get(name)
        if values.dtype.hasobject and name not in RESERVED:
            if known is None:
                shape = self._axis(name, values, numbers), *values[0].shape[1:]
                known = Field(name, shape, values[0].dtype)
            return known, np.empty(self.count, object)
        if values.dtype.kind == "U" and known is None:
            raise ExchangeError(
                f'"{name}" is text: derive it with its largest number of bytes, as '
                'np.char.encode(..., "utf-8").astype("S16").'
            )
        is_text = values.dtype.kind in "US"
        if name in RESERVED or not (values.dtype.kind in NUMBERS or is_text) or not values.ndim:
            raise ExchangeError(f'"{name}" of {values.dtype} cannot be derived as a field.')
        field = known or Field(name, values.shape[1:], values.dtype)
        place, shape = self._folder / f"{self._name}.{name}", (self.count, *values.shape[1:])
        kind = field.numpy_dtype
        if not all(shape):
            return field, np.zeros(shape, kind)
        return field, np.memmap(place, kind, "w+", shape=shape)

    def _axis(self, name: str, values: Array, numbers: Index) -> str:
        """Return the free axis that has the sizes of the values of some rows."""
        sizes = [np.shape(each)[:1] for each in values]
        axes = free_axes(self.fields.values())
        for axis, (first, *_) in axes.items():
            if [(len(each),) for each in self.read(first, numbers)] == sizes:
                return axis
        raise ExchangeError(
            f'"{name}" has an array of another size for each row, and these are the sizes of no '
            f"free axis: there are {listed(axes) or 'none'}."
        )

    def choose(
        self, view: View, part: Part, rows: Function | None, dropped: Collection[int]
    ) -> Index:
        """Return the numbers of the rows that are kept, ascending: see `edit`."""
        numbers = self._of_view(view, part)
        if rows is not None:
            numbers = self._filter(*_function(rows), numbers)
        return self._without(numbers, dropped)

    def _of_view(self, view: View, part: Part) -> Index:
        """Return the numbers of the rows that a view has, ascending."""
        if view.stride > 1 and "step" in self.fields:
            self._number_steps(view.stride)
        stored = replace(view, order="stored")
        with Batches(stored, 2**16, data=self._source, mode=self._name, part=part) as batches:
            parts = [batches.rows(number)[0] for number in range(len(batches))]
        return np.sort(np.concatenate(parts)) if parts else np.zeros(0, np.intp)

    def _number_steps(self, stride: int) -> None:
        """Count the steps of each trajectory in its rows that are kept: a gap would end it."""
        if self._trajectories is None:
            return
        steps = self._rows.gather("step", np.arange(self.count))
        for numbers in self._pieces():
            steps[numbers] = steps[numbers[0]] + np.arange(len(numbers)) // stride
        self._derived["step"] = steps

    def _filter(
        self, function: Callable[[Mapping[str, Array]], Any], what: str, numbers: Index
    ) -> Index:
        """Return those of some rows that a function keeps."""
        keeps, chosen = np.zeros(self.count, bool), np.zeros(self.count, bool)
        chosen[numbers] = True
        gaps = 0
        for some in self._pieces():
            found = np.asarray(function(_Columns(self, some)))
            if found.dtype != bool or found.shape != some.shape:
                raise ExchangeError(
                    f"{what} returned {found.dtype} of shape {found.shape} for {len(some)} rows, "
                    "not one boolean for each."
                )
            keeps[some] = found
            kept = np.flatnonzero(found[chosen[some]])
            gaps += len(kept) > 0 and int(kept[-1] - kept[0] + 1 > len(kept))
        if gaps and self._trajectories is not None and "step" not in self.fields:
            warnings.warn(
                f'{gaps} of {len(self._trajectories.rows)} trajectories of mode "{self._name}" '
                "now have gaps: windows take the rows on both sides of one as consecutive.",
                stacklevel=5,
            )
        return numbers[keeps[numbers]]

    def _without(self, numbers: Index, episodes: Collection[int]) -> Index:
        """Return those of some rows that do not belong to some episodes."""
        if not episodes:
            return numbers
        known = self._source.recorded_episodes(self._name)
        if known is None:
            raise ConfigError(
                f'The rows of mode "{self._name}" are not recorded as independent episodes, so '
                "there are none to drop."
            )
        entry = (known.first + known.rows).searchsorted(numbers, "right")
        inside = np.where(known.numbers[entry] > 1, numbers - known.first[entry], 0)
        return numbers[~np.isin(known.episode[entry] + inside, sorted(episodes))]

    def _pieces(self) -> Iterator[Index]:
        """Yield the numbers of the rows that functions get at once."""
        found = self._trajectories
        if found is not None:
            for start, count in zip(found.start, found.rows, strict=True):
                places = np.arange(start, start + count)
                yield places if found.places is None else found.places[places]
            return
        step = rows_per_block(sum(field.nbytes for field in self.fields.values()), BLOCK)
        for start in range(0, self.count, step):
            yield np.arange(start, min(start + step, self.count))

    def read(self, name: str, numbers: Index) -> Array:
        """Return a field of some rows."""
        if name in self._derived:
            return np.asarray(self._derived[name][numbers])
        return self._rows.gather(name, numbers)

    def copy(
        self,
        target: Dataset,
        fields: Mapping[str, Field],
        numbers: Index,
        advance: Advance,
        lost: Collection[int] | None,
    ) -> int:
        """Store some rows with their records, and return their number.

        Args:
            target: Receives them.
            fields: The new fields by their old names.
            numbers: The rows, ascending.
            advance: Called with the number of bytes stored.
            lost: Numbers of episodes of which no record is kept, not even that they have failed;
                None: only those with rows have one.
        """
        if not len(numbers):
            raise DatasetError(f'Nothing would be left of mode "{self._name}".')
        columns: Any = {
            field.name: _Column(self, name, field, numbers) for name, field in fields.items()
        }
        own = {field.name: field for field in fields.values()}
        if self._source.recorded_episodes(self._name) is None:
            return copy_stream(target, self._name, own, columns, advance)
        table = self._source.fields(EPISODES)
        reasons = {failed[1:3]: failed[3] for failed in self._source.failed_episodes(self._name)}
        records = _records_of(self._source.episode_table([self._name]), numbers, lost)
        copier = EpisodeCopier(target, self._name, own, columns, table, advance, reasons)
        return copier.copy(records)


class _Columns(Mapping[str, Array]):
    """The fields of some rows, read when they are used."""

    def __init__(self, mode: EditedMode, numbers: Index) -> None:
        self._mode, self._numbers = mode, numbers

    def __getitem__(self, name: str) -> Array:
        if name not in self._mode.fields:
            hint = nearest(name, self._mode.fields)
            raise ConfigError(f'There is no field "{name}": {listed(self._mode.fields)}.{hint}')
        return self._mode.read(name, self._numbers)

    def __iter__(self) -> Iterator[str]:
        return iter(self._mode.fields)

    def __len__(self) -> int:
        return len(self._mode.fields)


class _Column:
    """The rows of one field that are copied."""

    unit = problem = ""

    def __init__(self, mode: EditedMode, name: str, field: Field, numbers: Index) -> None:
        self._mode, self._name, self._field, self._numbers = mode, name, field, numbers
        self.shape, self.dtype = (len(numbers), *(field.shape or ())), field.numpy_dtype

    def read(self, start: int, count: int) -> Array:
        """Return the next `count` rows, which begin at `start`."""
        values = self._mode.read(self._name, self._numbers[start : start + count])
        return self._field.convert(values, axes=1)


def _as_rows(given: Any) -> Array:
    """Return values as an array; a list of arrays as an array of objects, as of free axes."""
    if isinstance(given, list) and any(np.ndim(each) for each in given):
        return np.fromiter(map(np.asarray, given), object, len(given))
    return np.asarray(given)


def _records_of(table: Batch, numbers: Index, lost: Collection[int] | None) -> Batch:
    """Return the records of the episodes of some rows, with as many rows as these.

    Args:
        table: All records, in order.
        numbers: The rows, ascending.
        lost: See `EditedMode.copy`.
    """
    ends = np.cumsum(table["rows"])
    entry = ends.searchsorted(numbers, "right")
    left = np.bincount(entry, minlength=len(ends))
    stays = np.zeros(len(ends), bool) if lost is None else ~np.isin(table["episode"], sorted(lost))
    whole = np.where(table["rows"] == 0, stays, left > 0)
    cut = (table["count"] > 1) & whole & (left < table["rows"])
    kept = np.flatnonzero(whole & ~cut)
    found = [(kept, table["episode"][kept], table["count"][kept], left[kept])]
    for place in np.flatnonzero(cut):  # of a range, runs of consecutive numbers
        inside = numbers[entry == place] - (ends[place] - table["rows"][place])
        begins = np.flatnonzero(np.diff(inside, prepend=-2) != 1)
        sizes = np.diff(begins, append=len(inside))
        runs = table["episode"][place] + inside[begins]
        found.append((np.full(len(begins), place), runs, sizes, sizes))
    places, episode, count, rows = map(np.concatenate, zip(*found, strict=True))
    order = np.lexsort((episode, places))
    records = {name: column[places[order]] for name, column in table.items()}
    changed = {"episode": episode[order], "count": count[order], "rows": rows[order]}
    return records | changed | {"first_row": np.cumsum(rows[order]) - rows[order]}


def _function(given: Function) -> tuple[Callable[[Mapping[str, Array]], Any], str]:
    """Return a function, and its name."""
    if isinstance(given, str):
        return import_component("function", given), given
    return given, name_of(given)


def name_of(given: Function) -> str:
    """Return a function's name, which is the same in each process."""
    if isinstance(given, str):
        return given
    return f"{given.__module__}:{getattr(given, '__qualname__', type(given).__qualname__)}"
