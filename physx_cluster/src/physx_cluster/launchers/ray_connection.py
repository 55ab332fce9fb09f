"""Connection to a Ray cluster: a running one, or one started here for this process."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
from ray import exceptions as ray_errors

from physx_cluster.placement.address import address_towards
from physx_core.errors import ConfigError
from physx_core.net import parse_address

_FAILURES = (ray_errors.RayError, ConnectionError, RuntimeError, ValueError, OSError, TimeoutError)
_ADDRESS = "RAY_ADDRESS"
_PROBE_TIME = 3.0  # s


class RayConnection:
    """This process as a Ray driver.

    Attributes:
        host: Address at which all nodes reach this machine; None: all nodes are on this machine.
    """

    def __init__(self, address: str | None) -> None:
        """Connect, unless this process is already connected.

        Args:
            address: ``HOST:PORT`` of Ray's head node, "auto" for the cluster on this machine,
                "local" to start one; None: the environment variable ``RAY_ADDRESS``, else the
                cluster on this machine, else a new one that ends with the run.

        Raises:
            ConfigError: If there is no such cluster.
        """
        self._is_own = not ray.is_initialized()
        self.host: str | None = None
        if self._is_own:
            _silence()
            self._connect(address or os.environ.get(_ADDRESS))
        context = ray.get_runtime_context()
        if self._is_own and self._is_local:
            return
        self.host = address_towards(context.gcs_address.rpartition(":")[0])

    def nodes(self) -> list[dict[str, float]]:
        """Return the resources of each live node."""
        return [dict(node["Resources"]) for node in ray.nodes() if node["Alive"]]

    def close(self) -> None:
        """Disconnect, and shut down the cluster if it was started here."""
        if self._is_own and ray.is_initialized():
            with _unchanged():
                ray.shutdown()

    def _connect(self, address: str | None) -> None:
        self._is_local = address == "local"
        if address is not None and address.startswith("ray://"):
            raise ConfigError(
                f"{address} is the address of a Ray Client server, which only forwards calls. "
                'Start the run on a cluster node, with launcher_kwargs={"address": "auto"}.'
            )
        try:
            if address in (None, "auto"):
                running = _find_running()
                self._is_local = running is None and address is None
                address = running or ("local" if self._is_local else address)
            if address not in ("auto", "local"):
                _probe(str(address))
            _init(str(address))
        except _FAILURES as error:
            reason = " ".join(str(error).split()).rstrip(".")
            raise ConfigError(
                f"Ray does not answer at {address}: {reason}. Start it with "
                '"ray start --head" on one node and "ray start --address HOST:6379" on the others, '
                f"including this one; or omit the address and {_ADDRESS}, and the run starts its "
                "own Ray cluster."
            ) from error


def _find_running() -> str | None:
    """Return the address of the cluster that was started on this machine, if it still runs."""
    note = Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster")
    try:
        address = note.read_text().strip()
        _probe(address)
    except (OSError, ConfigError):
        return None
    return address


def _probe(address: str) -> None:
    """Raise an error if nothing listens at an address; Ray itself would wait two minutes."""
    socket.create_connection(parse_address(address), timeout=_PROBE_TIME).close()


def _init(address: str) -> None:
    options: dict[str, Any] = {} if address != "local" else {"include_dashboard": False}
    with _unchanged():
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **options)


@contextlib.contextmanager
def _unchanged() -> Iterator[None]:
    """Undo Ray's side effects on this process: it handles SIGTERM and draws random numbers."""
    handler, numbers = signal.getsignal(signal.SIGTERM), random.getstate()
    try:
        yield
    finally:
        random.setstate(numbers)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _silence() -> None:
    """Keep Ray from printing its daemons' logs, for which it has no option.

    Also removes Ray's hook for uncaught exceptions.
    """
    worker: Any = sys.modules["ray._private.worker"]
    if sys.excepthook is getattr(worker, "custom_excepthook", None):
        sys.excepthook = worker.normal_excepthook
    if hasattr(worker, "print_to_stdstream"):
        worker.print_to_stdstream = lambda *arguments, **options: None
