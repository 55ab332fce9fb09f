"""Source: instances of one environment, in this process or elsewhere, behind one interface."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

from physx_core.errors import PhysxError, UsageError
from physx_core.fields import Field
from physx_core.typing import Batch


class Source(ABC):
    """Makes batches of samples with the instances of one environment.

    Row r of all that a source ever makes, counted from 0, comes from instance ``r % instance_nb``
    (counted from 0 here), whatever the sizes of the batches and the speed of the instances. So the
    seed and the number of instances determine every row. A context manager.

    Attributes:
        instance_nb: Number of instances.
        fields: The environment's fields, and those that physx adds to each row; shapes that the
            environment leaves open are None until the first batch.
    """

    instance_nb: int
    fields: list[Field]

    @abstractmethod
    def open(self) -> None:
        """Bring the instances to life.

        Raises:
            PhysxError: An environment or client failed.
        """

    @abstractmethod
    def batch(self, size: int, stored: Batch | None = None) -> Batch:
        """Return the next `size` rows, each checked; valid until the next call.

        Args:
            size: How many rows; shape of each array: (size, *field shape).
            stored: Stored rows to replay, field name to array of shape (size, *field shape): the
                instance that makes row i finds stored row i in `Environment.sample`, a copy as a
                dictionary of arrays. None: nothing is replayed, and it finds None.

        Raises:
            WrongSamplesError: `check_sample` rejected too many samples in a row.
            SampleError: A sample cannot be stored; names the field, instance and step.
            PhysxError: An environment or client failed.
        """

    @abstractmethod
    def pop_rejected(self) -> Batch:
        """Return what `check_sample` rejected while the last batch was made, and forget it.

        They have the same fields as other rows and come by instance, then by step; a rejected row
        belongs to the batch that holds the next accepted one of its instance. After a
        `WrongSamplesError` they are all those that were rejected before it. An invalid one, for
        example with NaN, is left out: see `physx_core.rows.RejectedSamples`. Empty without
        rejected rows and where ``record_wrong_samples`` is off.
        """

    @abstractmethod
    def apply(self, prediction: Batch) -> None:
        """Give row i of a prediction to the instance that made row i of the last batch."""

    @abstractmethod
    def close(self) -> None:
        """Close the environments; nothing stays behind. Calling it again does nothing."""

    def __enter__(self) -> Self:
        """Open the source; where that fails, environments that cannot be closed are not told of."""
        try:
            self.open()
        except BaseException:
            with contextlib.suppress(PhysxError):
                self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the source; after an error, no other takes its place."""
        with contextlib.suppress(PhysxError) if kind is not None else contextlib.nullcontext():
            self.close()


def check_stored(stored: Batch, size: int) -> None:
    """Check that stored rows are as many as a batch has.

    Raises:
        UsageError: There are more or fewer.
    """
    for name, values in stored.items():
        if len(values) != size:
            raise UsageError(f'{len(values)} stored rows of "{name}" cannot make {size} rows.')
