"""StoredBatches: a training's stored samples, and batches of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial

import numpy as np

from physx_core.config import EnvironmentConfig
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, DatasetError, UsageError, listed
from physx_core.fields import Field
from physx_core.normalization import Normalization
from physx_core.pipelines.learning.data_record import training_view, unseen_parts
from physx_core.pipelines.storage import other_samples
from physx_core.results.judge import Judged
from physx_core.typing import Batch, Index
from physx_core.views.batches import Batches
from physx_core.views.dataset_config import DatasetConfig
from physx_core.views.folds import Part
from physx_core.views.view import View

_SHOWN = 64
"""Largest number of validation samples whose predictions are shown."""
_PLAIN, _ALL = View(), View(hold_back=False)
_NOT_REPLAYED = ("window", "sources", "weights", "stride")

Snapshots = dict[str, dict[str, Sequence[int]]]
"""Mode to `Batches.snapshot`."""


class StoredBatches:
    """Reads the samples of a dataset, epoch by epoch, and holds some back if configured.

    Attributes:
        dataset: The dataset.
        mode: Mode of the samples to train on.
        count: Number of batches read, also before the training was resumed.
        has_changed: Whether samples were replaced since the last call of `normalization`.
        snapshots: The samples that there were when the first of them was read, by mode.
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
        batch_fields: Sequence[str],
        data_type: str,
        first: int,
        snapshots: Mapping[str, Mapping[str, Sequence[int]]],
    ) -> None:
        """Check that the samples are available, and hold some back if configured.

        Args:
            dataset: The dataset.
            config: Options for reading it.
            environment: Generates or replays the samples; None: they are only read.
            batch_size: Samples in a training batch.
            validation_batch_size: Samples in a validation batch.
            seed: Seed of the order of samples.
            batch_fields: Names of the fields that the network needs.
            data_type: Floating-point type of the batches.
            first: Number of batches that the training read before it was resumed.
            snapshots: The `snapshots` before the training was resumed; those of other modes are
                taken when the first of their samples is read.

        Raises:
            ConfigError: If the view is not one of what environments generate.
            DatasetError: If there are no samples to read.
        """
        self.dataset, self.mode = dataset, config.mode
        self.count, self.has_changed = first, False
        self.snapshots: Snapshots = {mode: dict(each) for mode, each in snapshots.items()}
        self._config, self._batch_size = config, batch_size
        self._validation_batch_size = validation_batch_size
        self._seed, self._names, self._data_type = seed, list(batch_fields), data_type
        self._batches: Batches | None = None
        self._longer: Batches | None = None
        if environment is None and not self.has_samples and not config.view.sources:
            raise DatasetError(
                f'The dataset in {dataset.directory} has no samples of mode "{self.mode}" to '
                f"train on. It has: {listed(dataset.modes)}."
                f"{other_samples(dataset.directory, self.mode)}"
            )
        generates = environment is not None and not environment.load_samples
        if environment is not None:
            _check_view(config.view, generates=generates)
        has_now = dataset.num_samples("validation") > 0
        had_mode = "validation" in self.snapshots if self.snapshots else has_now
        self._has_mode = had_mode and has_now  # else its samples were removed
        self._view = training_view(
            config, dataset.info, has_validation=had_mode, generates=generates
        )

    def _open(self, mode: str, view: View, size: int, part: Part = "training") -> Batches:
        """Open the samples of a mode as they were at its snapshot, or else are now."""
        open_now = partial(
            Batches,
            view,
            size,
            self._seed,
            data=None if view.sources else self.dataset,
            mode=mode,
            part=part,
            fields=self._names,
            dtype=self._data_type,
            reuse=True,
            beside=None if part == "training" else self._training,
        )
        known = self.snapshots.get(mode)
        try:
            found = open_now(snapshot=known)
        except DatasetError:
            if known is None or view.sources:
                raise
            found = open_now()  # samples were removed, as the training has said
        self.snapshots[mode] = {name: list(each) for name, each in found.snapshot.items()}
        return found

    @cached_property
    def _training(self) -> Batches:
        found = self._open(self.mode, self._view, self._batch_size)
        if self._has_mode:
            taken = [*self.dataset.rows("validation").snapshot]
            self.snapshots.setdefault("validation", {"": taken})
        return found

    @cached_property
    def _validation(self) -> Batches:
        return self._open_unseen("validation")

    def _open_unseen(self, name: str) -> Batches:
        parts = unseen_parts(self._view, self.mode, has_mode=self._has_mode)
        mode, view, part = parts[name]
        return self._open(mode, view, self._validation_batch_size, part)

    def read_as(self, change: Callable[[View], View]) -> Batches:
        """Read training batches of another view of the same samples, such as longer windows.

        Args:
            change: Returns it for the view that is configured.

        Returns:
            The batches.
        """
        self._longer = self._open(self.mode, change(self._view), self._batch_size)
        return self._longer

    @property
    def _read(self) -> Batches:
        return self._training if self._longer is None else self._longer

    def begin_epoch(self, names: Sequence[str], batches: int) -> None:
        """Prepare an epoch.

        Args:
            names: Fields of the batches.
            batches: Number of batches that will be taken; ignored, because nothing is read ahead.
        """
        if self._batches is None:
            self._batches = self._read.reading(names)

    def next(self) -> Batch:
        """Return the next batch, in physical units; valid until the next call."""
        if self._batches is None:
            raise UsageError("Call begin_epoch() before next_batch().")
        self.count += 1
        return self._batches[self.count - 1]

    def read(self, number: int, names: Sequence[str]) -> Batch:
        """Read a batch by its number, in physical units."""
        return self._read.reading(names)[number]

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
        return iter(self._validation.reading(names))

    def validation_samples(self, names: Sequence[str]) -> Batch:
        """Return some of the validation samples, always the same ones, from all parts of them."""
        count = self._validation.num_items
        chosen = np.linspace(0, count - 1, min(count, _SHOWN)).astype(np.intp)
        return self._validation.reading(names).take(chosen)

    def unseen(self, used: str) -> dict[str, Judged]:
        """Return the parts of the samples that the network does not learn from, by name.

        Args:
            used: What those for validation decided about the network, in words.
        """
        found = {}
        if self.has_validation:
            found["validation"] = Judged.of(self._validation, has_mode=self._has_mode, used=used)
        if self._view.test_fold is not None:
            found["test"] = Judged.of(self._open_unseen("test"), has_mode=False)
        return found

    @property
    def validation(self) -> Batches:
        """The validation batches, in the order of writing."""
        return self._validation

    @property
    def training(self) -> Batches:
        """The batches of one epoch after another."""
        return self._training

    @property
    def datasets(self) -> dict[str, Dataset]:
        """The datasets by the names of `View.sources`; "" is that of the run."""
        return self._training.datasets if self._view.sources else {"": self.dataset}

    @property
    def has_validation(self) -> bool:
        """Whether there are validation samples."""
        return self._has_mode or (self._view.hold_back and self._validation.num_items > 0)

    def describe_parts(self) -> Iterator[str]:
        """Say what is held back for validation, unless a mode is for that."""
        if self._view.hold_back and not self._has_mode:
            held = self._validation
            yield (
                f"{self.num_samples:,} samples to train on, {held.num_items:,} held back for "
                f"validation: {' and '.join(held.division)}"
            )

    @property
    def has_samples(self) -> bool:
        """Whether there are samples to train on."""
        return self.dataset.num_samples(self.mode) > 0

    @property
    def num_samples(self) -> int:
        """Number of samples to train on."""
        return self._read.num_items

    @property
    def num_batches(self) -> int:
        """Number of batches of one pass over them."""
        return len(self._read)

    @property
    def rows(self) -> Index | None:
        """The rows to train on, ascending; None: all of the mode."""
        if not self.has_samples or self._has_all_rows:
            return None
        return self._training.all_rows()

    @property
    def _has_all_rows(self) -> bool:
        """Whether all samples of the mode are trained on; later ones too, until one is read."""
        chooses = self._config.view not in (_PLAIN, _ALL) or self._view.hold_back
        is_chosen = chooses or self.mode in self.snapshots
        return not is_chosen or self._training.has_all_rows

    @property
    def fields(self) -> Mapping[str, Field]:
        """The stored fields by name, and windows of them."""
        stored = self.dataset.fields(self.mode) if self.mode in self.dataset else {}
        return stored | self._training.fields if self._view.windows else stored

    def normalization(self, *, recompute: bool = True) -> dict[str, Normalization]:
        """Return the normalization by field; empty if nothing is to be normalized.

        Args:
            recompute: Whether it may be recomputed from all samples, if so configured.
        """
        self.has_changed = False
        if self._config.normalize is False or not (self.has_samples or self._view.sources):
            return {}
        if self._view.windows or not self._has_all_rows:
            return self._training.normalization(self._config.normalize)
        if self._config.recompute_normalization and recompute:
            self.dataset.recompute_normalization(self.mode)
        return self.dataset.normalization_of(self.mode, self._config.normalize)


def _check_view(view: View, *, generates: bool) -> None:
    """Check that a view is one of what environments generate or replay."""
    if generates and view not in (_PLAIN, _ALL):
        raise ConfigError(
            "DatasetConfig.view chooses among stored samples, but environments generate "
            'these. Generate the samples first, or others in the mode "validation".'
        )
    for name in () if generates else _NOT_REPLAYED:
        if getattr(view, name) != getattr(_PLAIN, name):
            raise ConfigError(
                "Environments replay single rows of one dataset, each once: leave out "
                f"DatasetConfig.view.{name}."
            )
