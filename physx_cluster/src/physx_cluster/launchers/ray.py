"""RayLauncher: clients on the nodes of a Ray cluster."""

from __future__ import annotations

import importlib.util
import itertools
import logging
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import Any

from physx_cluster.launchers.messages import Messages
from physx_core import Closeable
from physx_core.components import ClientHandle, Launcher
from physx_core.errors import ClientError, ConfigError
from physx_core.origin import install_hint
from physx_core.processes import BackgroundThread, WorkerProcess
from physx_core.workers import ClientProcess

if importlib.util.find_spec("ray") is None:
    raise ConfigError(
        "The launcher cluster/ray needs Ray, which is not installed. "
        f"{install_hint('physx-cluster', 'ray')}"
    )

_DRIVER = "physx_cluster.launchers.ray_driver"
_OPEN_TIME = 150.0  # s, to start Ray on this machine
_LAUNCH_TIME = 30.0  # s, for an answer that takes Ray 2 s
_LEAVE_TIME = 10.0  # s, to disconnect from a cluster, or to end one
_STRATEGIES = ("SPREAD", "PACK", "STRICT_SPREAD", "STRICT_PACK")
_LOG = logging.getLogger("physx")


class RayLauncher(Launcher):
    """Starts the clients on the nodes of a Ray cluster.

    The clients' resources are reserved as one placement group. On each node an actor, the agent,
    starts the clients that Ray placed there as child processes and monitors them; on its own node,
    the run does that itself. If a node is lost, Ray moves its part of the group to another node,
    where the run restarts the clients (`EnvironmentConfig.retries`); the rows are the same. In an
    elastic run, each client has its own group and waits for a place independently.

    Ray is connected to by another process, the driver. If the cluster is lost, the run goes on with
    the clients that are connected, but starts no more.
    """

    elsewhere = True

    def __init__(
        self,
        *,
        address: str | None = None,
        num_cpus: float | None = None,
        num_gpus: float = 0,
        memory: float = 0,
        resources: dict[str, float] | None = None,
        strategy: str = "SPREAD",
        runtime_env: dict[str, Any] | None = None,
    ) -> None:
        """Store the options.

        Args:
            address: ``HOST:PORT`` of Ray's head node, "auto" for the cluster on this machine,
                "local" to start one; None: the cluster to which this process is connected, else the
                environment variable ``RAY_ADDRESS``, else the cluster on this machine, else a new
                one that ends with the run.
            num_cpus: CPUs of each client; None: one, or an equal share if the cluster has fewer
                CPUs than clients.
            num_gpus: GPUs of each client.
            memory: Memory of each client in bytes.
            resources: Amounts of custom resources of the nodes, by name.
            strategy: How Ray distributes the clients over the nodes: "SPREAD", "PACK",
                "STRICT_SPREAD", or "STRICT_PACK".
            runtime_env: Ray's runtime environment for the clients: packages, files, environment
                variables.

        Raises:
            ConfigError: If the strategy is unknown, an amount is negative, or all amounts are 0.
        """
        if strategy not in _STRATEGIES:
            raise ConfigError(f"strategy is {strategy!r}, but must be one of {_STRATEGIES}.")
        needs = {"CPU": num_cpus, "GPU": num_gpus, "memory": memory, **(resources or {})}
        wrong = [name for name, need in needs.items() if need is not None and need < 0]
        if wrong or (num_cpus == 0 and not any(needs.values())):
            raise ConfigError(
                f"A client needs {needs}: amounts must not be negative, and at least one "
                "resource must be positive, such as num_cpus=0.1."
            )
        self._options = {
            "address": address,
            "strategy": strategy,
            "needs": needs,
            "runtime_env": runtime_env,
        }
        self._driver: _DriverProcess | None = None

    def open(self) -> str | None:
        """Connect to Ray: see `Launcher.open`."""
        address = self._options["address"] or _connected_address()
        options = {**self._options, "address": address, "elastic": self.elastic}
        self._driver = _DriverProcess(options)
        return self._driver.host

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start the clients: see `Launcher.launch`.

        Raises:
            ClientError: If they have no place, or if Ray was lost.
        """
        assert self._driver is not None
        handles = self._driver.launch(instances, address, token)
        if self._driver.end and not self.elastic:  # an elastic run goes on with the others
            raise ClientError(instances[0], f"cannot be started: {self._driver.end}.")
        return [*handles]

    def close(self) -> None:
        """End the agents, and Ray if it was started here: see `Launcher.close`."""
        driver, self._driver = self._driver, None
        if driver is not None:
            driver.close()


class RayHandle(ClientHandle):
    """A client on one of the cluster's nodes."""

    def __init__(self, instance_id: int, key: int, driver: _DriverProcess) -> None:
        """Store the arguments.

        Args:
            instance_id: Number of the instance, from 1.
            key: What the driver calls it.
            driver: Sends it signals.
        """
        self.instance_id, self._key, self._driver = instance_id, key, driver
        self._state = "waiting for Ray"
        self._end: tuple[int, str] | None = None
        self._process: ClientProcess | None = None  # on the run's own node
        self._lock = threading.Lock()
        self._is_killed = False

    def exit_status(self) -> int | None:
        """Return the exit status: see `ClientHandle.exit_status`."""
        if self._process is not None:
            return self._process.exit_status()
        return self._end[0] if self._end is not None else None

    def stderr(self) -> str:
        """Return the last lines of its standard error: see `ClientHandle.stderr`."""
        if self._process is not None:
            return self._process.stderr()
        return self._end[1] if self._end is not None else ""

    def state(self) -> str:
        """Return what it waits for: see `ClientHandle.state`."""
        return self._state

    def terminate(self) -> None:
        """Ask the client to end: see `ClientHandle.terminate`."""
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """Kill the client: see `ClientHandle.kill`."""
        if not self._is_killed:
            self._is_killed = True
            self._signal(signal.SIGKILL)

    def take(self, message: Mapping[str, Any], address: str, token: str) -> None:
        """Take what the driver says about it."""
        match message["say"]:
            case "state":
                self._state = message["state"]
            case "end":
                self.finish(message["status"], message["stderr"])
            case "here":
                self._start(address, token)

    def finish(self, status: int, stderr: str = "") -> None:
        """Record its end, unless it is already known."""
        if self._end is None:
            self._end = status, stderr

    def lose_driver(self, why: str) -> None:
        """Note that Ray is lost: a client that has begun goes on, the others will never begin."""
        if self._process is None and not self._state.startswith("running"):
            self.finish(1, why)

    def _start(self, address: str, token: str) -> None:
        """Start the client on this machine."""
        process = ClientProcess(self.instance_id, address, token)
        with self._lock:
            if self._end is not None:
                return
            try:
                process.start()
            except ClientError as error:
                self.finish(1, str(error))
                return
            self._process, self._state = process, "running on this machine"

    def _signal(self, number: signal.Signals) -> None:
        with self._lock:
            if self._process is not None:
                is_kill = number == signal.SIGKILL
                self._process.kill() if is_kill else self._process.terminate()
            elif self._driver.end:
                # It exits by itself once the server has closed the connection.
                self.finish(-number)
            else:
                self._driver.signal(self._key, number)


class _DriverProcess(Closeable):
    """The process that is connected to Ray, and the thread that listens to it.

    Attributes:
        host: Address at which all nodes reach this machine; None: all nodes are on this machine.
        end: How it ended; empty while it runs.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        """Start it, and wait until it is connected.

        Args:
            options: What it is told first.

        Raises:
            ConfigError: If the options are not plain data, or there is no such cluster.
        """
        self.end = ""
        self._keys = itertools.count()
        self._handles: dict[int, tuple[RayHandle, str, str]] = {}
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._is_in_use = False
        self._process = WorkerProcess(_DRIVER, variables={}, stdout=subprocess.DEVNULL)
        self._messages = Messages(self._process.link)
        self._thread = BackgroundThread(self._listen, "physx-ray")
        self._thread.start()
        try:
            self._messages.send(**options)
            self.host = self._wait_until_connected()
            self._is_in_use = True
        except BaseException as error:
            self.close()
            if isinstance(error, TypeError):
                raise ConfigError(f"launcher_kwargs of cluster/ray: {error}.") from error
            raise

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[RayHandle]:
        """Have clients started: see `Launcher.launch`; if Ray is lost, all of them have ended.

        Raises:
            ClientError: If they have no place.
        """
        handles = {next(self._keys): number for number in instances}
        made = {key: RayHandle(number, key, self) for key, number in handles.items()}
        self._handles |= {key: (handle, address, token) for key, handle in made.items()}
        keys = [(number, key) for key, number in handles.items()]
        self._messages.send(keys=keys, address=address, token=token)
        answer = self._answer(_LAUNCH_TIME)
        for handle in made.values() if self.end else ():
            handle.lose_driver(self.end)
        if reason := answer.get("misfit"):
            raise ClientError(
                instances[0],
                f"has no place on Ray: {reason}. Ask for less with "
                'launcher_kwargs={"num_cpus": ...}, run fewer clients, or add nodes with "ray '
                'start --address ...".',
            )
        return [*made.values()]

    def signal(self, key: int, number: int) -> None:
        """Send a signal to a client."""
        self._messages.send(key=key, signal=int(number))

    def close(self) -> None:
        """Disconnect from Ray, and end it if it was started for the run."""
        self._is_in_use = False
        for handle, _, _ in self._handles.values():
            if handle.exit_status() is None:
                handle.kill()
        self._messages.finish()
        self._process.wait(_LEAVE_TIME)
        self._process.close()
        self._thread.join()
        self._messages.close()

    def _wait_until_connected(self) -> str | None:
        answer = self._answer(_OPEN_TIME)
        if "host" not in answer:
            raise ConfigError(answer.get("refusal") or f"{self.end}: {self._last_lines()}")
        host: str | None = answer["host"]
        return host

    def _answer(self, patience: float) -> dict[str, Any]:
        """Wait for the driver's answer; one that does not answer, or has ended, is lost."""
        if self.end:
            return {}
        try:
            return self._answers.get(timeout=patience)
        except queue.Empty:
            self._process.close()
            return self._answers.get()

    def _listen(self) -> None:
        """Take what the driver says, until it ends."""
        while (message := self._messages.receive()) is not None:
            if "key" in message:
                handle, address, token = self._handles[message["key"]]
                handle.take(message, address, token)
            else:
                self._answers.put(message)
        how = self._process.describe_end(_LEAVE_TIME)
        self.end = f"Ray is lost: the process that was connected to it {how}"
        if self._is_in_use:
            _LOG.warning(
                "%s. The run goes on with the clients that are connected, and starts no more.\n%s",
                self.end,
                self._last_lines(),
            )
            for handle, _, _ in [*self._handles.values()]:
                handle.lose_driver(self.end)
        self._answers.put({})

    def _last_lines(self) -> str:
        return "\n".join(self._process.stderr(1.0).strip().splitlines()[-5:])


def _connected_address() -> str | None:
    """Return the address of the cluster to which this process is connected, if it uses Ray."""
    ray: Any = sys.modules.get("ray")
    if ray is None or not ray.is_initialized():
        return None
    address: str = ray.get_runtime_context().gcs_address
    return address
