"""LocalSource: runs all instances of the environment in this process."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from physx_core.components.environment import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import UsageError
from physx_core.fields import Field
from physx_core.rows import ROW_FIELDS, RowBuffer, concatenate, copy_row, infer_shapes
from physx_core.sources.source import Source, check_stored
from physx_core.typing import Batch
from physx_core.workers.instance import Instance, instance_arguments


class LocalSource(Source):
    """Steps the instances one after the other, without serialization; one copy, into the row."""

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        *,
        accept_all: bool = False,
    ) -> None:
        """Prepare the instances.

        Args:
            config: The environment, and the number of instances.
            services: Serves the environments' requests.
            seed: Seed of all instances.
            accept_all: Whether samples that `check_sample` rejects count like the others.
        """
        self.instance_nb = config.num_clients
        self._services = services
        self._config = config
        self._instances = [
            Instance(**instance_arguments(config, number, seed, accept_all))
            for number in range(1, self.instance_nb + 1)
        ]
        self._buffer: RowBuffer | None = None
        self._next = 0
        self._last = range(0)

    @property
    def fields(self) -> list[Field]:
        """The fields of the rows: see `Source.fields`."""
        if self._buffer is not None:
            return self._buffer.fields
        known = self._instances[0].fields
        return [*known, *ROW_FIELDS] if known else []

    def open(self) -> None:
        """Create the instances' environments: see `Source.open`."""
        for instance in self._instances:
            instance.open(self._services, draw=self._config.visualizer is not None)

    def batch(self, size: int, stored: Batch | None = None) -> Batch:
        """Return the next rows: see `Source.batch`."""
        if stored is not None:
            check_stored(stored, size)
        if self._config.record_wrong_samples:
            self.pop_rejected()
        buffer = self._buffer
        if buffer is not None:
            buffer.clear()
            if buffer.capacity < size:
                buffer = self._buffer = RowBuffer(buffer.fields[: -len(ROW_FIELDS)], size)
        instances, count = self._instances, self.instance_nb
        self._last = range(self._next, self._next + size)
        for row in range(size):
            instance = instances[self._next % count]
            sample = instance.step(None if stored is None else copy_row(stored, row))
            if buffer is None:
                buffer = self._buffer = RowBuffer(infer_shapes(instance.fields, sample), size)
            buffer.put(sample, instance.instance_id, instance.last_episode, instance.last_step)
            self._next += 1
        if buffer is None:
            raise UsageError(f"A batch must have at least one row, not {size}.")
        return buffer.take()

    def pop_rejected(self) -> Batch:
        """Return the rejected samples: see `Source.pop_rejected`."""
        blocks = []
        for instance in self._instances:
            if instance.rejected is not None:
                if self._buffer is None:
                    fields = instance.rejected.infer_shapes(instance.fields)
                else:
                    fields = self._buffer.fields[: -len(ROW_FIELDS)]
                blocks.append(instance.rejected.take(fields, instance.instance_id))
        return concatenate(blocks)

    def apply(self, prediction: Batch) -> None:
        """Pass predictions to the instances: see `Source.apply`."""
        for row, number in enumerate(self._last):
            sample = {name: values[row] for name, values in prediction.items()}
            self._instances[number % self.instance_nb].apply(sample)

    def close(self) -> None:
        """Close the environments; the first error is raised once all of them are closed."""
        with contextlib.ExitStack() as stack:
            for instance in self._instances:
                stack.callback(instance.close)
