"""Source: instances of one environment, in this process or elsewhere, behind one interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

from physx_core.fields import Batch, Field


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
    def batch(self, size: int) -> Batch:
        """Return the next `size` rows, each checked; valid until the next call.

        Args:
            size: How many rows; shape of each array: (size, *field shape).

        Raises:
            SampleError: A sample cannot be stored; names the field, instance and step.
            PhysxError: An environment or client failed.
        """

    @abstractmethod
    def apply(self, prediction: Batch) -> None:
        """Give row i of a prediction to the instance that made row i of the last batch."""

    @abstractmethod
    def close(self) -> None:
        """Close the environments; nothing stays behind. Calling it again does nothing."""

    def __enter__(self) -> Self:
        """Open the source."""
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the source."""
        self.close()
