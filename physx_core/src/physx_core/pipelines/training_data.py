"""TrainingData: where a training's batches come from, epoch by epoch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from physx_core.config import DatasetConfig, EnvironmentConfig
from physx_core.dataset import Dataset, Subset
from physx_core.dataset.write.definitions import compare_fields
from physx_core.errors import ConfigError, DatasetError, UsageError, listed
from physx_core.fields import RESERVED, Field
from physx_core.pipelines.storage import record_rejected
from physx_core.pipelines.stored_rows import StoredRows
from physx_core.sources.source import Source
from physx_core.statistics import Normalization
from physx_core.typing import Batch


class TrainingData:
    """Batches that environments make, or that the dataset holds, or that go from one to the other.

    Without environments all epochs read the dataset. Environments make new samples in the first
    epoch, or in each with ``always_produce``; with ``load_samples`` they replay stored ones in the
    first epoch, or in each with ``only_first_epoch=False``. The other epochs read the dataset.

    In an epoch that replays, the samples to learn from are taken once in each pass, in the order of
    writing or, with ``shuffle``, in a new random one; an epoch is one pass, or ``batch_nb``
    batches. Each goes to an instance, which finds it in `Environment.sample`; what it makes of it
    has the same fields, is checked like any sample, is learned from, and takes the place of the
    stored values in the dataset. The row keeps its ``env_id``, ``episode`` and ``step``. A later
    replay begins with what the earlier one made. Samples that are held back, and those of the mode
    "validation", are not replayed. What normalizes is computed from the stored rows before the
    first epoch, and anew before each epoch that follows a replay.

    Attributes:
        dataset: Where batches are read from, and stored if environments make them.
        source: The environments; None where the dataset alone is read.
        batches_read: Number of batches that were read from the dataset.
        parts: The samples to learn from and those held back, ``training`` and ``validation``;
            empty where none are held back.
    """

    def __init__(
        self,
        dataset: Dataset,
        source: Source | None,
        config: DatasetConfig,
        *,
        batch_size: int,
        batch_nb: int | None,
        seed: int,
        environment: EnvironmentConfig | None,
        data_type: str,
    ) -> None:
        """Keep where to read and what.

        Args:
            dataset: The dataset.
            source: The environments, or None.
            config: How the dataset is read.
            batch_size: Samples in a batch.
            batch_nb: Batches in an epoch; None: one pass over the stored samples.
            seed: Seed of the order of samples.
            environment: What the environments are for; None without a source.
            data_type: Floating type of the batches that are read.

        Raises:
            ConfigError: Environments make the samples, and `batch_nb` is missing or some are to
                be held back; or there are too few to hold back some.
            DatasetError: Stored samples are needed, and the dataset has none of the mode.
            FieldsMismatchError: The environments have other fields than the samples to replay.
        """
        replay = environment is not None and environment.load_samples
        if source is not None and batch_nb is None and not replay:
            raise ConfigError(
                "Training.batch_nb is missing: environments make as many batches as it says."
            )
        self.dataset, self.source = dataset, source
        self.batches_read = 0
        self._config = config
        self._batch_size, self._batch_nb = batch_size, batch_nb
        self._seed = seed
        self._always = environment is not None and (
            not environment.only_first_epoch if replay else environment.always_produce
        )
        self._data_type = data_type
        self._mode = config.mode
        self._reader: Iterator[Batch] | None = None
        self._at_work = source is not None
        self._changed = False
        if source is None and not self._count(self._mode):
            raise DatasetError(
                f'The dataset has no samples of mode "{self._mode}" to train on. '
                f"It has: {listed(dataset.modes)}."
            )
        self.parts = self._split(replay)
        self._stored = self._stored_rows(source) if replay and source is not None else None

    def _split(self, replay: bool) -> dict[str, Subset]:
        share = self._config.validation_split
        if not share:
            return {}
        if self.source is not None and not replay:
            raise ConfigError(
                "DatasetConfig.validation_split holds back stored samples, but environments make "
                'these. Make the samples first, or make others in the mode "validation".'
            )
        if self._count("validation"):
            return {}
        shares = {"training": 1 - share, "validation": share}
        return self.dataset.split(self._mode, shares, by=self._config.split_by)

    def _stored_rows(self, source: Source) -> StoredRows:
        """Return the rows to replay, which have the environments' fields."""
        part = self.parts.get("training")
        random = np.random.default_rng([self._seed, 1]) if self._config.shuffle else None
        rows = StoredRows(self.dataset, self._mode, part.rows if part else None, random)
        known, given = (
            {name: field for name, field in fields.items() if name not in RESERVED}
            for fields in (self.fields, {field.name: field for field in source.fields})
        )
        compare_fields(f'The environment cannot replay mode "{self._mode}", which', known, given)
        return rows

    def begin_epoch(self, epoch_id: int, names: Sequence[str]) -> int:
        """Get ready for an epoch and return its number of batches.

        Args:
            epoch_id: Number of the epoch, counted from 0.
            names: Fields that the batches read from the dataset shall hold.
        """
        self._at_work = self.source is not None and (epoch_id == 0 or self._always)
        if not self._at_work and self._reader is None:
            part = self.parts.get("training")
            batches = part.batches if part else partial(self.dataset.batches, self._mode)
            self._reader = batches(
                self._batch_size,
                shuffle=self._config.shuffle,
                seed=self._seed,
                epochs=None,
                fields=names,
                dtype=self._data_type,
                reuse=True,
            )
        return self._batch_nb or -(-self._samples // self._batch_size)

    def next_batch(self) -> Batch:
        """Return the next batch in physical units; stored already if environments made it."""
        if self._at_work and self.source is not None:
            with record_rejected(self.source, self.dataset):
                if self._stored is not None:
                    return self._replayed(self.source, self._stored)
                batch = self.source.batch(self._batch_size)
                self.dataset.define_fields(self._mode, self.source.fields)
                self.dataset.append(self._mode, batch, checked=True)
                return batch
        if self._reader is None:
            raise UsageError("next_batch() needs begin_epoch() before it.")
        self.batches_read += 1
        return next(self._reader)

    def _replayed(self, source: Source, stored: StoredRows) -> Batch:
        """Have the environments replay the next stored samples, and store what they make."""
        index, rows = stored.take(self._batch_size)
        batch = source.batch(len(index), rows)
        made = {name: values for name, values in batch.items() if name not in RESERVED}
        self.dataset.update(self._mode, index, made)
        self._changed = True
        return batch

    def skip(self, batches: int) -> None:
        """Pass over batches that an earlier part of the training has read."""
        for _ in range(batches):
            self.next_batch()

    @property
    def produces(self) -> bool:
        """Whether environments make new samples in the present epoch."""
        return self._at_work and self._stored is None

    @property
    def has_changed(self) -> bool:
        """Whether stored samples were replaced since `normalization` was called."""
        return self._changed

    def validation_batches(self, names: Sequence[str]) -> Iterator[Batch]:
        """Return the batches to validate with, in the order of writing."""
        part = self.parts.get("validation")
        batches = part.batches if part else partial(self.dataset.batches, "validation")
        return batches(1024, fields=names, dtype=self._data_type, reuse=True)

    @property
    def has_validation(self) -> bool:
        """Whether there are samples to validate with."""
        return bool(self.parts) or self._count("validation") > 0

    @property
    def fields(self) -> Mapping[str, Field]:
        """The stored fields by name; those of the environments as long as nothing is stored."""
        if self.source is not None and not self._count(self._mode):
            return {field.name: field for field in self.source.fields}
        return self.dataset.fields(self._mode)

    def normalization(self) -> dict[str, Normalization]:
        """Return what normalizes the fields; empty where nothing shall be normalized."""
        self._changed = False
        if not self._config.normalize or not self._count(self._mode):
            return {}
        if self.parts:
            return self.parts["training"].normalization()
        if self._config.recompute_normalization and not self.produces:
            return self.dataset.recompute_normalization(self._mode)
        return self.dataset.normalization_of(self._mode)

    @property
    def _samples(self) -> int:
        part = self.parts.get("training")
        return part.num_samples if part else self._count(self._mode)

    def _count(self, mode: str) -> int:
        return self.dataset.num_samples(mode) if mode in self.dataset.modes else 0
