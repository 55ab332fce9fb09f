"""Dataset: samples by mode and field, written by one process and read by any."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike

from physx_core.closeable import Closeable
from physx_core.dataset.read import strategy as strategies
from physx_core.dataset.read.cache import ColumnCache
from physx_core.dataset.read.episodes import Episode, find_episodes
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.sampling import Batches
from physx_core.dataset.read.splits import Source, Subset, split
from physx_core.dataset.read.views import ModeView
from physx_core.dataset.repair import recovery
from physx_core.dataset.repair.report import find_problems, summarize
from physx_core.dataset.store.manifest import Manifest
from physx_core.dataset.store.mode_statistics import statistics_of
from physx_core.dataset.write.appender import Appender
from physx_core.dataset.write.opening import WriterOptions, create, extend
from physx_core.dataset.write.writer import Writer
from physx_core.dataset.writing import Changes
from physx_core.errors import UsageError
from physx_core.fields import Field
from physx_core.statistics import Normalization
from physx_core.typing import Batch

MAX_FILE_SIZE = 0.25


class Dataset(Changes, Closeable):
    """A folder of partition files with its manifest; make one with `create` or `open`.

    A context manager. One process at a time may write; any number may read, also meanwhile. What
    `append` returned from survives the death of the process at any later moment.

    Attributes:
        directory: The folder.
        session: Session that new partitions are named after; empty when only reading.
    """

    def __init__(
        self,
        directory: Path,
        manifest: Manifest,
        writer: Writer | None = None,
        lock: int | None = None,
    ) -> None:
        self.directory = directory
        self.session = writer.session if writer else ""
        self._manifest = manifest
        self._writer = writer
        self._lock = lock
        self._reader = Reader(directory, manifest)
        self._columns = ColumnCache(self._reader)
        self._appender = Appender(writer) if writer else None
        self._closed = False

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
        """Make a new dataset and open it for writing.

        Args:
            directory: Its folder; made if it does not exist.
            session: Name that its files begin with.
            max_file_size: Size in GB at which a partition is full and the next one begins.
            durable: Whether every append waits for the disk, to survive a power cut too.
                Otherwise the disk gets what is written about once a second.
            shared: Whether other processes may write to it at the same time: see `open`.
            info: Where the data come from: see `update_info`.

        Raises:
            DatasetError: There is a dataset already, or the folder cannot be written.
            DatasetLockedError: Another process is making one there.
            ConfigError: The session's name or the size is not valid.
        """
        folder = Path(directory)
        options = WriterOptions(session, max_file_size, durable, shared)
        writer, lock = create(folder, options, info or {})
        return cls(folder, writer.store.manifest, writer, lock)

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
        """Open a dataset that exists.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.
            writable: Whether to add rows. Otherwise nothing on the disk is ever changed.
            session: Name of the new files when writing; None: that of the last session.
            max_file_size: Size in GB at which a new partition is full.
            durable: Whether every append waits for the disk, to survive a power cut too.
            shared: Whether other processes may write to it at the same time, each with
                ``shared=True``. Each writes partitions of its own; the partitions follow each
                other in the order in which they were begun.

        Raises:
            DatasetNotFoundError: There is no dataset.
            DatasetLockedError: It is to be written, and another process does so.
            DatasetError: Its manifest is not valid, or a partition is damaged and it is to be
                written.
            ConfigError: The session's name or the size is not valid.
        """
        folder = recovery.locate(directory)
        if not writable:
            return cls(folder, recovery.load(folder))
        options = WriterOptions(session, max_file_size, durable, shared)
        writer, lock = extend(folder, options)
        return cls(folder, writer.store.manifest, writer, lock)

    @property
    def writable(self) -> bool:
        """Whether rows can be added."""
        return self._writer is not None and not self._closed

    def close(self) -> None:
        """Store what waits, seal the last partitions and release the lock; twice does nothing.

        Raises:
            DatasetError: What waits cannot be stored; all that was committed is intact.
        """
        if self._closed:
            return
        try:
            if self._writer is not None:
                try:
                    self.flush()
                finally:
                    self._writer.close()
        finally:
            self._closed = True
            self._columns.clear()
            if self._lock is not None:
                os.close(self._lock)

    # Reading --------------------------------------------------------------------------------

    @property
    def modes(self) -> list[str]:
        """Names of the modes."""
        return list(self._manifest.modes)

    @property
    def info(self) -> dict[str, Any]:
        """Where the data come from: environment, its keyword arguments, seed and the like."""
        return dict(self._manifest.info)

    @property
    def versions(self) -> dict[str, str]:
        """Versions of Python and of the packages that made the dataset."""
        return dict(self._manifest.versions)

    def fields(self, mode: str) -> dict[str, Field]:
        """Return the fields of a mode by name.

        Raises:
            DatasetError: There is no such mode, or a partition is missing or damaged.
        """
        return dict(self._reader.mode(mode).fields)

    def num_samples(self, mode: str) -> int:
        """Return the number of committed samples of a mode.

        Raises:
            DatasetError: There is no such mode, or a partition is missing or damaged.
        """
        self._reading()
        return self._reader.rows(mode)

    def __getitem__(self, mode: str) -> ModeView:
        self._reading()
        self._reader.mode(mode)
        return ModeView(self._reader, self._columns, mode)

    def __contains__(self, mode: object) -> bool:
        return mode in self._manifest.modes

    def refresh(self) -> None:
        """See the rows that another process has committed since the dataset was opened.

        Raises:
            DatasetError: The manifest is not valid any more.
        """
        self._reading()
        if self._writer is None:
            moved = recovery.refresh(self.directory, self._manifest)
        else:
            moved = self._writer.refresh()
        if moved:
            self._columns.clear()

    def batches(
        self,
        mode: str,
        batch_size: int,
        *,
        shuffle: bool = False,
        seed: int | Sequence[int] | None = None,
        epochs: int | None = 1,
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
        reuse: bool = False,
        normalize: bool | Mapping[str, Normalization] = False,
        strategy: strategies.Choice = "auto",
    ) -> Iterator[Batch]:
        """Go through the samples of a mode in batches.

        Args:
            mode: Name of the mode.
            batch_size: Samples of a batch; only the last one of an epoch may have fewer.
            shuffle: Whether each epoch is a new random order of all samples.
            seed: Seed of the orders; None: a different one each time.
            epochs: How often to go through all samples; None: without end. An epoch begins with
                the samples that are committed by then.
            fields: Names of the fields to give; None: all of them.
            dtype: Type that floating fields are given in; None: their own.
            reuse: Whether every batch is given in the same arrays, which is faster; each batch is
                then valid until the next.
            normalize: Whether floating fields are normalized, in place, by the mean and deviation
                of all samples of the mode; or the normalization to use.
            strategy: How samples are read, see `physx_core.dataset.read.strategy`; ``auto``: as
                suits the fields' sizes and the free memory.

        Returns:
            An iterator over batches: field name to array of shape (samples, *field shape).

        Raises:
            DatasetError: There is no such mode or field, or the mode has no samples.
            ConfigError: `batch_size` or `epochs` is out of range, or there is no such strategy.
        """
        self._reading()
        if isinstance(normalize, bool):
            normalize = self.normalization_of(mode) if normalize else {}
        return iter(
            Batches(
                self._columns,
                mode,
                list(dict.fromkeys(self._reader.mode(mode).fields if fields is None else fields)),
                batch_size,
                epochs,
                np.random.default_rng(seed) if shuffle else None,
                None if dtype is None else np.dtype(dtype),
                reuse,
                strategies.check(strategy),
                normalize,
            )
        )

    def reading_strategy(
        self, mode: str, fields: Sequence[str] | None = None
    ) -> strategies.Strategy:
        """Return how `batches` reads by itself: ``memory``, ``disk exact`` or ``disk windowed``.

        Args:
            mode: Name of the mode.
            fields: Names of the fields that are read together; None: all of them.

        Raises:
            DatasetError: There is no such mode or field.
        """
        self._reading()
        names = list(self._reader.mode(mode).fields if fields is None else fields)
        return self._columns.strategy(mode, names, None)

    def episodes(self, mode: str) -> list[Episode]:
        """Return the trajectories of a mode, each with the numbers of its rows in order of time.

        A trajectory ends where an environment calls `Environment.new_episode`, where
        `check_sample` refuses a sample, and where another run begins.

        Raises:
            DatasetError: There is no such mode, or its rows do not say where trajectories begin.
        """
        return find_episodes(self[mode], self.num_samples(mode))

    def split(
        self, mode: str, shares: Mapping[str, float], *, by: str = "row", seed: int = 0
    ) -> dict[str, Subset]:
        """Split the samples that a mode has now into parts, without copying any.

        Args:
            mode: Name of the mode.
            shares: Name of each part to its share; together 1 at most, what is left is in none.
            by: ``row``: rows are drawn at random; ``episode``: whole trajectories are, so that
                none has rows in two parts.
            seed: Seed of the draw; the same rows and seed give the same parts.

        Raises:
            DatasetError: There is no such mode, or trajectories are not known.
            ConfigError: The shares are unfit, or a part would be empty.
        """
        source = Source(self[mode], self._columns, mode, self.num_samples(mode))
        return split(source, shares, by, seed)

    @property
    def normalization(self) -> dict[str, Normalization]:
        """Mean and standard deviation of the floating fields of mode ``training``."""
        return self.normalization_of("training") if "training" in self else {}

    def normalization_of(self, mode: str) -> dict[str, Normalization]:
        """Return mean and standard deviation of the floating fields of a mode, of all its samples.

        Raises:
            DatasetError: There is no such mode, or a partition is missing or damaged.
        """
        self._reading()
        statistics = statistics_of(self._reader, mode)
        return {name: s.normalization() for name, s in statistics.items() if s.count}

    def recompute_normalization(self, mode: str = "training") -> dict[str, Normalization]:
        """Compute mean and standard deviation anew from all stored samples, and keep them.

        Raises:
            DatasetError: There is no such mode, or a partition is missing or damaged.
        """
        self._reading()
        self._reader.mode(mode).forget_statistics()
        found = self.normalization_of(mode)
        self._keep_statistics()
        return found

    def describe(self) -> list[dict[str, Any]]:
        """Return one row of a table for each field of each mode.

        Returns:
            Rows with the entries mode, field, role, dtype, shape, unit, samples, partitions and
            bytes (of the values).
        """
        self._reading()
        return summarize(self._manifest)

    def verify(self, *, content: bool = True) -> list[str]:
        """Check all partition files: there, whole, of the right rows, and unchanged.

        Args:
            content: Whether to read every byte; otherwise only headers and sizes are checked.

        Returns:
            One text for each problem; empty for a sound dataset.
        """
        self._reading()
        return find_problems(self.directory, self._manifest, content)

    # Within ---------------------------------------------------------------------------------

    def _reading(self) -> None:
        if self._closed:
            raise UsageError(f"The dataset in {self.directory} is closed.")
        if self._appender is not None:
            self._appender.flush()
            self._forget_moved()
