"""ClientSource: runs each instance of the environment in a client process, over TCP."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from physx_core.components.services import Services
from physx_core.config import EnvironmentConfig
from physx_core.dataset.write.delegation import Delegation
from physx_core.errors import (
    FieldShapeError,
    FieldsMismatchError,
    UsageError,
    WrongSamplesError,
)
from physx_core.fields import Field
from physx_core.net.frames import Kind, pack
from physx_core.net.link import SOCKETS, Transport
from physx_core.net.values import encode
from physx_core.rows import ROW_FIELDS, concatenate
from physx_core.sources.source import Canceled, Source, check_stored
from physx_core.typing import Batch
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.pasts import NOTHING, Skip
from physx_core.workers.row_codec import row_bytes
from physx_core.workers.server.client_group import ClientGroup
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.written_rows import WrittenRows

if TYPE_CHECKING:
    from physx_core.sources.client_episodes import ClientEpisodes
    from physx_core.workers.episode_queue import EpisodeQueue

_AHEAD_BYTES = 4 << 20
_AHEAD_ROWS = 1 << 16


class ClientSource(Source):
    """Collects rows from clients, and places each by its instance and step.

    Rows are bit-identical to those of `LocalSource`. Requests of the environments are served while
    waiting for a batch. A request for a prediction is held until the batch that contains the row
    being generated is requested. If the services have a method
    ``predict_batch(batch) -> batch``, predictions wait until every instance that owes a row of the
    batch has requested one, and are computed together in the order of the instances, so the groups
    are the same in every run, however far the clients run ahead. A network may round these
    differently from single samples.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        *,
        run_ahead: int | None = None,
        total: int | None = None,
        accept_all: bool = False,
        skip: Skip = NOTHING,
        delegation: Delegation | None = None,
        transport: Transport = SOCKETS,
        keeps_pasts: bool = False,
    ) -> None:
        """Prepare the clients.

        Args:
            config: The environment, and the number of clients.
            services: Serves the environments' requests.
            seed: Seed of all instances.
            run_ahead: Number of rows that each client may generate before they are requested;
                None: as many as fit in 4 MB. Must be 0 if predictions are applied, or stored rows
                are replayed.
            total: Total number of rows that will be requested, including those to skip; clients
                generate none beyond it. None: unknown.
            accept_all: Whether samples that `check_sample` rejects count like the others.
            skip: The rows that an earlier run already got: generated again, but not returned.
            delegation: Lets the clients write the rows of independent episodes themselves; None:
                they send them.
            transport: What connects the clients, and the clock that the run follows.
            keeps_pasts: Whether somebody calls `take_pasts` after each batch.
        """
        self._written = None if delegation is None else WrittenRows(delegation)
        self._name = getattr(config.environment, "__name__", str(config.environment))
        self._clock = transport.clock
        self._episodes: ClientEpisodes | None = None
        self.instance_nb = config.num_clients
        self.sets = ParameterSets(config, seed, skip)
        keeps_pasts = keeps_pasts and config.state_every > 0
        self._group = ClientGroup(
            config,
            services,
            seed,
            self.sets,
            accept_all=accept_all,
            skip=skip,
            written=self._written,
            transport=transport,
            keeps_pasts=keeps_pasts,
        )
        self._journals = self._group.journals if keeps_pasts else {}
        self._rejections = 0
        if config.record_wrong_samples:
            self._rejections = config.max_wrong_samples_per_step + 1
        self._failed_row: int | None = None
        self._run_ahead, self._total = run_ahead, total
        self._asked = self._first = self.rows = skip.rows
        self._taken = [skip.rows_of(n + 1, self.instance_nb) for n in range(self.instance_nb)]
        self._agreeing = {1}
        self._opened: list[Field] = []
        self._table: list[Field] = []
        self._out: Batch = {}
        self._capacity = 0
        self._failed = self._closed = False

    @property
    def fields(self) -> list[Field]:
        """The fields of the rows: see `Source.fields`."""
        if self._table or not self._opened:
            return self._table
        told = (peer.row_fields for peer in self._group.server.peers.values() if peer.row_fields)
        return next(told, self._opened)

    def open(self) -> None:
        """Start the clients: see `Source.open`.

        Raises:
            PhysxError: If an environment or client fails.
        """
        try:
            self._group.open()
            first, *others = self._group.ready
            self._opened = [*first.fields, *ROW_FIELDS]
            for peer in others:
                self._agree(peer.instance_id, first.fields, peer.fields)
                self._agree(peer.instance_id, first.episode_fields, peer.episode_fields)
            parameters = [peer.parameters for peer in (first, *others)]
            self.sets.begin(parameters)
            self.is_plain = not (self.sets.parameters or self._rejections)
            self.is_independent = first.is_independent
            self.episode_fields = first.episode_fields
            if self._group.config.is_elastic:
                self.check_independent()
        except BaseException:
            self._failed = True
            raise

    def lease(self, queue: EpisodeQueue) -> ClientEpisodes:
        """Simulate independent episodes: see `Source.lease`."""
        from physx_core.sources.client_episodes import ClientEpisodes  # streams need no records

        self._episodes = ClientEpisodes(
            self._group,
            self.sets,
            queue,
            self._check_guest,
            self._check_canceled,
            self._clock,
            self._written,
        )
        return self._episodes

    def _check_guest(self, peer: Peer) -> None:
        """Check that a client that has joined the run runs the same environment as the others."""
        self._agree(peer.instance_id, self._opened[: -len(ROW_FIELDS)], peer.fields)
        self._agree(peer.instance_id, self.episode_fields, peer.episode_fields)
        self.sets.check_same(peer.instance_id, peer.parameters)

    def batch(self, size: int, stored: Batch | None = None) -> Batch:
        """Return the next rows: see `Source.batch`.

        Raises:
            UsageError: If stored rows are given, but the clients run ahead.
        """
        if size < 1:
            raise UsageError(f"A batch must have at least one row, not {size}.")
        if not self._opened or self._closed:
            raise UsageError("This source is not open: use it in a with statement.")
        if stored is not None:
            check_stored(stored, size)
            if self._run_ahead != 0:
                raise UsageError("Stored rows need ClientSource(run_ahead=0).")
        self.pop_rejected()
        self._first, self._asked = self._asked, self._asked + size
        try:
            if stored is not None:
                self._send_shares(Kind.STORED, stored, "a stored row")
            self._grant()
            if not self._table:
                self._group.wait(self._without_table)
                self._grant()
            if self._capacity < size:
                self._capacity = size
                self._out = {
                    field.name: np.empty((size, *shape), kind)
                    for field in self._table
                    for shape, kind in [field.row_kind]
                }
            self._group.wait(self._without_rows)
            self.rows = self._asked
        except BaseException:
            self._failed = True
            raise
        rows = {name: array[:size] for name, array in self._out.items()}
        self.sets.note(rows)
        return rows

    def apply(self, prediction: Batch) -> None:
        """Pass predictions to the instances: see `Source.apply`.

        An error that an environment raises here is raised by the next call to `batch` or `close`.

        Raises:
            UsageError: If the clients run ahead of the last batch.
        """
        if self._run_ahead != 0:
            raise UsageError("apply() needs ClientSource(run_ahead=0).")
        self._send_shares(Kind.APPLY, prediction, "the prediction")

    def pop_rejected(self) -> Batch:
        """Return the rejected samples: see `Source.pop_rejected`."""
        blocks: list[Batch] = []
        for number, peer in sorted(self._group.server.peers.items()) if self._rejections else ():
            if self._table and peer.row_fields == self._table:
                blocks += peer.rejected.take(self._end_of_rejected(number))
        return concatenate(blocks)

    def close(self) -> None:
        """Close the environments and end the clients: see `Source.close`."""
        if self._closed:
            return
        self._closed = True
        goes_on = self._episodes is not None and self._episodes.is_busy
        self._group.close(orderly=not (self._failed or goes_on))
        if self._failed:
            return
        for number, peer in sorted(self._group.server.peers.items()):
            if peer.failure is not None and (
                self._run_ahead == 0
                or self._episodes is not None
                or peer.failed_row < self._wanted(number, self._asked)
            ):
                raise peer.failure

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the source; after an error, do not wait for the clients."""
        self._failed = self._failed or kind is not None
        super().__exit__(kind, error, trace)

    def _send_shares(self, kind: Kind, batch: Batch, what: str) -> None:
        """Send each instance the rows that correspond to its rows of the last batch."""
        size = self._asked - self._first
        for number in range(1, self.instance_nb + 1):
            # The position of the instance's first row in the batch.
            start = (number - 1 - self._first) % self.instance_nb
            rows = {
                name: part.tolist() if part.dtype.hasobject else part  # the arrays of a free axis
                for name, values in batch.items()
                for part in [np.asarray(values)[start : size : self.instance_nb]]
            }
            count = len(range(start, size, self.instance_nb))
            if count:
                self._group.peer(number).send(pack(kind, encode(rows, what), count))

    def _end_of_rejected(self, number: int) -> int | None:
        """Return the step before which an instance's rejected rows belong to the last batch.

        None: all of them do, because its last row failed.
        """
        end = self._asked if self._failed_row is None else self._failed_row
        if self._failed_row is not None and self._failed_row % self.instance_nb == number - 1:
            return None
        last = (self._wanted(number, end) - 1) * self.instance_nb + number - 1 - self._first
        return int(self._out["step"][last]) if last >= 0 else 0

    def _wanted(self, number: int, rows: int) -> int:
        """Return how many of the first `rows` rows an instance generates."""
        return (rows - number + self.instance_nb) // self.instance_nb

    def _grant(self) -> None:
        """Allow the clients to generate the requested rows, and some ahead."""
        ahead = self._run_ahead
        if ahead is None:
            size = row_bytes(self._table) or _AHEAD_BYTES
            ahead = min(max(1, _AHEAD_BYTES // size), _AHEAD_ROWS) if self._table else 0
        allowances: dict[Peer, int] = {}
        for number in range(1, self.instance_nb + 1):
            peer = self._group.peer(number)
            needed = peer.wanted = self._wanted(number, self._asked)
            allowed = needed + ahead
            if self._total is not None:
                allowed = max(needed, min(allowed, self._wanted(number, self._total)))
            if peer.granted < needed or allowed - peer.granted > ahead // 4:
                allowances[peer] = allowed
            else:
                allowances[peer] = peer.granted
        for peer, allowed in allowances.items():
            if allowed > peer.granted:
                peer.granted = allowed
                peer.rejected_limit = allowed * self._rejections
                peer.send(pack(Kind.CREDIT, number=allowed))
                peer.pace.go_on()

    def _without_table(self) -> list[int]:
        """Return the first instance until its fields are known; it generates the first row."""
        self._check_canceled()
        peer = self._group.peer(1)
        if peer.row_fields:
            self._table = peer.row_fields
            return []
        if peer.failure is not None:
            raise peer.failure
        return [1]

    def _without_rows(self) -> list[int]:
        """Move received rows into the batch; return the instances whose rows are missing."""
        self._check_canceled()
        owing, failed = [], {}
        for number in range(1, self.instance_nb + 1):
            peer, taken = self._group.peer(number), self._taken[number - 1]
            missing = self._wanted(number, self._asked) - taken
            if not missing:
                continue
            if peer.row_fields and number not in self._agreeing:
                self._agree(number, self._table, peer.row_fields)
                self._agreeing.add(number)
            if peer.rows.count:
                start = taken * self.instance_nb + number - 1 - self._first
                moved = peer.rows.take(missing, self._out, start, self.instance_nb)
                self._taken[number - 1] += moved
                missing -= moved
            if missing and peer.failure is not None and not peer.rows.count:
                failed[self._next_row(number)] = peer.failure
            elif missing:
                owing.append(number)
        if failed:
            row = min(failed)
            earlier = [number for number in owing if self._next_row(number) < row]
            if not (earlier and self._rejections and isinstance(failed[row], WrongSamplesError)):
                self._failed_row = row
                number = row % self.instance_nb + 1
                self.sets.explain(number, self._group.peer(number).episode, failed[row])
                raise failed[row]
            return earlier  # rows rejected before it are needed too
        return owing

    def _check_canceled(self) -> None:
        if self._is_canceled:
            raise Canceled

    def _next_row(self, number: int) -> int:
        """Return the index among all rows of the next one that an instance generates."""
        return self._taken[number - 1] * self.instance_nb + number - 1

    def _agree(self, number: int, first: Sequence[Field], other: Sequence[Field]) -> None:
        """Check that an instance has the same fields as the first one."""
        if list(first) == list(other):
            return
        mine, theirs = ({field.name: field for field in fields} for fields in (first, other))
        for name in mine.keys() & theirs.keys() if self._table else ():
            if mine[name].shape != theirs[name].shape:
                raise FieldShapeError(
                    f'field "{name}" has shape {theirs[name].shape} but is defined as '
                    f"{mine[name].shape}.",
                    field=name,
                    instance_id=number,
                    step=0,
                )
        names = [*mine, *(name for name in theirs if name not in mine)]
        raise FieldsMismatchError(
            f"Instances 1 and {number} define different fields",
            {
                name: f"{mine.get(name, 'not defined')} and {theirs.get(name, 'not defined')}"
                for name in names
                if mine.get(name) != theirs.get(name)
            },
        )
