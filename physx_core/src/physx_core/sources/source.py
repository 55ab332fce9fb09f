"""Source: the interface to the instances of one environment, in this process or in clients."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from physx_core.closeable import Closeable
from physx_core.errors import PhysxError, UsageError
from physx_core.fields import Field
from physx_core.typing import Batch
from physx_core.workers.journal import Journal
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.pasts import Past

if TYPE_CHECKING:
    from physx_core.sources.episode_source import EpisodeSource
    from physx_core.workers.episode_queue import EpisodeQueue


class Canceled(BaseException):
    """A call to `Source.batch` was canceled: the run is over, and nothing is kept."""


class Opened(Closeable):
    """A context manager that opens environments, and closes them again."""

    @abstractmethod
    def open(self) -> None:
        """Create the environments.

        Raises:
            PhysxError: If an environment or client fails.
        """

    def __enter__(self) -> Self:
        """Open the source; if that fails, errors from closing the environments are suppressed."""
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
        """Close the source; after an error, errors from closing are suppressed."""
        with contextlib.suppress(PhysxError) if kind is not None else contextlib.nullcontext():
            self.close()


class Source(Opened):
    """Generates batches of samples with the instances of one environment.

    Row r, counted from 0 over all batches, comes from instance ``r % instance_nb`` (from 0 here),
    regardless of batch sizes and of the speed of the instances. So the seed and the number of
    instances determine every row. Sources are context managers.

    Attributes:
        instance_nb: Number of instances.
        sets: The sets of parameters that the instances get; those whose first rows are in the last
            batch can be taken from it.
        ignores_predictions: Whether `apply` is known to have no effect; unknown for clients.
        is_independent: Whether the environment's episodes are independent, so that `lease` can be
            used; known once the source is open.
        episode_fields: The fields that each independent episode has once; known once it is open.
        is_plain: Whether all that an open source produces are rows: there are no parameters, and
            rejected samples are not recorded.
        rows: Number of rows that have been returned, with those of an earlier run.
    """

    instance_nb: int
    sets: ParameterSets
    ignores_predictions = False
    is_independent = False
    episode_fields: Sequence[Field] = ()
    is_plain = False
    rows = 0
    _is_canceled = False
    _journals: Mapping[int, Journal] = {}  # if a later run may go on
    _name = ""

    @property
    @abstractmethod
    def fields(self) -> list[Field]:
        """The environment's fields, and those that physx adds to each row.

        Shapes that the environment does not define are None until it has set the data of a step
        and asks for a prediction, or until the first batch. Empty before `open`.
        """

    @abstractmethod
    def batch(self, size: int, stored: Batch | None = None) -> Batch:
        """Return the next `size` rows, each checked; valid until the next call.

        Args:
            size: Number of rows; shape of each array: (size, *field shape).
            stored: Stored rows to replay, field name to array of shape (size, *field shape): the
                instance that generates row i gets a copy of stored row i as `Environment.sample`,
                a dictionary of arrays. None: nothing is replayed, and `Environment.sample` is None.
                The parameters of the rows may be among the entries: see `Instance.step`.

        Raises:
            WrongSamplesError: If `check_sample` rejects too many consecutive samples.
            SampleError: If a sample cannot be stored; it names the field, instance and step.
            PhysxError: If an environment or client fails.
        """

    @abstractmethod
    def pop_rejected(self) -> Batch:
        """Return and clear the samples that `check_sample` rejected during the last batch.

        They have the same fields as other rows and are ordered by instance, then by step; a
        rejected row belongs to the batch with its instance's next accepted row. After a
        `WrongSamplesError` they are all samples rejected before it. Invalid ones, for example with
        NaN, are left out. Empty if ``record_wrong_samples`` is off.
        """

    @abstractmethod
    def apply(self, prediction: Batch) -> None:
        """Pass row i of a prediction to the instance that generated row i of the last batch."""

    @abstractmethod
    def lease(self, queue: EpisodeQueue) -> EpisodeSource:
        """Simulate independent episodes by number, instead of streams: do not call `batch` then.

        Args:
            queue: The numbers to simulate.
        """

    def take_pasts(self) -> Mapping[int, Past] | None:
        """Return what the instances need to go on after the last batch, and forget what was before.

        Returns:
            The past of each instance by number; None: a later run has to repeat the rows.
        """
        nb, found = self.instance_nb, dict[int, Past]()
        for number, journal in self._journals.items():
            if (past := journal.at((self.rows - number + nb) // nb)) is not None:
                found[number] = past
        return found if len(found) == nb else None

    def check_independent(self) -> None:
        """Check that the environment's episodes are independent.

        Raises:
            UsageError: If not.
        """
        if not self.is_independent:
            raise UsageError(
                f"{self._name} is a stream, which has no episodes to count: set episode_steps, or "
                "independent_episodes = True and call end_episode(); of a Gymnasium environment "
                "that ends its episodes, give --environment.independent-episodes. Or give batch_nb "
                "and batch_size instead of episodes, without min_clients and max_clients."
            )

    def cancel(self) -> None:
        """Make a call to `batch` in another thread end soon, with `Canceled`; then call `close`.

        Environments in this process finish the call.
        """
        self._is_canceled = True

    @abstractmethod
    def close(self) -> None:
        """Close the environments, and end their clients. Calling it again does nothing."""


def check_stored(stored: Batch, size: int) -> None:
    """Check that there is one stored row for each row of a batch."""
    for name, values in stored.items():
        if len(values) != size:
            raise UsageError(
                f'There are {len(values)} stored rows of "{name}" for a batch of {size} rows.'
            )
