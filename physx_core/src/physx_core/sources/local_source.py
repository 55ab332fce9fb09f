"""LocalSource: runs all instances of the environment in this process."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from physx_core.components.services import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError, PhysxError, StateError, UsageError
from physx_core.fields import Field
from physx_core.net.frames import Kind, pack
from physx_core.net.remote_errors import decode_error, encode_error
from physx_core.net.values import decode, encode
from physx_core.rows import ROW_FIELDS, RowBuffer, concatenate, copy_row, infer_shapes
from physx_core.sources.source import Source, check_stored
from physx_core.typing import Batch, Sample
from physx_core.workers.instance import Instance, instance_arguments
from physx_core.workers.journal import Journal
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.pasts import NOTHING, Answer, Past, Skip

if TYPE_CHECKING:
    from physx_core.sources.episode_source import LocalEpisodes
    from physx_core.workers.episode_queue import EpisodeQueue


_LOG = logging.getLogger("physx")


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
        keeps_pasts: bool = False,
    ) -> None:
        """Prepare the instances.

        Args:
            config: The environment, and the number of instances.
            services: Serves the environments' requests.
            seed: Seed of all instances.
            accept_all: Whether samples that `check_sample` rejects count like the others.
            skip: The rows that an earlier run already got: generated again, but not returned.
            keeps_pasts: Whether somebody calls `take_pasts` after each batch.

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
        self.rows, self._skip = skip.rows, skip
        self._last = range(0)
        self._rejected: list[list[Batch]] = [[] for _ in self._instances]
        pasts = [skip.pasts.get(each.instance_id, Past()) for each in self._instances]
        self._restored = [past.rows for past in pasts]
        self._rejections = [past.rejected for past in pasts]
        self._says_refusal = config.state_every > 0
        self._journals: dict[int, Journal] = {}
        if keeps_pasts and config.state_every:
            for number in range(1, self.instance_nb + 1):
                past, limit = skip.pasts.get(number), 1e9 * config.journal_size
                self._journals[number] = Journal(
                    number, limit, self.sets, services, past, keeps=True
                )

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
            self._generate_again()
        self._last = range(self._next, self._next + size)
        rows = self._fill(size, stored).take()
        self.rows = self._next
        if not self.is_plain:
            self.sets.note(rows)
        return rows

    def lease(self, queue: EpisodeQueue) -> LocalEpisodes:
        """Simulate independent episodes: see `Source.lease`."""
        from physx_core.sources.episode_source import LocalEpisodes  # streams need no records

        every = self._config.state_every
        return LocalEpisodes(self._instances[0], self.sets, queue, every)

    def _open(self, instance: Instance) -> None:
        draw, with_states = self._config.visualizer is not None, self._config.state_every > 0
        choose = partial(self.sets.choose, instance.instance_id)
        number, services = instance.instance_id, self._services
        journal = self._journals.get(number)
        if journal is not None:
            services = _Remembering(services, journal)
        instance.open(services, draw, choose, with_states=with_states)
        if journal is not None:
            journal.end_creation()
        past = self._skip.pasts.get(number)
        if past is not None and past.state:
            instance.set_state(decode(past.state)["instance"])

    def _fill(self, size: int, stored: Batch | None = None) -> RowBuffer:
        """Generate the next rows; return the buffer with them."""
        buffer, first, count = self._buffer, self._next, self.instance_nb
        if buffer is not None and buffer.capacity < size:
            buffer = self._buffer = RowBuffer(buffer.fields[: -len(ROW_FIELDS)], size)
        elif buffer is not None and buffer.count:  # an error ended the last batch
            buffer.clear()
        instances = self._instances
        while self._next < first + size:
            place = self._next % count
            instance = instances[place]
            given = None if stored is None else copy_row(stored, self._next - first)
            sample = self._step(self._next, given)
            if buffer is None:
                buffer = self._buffer = RowBuffer(infer_shapes(instance.fields, sample), size)
            buffer.put(sample, place + 1, instance.last_episode, instance.last_step)
            self._next += 1
        if buffer is None:
            raise UsageError(f"A batch must have at least one row, not {size}.")
        return buffer

    def _step(self, row: int, stored: Sample | None = None) -> dict[str, Any]:
        """Return a row of the instance whose turn it is; take its state before, if it is due."""
        number, place = divmod(row, self.instance_nb)
        instance, every = self._instances[place], self._config.state_every
        try:
            if every and number and number % every == 0 and number != self._restored[place]:
                self._take_state(instance, number)
            return instance.step(stored)
        except PhysxError as error:
            if instance.environment is not None:
                self.sets.explain(place + 1, instance.environment.episode_index, error)
            raise

    def _take_state(self, instance: Instance, rows: int) -> None:
        """Take a state, after the same rows as in a client."""
        number = instance.instance_id
        self._take_rejected(instance)
        try:
            state = instance.get_state()
        except StateError as error:
            if self._says_refusal:
                self._says_refusal = False
                _LOG.warning(
                    "A run that is resumed will repeat all rows since the last state, as instance "
                    "%d gives none. %s",
                    number,
                    error,
                )
            return
        if number in self._journals:
            encoded = encode({"instance": state, "stored": []}, "the state")
            rejected = self._rejections[number - 1]
            self._journals[number].keep_state(Past(rows, encoded, rejected))

    def _generate_again(self) -> None:
        """Generate the rows that an earlier run already got, and discard them."""
        for row in range(self._next, self._skip.rows):
            if row // self.instance_nb >= self._restored[row % self.instance_nb]:
                self._step(row)
            self._next = row + 1

    def pop_rejected(self) -> Batch:
        """Return the rejected samples: see `Source.pop_rejected`."""
        blocks = []
        for instance, taken in zip(self._instances, self._rejected, strict=True):
            self._take_rejected(instance)
            blocks += taken
            taken.clear()
        return concatenate(blocks)

    def _take_rejected(self, instance: Instance) -> None:
        """Take the samples that an instance has rejected, but for those that a run already got."""
        place, rejected = instance.instance_id - 1, instance.rejected
        if rejected is None:
            return
        fields = rejected.infer_shapes(instance.fields)
        if self._buffer is not None:
            fields = self._buffer.fields[: -len(ROW_FIELDS)]
        rows = rejected.take(fields, instance.instance_id)
        count = len(rows["step"])
        left = max(0, self._skip.rejected_of(instance.instance_id) - self._rejections[place])
        self._rejections[place] += count
        self._rejected[place].append({name: values[left:] for name, values in rows.items()})

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


class _Remembering:
    """The run's services for one instance; their answers are noted, and told again."""

    def __init__(self, services: Services, journal: Journal) -> None:
        self._services, self._journal = services, journal
        self.save_parameters = services.save_parameters
        self.load_parameters = services.load_parameters
        self.show = services.show

    def predict(self, fields: Sample) -> Sample:
        """Return the prediction for one sample: see `Services.predict`."""
        told: Sample = self._told(self._services.predict, fields)
        return told

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return what a person does, or did then: see `Services.touch`."""
        told: Sequence[float] = self._told(self._services.touch, instance_id)
        return told

    def _told(self, ask: Callable[[Any], Any], of: Any) -> Any:
        answer = self._journal.tell()
        if answer is None:
            try:
                found = ask(of)
            except PhysxError as error:
                self._keep((False, encode_error(error)))
                raise
            self._keep((True, encode(found, "the answer of the run")))
            return found
        self._keep(answer)
        if not answer[0]:
            raise decode_error(answer[1])
        return decode(answer[1])

    def _keep(self, answer: Answer) -> None:
        kind = Kind.ANSWER if answer[0] else Kind.REFUSAL
        number = self._journal.answers + 1
        self._journal.record(pack(kind, answer[1], number), is_prediction=True)
