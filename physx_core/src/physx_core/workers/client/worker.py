"""Client: runs one instance of the environment in this process, for a server elsewhere."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physx_core.components.scene.event import Event
from physx_core.errors import PhysxError
from physx_core.net.frames import Kind, pack
from physx_core.net.remote_errors import encode_error
from physx_core.net.spin_wait import has_core_for_each
from physx_core.net.values import encode
from physx_core.processes import CLIENT_VARIABLE, Terminated
from physx_core.typing import Sample
from physx_core.workers.client.joining import PATIENCE, join
from physx_core.workers.client.link import RunEnded, ServerGone, WorkerLink
from physx_core.workers.client.producer import Producer
from physx_core.workers.instance import Instance

if TYPE_CHECKING:
    from physx_core.workers.client.episode_producer import EpisodeProducer
    from physx_core.workers.client.row_files import RowFiles

_PACKAGES = re.compile(r"/(site-packages|dist-packages|lib-dynload|lib\d*/python3[^/]*)(/|$)")
"""What belongs to an interpreter, in the module path."""


def run_client(
    address: str,
    token: str,
    instance: int | None = None,
    *,
    patience: float = PATIENCE,
    answer_time: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> int:
    """Run one instance of the environment for a server until it ends the run.

    Args:
        address: The server's ``HOST:PORT``.
        token: Token of the run.
        instance: Number of the instance to run, counted from 1; None: any that is free.
        patience: How long to retry if nothing listens, in s.
        answer_time: How long to wait for the answer of a server that listens, in s; None: without
            limit.
        say: Called with a description of what happens.

    Returns:
        Exit status of the process: 0 once the run has ended, 1 if the environment failed (the
        server knows why) or the server is gone.
    """
    say(f"connecting to the server at {address}")
    link, setup = join(address, token, instance or 0, patience, answer_time)
    link.exit_if_lost()
    try:
        os.environ[CLIENT_VARIABLE] = "1"
        link.heartbeat = setup.pop("heartbeat")
        _take_place(setup.pop("path"), setup.pop("directory"))
        return run_instance(link, setup, say)
    except RunEnded:
        say("the server is gone")
        return 1
    finally:
        link.close()


def run_instance(
    link: WorkerLink, setup: dict[str, Any], say: Callable[[str], None] = lambda text: None
) -> int:
    """Run one instance in this process, wherever it is, until the server ends the run.

    Args:
        link: Connection to the server.
        setup: What `join` returned, without the module path and the working directory.
        say: Called with a description of what happens.

    Returns:
        See `run_client`.

    Raises:
        ServerGone: If the server is gone without having ended the run.
    """
    draw, skip, folder = setup.pop("draw"), setup.pop("skip"), setup.pop("folder", None)
    every, state = setup.pop("state_every"), setup.pop("state")
    say(
        f"running {setup['environment']}, instance {setup['instance_id']} of {setup['instance_nb']}"
        + _describe_past(skip["rows"], 0 if state is None else state["rows"])
    )
    link.spins = has_core_for_each(setup["instance_nb"])
    shown, skip["state_every"] = skip.pop("shown"), every
    client = _Client(link, Instance(**setup), folder, shown, skip)
    try:
        client.live(draw, state)
    finally:
        client.close()
    if client.is_forsaken:
        raise ServerGone
    with contextlib.suppress(ServerGone):  # the server may have ended first
        link.send(pack(Kind.BYE))
    failure = client.failure
    say("the run has ended" if failure is None else f"{type(failure).__name__}: {failure}")
    link.finish()
    return 0 if failure is None else 1


def _describe_past(rows: int, restored: int) -> str:
    text = f"; it goes on from its state after {restored} rows" if restored else ""
    return text + (f"; {rows - restored} rows are generated again" if rows > restored else "")


def _take_place(path: list[str], directory: str) -> None:
    """Use the server's module path and working directory, as far as they exist here.

    The packages of another interpreter are not for this one.
    """
    if Path(directory).is_dir():
        os.chdir(directory)
    own = {str(Path(entry).resolve()) for entry in sys.path}
    found = [
        entry
        for entry in path
        if Path(entry).exists() and (entry in own or not _PACKAGES.search(entry))
    ]
    sys.path[:] = [*found, *(entry for entry in sys.path if entry not in found)]


class _Client:
    """Runs one instance from start to end; its errors go to the server.

    Attributes:
        failure: The error that was sent.
        is_forsaken: Whether the server is gone without ending the run.
    """

    def __init__(
        self,
        link: WorkerLink,
        instance: Instance,
        folder: dict[str, Any] | None,
        shown: int,
        skip: dict[str, int],
    ) -> None:
        self.failure: PhysxError | None = None
        self.is_forsaken = False
        self._link, self._instance, self._folder = link, instance, folder
        self._producer = Producer(link, instance, **skip)
        self._services = RemoteServices(link, self._producer, shown)
        self._state_every = skip["state_every"]
        self._leased: EpisodeProducer | None = None
        self._row_files: RowFiles | None = None

    def live(self, draw: bool, state: Mapping[str, Any] | None) -> None:
        """Open the environment and generate rows until the run ends or the environment fails.

        Args:
            draw: Whether there is a visualizer.
            state: What an earlier client sent, to go on from; None: begin.
        """
        services, with_states = self._services, self._state_every > 0
        try:
            if self._folder is not None:
                from physx_core.workers.client.row_files import RowFiles

                self._row_files = RowFiles(self._link, self._folder)
            self._instance.open(services, draw, services.choose, with_states=with_states)
            parameters = [parameter.to_dict() for parameter in self._instance.parameters]
            if parameters:
                self._link.send(pack(Kind.PARAMETERS, encode(parameters)))
            defined = [*self._instance.fields, *self._instance.episode_fields]
            fields = [field.to_dict() for field in defined]
            self._link.send(pack(Kind.READY, encode(fields), int(self._instance.is_independent)))
            if state is not None:
                self._producer.resume(state)
            self._run()
        except (KeyboardInterrupt, Terminated):
            with contextlib.suppress(ServerGone):
                self._link.send(pack(Kind.BYE))  # others go on with its episodes
            raise
        except RunEnded as end:
            self.is_forsaken = isinstance(end, ServerGone)
            if self._producer.failure is not None:
                self._report(self._producer.failure, self._producer.made)
        except PhysxError as error:
            self._report(error, self._producer.made)

    def _run(self) -> None:
        """Generate a stream, or simulate the episodes that the server leases if it does."""
        first = self._link.receive()
        self._link.put_back(first)
        if first.kind is Kind.LEASE:
            # Importing datasets takes a quarter of a client's start time; streams need none.
            from physx_core.workers.client.episode_producer import EpisodeProducer

            self._leased = EpisodeProducer(
                self._link, self._instance, self._row_files, self._state_every
            )
        (self._leased or self._producer).run()

    def close(self) -> None:
        """Close the environment, and the files that it writes."""
        for opened in (self._instance, self._row_files):
            try:
                if opened is not None:
                    opened.close()
            except PhysxError as error:
                if self.failure is None:
                    self._report(error, 0)

    def _report(self, error: PhysxError, row: int) -> None:
        self.failure = error
        self._link.send(pack(Kind.ERROR, encode_error(error), row))


class RemoteServices:
    """Services of the run, requested over the connection."""

    def __init__(self, link: WorkerLink, producer: Producer, shown: int = 0) -> None:
        """Store the connection.

        Args:
            link: Connection to the server.
            producer: Generates the rows; pending ones are sent before each wait for an answer.
            shown: How many messages with drawing events predecessors sent.
        """
        self._link, self._producer, self._skip = link, producer, shown

    def predict(self, fields: Sample) -> Sample:
        """Return the network's prediction: see `Services.predict`."""
        self._producer.announce_early()
        prediction: Sample = self._ask(Kind.PREDICT, fields, "get_prediction()")
        return prediction

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return what a person does to the instance: see `Services.touch`."""
        done: Sequence[float] = self._ask(Kind.TOUCH, None, "a person's hand")
        return done

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Save values of the instance: see `Services.save_parameters`."""
        self._ask(Kind.SAVE, values if instance_id else {"": values}, "save_parameters()")

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that the instance saved: see `Services.load_parameters`."""
        values: dict[str, Any] = self._ask(Kind.LOAD, not instance_id, "load_parameters()")
        return values

    def choose(self, episode: int) -> dict[str, Any]:
        """Return the parameters of an episode."""
        values: dict[str, Any] = self._link.ask(Kind.CHOOSE, episode, "the parameters")
        return values

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Send drawing events: see `Services.show`."""
        self._producer.shown += 1
        if self._producer.shown <= self._skip:
            return
        plain = [(event.action, event.kind, event.names, dict(event.values)) for event in events]
        self._link.send(pack(Kind.SHOW, encode(plain, "update_visualization()"), step))

    def _ask(self, kind: Kind, value: Any, what: str) -> Any:
        self._producer.flush()
        return self._link.ask(kind, value, what)
