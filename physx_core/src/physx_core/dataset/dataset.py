"""Dataset: samples by mode and field, written by one or more processes, read by any number."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Self, Unpack

import numpy as np

from physx_core import files
from physx_core.closeable import Closeable
from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.episode_reading import EpisodeReading
from physx_core.dataset.read.mode_rows import ModeRows, Snapshot
from physx_core.dataset.read.mode_statistics import compute_of
from physx_core.dataset.read.ordered_statistics import compute_in_order, store_in_order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.sampling import BatchOptions, BatchReader
from physx_core.dataset.read.shuffling import OrderName, choose_order
from physx_core.dataset.read.views import ModeView, row_numbers
from physx_core.dataset.repair import recovery, repair
from physx_core.dataset.repair.report import find_problems, summarize
from physx_core.dataset.store import locks
from physx_core.dataset.store.episode_record import EpisodeRecord
from physx_core.dataset.store.episode_table import EPISODES, LOST, has_table
from physx_core.dataset.store.manifest import Manifest, to_plain_info
from physx_core.dataset.write.appender import Appender
from physx_core.dataset.write.compacting import compact
from physx_core.dataset.write.delegation import Delegation
from physx_core.dataset.write.merging import add_partitions, drop_partition
from physx_core.dataset.write.opening import WriterOptions, create, extend
from physx_core.dataset.write.updating import check_unchanged, check_update
from physx_core.dataset.write.writer import Writer
from physx_core.errors import DatasetError, UsageError
from physx_core.fields import Field
from physx_core.normalization import Normalization, Normalize, compute_normalization
from physx_core.plugins.commands import find_command
from physx_core.typing import Batch

MAX_FILE_SIZE = 0.25


class Dataset(EpisodeReading, Closeable):
    """A folder of partition files and their manifest; use `create` or `open` to get one.

    A context manager. Unless the dataset is shared, one process at a time may write; any number
    may read at the same time. Rows stored by `append` survive if the process dies later.

    Attributes:
        directory: The folder.
        session: Session that new partitions are named after; empty when reading only.
    """

    def __init__(self, directory: Path, manifest: Manifest, writer: Writer | None = None) -> None:
        self.directory = directory
        self.session = writer.session if writer else ""
        self._manifest = manifest
        self._reader = writer.reader if writer else Reader(directory, manifest)
        self._columns = ColumnCache(self._reader)
        self._appender = Appender(writer) if writer else None
        self._closed = False
        self._look_for_writer()

    def __repr__(self) -> str:
        if self._closed:
            return f"<Dataset {self.directory}: closed>"
        counts = [f"{self.num_samples(mode):,} {mode}" for mode in self.modes]
        return f"<Dataset {self.directory}: {', '.join(counts) or 'empty'}>"

    def show(self, row: int | None = None) -> None:
        """Show the rows in the viewer's widget below the notebook's cell.

        Without the widget a picture of a row is shown there, and elsewhere its path is printed.

        Args:
            row: Number of the row where the cursor stands; None: the last one.

        Raises:
            UsageError: If physx-rerun is not installed.
            DatasetError: If there is no such row.
            PhysxError: If there is neither a widget nor a driver for pictures.
        """
        rows = max(map(self.num_samples, self.modes), default=0)
        if row is not None and not 0 <= row < rows:
            raise DatasetError(f"{self.directory} has no row {row}: it has {rows:,}, from 0.")
        find_command("view").show(self.directory, row=row)

    # Opening and closing --------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        directory: str | Path,
        session: str = "run",
        *,
        max_file_size: float = MAX_FILE_SIZE,
        durable: bool = False,
        shared: bool = False,
        info: Mapping[str, Any] | None = None,
    ) -> Self:
        """Create a dataset and open it for writing.

        Args:
            directory: Folder of the dataset; created if it does not exist.
            session: Prefix of the file names.
            max_file_size: Size in GB at which a partition is full and the next one begins.
            durable: Whether every append waits for the disk, so that rows also survive a power
                failure. Otherwise, rows reach the disk within about a second.
            shared: Whether other processes may write to it at the same time: see `open`.
            info: Where the data come from: see `update_info`.

        Raises:
            DatasetError: If the folder already holds a dataset or cannot be written.
            DatasetLockedError: If another process is creating a dataset there.
            ConfigError: If the session's name or the size is invalid.
        """
        options = WriterOptions(session, max_file_size, durable, shared)
        writer = create(Path(directory), options, info or {})
        return cls(Path(directory), writer.store.manifest, writer)

    @classmethod
    def open(
        cls,
        directory: str | Path,
        *,
        writable: bool = False,
        session: str | None = None,
        max_file_size: float = MAX_FILE_SIZE,
        durable: bool = False,
        shared: bool = False,
    ) -> Self:
        """Open an existing dataset.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.
            writable: Whether the dataset can be changed. Otherwise nothing on disk is changed.
            session: Prefix of the new file names when writing; None: that of the last session.
            max_file_size: Size in GB at which a new partition is full.
            durable: Whether every append waits for the disk, so that rows also survive a power
                failure.
            shared: Whether other processes may write to it at the same time, each with
                ``shared=True``. Each writes separate partitions, ordered by when they were begun.

        Raises:
            DatasetNotFoundError: If there is no dataset.
            DatasetLockedError: If opened for writing while another process writes to it.
            DatasetError: If the manifest is invalid, or a partition is damaged and the dataset is
                opened for writing.
            ConfigError: If the session's name or the size is invalid.
        """
        folder = recovery.locate(directory)
        if not writable:
            return cls(folder, recovery.load(folder))
        writer = extend(folder, WriterOptions(session, max_file_size, durable, shared))
        return cls(folder, writer.store.manifest, writer)

    @property
    def writable(self) -> bool:
        """Whether rows can be added."""
        return self._appender is not None and not self._closed

    def close(self) -> None:
        """Store pending samples, seal the last partitions and release the lock.

        Closing a closed dataset does nothing, nor does closing it in a process forked from the one
        that opened it: rows and lock belong to that one.

        Raises:
            DatasetError: If pending samples cannot be stored; committed rows stay intact.
        """
        if self._closed:
            return
        try:
            if self._appender is not None and self._appender.writer.is_own:
                try:
                    self._appender.flush()
                finally:
                    self._appender.writer.close()
        finally:
            self._closed = True
            self._columns.clear()

    # Reading --------------------------------------------------------------------------------

    @property
    def modes(self) -> list[str]:
        """Names of the modes."""
        return list(self._manifest.modes)

    @property
    def info(self) -> dict[str, Any]:
        """Where the data come from: environment, its keyword arguments, seed, etc."""
        return dict(self._manifest.info)

    @property
    def versions(self) -> dict[str, str]:
        """Versions of Python and of the packages that created the dataset."""
        return dict(self._manifest.versions)

    def fields(self, mode: str) -> dict[str, Field]:
        """Return the fields of a mode by name.

        Raises:
            DatasetError: If there is no such mode, or a partition is missing or damaged.
        """
        return dict(self._reader.mode(mode).fields)

    def num_samples(self, mode: str) -> int:
        """Return the number of committed samples of a mode; 0 if there is no such mode.

        Raises:
            DatasetError: If a partition is missing or damaged.
        """
        self._prepare_reading()
        return self._reader.rows(mode) if mode in self else 0

    def __getitem__(self, mode: str) -> ModeView:
        self._prepare_reading()
        self._reader.mode(mode)
        return ModeView(self._columns, mode)

    def __contains__(self, mode: object) -> bool:
        return mode in self._manifest.modes

    def refresh(self) -> None:
        """Load the rows that another process has committed since the dataset was opened.

        While it writes, only those of its episodes count that come before the first missing number,
        so that rows keep their numbers as more of them finish. It is known by its lock.

        If that process updates rows of an open partition after `batches` has read them into
        memory, later batches still hold the old values; reopen the dataset to see the new ones.

        Raises:
            DatasetError: If the manifest is no longer valid.
        """
        self._prepare_reading()
        if self._appender is None:
            self._manifest.take(recovery.load(self.directory))
            self._look_for_writer()
        else:
            self._appender.writer.refresh()

    def batches(
        self, mode: str, batch_size: int, **options: Unpack[BatchOptions]
    ) -> Iterator[Batch]:
        """Iterate over the samples of a mode in batches.

        Args:
            mode: Name of the mode.
            batch_size: Samples per batch; only the last batch of an epoch may have fewer.
            **options: Any of these keyword arguments:

                shuffle (bool): Whether each epoch visits all samples in a new random order. False
                by default.
                order (str | None): How they are shuffled, ``"exact"`` or ``"blocks"``: see
                `OrderName`; None, the default: see `default_order`.
                seed (int | Sequence[int] | None): Seed of the orders; None, the default: a
                different one each time. The orders depend on nothing else but the number of
                samples and, with ``"blocks"``, the size of a stored one.
                epochs (int | None): Number of passes over all samples, 1 by default; None:
                endless. An epoch covers the samples that are committed when it begins.
                first (int): Number of the first batch, counted from 0 over all epochs of as many
                samples as there are now. 0 by default.
                fields (Sequence[str] | None): Names of the fields to read; None, the default: all.
                dtype (DTypeLike | None): Type to convert floating-point fields to; None, the
                default: no conversion.
                reuse (bool): Whether every batch is returned in the same arrays, which is faster;
                each batch is then valid only until the next. False by default.
                normalize (bool | Mapping[str, Normalization]): Whether to normalize floating-point
                fields in place by the mean and standard deviation of all samples of the mode; or
                the normalization to use. False by default.

        Returns:
            An iterator over batches: field name to array of shape (samples, *field shape). Free
            axes are packed: see `physx_core.packing.pack`; `reuse` then makes no difference.

        Raises:
            DatasetError: If there is no such mode or field, or the mode has no samples.
            ConfigError: If a number is out of range, or there is no such order.
        """
        self._prepare_reading()
        if options.get("normalize") is True:
            options["normalize"] = self.normalization_of(mode)
        return iter(BatchReader(self._columns, mode, batch_size, **options))

    def default_order(self, mode: str) -> OrderName:
        """Return how `batches` shuffles all samples of a mode by default: by their number and size.

        Up to two million samples, and any number of at least 4 kB each, are shuffled exactly.

        Raises:
            DatasetError: If there is no such mode.
        """
        self._prepare_reading()
        return choose_order(self._reader.rows(mode), self._reader.row_nbytes(mode))

    def rows(self, mode: str, snapshot: Snapshot | None = None) -> ModeRows:
        """Return the rows of a mode as they are now, or were at a snapshot: see `ModeRows`.

        Raises:
            DatasetError: If there is no such mode, or rows of the snapshot are missing.
        """
        self._prepare_reading()
        return ModeRows(self._columns, mode, snapshot)

    @property
    def is_written(self) -> bool:
        """Whether another process is writing to it as its only writer."""
        return self._appender is None and locks.is_written(self.directory)

    @property
    def normalization(self) -> dict[str, Normalization]:
        """Mean and standard deviation of the floating-point fields of mode ``training``."""
        return self.normalization_of("training") if "training" in self else {}

    def normalization_of(self, mode: str, normalize: Normalize = True) -> dict[str, Normalization]:
        """Return mean and standard deviation of a mode's floating-point fields over all samples.

        Args:
            mode: Name of the mode.
            normalize: How: see `DatasetConfig.normalize`.

        Raises:
            DatasetError: If there is no such mode, a partition is missing or damaged, or a value
                has no logarithm.
            ConfigError: If the fields cannot be normalized so.
        """
        rows = self.rows(mode)
        return compute_normalization(normalize, rows.fields, rows.fields, partial(compute_of, rows))

    def recompute_normalization(self, mode: str = "training") -> dict[str, Normalization]:
        """Recompute mean and standard deviation from all stored samples and store them.

        Raises:
            DatasetError: If there is no such mode, or a partition is missing or damaged.
        """
        self._prepare_reading()
        self._reader.mode(mode).forget_statistics()
        if self._reader.order(mode) is not None:
            compute_in_order(self._reader, mode, anew=True)
        found = self.normalization_of(mode)
        store = self._appender.writer.store if self._appender is not None else None
        if store is not None and not store.shared:  # of several writers, the next one stores them
            with files.storing("The statistics"):
                with store.change():
                    pass
                store_in_order(self._reader)
        return found

    def describe(self) -> list[dict[str, Any]]:
        """Return a table with one row for each field of each mode.

        Returns:
            Rows with the entries mode, field, role, dtype, shape, unit, axes, like, samples,
            partitions and bytes (of the values).
        """
        self._prepare_reading()
        return summarize(self._manifest, self._reader.rows)

    def contents(self, mode: str) -> list[tuple[str, int, int, str]]:
        """Return what identifies the rows of a mode, from the manifest alone.

        Returns:
            For each partition the session that wrote it, its number there, its rows, and a digest
            of its fields and their checksums; empty while rows are being written or updated. Rows
            that are not committed yet do not count. If the mode has episodes, the partitions of
            the table of episodes follow, without rows, as those of ``SESSION/episodes``.
        """
        known = self._manifest.modes[mode]
        found = [(p.session, p.index, p.rows, p.digest(known.fields)) for p in known.partitions]
        if self._reader.order(mode) is None:
            return found
        table = self._manifest.modes[EPISODES]
        return found + [
            (f"{p.session}/{EPISODES}", p.index, 0, p.digest(table.fields))
            for p in table.partitions
        ]

    def verify(self, *, content: bool = True) -> list[str]:
        """Check that all partition files exist and are complete, consistent and unchanged.

        Args:
            content: Whether to read every byte; otherwise only headers and sizes are checked.

        Returns:
            One message per problem; empty for a sound dataset.
        """
        self._prepare_reading()
        return find_problems(self.directory, self._manifest, content)

    # Writing --------------------------------------------------------------------------------

    def define_fields(self, mode: str, fields: Iterable[Field]) -> None:
        """Define the fields of a mode, with their units and roles, before its first rows.

        Args:
            mode: Name of the mode.
            fields: The fields; a shape of None is taken from the first rows.

        Raises:
            FieldsMismatchError: If the mode already has different fields.
            ConfigError: If the mode's name is not an identifier, or there are no fields.
            UsageError: If the dataset is closed or open for reading only.
        """
        self._for_writing().define_fields(mode, fields)

    def append(self, mode: str, rows: Mapping[str, Any], *, checked: bool = False) -> None:
        """Store rows; they are committed when this returns.

        Args:
            mode: Name of the mode. If it has no fields yet, they are inferred from the rows.
            rows: Field name to array of shape (n, *field shape), all fields of the mode; with a
                free axis, n arrays. Accepts what `Field.convert` accepts.
            checked: Whether the rows are known to be finite, as those of a `Source` are: arrays of
                the fields' types are then stored without checking their values again.

        Raises:
            SampleError: If a field is missing, unknown, of the wrong shape, type or length, or
                holds NaN or infinity. None of the rows is stored.
            DatasetError: If the disk is full or fails; says how many of the rows are stored.
            UsageError: If the dataset is closed or open for reading only.
        """
        appender = self._appender
        if appender is None or self._closed:
            appender = self._for_writing()
        if mode == EPISODES:
            self._check_ordinary(mode)
        appender.append(mode, rows, checked=checked)

    def unfinished_episodes(self, mode: str, campaign: int) -> dict[int, tuple[int, int]]:
        """Return the episodes of which parts are stored, but not the last one.

        Args:
            mode: Name of a mode.
            campaign: Number of the campaign in it.

        Returns:
            For the number of each the number of its next part, and how many rows it has.

        Raises:
            UsageError: If the dataset is not open for writing, or closed.
        """
        return self._for_writing().writer.recorder.unfinished(mode, campaign)

    def append_episodes(
        self,
        mode: str,
        rows: Mapping[str, Any],
        episodes: Sequence[EpisodeRecord],
        *,
        episode_fields: Iterable[Field] = (),
        checked: bool = False,
        first_row: int | None = None,
    ) -> None:
        """Store rows of independent episodes, and what is recorded of these.

        From the first call on, the rows of a mode are those of its recorded episodes, in order of
        campaign and number, in whatever order they come; rows that `append` has stored before come
        before them, and rows that it stores later after the episodes that are there then. An
        episode counts once its last part is recorded: if the process dies before, its rows do not
        exist for any reader. The records are rows of the mode ``episodes``:
        `physx_core.dataset.store.episode_table` describes them.

        Args:
            mode: ``training``, ``validation`` or ``prediction``. If it has no fields yet, they are
                inferred from the rows.
            rows: Field name to array of shape (n, *field shape), as for `append`; of no fields if
                there are no rows.
            episodes: The episodes, or parts of them, that the rows belong to, in order. The first
                ones of a dataset determine which parameters all must have.
            episode_fields: Those of role ``episode`` that records may have, all or none; the first
                call for a dataset determines them. Of a record without them, 0 is stored.
            checked: Whether the rows are known to be finite, as in `append`.
            first_row: Address of the rows, if a process to which the mode is delegated has written
                them, so that none are given: see `delegate`.

        Raises:
            SampleError: If a field or a parameter is missing, unknown, of the wrong shape, type or
                length, or holds NaN or infinity. Nothing is stored.
            ConfigError: If the mode cannot hold episodes.
            DatasetError: If the disk is full or fails; rows stored before stay.
            UsageError: If the episodes have another number of rows, if a part does not follow the
                one before, if there are no such rows at `first_row`, or if the dataset is closed,
                open for reading only, or shared.
        """
        self._as_only_writer("store episodes")
        self._for_writing().append_episodes(
            mode,
            rows,
            episodes,
            episode_fields=episode_fields,
            checked=checked,
            first_row=first_row,
        )

    def define_episodes(
        self, parameters: Iterable[Field] = (), episode_fields: Iterable[Field] = ()
    ) -> None:
        """Define what is recorded of each episode, unless the dataset has episodes already.

        Args:
            parameters: The parameters that all episodes have.
            episode_fields: The fields of role ``episode`` that they may have.

        Raises:
            UsageError: If the dataset is closed, open for reading only, or shared.
        """
        self._as_only_writer("store episodes")
        self._for_writing().define_episodes(parameters, episode_fields)

    def delegate(self, mode: str) -> Delegation:
        """Let other processes write the rows of episodes of a mode, until the dataset is closed.

        They share the dataset's folder, each with a `PartitionWriter`; this process keeps the
        manifest, and stores the records with `append_episodes`. `define_episodes` comes before
        the first rows.

        Args:
            mode: Name of the mode; nothing else may change its rows.

        Raises:
            UsageError: If the dataset is closed, open for reading only, or shared.
            DatasetError: If the folder cannot be written.
        """
        self._check_ordinary(mode)
        return self._as_only_writer("let others write rows").delegate(mode)

    def append_sample(self, mode: str, sample: Mapping[str, Any]) -> None:
        """Store one sample; it is committed together with others or by `flush`.

        Args:
            mode: Name of the mode. If it has no fields yet, they are inferred from the sample.
            sample: Field name to value of the field's shape, all fields of the mode.

        Raises:
            SampleError: If the sample is invalid, as in `append`.
            DatasetError: If pending samples cannot be stored because the disk is full or fails.
            UsageError: If the dataset is closed or open for reading only.
        """
        self._check_ordinary(mode)
        self._for_writing().append_sample(mode, sample)

    def flush(self) -> None:
        """Commit the pending samples.

        Raises:
            DatasetError: If the disk is full or fails; says how many samples are stored. The
                others are discarded.
            UsageError: If the dataset is closed or open for reading only.
        """
        self._for_writing().flush()

    def update_info(self, /, **values: Any) -> None:
        """Set entries of `info` and store them.

        Args:
            values: Numbers, strings, lists, dictionaries; tuples and arrays become lists, classes
                and paths become strings.

        Raises:
            ConfigError: If JSON cannot represent a value.
            UsageError: If the dataset is closed or open for reading only.
        """
        store = self._for_writing().writer.store
        with files.storing("The dataset's info"), store.change() as manifest:
            manifest.info |= to_plain_info(values)

    def update(self, mode: str, index: Any, rows: Mapping[str, Any]) -> None:
        """Overwrite stored rows in place.

        The new values are committed when this returns. If the process dies before that, each value
        is either old or new; a concurrent reader may also see a mix. Checksums and statistics of
        the updated partitions are recomputed when the dataset is closed.

        Args:
            mode: Name of the mode.
            index: Row number, slice, or array of row numbers or booleans.
            rows: Field name to rows of shape (n, *field shape), or to a single value if `index` is
                one number; any of the mode's fields.

        Raises:
            SampleError: If a field is unknown, or rows have the wrong shape, type or number, other
                sizes of free axes than before, or hold NaN or infinity. Nothing is changed.
            IndexError: If there are no such rows.
            DatasetError: If the disk fails, or a partition is damaged.
            UsageError: If the dataset is closed, open for reading only, or shared.
        """
        self._check_ordinary(mode)
        writer = self._as_only_writer("update rows")
        fields, total = self._reader.mode(mode).fields, self._reader.rows(mode)
        numbers = row_numbers(index, total)
        single = not isinstance(index, slice) and np.ndim(index) == 0
        values = check_update(fields, numbers, rows, single=single)
        order = self._reader.order(mode)
        numbers = numbers if order is None else order.stored(numbers)
        check_unchanged(fields, values, self._reader.sizes(mode, numbers))
        with files.storing(f"{len(numbers)} updated rows of mode {mode!r}"):
            writer.update(mode, numbers, values)

    def merge(self, directory: str | Path) -> None:
        """Append either all rows or none of another dataset; that one is not changed.

        The other's campaigns of episodes follow the dataset's own. Its `info` is kept as well: the
        dataset's has an entry ``merged``, a list of those of all datasets that were appended.

        Args:
            directory: The other dataset's folder, or the session's folder that holds it.

        Raises:
            DatasetNotFoundError: If there is no dataset.
            FieldsMismatchError: If the fields of a mode differ between the datasets.
            DatasetError: If the other dataset is damaged or is this one, or the disk is full.
            UsageError: If the dataset is closed or open for reading only.
        """
        appender, source = self._for_writing(), recovery.locate(directory)
        if source.resolve() == self.directory.resolve():
            raise DatasetError(f"{source} cannot be merged into itself.")
        appender.flush()
        given = recovery.load(source)
        recovery.count_rows(source, given, thorough=True)
        if given.problems:
            raise next(iter(given.problems.values()))
        if has_table(given) or has_table(self._manifest):
            self._as_only_writer("merge episodes")
        with files.storing(f"The rows of {source}"):
            appender.define_modes({n: mode.fields.values() for n, mode in given.modes.items()})
            for name in given.modes.keys() | {EPISODES}:
                appender.writer.finish(name)
            add_partitions(appender.writer, source, given)

    def remove_partition(self, mode: str, index: int, session: str | None = None) -> int:
        """Remove a partition with all its rows and files; the rows after it move up.

        Episodes that lack rows then do not count any more, as if they had not been computed.

        Args:
            mode: Name of the mode.
            index: Number of the partition, as in the names of its files.
            session: Session that wrote it; required if several sessions have this number.

        Returns:
            Number of rows removed.

        Raises:
            DatasetError: If there is no such partition or mode, or the disk fails.
            UsageError: If the dataset is closed, open for reading only, or shared.
        """
        writer = self._as_only_writer("remove partitions")
        self._reader.mode(mode)
        self._check_ordinary(mode)
        with files.storing(f"Mode {mode!r} without partition {index}"):
            return drop_partition(writer, mode, session, index)

    def compact(self, mode: str | None = None) -> int:
        """Remove rows that no episode has from the disk, and put the others in order.

        Such rows are those of failed, lost, replaced and unfinished episodes; the parts of the
        latter have to be stored again, from the first one on. Rows, episodes, parameters and
        statistics stay as they are. Modes without episodes are left alone. It takes disk space for
        a copy of the rows, except for those of the first partitions if these are in order already.
        If the process dies, the dataset is the one from before or after it, and the next writer
        removes what is left over.

        Args:
            mode: Name of the mode; None: all.

        Returns:
            How many bytes of disk space were freed; negative if the files now take more.

        Raises:
            DatasetError: If there is no such mode, if its rows, their records or some of them are
                damaged or lost, or if the disk is full or fails. Nothing is changed then.
            UsageError: If the dataset is closed, open for reading only, or shared, or if other
                processes write the rows.
        """
        writer = self._as_only_writer("compact it")
        if mode is not None:
            self._reader.mode(mode)  # there must be one
        if self._manifest.info.get(LOST):
            raise DatasetError(
                f"Records of episodes in {self.directory} were lost, so it is unknown which rows "
                "count. Nothing was compacted. `physx verify` says what can be done."
            )
        with files.storing("The compacted rows"):
            return compact(writer, self.modes if mode is None else [mode])

    @staticmethod
    def repair(directory: str | Path) -> list[str]:
        """Repair what `verify` finds, as far as possible; no file is ever deleted.

        Partitions that a killed writer left open are sealed; a missing, truncated or edited
        manifest is checked against the partition files or rebuilt from them; damaged headers of
        sound rows are rewritten. The files of unreadable partitions are moved to the folder
        ``damaged``, so that the other rows can be used.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.

        Returns:
            One message per repair; empty if there was nothing to repair.

        Raises:
            DatasetNotFoundError: If there is no dataset.
            DatasetLockedError: If a process is writing to it.
            DatasetError: If the folder cannot be written.
        """
        return repair.repair(recovery.locate(directory))

    @staticmethod
    def rebuild(directory: str | Path) -> None:
        """Rebuild the manifest from the partition files alone; the old one is kept next to it.

        Everything but the info is restored: fields, units, order, checksums and statistics.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.

        Raises:
            DatasetNotFoundError: If there is no dataset.
            DatasetLockedError: If a process is writing to it.
            DatasetError: If a partition is missing or damaged, or the folder cannot be written.
        """
        repair.rebuild(recovery.locate(directory))

    # Internals ------------------------------------------------------------------------------

    def _prepare_reading(self) -> None:
        """Check that the dataset is open, and commit pending samples."""
        if self._closed:
            raise UsageError(f"The dataset in {self.directory} is closed.")
        if self._appender is not None:
            self._appender.flush()

    def _look_for_writer(self) -> None:
        """Find out whether another process is writing, so that only complete numbers count."""
        if self._appender is None and EPISODES in self._manifest.modes:
            self._reader.orders.until_gap = locks.is_written(self.directory)

    def _check_ordinary(self, mode: str) -> None:
        """Check that a mode is not the table of episodes, which says which rows count."""
        if mode == EPISODES and has_table(self._manifest):
            raise UsageError(
                f'Mode "{EPISODES}" is the table of episodes: only append_episodes() changes it.'
            )

    def _for_writing(self) -> Appender:
        """Return the appender, if the dataset is open for writing."""
        if self._closed:
            raise UsageError(f"The dataset in {self.directory} is closed.")
        if self._appender is None:
            raise UsageError(
                f"The dataset in {self.directory} is open for reading only. To change it, use "
                "Dataset.open(directory, writable=True)."
            )
        return self._appender

    def _as_only_writer(self, what: str) -> Writer:
        """Store pending samples and return the writer; an error if the dataset is shared."""
        appender = self._for_writing()
        if appender.writer.store.shared:
            raise UsageError(
                f"Only a dataset's sole writer can {what}: open it without shared=True."
            )
        appender.flush()
        return appender.writer
