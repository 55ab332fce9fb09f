"""Copies a dataset with other rows, other fields, or fields of other names and types."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike

from physx_core.dataset import (
    EPISODES,
    TABLE_FIELDS,
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
from physx_formats.table import BLOCK, Advance, check_new
from physx_formats.transfer.episodes import EpisodeCopier, copy_stream

Function: TypeAlias = "str | Callable[[Mapping[str, Array]], Any]"
_ALL = View(hold_back=False)


def edit(
    directory: str | Path,
    out: str | Path,
    *,
    modes: Sequence[str] = (),
    view: View = _ALL,
    part: Part = "all",
    drop_episodes: Collection[int] = (),
    rows: Function | None = None,
    derive: Function | None = None,
    keep: Collection[str] = (),
    drop: Collection[str] = (),
    cast: Mapping[str, DTypeLike] | None = None,
    units: Mapping[str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    advance: Advance = lambda nbytes: None,
) -> dict[str, int]:
    """Write a dataset that has the rows and fields of another one as they should be.

    What is not named stays as it is, bit by bit: values, units, numbers, parameters and records of
    episodes, so that folds stay the same, too. The new dataset's `info` says what it was made from.

    The functions get the rows of one trajectory in temporal order, as a mapping from field names to
    arrays of shape (rows, *field shape), which are read when they are used; of episodes of one row,
    and of data that record no trajectories, as many at once as fit into a few megabytes. Names are
    those before `rename`.

    Args:
        directory: The folder of the dataset, or of the session that holds it.
        out: The new folder.
        modes: Names of the modes; empty: all that have rows.
        view: Chooses episodes, and every `View.stride`-th row of each trajectory. It has neither
            windows nor weights nor sources.
        part: Which part of the view: ``training``, ``validation``, ``test``, or ``all``.
        drop_episodes: Numbers of independent episodes to leave out.
        rows: Returns which rows to keep, booleans of shape (rows,). A reference
            ``"module:function"`` or ``"script.py:function"``, or the function itself.
        derive: Returns further fields, or new values of fields, by name: arrays of shape
            (rows, *field shape), or for a free axis a list of arrays, one for each row. Likewise.
        keep: The fields to keep; empty: all.
        drop: The fields to leave out.
        cast: New types of fields. Values are rounded as when they are stored: see `Field.convert`.
        units: New units of fields.
        rename: New names of fields.
        advance: Called with the number of bytes stored.

    Returns:
        Number of rows of each mode.

    Raises:
        ConfigError: If there is no such field, or the changes contradict one another.
        ExchangeError: If `out` exists, or a function returns something else.
        DatasetError: If the dataset is missing or damaged, nothing is left of a mode, or the disk
            is full. Nothing is left behind then.
        SampleError: If values do not fit the types.
    """
    out = Path(out)
    check_new(out)
    if view.windows or view.weights or view.sources:
        raise ConfigError("Only what a View says of episodes, stride and folds chooses rows.")
    with (
        Dataset.open(directory) as source,
        tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=".edit-") as folder,
    ):
        names = list(modes or (name for name in source.modes if source.num_samples(name)))
        names = [name for name in names if name != EPISODES or not source.has_episodes]
        fields = _Fields(keep, drop, cast or {}, units or {}, rename or {})
        origin = {"dataset": Path(directory).resolve().name, "digest": _digest(source, names)}
        said = _said(modes, view, part, drop_episodes, rows, derive) | fields.said()
        done, draft = {}, Path(folder) / "dataset"
        with Dataset.create(draft, session="edit") as target:
            history = source.info.get("edits", [])
            target.update_info(**{**source.info, "edits": [*history, origin | said]})
            _define_episodes(target, source)
            for name in names:
                edited = _Mode(source, name, Path(folder))
                if derive is not None:
                    edited.derive(*_function(derive))
                numbers = edited.choose(view, part, rows, drop_episodes)
                chooses = part != "all" or bool(view.episodes or view.where)
                failed = None if chooses else drop_episodes
                done[name] = edited.copy(target, fields.of(edited.fields), numbers, advance, failed)
        fields.check_used()
        draft.rename(out)
    return done


def _define_episodes(target: Dataset, source: Dataset) -> None:
    """Define what is recorded of episodes as in another dataset, if it has any."""
    if not source.has_episodes:
        return
    own = {field.name for field in TABLE_FIELDS}
    known = [field for name, field in source.fields(EPISODES).items() if name not in own]
    target.define_episodes(
        [field for field in known if field.role != "episode"],
        [field for field in known if field.role == "episode"],
    )


class _Fields:
    """Which fields there will be."""

    def __init__(
        self,
        keep: Collection[str],
        drop: Collection[str],
        cast: Mapping[str, DTypeLike],
        units: Mapping[str, str],
        rename: Mapping[str, str],
    ) -> None:
        self._keep, self._drop, self._cast = set(keep), set(drop), cast
        self._units, self._rename = units, rename
        self._named = {*keep, *drop, *cast, *units, *rename}
        self._seen: set[str] = set()
        taken = [name for name in RESERVED if name in {*drop, *cast, *units, *rename}]
        if taken:
            raise ConfigError(f'"{taken[0]}" says which trajectory a row belongs to: it must stay.')
        if self._keep & self._drop:
            raise ConfigError(f'"{min(self._keep & self._drop)}" is to be kept and dropped.')

    def said(self) -> dict[str, Any]:
        """Return the changes as plain data."""
        cast = {name: np.dtype(kind).str for name, kind in self._cast.items()}
        found = {"keep": sorted(self._keep), "drop": sorted(self._drop), "cast": cast}
        found |= {"units": dict(self._units), "rename": dict(self._rename)}
        return {name: value for name, value in found.items() if value}

    def of(self, fields: Mapping[str, Field]) -> dict[str, Field]:
        """Return the new fields of a mode, by their old names."""
        self._seen |= fields.keys()
        chosen = {
            name: field
            for name, field in fields.items()
            if name in RESERVED
            or ((not self._keep or name in self._keep) and name not in self._drop)
        }
        if not chosen.keys() - set(RESERVED):
            raise ConfigError(f"No field would be left of {listed(fields)}.")
        found = {
            name: replace(
                field,
                name=self._rename.get(name, name),
                dtype=self._cast.get(name, field.dtype),
                unit=self._units.get(name, field.unit),
                like=self._rename.get(field.like, field.like) if field.like in chosen else "",
            )
            for name, field in chosen.items()
        }
        names = [field.name for field in found.values()]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ConfigError(f'Two fields would be called "{min(twice)}".')
        return found

    def check_used(self) -> None:
        """Check that all fields that are named were found."""
        for name in sorted(self._named - self._seen):
            hint = nearest(name, sorted(self._seen))
            raise ConfigError(f'There is no field "{name}": {listed(sorted(self._seen))}.{hint}')


class _Mode:
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

    def derive(self, function: Callable[[Mapping[str, Array]], Any], what: str) -> None:
        """Compute further fields, into files."""
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
                stacklevel=3,
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

    def __init__(self, mode: _Mode, numbers: Index) -> None:
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

    def __init__(self, mode: _Mode, name: str, field: Field, numbers: Index) -> None:
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
        lost: See `_Mode.copy`.
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
    return given, _name_of(given)


def _name_of(given: Function) -> str:
    """Return a function's name, which is the same in each process."""
    if isinstance(given, str):
        return given
    return f"{given.__module__}:{getattr(given, '__qualname__', type(given).__qualname__)}"


def _said(
    modes: Sequence[str],
    view: View,
    part: Part,
    drop_episodes: Iterable[int],
    rows: Function | None,
    derive: Function | None,
) -> dict[str, Any]:
    """Return what chooses rows, and what computes fields, as plain data."""
    found: dict[str, Any] = {"modes": list(modes)} if modes else {}
    for name in ("episodes", "where", "stride"):
        if getattr(view, name) != getattr(_ALL, name):
            found[name] = getattr(view, name)
    if part != "all":
        folds = ("folds", "fold", "test_fold", "fold_seed")
        found |= {"part": part} | {name: getattr(view, name) for name in folds}
    if drop_episodes:
        found["drop_episodes"] = sorted(drop_episodes)
    functions = {"rows": rows, "derive": derive}
    return found | {name: _name_of(given) for name, given in functions.items() if given is not None}


def _digest(source: Dataset, modes: Sequence[str]) -> str:
    """Return a digest of what a dataset has in some modes, from its manifest alone."""
    known = [(mode, source.contents(mode)) for mode in modes]
    return blake2b(repr(known).encode(), digest_size=8).hexdigest()
