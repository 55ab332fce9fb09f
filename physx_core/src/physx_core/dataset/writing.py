"""What `Dataset` does that changes the files of a dataset."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.read.cache import ColumnCache
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.repair import recovery, repairing
from physx_core.dataset.store.manifest import Manifest, plain_info
from physx_core.dataset.write import merging, updating
from physx_core.dataset.write.appender import Appender
from physx_core.dataset.write.writer import Writer
from physx_core.errors import DatasetError, UsageError
from physx_core.fields import Field


class Changes:
    """The part of `Dataset` that changes what is stored.

    Attributes:
        directory: The folder.
    """

    directory: Path
    _writer: Writer | None
    _appender: Appender | None
    _reader: Reader
    _columns: ColumnCache
    _closed: bool

    def define_fields(self, mode: str, fields: Iterable[Field]) -> None:
        """Define the fields of a mode, with their units and roles, before its first rows.

        Args:
            mode: Name of the mode.
            fields: The fields; a shape of None is taken from the first rows.

        Raises:
            FieldsMismatchError: The mode has other fields already.
            ConfigError: The mode's name is no identifier, or there is no field.
            UsageError: The dataset is closed or only read.
        """
        self._writing().define_fields(mode, fields)

    def append(self, mode: str, rows: Mapping[str, Any], *, checked: bool = False) -> None:
        """Store rows; they are committed when this returns.

        Args:
            mode: Name of the mode. If it has no fields yet, they are taken from the rows.
            rows: Field name to array of shape (n, *field shape), all fields of the mode. What fits
                is decided by `Field.convert`.
            checked: Whether the rows are known to be finite, as those of a `Source` are: arrays of
                the fields' types are then stored without another look at their values.

        Raises:
            SampleError: A field is missing, unknown, of another shape, type or length, or holds
                NaN or an infinite number. Nothing of the rows is stored.
            DatasetError: The disk is full or fails; says how many of the rows are stored.
            UsageError: The dataset is closed or only read.
        """
        self._writing().append(mode, rows, checked=checked)
        self._forget_moved()

    def append_sample(self, mode: str, sample: Mapping[str, Any]) -> None:
        """Store one sample; it is committed with some others, or by `flush`.

        Args:
            mode: Name of the mode. If it has no fields yet, they are taken from the sample.
            sample: Field name to value of the field's shape, all fields of the mode.

        Raises:
            SampleError: The sample cannot be stored, as in `append`.
            DatasetError: The samples that waited cannot be stored: the disk is full or fails.
            UsageError: The dataset is closed or only read.
        """
        self._writing().append_sample(mode, sample)
        self._forget_moved()

    def flush(self) -> None:
        """Commit the samples that wait.

        Raises:
            DatasetError: The disk is full or fails; says how many of them are stored. The others
                are forgotten.
        """
        self._writing().flush()

    def update_info(self, **values: Any) -> None:
        """Set entries of `info` and store them.

        Args:
            values: Numbers, texts, lists, dictionaries; tuples and arrays become lists, classes
                and paths become texts.

        Raises:
            ConfigError: A value is nothing that JSON can hold.
            UsageError: The dataset is closed or only read.
        """
        self._writing()
        with self._changing("The dataset's info") as manifest:
            manifest.info |= plain_info(values)

    def update(self, mode: str, index: Any, rows: Mapping[str, Any]) -> None:
        """Write rows over stored ones, in place.

        They are committed when this returns. A process that dies meanwhile leaves each value
        either old or new, and a reader at the same moment may see some of both. Checksums and
        statistics of what was touched are computed anew when the dataset is closed.

        Args:
            mode: Name of the mode.
            index: Number of a row, a slice, or an array of numbers or booleans.
            rows: Field name to rows of shape (n, *field shape), or to a single value where
                `index` is one number; any of the mode's fields.

        Raises:
            SampleError: A field is unknown, or rows are of another shape, type or number, or hold
                NaN or an infinite number. Nothing is changed.
            IndexError: There are no such rows.
            DatasetError: The disk fails, or a partition is damaged.
            UsageError: The dataset is closed, only read, or shared with other writers.
        """
        writer = self._alone("update rows")
        fields, total = self._reader.mode(mode).fields, self._reader.rows(mode)
        numbers = updating.row_numbers(index, total)
        single = not isinstance(index, slice) and np.ndim(index) == 0
        values = updating.checked(fields, numbers, rows, single=single)
        with files.storing(f"{len(numbers)} updated rows of mode {mode!r}"):
            writer.wait()
            updating.update_rows(writer.store, mode, numbers, values, durable=writer.durable)
        self._forget_moved()

    def merge(self, directory: str | Path) -> None:
        """Append all rows of another dataset, which is not changed; all of them, or none.

        Args:
            directory: The other dataset's folder, or the session's folder that holds it.

        Raises:
            DatasetNotFoundError: There is no dataset.
            FieldsMismatchError: A mode has other fields here than there.
            DatasetError: The other is damaged or this very dataset, or the disk is full.
            UsageError: The dataset is closed or only read.
        """
        appender, source = self._writing(), recovery.locate(directory)
        if source.resolve() == self.directory.resolve():
            raise DatasetError(f"{source} cannot be merged into itself.")
        appender.flush()
        given = recovery.load(source)
        if given.problems:
            raise next(iter(given.problems.values()))
        with files.storing(f"The rows of {source}"):
            for name, mode in given.modes.items():
                appender.define_fields(name, mode.fields.values())
                appender.writer.finish(name)
            merging.take_partitions(appender.writer, source, given)

    def remove_partition(self, mode: str, index: int, session: str | None = None) -> int:
        """Remove a partition with all its rows and files; rows behind it move up.

        Args:
            mode: Name of the mode.
            index: Number of the partition, as in the names of its files.
            session: Session that wrote it; needed where several have one of this number.

        Returns:
            How many rows it had.

        Raises:
            DatasetError: There is no such partition or mode, or the disk fails.
            UsageError: The dataset is closed, only read, or shared with other writers.
        """
        writer = self._alone("remove partitions")
        self._reader.mode(mode)
        with files.storing(f"Mode {mode!r} without partition {index}"):
            writer.finish(mode)
            rows = merging.drop_partition(writer, mode, session, index)
        self._forget_moved()
        return rows

    @staticmethod
    def repair(directory: str | Path) -> list[str]:
        """Put right what `verify` finds, as far as that is possible; no file is ever deleted.

        What a killed writer left open is sealed; a manifest that is missing, cut or edited is
        checked against the partition files or rebuilt from them; a damaged header is made anew
        around sound rows. The files of partitions that cannot be read are moved to the folder
        ``damaged``, so that the other rows can be used.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.

        Returns:
            One text for each thing that was repaired; empty if there was nothing to do.

        Raises:
            DatasetNotFoundError: There is no dataset.
            DatasetLockedError: A process writes to it.
            DatasetError: The folder cannot be written.
        """
        return repairing.repair(recovery.locate(directory))

    @staticmethod
    def rebuild(directory: str | Path) -> None:
        """Make the manifest anew from the partition files alone; the old one is kept beside it.

        Everything but the info comes back: fields, units, order, checksums and statistics.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.

        Raises:
            DatasetNotFoundError: There is no dataset.
            DatasetLockedError: A process writes to it.
            DatasetError: A partition is missing or damaged, or the folder cannot be written.
        """
        repairing.rebuild(recovery.locate(directory))

    def _writing(self) -> Appender:
        if self._closed:
            raise UsageError(f"The dataset in {self.directory} is closed.")
        if self._appender is None:
            raise UsageError(
                f"The dataset in {self.directory} was opened for reading. To change it, use "
                "Dataset.open(directory, writable=True)."
            )
        return self._appender

    def _alone(self, what: str) -> Writer:
        """Return the writer, if it is the only one, with all samples stored."""
        appender = self._writing()
        if appender.writer.store.shared:
            raise UsageError(
                f"To {what}, have the dataset for yourself: open it without shared=True."
            )
        appender.flush()
        return appender.writer

    @contextlib.contextmanager
    def _changing(self, what: str) -> Iterator[Manifest]:
        writer = self._writing().writer
        with files.storing(what), writer.store.change() as manifest:
            yield manifest

    def _keep_statistics(self) -> None:
        """Store statistics that were computed anew; several writers leave that to the next."""
        if self._writer is not None and not self._writer.store.shared:
            with self._changing("The statistics"):
                pass

    def _forget_moved(self) -> None:
        """Forget rows kept in memory that are not what is stored any more."""
        if self._writer is not None and self._writer.store.moved:
            self._writer.store.moved = False
            self._columns.clear()
