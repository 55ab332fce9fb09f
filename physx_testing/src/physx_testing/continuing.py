"""Continues an environment from its states: ``python -m physx_testing.continuing LINK``."""

from __future__ import annotations

import socket
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from physx_core.net import decode, encode
from physx_core.processes import WorkerProcess, prepare_worker
from physx_core.typing import Batch
from physx_core.workers import Instance
from physx_testing.environment import one_instance
from physx_testing.subject import Subject
from physx_testing.worker import LENGTH

ROWS = 12
MOMENTS = (1, 6)
"""Numbers of rows after which states are taken."""


def rows_between(instance: Instance, made: int, states: dict[int, bytes] | None) -> list[Batch]:
    """Return the rows of an instance from one on, taking states as the first process does.

    Args:
        instance: The instance.
        made: How many rows came before.
        states: Gets the states by the number of rows before them; None: none are taken.
    """
    found = []
    for row in range(made, ROWS):
        if row in MOMENTS and states is not None and row not in states:
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
    with WorkerProcess("physx_testing.continuing") as process:
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
    link.sendall(LENGTH.pack(len(payload)) + payload)


def _receive(incoming: Any) -> Any:
    header = incoming.read(LENGTH.size)
    return decode(incoming.read(*LENGTH.unpack(header))) if header else None


if __name__ == "__main__":
    main()
