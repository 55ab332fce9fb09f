"""TrainingData: where a training's batches come from, epoch by epoch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

from physx_core.config import DatasetConfig
from physx_core.dataset import Dataset, Subset
from physx_core.errors import ConfigError, DatasetError, UsageError, listed
from physx_core.fields import Batch, Field
from physx_core.sources.source import Source
from physx_core.statistics import Normalization


class TrainingData:
    """Batches that environments make, or that the dataset holds.

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
        always_produce: bool,
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
            always_produce: Whether environments make new samples in every epoch.
            data_type: Floating type of the batches that are read.

        Raises:
            ConfigError: Environments make the samples, and `batch_nb` is missing or some are to
                be held back; or there are too few to hold back some.
            DatasetError: The dataset alone is read, and has no samples of the mode.
        """
        if source is not None and batch_nb is None:
            raise ConfigError(
                "Training.batch_nb is missing: environments make as many batches as it says."
            )
        self.dataset, self.source = dataset, source
        self.batches_read = 0
        self._config = config
        self._batch_size, self._batch_nb = batch_size, batch_nb
        self._seed = seed
        self._always_produce = always_produce
        self._data_type = data_type
        self._mode = config.mode
        self._reader: Iterator[Batch] | None = None
        self._produces = source is not None
        if source is None and not self._count(self._mode):
            raise DatasetError(
                f'The dataset has no samples of mode "{self._mode}" to train on. '
                f"It has: {listed(dataset.modes)}."
            )
        self.parts = self._split()

    def _split(self) -> dict[str, Subset]:
        share = self._config.validation_split
        if not share:
            return {}
        if self.source is not None:
            raise ConfigError(
                "DatasetConfig.validation_split holds back stored samples, but environments make "
                'these. Make the samples first, or make others in the mode "validation".'
            )
        if self._count("validation"):
            return {}
        shares = {"training": 1 - share, "validation": share}
        return self.dataset.split(self._mode, shares, by=self._config.split_by)

    def begin_epoch(self, epoch_id: int, names: Sequence[str]) -> int:
        """Get ready for an epoch and return its number of batches.

        Args:
            epoch_id: Number of the epoch, counted from 0.
            names: Fields that the batches read from the dataset shall hold.
        """
        self._produces = self.source is not None and (epoch_id == 0 or self._always_produce)
        if not self._produces and self._reader is None:
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
        if self._produces and self.source is not None:
            batch = self.source.batch(self._batch_size)
            self.dataset.define_fields(self._mode, self.source.fields)
            self.dataset.append(self._mode, batch)
            return batch
        if self._reader is None:
            raise UsageError("next_batch() needs begin_epoch() before it.")
        self.batches_read += 1
        return next(self._reader)

    def skip(self, batches: int) -> None:
        """Pass over batches that an earlier part of the training has read."""
        for _ in range(batches):
            self.next_batch()

    @property
    def produces(self) -> bool:
        """Whether environments make the batches of the present epoch."""
        return self._produces

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
        """The stored fields by name."""
        return self.dataset.fields(self._mode)

    def normalization(self) -> dict[str, Normalization]:
        """Return what normalizes the fields; empty where nothing shall be normalized."""
        if not self._config.normalize:
            return {}
        if self.parts:
            return self.parts["training"].normalization()
        if self._config.recompute_normalization and not self._produces:
            return self.dataset.recompute_normalization(self._mode)
        return self.dataset.normalization_of(self._mode)

    @property
    def _samples(self) -> int:
        part = self.parts.get("training")
        return part.num_samples if part else self._count(self._mode)

    def _count(self, mode: str) -> int:
        return self.dataset.num_samples(mode) if mode in self.dataset.modes else 0
