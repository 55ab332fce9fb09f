"""StoredBatches: a training's stored samples, and batches of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from physx_core.config import DatasetConfig, EnvironmentConfig
from physx_core.dataset import Dataset, Subset
from physx_core.errors import ConfigError, DatasetError, UsageError, listed
from physx_core.fields import Field
from physx_core.pipelines.storage import other_samples
from physx_core.statistics import Normalization
from physx_core.typing import Batch, Index

_SHOWN = 64
"""Largest number of validation samples whose predictions are shown."""


class StoredBatches:
    """Reads the samples of a dataset, epoch by epoch, and holds some back if configured.

    Attributes:
        dataset: The dataset.
        mode: Mode of the samples to train on.
        parts: The samples to train on and those held back, ``training`` and ``validation``; empty
            if none are held back.
        count: Number of batches read, also before the training was resumed.
        has_changed: Whether samples were replaced since the last call of `normalization`.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: DatasetConfig,
        environment: EnvironmentConfig | None,
        *,
        batch_size: int,
        validation_batch_size: int,
        seed: int,
        data_type: str,
        first: int,
    ) -> None:
        """Check that the samples are available, and hold some back if configured.

        Args:
            dataset: The dataset.
            config: Options for reading it.
            environment: Generates or replays the samples; None: they are only read.
            batch_size: Samples in a training batch.
            validation_batch_size: Samples in a validation batch.
            seed: Seed of the order of samples.
            data_type: Floating-point type of the batches.
            first: Number of batches that the training read before it was resumed.

        Raises:
            ConfigError: If samples should be held back, but environments generate them.
            DatasetError: If there are no samples to read.
        """
        self.dataset, self.mode = dataset, config.mode
        self.count = first
        self.has_changed = False
        self._config, self._batch_size = config, batch_size
        self._validation_batch_size = validation_batch_size
        self._seed, self._data_type = seed, data_type
        self._reader: Iterator[Batch] | None = None
        if environment is None and not self.has_samples:
            raise DatasetError(
                f'The dataset in {dataset.directory} has no samples of mode "{self.mode}" to '
                f"train on. It has: {listed(dataset.modes)}."
                f"{other_samples(dataset.directory, self.mode)}"
            )
        if config.validation_split and environment is not None and not environment.load_samples:
            raise ConfigError(
                "DatasetConfig.validation_split holds back stored samples, but environments "
                'generate these. Generate the samples first, or others in the mode "validation".'
            )
        self.parts: dict[str, Subset] = {}
        if config.validation_split and not dataset.num_samples("validation"):
            share = config.validation_split
            shares = {"training": 1 - share, "validation": share}
            self.parts = dataset.split(self.mode, shares, by=config.split_by)

    def begin_epoch(self, names: Sequence[str], batches: int) -> None:
        """Prepare an epoch.

        Args:
            names: Fields of the batches.
            batches: Number of batches that will be taken; ignored, because nothing is read ahead.
        """
        if self._reader is None:
            part = self.parts.get("training")
            read = part.batches if part else partial(self.dataset.batches, self.mode)
            self._reader = read(
                self._batch_size,
                shuffle=self._config.shuffle,
                seed=self._seed,
                epochs=None,
                fields=names,
                dtype=self._data_type,
                reuse=True,
                first=self.count,
            )

    def next(self) -> Batch:
        """Return the next batch, in physical units; valid until the next call."""
        if self._reader is None:
            raise UsageError("Call begin_epoch() before next_batch().")
        self.count += 1
        return next(self._reader)

    def update(self, index: Index, rows: Batch) -> None:
        """Replace samples.

        Args:
            index: Their indices in the mode.
            rows: Their new values.
        """
        self.dataset.update(self.mode, index, rows)
        self.has_changed = True

    def validation_batches(self, names: Sequence[str]) -> Iterator[Batch]:
        """Return the validation batches, in the order of writing."""
        part = self.parts.get("validation")
        batches = part.batches if part else partial(self.dataset.batches, "validation")
        return batches(self._validation_batch_size, fields=names, dtype=self._data_type, reuse=True)

    def validation_samples(self, names: Sequence[str]) -> Batch:
        """Return some of the validation samples, always the same ones, from all parts of them."""
        part = self.parts.get("validation")
        count = part.num_samples if part else self.dataset.num_samples("validation")
        chosen = np.linspace(0, count - 1, min(count, _SHOWN)).astype(np.intp)
        view = part or self.dataset["validation"]
        return {name: view[name][chosen] for name in names}

    @property
    def has_validation(self) -> bool:
        """Whether there are validation samples."""
        return bool(self.parts) or self.dataset.num_samples("validation") > 0

    @property
    def has_samples(self) -> bool:
        """Whether there are samples to train on."""
        return self.dataset.num_samples(self.mode) > 0

    @property
    def num_samples(self) -> int:
        """Number of samples to train on."""
        part = self.parts.get("training")
        return part.num_samples if part else self.dataset.num_samples(self.mode)

    @property
    def fields(self) -> Mapping[str, Field]:
        """The stored fields by name."""
        return self.dataset.fields(self.mode)

    def normalization(self, *, recompute: bool = True) -> dict[str, Normalization]:
        """Return the normalization by field; empty if nothing is to be normalized.

        Args:
            recompute: Whether it may be recomputed from all samples, if so configured.
        """
        self.has_changed = False
        if not self._config.normalize or not self.has_samples:
            return {}
        if self.parts:
            return self.parts["training"].normalization()
        if self._config.recompute_normalization and recompute:
            return self.dataset.recompute_normalization(self.mode)
        return self.dataset.normalization_of(self.mode)
