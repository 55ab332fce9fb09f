"""LocalSource: runs all instances of the environment in this process."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from physx_core.components.environment import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError, PhysxError, StateError, UsageError
from physx_core.fields import Field
from physx_core.rows import ROW_FIELDS, RowBuffer, concatenate, copy_row, infer_shapes
from physx_core.sources.source import Source, check_stored
from physx_core.typing import Batch
from physx_core.workers.instance import NOTHING, Instance, Skip, instance_arguments
from physx_core.workers.parameter_sets import ParameterSets

if TYPE_CHECKING:
    from physx_core.sources.episode_source import LocalEpisodes
    from physx_core.workers.episode_queue import EpisodeQueue


class LocalSource(Source):
    """Steps the instances one after another, without serialization; one copy, into the row."""

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        *,
        accept_all: bool = False,
        skip: Skip = NOTHING,
    ) -> None:
        """Prepare the instances.

        Args:
            config: The environment, and the number of instances.
            services: Serves the environments' requests.
            seed: Seed of all instances.
            accept_all: Whether samples that `check_sample` rejects count like the others.
            skip: The rows that an earlier run already got: generated again, but not returned.

        Raises:
            ConfigError: If the configuration is for an elastic run, which needs clients.
        """
        if config.is_elastic:
            raise ConfigError(
                "EnvironmentConfig.min_clients and max_clients are for clients, but the "
                "environment runs in this process (as_tcp_ip_client=False, or the only "
                "environment of a prediction): leave them out."
            )
        self.instance_nb = config.num_clients
        self._name = getattr(config.environment, "__name__", str(config.environment))
        self._services = services
        self._config = config
        self.sets = ParameterSets(config, seed, skip)
        self._instances = [
            Instance(**instance_arguments(config, number, seed, accept_all))
            for number in range(1, self.instance_nb + 1)
        ]
        self._buffer: RowBuffer | None = None
        self._next = 0
        self._skip = skip
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
            self._open(instance)
        self.ignores_predictions = all(instance.ignores_predictions for instance in self._instances)
        self.sets.begin([instance.parameters for instance in self._instances])
        self.is_independent = self._instances[0].is_independent
        self.episode_fields = self._instances[0].episode_fields
        self.is_plain = not (self.sets.parameters or self._config.record_wrong_samples)

    def batch(self, size: int, stored: Batch | None = None) -> Batch:
        """Return the next rows: see `Source.batch`.

        Raises:
            UsageError: If the first batch has no rows, or there are not `size` stored rows.
            PhysxError: If an environment fails.
        """
        if stored is not None:
            check_stored(stored, size)
        if not self.is_plain:
            self.pop_rejected()
        if self._next < self._skip.rows:
            self._generate_again(size)
        self._last = range(self._next, self._next + size)
        rows = self._fill(size, stored).take()
        if not self.is_plain:
            self.sets.note(rows)
        return rows

    def lease(self, queue: EpisodeQueue) -> LocalEpisodes:
        """Simulate independent episodes: see `Source.lease`."""
        from physx_core.sources.episode_source import LocalEpisodes  # streams need no records

        return LocalEpisodes(self._instances[0], self.sets, queue)

    def _open(self, instance: Instance) -> None:
        draw, with_states = self._config.visualizer is not None, self._config.state_every > 0
        choose = partial(self._choose, instance.instance_id)
        instance.open(self._services, draw, choose, with_states=with_states)

    def _choose(self, instance_id: int, episode: int) -> dict[str, Any]:
        return self.sets.choose(instance_id, episode)

    def _fill(self, size: int, stored: Batch | None = None) -> RowBuffer:
        """Generate the next rows; return the buffer with them."""
        buffer, first, count = self._buffer, self._next, self.instance_nb
        if buffer is not None and buffer.capacity < size:
            buffer = self._buffer = RowBuffer(buffer.fields[: -len(ROW_FIELDS)], size)
        elif buffer is not None and buffer.count:  # an error ended the last batch
            buffer.clear()
        instances, every = self._instances, self._config.state_every
        while self._next < first + size:
            place = self._next % count
            instance = instances[place]
            given = None if stored is None else copy_row(stored, self._next - first)
            try:
                if every and (row := self._next // count) and row % every == 0:
                    with contextlib.suppress(StateError):  # after the same rows as in a client
                        instance.get_state()
                sample = instance.step(given)
            except PhysxError as error:
                if instance.environment is not None:
                    self.sets.explain(place + 1, instance.environment.episode_index, error)
                raise
            if buffer is None:
                buffer = self._buffer = RowBuffer(infer_shapes(instance.fields, sample), size)
            buffer.put(sample, place + 1, instance.last_episode, instance.last_step)
            self._next += 1
        if buffer is None:
            raise UsageError(f"A batch must have at least one row, not {size}.")
        return buffer

    def _generate_again(self, size: int) -> None:
        """Generate the rows that an earlier run already got, and discard them."""
        while left := self._skip.rows - self._next:
            self._fill(min(left, size)).clear()
        for instance in self._instances:
            if instance.rejected is not None:
                instance.rejected.discard(self._skip.rejected_of(instance.instance_id))

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
        """Close the environments; the first error is raised once all are closed."""
        with contextlib.ExitStack() as stack:
            for instance in self._instances:
                stack.callback(instance.close)
