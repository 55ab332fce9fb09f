"""Batches: a view bound to data, a batch size and a seed; any batch can be had by its number."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from physx_core.closeable import Closeable
from physx_core.config import to_plain
from physx_core.dataset import Dataset, Snapshot
from physx_core.dataset.read.batch_arrays import BatchArrays
from physx_core.dataset.read.epochs import Epoch
from physx_core.dataset.read.mode_statistics import compute_of
from physx_core.dataset.read.shuffling import ItemOrder, key_of
from physx_core.dataset.store.definitions import compare_fields
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.errors import ConfigError, DatasetError, UsageError
from physx_core.fields import Field, free_axes
from physx_core.normalization import Measured, Normalization, Normalize, compute_normalization
from physx_core.packing import Scratch, join, pack, packed_fields
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array, Batch, Index
from physx_core.views.folds import Part
from physx_core.views.items import Located
from physx_core.views.options import ViewOptions, Window
from physx_core.views.sources import Source, window_of

_SHARES = 1000
_AHEAD = 4096
PAD = "_is_pad"
"""What is added to the name of a window for that of the field that marks its repeated values."""


class Batches(Closeable):
    """Batches in physical units; batch `number` depends on view, snapshot, size, seed and part.

    It does not depend on free memory, on the other fields that are read, on other processes, or on
    rows that are added later. ``batches[number]`` is a batch, ``len(batches)`` the number of
    batches of an epoch; the numbers of later epochs, in other orders, follow. So
    ``torch.utils.data.DataLoader(batches, batch_size=None)`` reads an epoch, with any number of
    workers: each opens the files for itself.

    Attributes:
        view: The view.
        batch_size: Number of items in a batch; the last of an epoch may have fewer.
        seed: Seed of the orders.
        part: Which part of the view.
        mode: Mode of the rows.
        snapshot: The rows of each source when the batches were opened, by its folder as the view
            names it; "" if it names none.
        num_items: Number of items in an epoch.
    """

    def __init__(
        self,
        view: ViewOptions,
        batch_size: int,
        seed: int = 0,
        *,
        data: Dataset | str | Path | None = None,
        mode: str = "training",
        part: Part = "training",
        snapshot: Mapping[str, Sequence[int]] | None = None,
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
        reuse: bool = False,
        beside: Batches | None = None,
    ) -> None:
        """Open the data.

        Args:
            view: The view.
            batch_size: Number of items in a batch.
            seed: Seed of the orders.
            data: The dataset, or its folder, if the view names no sources.
            mode: Mode of the rows.
            part: ``training``, ``validation``, ``test``, or ``all`` of them.
            snapshot: The `snapshot` of other batches: only those rows exist; None: all do.
            fields: Names of windows or stored fields to read; None: the windows, or without any
                all stored fields.
            dtype: Type to convert floating-point fields to; None: no conversion.
            reuse: Whether every batch is in the same arrays, which is faster where a batch is
                needed no longer than until the next.
            beside: Batches of another part of the same rows, divided alike: their trajectories,
                which may take a pass over the rows, are not sought again.

        Raises:
            ConfigError: If there is nothing to read, or the view does not fit the data.
            DatasetError: If there is no dataset, mode or field, or rows are missing.
        """
        if batch_size < 1:
            raise ConfigError(f"batch_size is {batch_size} but must be at least 1.")
        if view.sources and data is not None:
            raise ConfigError("The data are given twice: leave out View.sources, or `data`.")
        if not view.sources and data is None:
            raise ConfigError("View.sources names no data: add a folder with its share.")
        self.view, self.batch_size, self.seed = view, batch_size, seed
        self.part, self.mode = part, mode
        self._opened = contextlib.ExitStack()
        given = {None: 1.0} if data is not None else view.sources
        others = beside._sources if beside is not None else [None] * len(given)
        self._sources: list[Source] = [
            self._open(name, data, snapshot, other)
            for name, other in zip(given, others, strict=True)
        ]
        self.snapshot = {
            name or "": source.rows.snapshot
            for name, source in zip(given, self._sources, strict=True)
        }
        self.num_items = self._count(np.array(list(given.values())))
        self._num_batches = self._divide()
        self._choose(fields, dtype, reuse=reuse)
        self._is_plain = len(self._sources) == 1 and not (view.windows or view.weights)
        self._epoch: tuple[int, Epoch] | None = None
        self._process = os.getpid()
        self._passes: dict[tuple[int, int, int], tuple[ItemOrder, int]] = {}
        self._ahead = 0, 0, 0, Located(np.zeros(0, np.intp), None)

    def _open(
        self,
        name: str | None,
        data: Dataset | str | Path | None,
        snapshot: Mapping[str, Sequence[int]] | None,
        beside: Source | None,
    ) -> Source:
        dataset = data
        if not isinstance(dataset, Dataset):
            dataset = self._opened.enter_context(Dataset.open(name or str(dataset)))
        known: Snapshot | None = None
        if snapshot is not None:
            if (name or "") not in snapshot:
                folder = dataset.directory
                raise ConfigError(f"The snapshot has no rows of the source {name or folder}.")
            known = Snapshot(*snapshot[name or ""])
        return Source(self.view, dataset, self.mode, self.part, known, beside)

    def _count(self, shares: Array) -> int:
        """Return the number of items of an epoch, and find out which source has which of them."""
        counts = np.array([source.count for source in self._sources])
        exact = shares / shares.sum() * _SHARES
        each = np.floor(exact).astype(int)
        each[np.argsort(each - exact)[: _SHARES - each.sum()]] += 1
        if not each.all():
            raise ConfigError(f"View.sources: a share is less than 1 in {_SHARES}.")
        places = np.concatenate([(np.arange(count) + 0.5) / count for count in each])
        of = np.repeat(np.arange(len(each)), each)[np.argsort(places, kind="stable")]
        self._source_of, self._shares = of, each
        self._before = np.array([np.cumsum(of == k) - (of == k) for k in range(len(each))])
        if not counts.all() and self.part not in ("validation", "test"):
            empty = self._sources[int(np.argmin(counts))]
            raise DatasetError(
                f'There is nothing to read for the part "{self.part}" in '
                f'{empty.dataset.directory}: mode "{self.mode}" has {empty.rows.count} rows in '
                f"{empty.trajectories[1]} trajectories, of which the view takes "
                f"{empty.trajectories[0]}, and no window fits into one."
            )
        if len(counts) == 1 or not counts.all():
            return int(counts.min())
        if self.view.epoch == "first":
            return int((counts * _SHARES // each).min())
        return int((-(-counts * _SHARES // each)).max())

    def _choose(self, names: Sequence[str] | None, dtype: DTypeLike | None, *, reuse: bool) -> None:
        """Choose what a batch contains."""
        stored = self._sources[0].rows.fields
        several = [window for window in self.view.windows.values() if not window.is_single]
        steps = {axis: len(w.at) for w in several for axis in self._axes_of(w).values()}
        added = packed_fields([*free_axes(stored.values()), *steps], steps)
        wanted = list(names or self.view.windows or stored)
        self._names = [name for name in wanted if name in stored or name not in added]
        self._all_names = None if names is None else list(names)
        self._named = None if names is None else [name for name in names if name in added]
        self._windows = {name: window_of(self.view, name) for name in self._names}
        self._dtype, self._reuse = None if dtype is None else np.dtype(dtype), reuse
        self.fields: dict[str, Field] = {}
        for name in self._names:
            self.fields |= self._described(name)
        self._kinds = {n: field.converted_dtype(self._dtype) for n, field in self.fields.items()}
        kinds = {n: (field.row_kind[0], self._kinds[n]) for n, field in self.fields.items()}
        self._axes = free_axes(self.fields.values())
        self._steps = {
            self.fields[name].free_axis: len(window.at)
            for name, window in self._windows.items()
            if self.fields[name].free_axis and not window.is_single
        }
        self.fields |= packed_fields(self._axes, self._steps)
        self._scratch = Scratch() if self._axes and reuse else None
        self._arrays = BatchArrays({} if self._axes else kinds, self.batch_size, reuse=reuse)

    def reading(self, fields: Sequence[str]) -> Batches:
        """Return the same batches, of other fields; they share the open files."""
        other = object.__new__(type(self))  # `copy` would open the data again, as pickles do
        other.__dict__ |= self.__dict__
        other._choose(fields, self._dtype, reuse=self._reuse)
        other._epoch, other._opened = None, contextlib.ExitStack()
        return other

    def _divide(self) -> int:
        """Return the number of batches of an epoch."""
        whole, rest = divmod(self.num_items, self.batch_size)
        found = whole + (rest > 0 and not self.view.drop_last)
        if self.num_items and not found:
            raise ConfigError(
                f"An epoch has {self.num_items} items, fewer than a batch of {self.batch_size}, "
                "and View.drop_last leaves out what is left."
            )
        return found

    def _described(self, name: str) -> dict[str, Field]:
        """Return the fields of a window or stored field in a batch."""
        window = self._windows[name]
        first = self._sources[0]
        if window.field not in first.rows.fields:
            raise DatasetError(
                f'Mode "{self.mode}" of {first.dataset.directory} has no field "{window.field}".'
            )
        stored = first.rows.fields[window.field]
        for other in self._sources[1:]:
            compare_fields(
                f"The source {other.dataset.directory}",
                {n: f for n, f in other.rows.fields.items() if n == window.field},
                {window.field: stored},
            )
        of_window = () if window.is_single else (len(window.at),)
        like = stored.name if stored.name != name else stored.like
        shape, axes, indexes = stored.shape or (), stored.axes, stored.indexes
        if of_window:
            own = self._axes_of(window)
            indexes = own.get(indexes, indexes)
            if stored.free_axis:
                shape = own[stored.free_axis], *shape[1:]
                axes = (shape[0], *axes[1:]) if axes else ()
            else:
                shape, axes = (*of_window, *shape), (("time", *axes) if axes else ())
        axes = axes if len(set(axes)) == len(axes) else ()
        of = replace(stored, name=name, shape=shape, axes=axes, like=like, indexes=indexes)
        found = {name: of}
        if self.view.edges == "pad" and name in self.view.windows:
            found[name + PAD] = Field(name + PAD, of_window, "bool", role="additional")
        return found

    def _axes_of(self, window: Window) -> dict[str, str]:
        """Return the free axes of the rows of a window, by that of each row.

        Windows with the same offsets share them; they have the name of the first of these.
        """
        stored = self._sources[0].rows.fields
        same = {
            name: stored[other.field].free_axis
            for name, other in self.view.windows.items()
            if other.at == window.at and not other.is_single and other.field in stored
        }
        first = next((name for name, axis in same.items() if axis), "")
        return {axis: f"{first}_{axis}" for axis in same.values() if axis}

    # Batches --------------------------------------------------------------------------------

    def __len__(self) -> int:
        return self._num_batches

    def __getitem__(self, number: int) -> Batch:
        """Return a batch: field name to array of shape (items, *field shape).

        Free axes are packed: see `physx_core.packing.pack`.

        Args:
            number: Its number, from 0; those of each epoch follow those of the one before.

        Raises:
            IndexError: If it is negative, or nothing is in this part.
            DatasetError: If rows cannot be read.
        """
        epoch, start, stop = self._place(number)
        for source in self._sources:
            source.rows.check()
        if self._axes:
            return self._packed(epoch, start, stop)
        if self._is_plain:
            batch = self._arrays.take(stop - start)
            self._begin(epoch).fill(start, batch)
            return batch
        if len(self._sources) == 1:
            return self._values(self._sources[0], self._next(epoch, start, stop))
        batch = self._arrays.take(stop - start)
        for source, (slots, items) in zip(
            self._sources, self._drawn(epoch, start, stop), strict=True
        ):
            where = source.items.locate(items)
            for name, values in self._values(source, where).items() if len(slots) else ():
                batch[name][slots] = values
        return batch

    def _packed(self, epoch: int, start: int, stop: int) -> Batch:
        """Return a batch in which free axes are packed: see `packing.pack`."""
        if len(self._sources) == 1:
            return self._pack(self._sources[0], self._next(epoch, start, stop))
        rows: Batch = {}
        drawn = self._drawn(epoch, start, stop)
        for source, (slots, items) in zip(self._sources, drawn, strict=True):
            where = source.items.locate(items)
            for name, values in self._values(source, where).items() if len(slots) else ():
                empty = np.empty((stop - start, *values.shape[1:]), values.dtype)
                rows.setdefault(name, empty)[slots] = values
        found: Batch = {}
        sizes: dict[str, Index] = {}
        for name, values in rows.items():
            field = self.fields[name]
            if field.free_axis:
                values, counts = join(field, values.ravel().tolist())
                self._check_sizes(name, counts, sizes)
            found[name] = values.astype(self._kinds[name], copy=False)
        return pack(self.fields, found, sizes, self._named, steps=self._steps)

    def _pack(self, source: Source, where: Located) -> Batch:
        """Return some items of a source as a batch in which free axes are packed."""
        fixed = {n: w for n, w in self._windows.items() if not self.fields[n].free_axis}
        found, sizes = self._values(source, where, fixed), dict[str, Index]()
        scratch = self._scratch
        for name, window in self._windows.items():
            if name not in fixed:
                if where.rows is not None and len(window.at) == 1:
                    rows = where.rows + window.at[0]
                else:
                    rows = source.items.rows(where.items, window.at).ravel()
                allocate = np.empty if scratch is None else partial(scratch.take, name)
                found[name], counts = source.rows.entries(window.field, rows, self._dtype, allocate)
                self._check_sizes(name, counts, sizes)
                found |= self._padding(source, where, name)
        found = {name: found[name] for name in self._kinds}
        return pack(self.fields, found, sizes, self._named, scratch, self._steps)

    def _check_sizes(self, name: str, counts: Index, sizes: dict[str, Index]) -> None:
        """Check that fields that share a free axis have the same sizes in a batch."""
        axis = self.fields[name].free_axis
        if sizes.setdefault(axis, counts) is not counts and not np.array_equal(sizes[axis], counts):
            raise DatasetError(
                f'"{name}" has other sizes of the axis "{axis}" than the fields before it: the '
                "rows of its window have others. Read windows only where sizes stay."
            )

    def _place(self, number: int) -> tuple[int, int, int]:
        """Return the epoch of a batch, and its first position there and that after its last."""
        if number < 0 or not self._num_batches:
            raise IndexError(f"There is no batch {number} of {self._num_batches} in an epoch.")
        epoch, place = divmod(int(number), self._num_batches)
        start = place * self.batch_size
        return epoch, start, min(start + self.batch_size, self.num_items)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of the first epoch."""
        return (self[number] for number in range(len(self)))

    def rows(self, number: int) -> list[Index]:
        """Return the reference rows of a batch's items, by source."""
        drawn = self._drawn(*self._place(number))
        return [
            source.items.rows(items)[:, 0]
            for source, (_, items) in zip(self._sources, drawn, strict=True)
        ]

    def groups(self, number: int) -> Index:
        """Return the trajectory of each of a batch's items, as a number, shape (items,).

        It numbers the trajectories, or blocks of rows, of all sources and parts, from 0.
        """
        epoch, start, stop = self._place(number)
        found, before = np.empty(stop - start, np.intp), 0
        drawn = self._drawn(epoch, start, stop)
        for source, (slots, items) in zip(self._sources, drawn, strict=True):
            found[slots] = before + source.groups_of(items)
            before += len(source.groups.found.rows)
        return found

    @property
    def group_nouns(self) -> list[str]:
        """What `groups` are, by source: "episode", "trajectory" or "block"."""
        return [source.groups.noun for source in self._sources]

    @property
    def num_groups(self) -> int:
        """Number of trajectories, or blocks of rows, of all sources and parts."""
        return sum(len(source.groups.found.rows) for source in self._sources)

    def describe_group(self, group: int) -> dict[str, Any]:
        """Return what is known of one of `groups`: its number, rows and parameters."""
        for (name, dataset), source in zip(self.datasets.items(), self._sources, strict=True):
            count = len(source.groups.found.rows)
            if group < count:
                place = {"source": name or str(dataset.directory)} if name else {}
                return place | source.describe_group(group)
            group -= count
        raise IndexError(f"There is no group {group}.")

    def window(self, name: str) -> Window:
        """Return the window of a field; of a stored one, its value at offset 0."""
        return window_of(self.view, name)

    def quantity(self, name: str) -> str:
        """Return the stored field whose quantity a field is: see `Field.like`."""
        stored = self.window(name).field
        known = self._sources[0].rows.fields.get(stored)  # None: of what packing adds
        return stored if known is None else known.like or stored

    @property
    def is_whole(self) -> bool:
        """Whether the parts of the view differ in trajectories, not only in pieces of them."""
        return all(source.is_whole for source in self._sources)

    def take(self, items: Index) -> Batch:
        """Return some of the items of a single source as a batch, whatever their order."""
        self._only.rows.check()
        if self._axes:
            return self._pack(self._only, self._only.items.locate(items))
        return self._values(self._only, self._only.items.locate(items))

    @property
    def _only(self) -> Source:
        if len(self._sources) > 1:
            raise UsageError("This needs a view of a single source.")
        return self._sources[0]

    @property
    def has_all_rows(self) -> bool:
        """Whether all rows that the mode of a single source has now are in this part."""
        sources = self._sources
        return len(sources) == 1 and sources[0].items.num_rows == sources[0].num_samples

    def all_rows(self) -> Index:
        """Return the numbers of all rows of a single source in this part, ascending."""
        return self._only.items.all_rows()

    def _begin(self, number: int) -> Epoch:
        """Return an epoch of a single source without windows."""
        if self._process != os.getpid():  # forked, without the thread that reads ahead
            self._process, self._epoch = os.getpid(), None
        if self._epoch is None or self._epoch[0] != number:
            if self._epoch is not None:
                self._epoch[1].close()
                self._epoch = None
            source = self._sources[0]
            items = source.items
            epoch = source.rows.epoch(
                list(self.fields),
                self._dtype,
                self._pass(0, number, 0)[0],
                None if items.is_plain else lambda chosen: items.rows(chosen)[:, 0],
            )
            self._epoch = number, epoch
        return self._epoch[1]

    def _pass(self, source: int, epoch: int, repeat: int) -> tuple[ItemOrder, int]:
        """Return the order of a pass over a source, one of several in an epoch, and its key."""
        which = source, epoch, repeat
        if which not in self._passes:
            key = key_of(self.seed, epoch, source, repeat)
            last = [each for each in self._passes if each[0] == source][-1:]
            others = {k: v for k, v in self._passes.items() if k[0] != source or k in last}
            self._passes = {**others, which: (self._sources[source].pass_order(key), key)}
        return self._passes[which]

    def _items(self, source: int, epoch: int, repeat: int, start: int, stop: int) -> Index:
        """Return the items at some positions of a pass."""
        order, key = self._pass(source, epoch, repeat)
        return self._sources[source].drawn(order.items(start, stop), key)

    def _next(self, epoch: int, start: int, stop: int) -> Located:
        """Return the items of a batch of a single source; of those after it, several at once."""
        known, first, last, found = self._ahead
        if known != epoch or start < first or stop > last:
            follows = known == epoch and start == last
            last = min(start + _AHEAD, self.num_items) if follows else stop
            last, first = max(last, stop), start
            found = self._sources[0].items.locate(self._items(0, epoch, 0, first, last))
            self._ahead = epoch, first, last, found
        return found.part(start - first, stop - first)

    def _drawn(self, epoch: int, start: int, stop: int) -> list[tuple[Index, Index]]:
        """Return for each source which places of a batch it fills, and with which items."""
        slots = np.arange(start, stop)
        turns, places = np.divmod(slots, _SHARES)
        of, found = self._source_of[places], []
        for k, source in enumerate(self._sources):
            mine = np.flatnonzero(of == k)
            positions = turns[mine] * self._shares[k] + self._before[k][places[mine]]
            items = np.empty(len(mine), np.intp)
            for repeat in np.unique(positions // source.count).tolist():
                here = positions // source.count == repeat
                inside = positions[here] - repeat * source.count
                first = int(inside[0])
                drawn = self._items(k, epoch, repeat, first, int(inside[-1]) + 1)
                items[here] = drawn[inside - first]
            found.append((mine, items))
        return found

    def _values(
        self, source: Source, where: Located, windows: Mapping[str, Window] | None = None
    ) -> Batch:
        """Return what a batch contains of some items of a source, or of some windows."""
        found: Batch = {}
        for name, window in (self._windows if windows is None else windows).items():
            values = source.gather(window.field, where, window.at)
            values = values[:, 0] if window.is_single else values
            if not self.fields[name].free_axis:
                values = values.astype(self._kinds[name], copy=False)
            found[name] = values
            found |= self._padding(source, where, name)
        return found

    def _padding(self, source: Source, where: Located, name: str) -> Batch:
        """Return which values of a window are repeated, if it may have some."""
        if name + PAD not in self.fields:
            return {}
        window = self._windows[name]
        padded = source.items.are_padded(where.items, window.at)
        return {name + PAD: padded[:, 0] if window.is_single else padded}

    # What it is ---------------------------------------------------------------------------------

    @property
    def digest(self) -> str:
        """Digest of all that the batches depend on, besides the values of the rows."""
        known = {name: tuple(each) for name, each in self.snapshot.items()}
        bound = to_plain(self.view), known, self.mode, self.part, self.batch_size, self.seed
        return blake2b(repr(bound).encode(), digest_size=8).hexdigest()

    def normalization(self, normalize: Normalize = True) -> dict[str, Normalization]:
        """Return the normalization of the floating-point fields by the rows of this part.

        That of a window is that of its stored field, at each offset.

        Args:
            normalize: How: see `DatasetConfig.normalize`.

        Raises:
            ConfigError: If the fields cannot be normalized so.
            DatasetError: If rows cannot be read, or a value has no logarithm.
        """
        return compute_normalization(
            normalize, self.fields, self._sources[0].rows.fields, self._statistics
        )

    def _statistics(self, of: Measured) -> RunningStatistics:
        total = RunningStatistics()
        for source in self._sources:
            total.merge(
                self._statistics_of_increments(source, of)
                if of.since
                else compute_of(source.rows, of, source.items.ranges())
            )
        return total

    def _statistics_of_increments(self, source: Source, of: Measured) -> RunningStatistics:
        total, both = RunningStatistics(of.pooled), self.reading(of.names)
        values = both._pack if both._axes else both._values
        step = rows_per_block(sum(field.nbytes for field in both.fields.values()))
        for start in range(0, source.count, step):
            items = np.arange(start, min(start + step, source.count))
            total.update(of.of(values(source, source.items.locate(items))))
        return total

    @property
    def datasets(self) -> dict[str, Dataset]:
        """The dataset of each source, by its folder as the view names it; "" if it names none."""
        names = self.view.sources or ("",)
        return {n: each.dataset for n, each in zip(names, self._sources, strict=True)}

    @property
    def division(self) -> list[str]:
        """What is in this part of each source, in words."""
        return [source.division for source in self._sources]

    def explain(self) -> str:
        """Return in words what the batches are made of."""
        lines = [
            f"{len(self)} batches of {self.batch_size} of {self.num_items} items in an epoch "
            f'("{self.part}")'
        ]
        for source, share in zip(self._sources, self._shares.tolist(), strict=True):
            lines.append(
                f"{source.dataset.directory}: {source.count} items of {source.rows.count} rows, "
                f"{source.division}, {share / 10:g} % of each batch; order "
                f'"{source.order}"'
            )
        if any(source.order == "blocks" for source in self._sources):
            lines.append("each batch draws from up to 256 places of a source")
        lines += [f"{n} = {w.field} at {list(w.at)}" for n, w in self.view.windows.items()]
        return "\n".join(lines)

    def close(self) -> None:
        """Close the files; calling it again does nothing."""
        if self._epoch is not None:
            self._epoch[1].close()
            self._epoch = None
        self._opened.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Let another process open the data for itself, as they are here."""
        data = None if self.view.sources else str(self._sources[0].dataset.directory)
        options = {
            "data": data, "mode": self.mode, "part": self.part, "snapshot": self.snapshot,
            "fields": self._all_names, "dtype": self._dtype, "reuse": self._reuse,
        }  # fmt: skip
        return _reopen, (self.view, self.batch_size, self.seed, options)

    def __repr__(self) -> str:
        return f"<{len(self)} batches of {self.batch_size} of {self.num_items} items>"


def _reopen(view: ViewOptions, batch_size: int, seed: int, options: dict[str, Any]) -> Batches:
    return Batches(view, batch_size, seed, **options)
