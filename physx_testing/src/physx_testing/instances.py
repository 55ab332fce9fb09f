"""Instances of environments, here and in another process, where they go on from their states.

``python -m physx_testing.instances LINK`` is that process.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components import Event
from physx_core.config import EnvironmentConfig
from physx_core.net import decode, encode
from physx_core.processes import WorkerProcess, prepare_worker
from physx_core.typing import Batch, Sample
from physx_core.workers import Instance, instance_arguments
from physx_testing.report import NotApplicableError
from physx_testing.subject import Subject

SEED = (5, 0, 0)
_LENGTH = struct.Struct("<Q")
_ROWS = 12
_MOMENTS = (1, 6)
"""Numbers of rows after which states are taken."""


class Services:
    """A run without a network that keeps what the environment saves and draws."""

    def __init__(self) -> None:
        self.saved: dict[int, dict[str, Any]] = {}
        self.drawn: list[Event] = []

    def predict(self, fields: Sample) -> Sample:
        """Skip the check, because the kit has no network for the environment."""
        raise NotApplicableError("it asks for predictions of a network, which the kit lacks")

    def touch(self, instance_id: int) -> Sequence[float]:
        """Do nothing, as nobody is there."""
        return ()

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Keep values of an instance."""
        self.saved[instance_id] = {**self.saved.get(instance_id, {}), **values}

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that an instance saved."""
        return self.saved.get(instance_id, {})

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Keep what is drawn."""
        self.drawn += events


def config_of(subject: Subject, number: int, **options: Any) -> EnvironmentConfig:
    """Return the configuration of instances in this process."""
    return EnvironmentConfig(
        subject.reference,
        env_kwargs=dict(subject.arguments),
        num_clients=number,
        as_tcp_ip_client=False,
        **options,
    )


@contextlib.contextmanager
def one_instance(subject: Subject, number: int = 1, instances: int = 1) -> Iterator[Instance]:
    """Yield one of several instances, as a client would have it."""
    config = config_of(subject, instances)
    instance = Instance(**instance_arguments(config, number, SEED, accept_all=False))
    try:
        instance.open(Services(), draw=False)
        yield instance
    finally:
        instance.close()


def rows_between(instance: Instance, made: int, states: dict[int, bytes] | None) -> list[Batch]:
    """Return the rows of an instance from one on, taking states as the first process does.

    Args:
        instance: The instance.
        made: How many rows came before.
        states: Gets the states by the number of rows before them; None: none are taken.
    """
    found = []
    for row in range(made, _ROWS):
        if row in _MOMENTS and states is not None and row not in states:
            states[row] = encode(instance.get_state(), "what get_state() returned")
        sample = {name: np.array(value) for name, value in instance.step().items()}
        place = {"episode": instance.last_episode, "step": instance.last_step}
        found.append(sample | {name: np.asarray(number) for name, number in place.items()})
    return found


def in_another_process(subject: Subject, states: Mapping[int, bytes]) -> dict[int, list[Batch]]:
    """Return the rows that follow each state there.

    Raises:
        AssertionError: If the process fails.
    """
    request = {
        "subject": (subject.kind, subject.reference, dict(subject.arguments)),
        "states": dict(states),
        "path": list(sys.path),
    }
    with WorkerProcess("physx_testing.instances") as process:
        _send(process.link, request)
        with process.link.makefile("rb") as incoming:
            answer: Any = _receive(incoming)
            if answer is None:
                raise AssertionError(f"another process {process.describe_end()}")
    if isinstance(answer, str):
        raise AssertionError(f"another process could not go on from the state: {answer}")
    return dict(answer)


def main() -> None:
    """Answer the single request that arrives through a socket."""
    link = socket.socket(fileno=int(sys.argv[1]))
    prepare_worker()
    with link, link.makefile("rb") as incoming:
        request = _receive(incoming)
        sys.path[:] = request["path"]
        subject = Subject(*request["subject"])
        try:
            answer: Any = {row: _continued(subject, row, state) for row, state in
                           request["states"].items()}  # fmt: skip
        except Exception as error:
            answer = f"{type(error).__name__}: {error}"
        _send(link, answer)


def _continued(subject: Subject, made: int, state: bytes) -> list[Batch]:
    with one_instance(subject) as instance:
        instance.track_states()
        instance.set_state(decode(state))
        return rows_between(instance, made, {made: state})


def _send(link: socket.socket, value: Any) -> None:
    payload = encode(value, "rows and states")
    link.sendall(_LENGTH.pack(len(payload)) + payload)


def _receive(incoming: Any) -> Any:
    header = incoming.read(_LENGTH.size)
    return decode(incoming.read(*_LENGTH.unpack(header))) if header else None


if __name__ == "__main__":
    main()
