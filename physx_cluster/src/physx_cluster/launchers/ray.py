"""RayLauncher: clients on the nodes of a Ray cluster."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Coroutine, Sequence
from concurrent.futures import Future
from typing import Any

from physx_cluster.placement.bundles import Bundle, describe, find_misfit, share_of_processors
from physx_core.components import ClientHandle, Launcher
from physx_core.errors import ClientError, ConfigError
from physx_core.origin import install_hint

try:
    import ray
    from ray.exceptions import RayActorError, RayError
    from ray.util.placement_group import (
        placement_group,
        placement_group_table,
        remove_placement_group,
    )
    from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy
except ImportError as error:
    raise ConfigError(
        f"The launcher cluster/ray needs Ray: {error}. {install_hint('physx-cluster', 'ray')}"
    ) from error

from physx_cluster.launchers.ray_agent import Agent
from physx_cluster.launchers.ray_connection import RayConnection

_CALLS = 100_000  # concurrent calls of one agent: two for each client
# A Ray process kills its children when it is told to exit: the clients, whose own children would
# survive, and the watchdog, which would have ended all of them.
_LEAVE_CHILDREN = {"RAY_kill_child_processes_on_worker_exit": "false"}
_ANSWER_TIME = 1.0  # s, for an agent that is asked to kill a client
_LOOK_TIME = 2.0  # s, for Ray to find nodes
_PAUSE = 0.25
_STRATEGIES = ("SPREAD", "PACK", "STRICT_SPREAD", "STRICT_PACK")


class RayLauncher(Launcher):
    """Starts the clients on the nodes of a Ray cluster.

    The clients' resources are reserved as one placement group. On each node an actor, the agent,
    starts the clients that Ray placed there as child processes and monitors them; on its own node,
    the run does that itself. If a node is lost, Ray moves its part of the group to another node,
    where the run restarts the clients (`EnvironmentConfig.restarts`); the rows are the same. In an
    elastic run, each client has its own group and waits for a place independently.
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
                "local" to start one; None: the environment variable ``RAY_ADDRESS``, else the
                cluster on this machine, else a new one that ends with the run.
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
        self._address, self._strategy, self._needs = address, strategy, needs
        self._runtime_env = runtime_env
        self._connection: RayConnection | None = None
        self._nodes: _Nodes | None = None

    def open(self) -> str | None:
        """Connect to Ray: see `Launcher.open`."""
        self._connection = RayConnection(self._address)
        self._nodes = _Nodes(self._runtime_env)
        return self._connection.host

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start the clients: see `Launcher.launch`."""
        assert self._nodes is not None and self._connection is not None
        without = [number for number in instances if number not in self._nodes.places]
        groups = [[number] for number in without] if self.elastic else [without]
        for group in groups if without else ():
            self._reserve(group, len(without))
        return [self._nodes.start(number, address, token) for number in instances]

    def close(self) -> None:
        """End the agents, and Ray if it was started here: see `Launcher.close`."""
        nodes, self._nodes = self._nodes, None
        connection, self._connection = self._connection, None
        if nodes is not None:
            nodes.close()
        if connection is not None:
            connection.close()

    def _reserve(self, instances: Sequence[int], total: int) -> None:
        """Reserve the resources of some of all clients; Ray decides where."""
        assert self._nodes is not None and self._connection is not None
        found = self._connection.nodes()
        needs = dict(self._needs)
        if needs["CPU"] is None:
            needs["CPU"] = share_of_processors(found, total)
        bundle: Bundle = {name: float(need) for name, need in needs.items() if need}
        group = placement_group([bundle] * len(instances), strategy=self._strategy)
        self._nodes.add(group, instances, bundle)
        if self.elastic:
            misfit = find_misfit(found, bundle)
        else:
            misfit = "" if group.wait(_LOOK_TIME) else self._find_reason(group, bundle)
        if misfit:
            raise ClientError(
                instances[0],
                f"has no place on Ray: {misfit}. Ask for less with "
                'launcher_kwargs={"num_cpus": ...}, run fewer clients, or add nodes with "ray '
                'start --address ...".',
            )

    def _find_reason(self, group: Any, bundle: Bundle) -> str:
        """Return why Ray can never place a group on the current nodes; empty if it may."""
        assert self._connection is not None
        found = self._connection.nodes()
        if misfit := find_misfit(found, bundle):
            return misfit
        table = placement_group_table(group)
        if table["stats"]["scheduling_state"] != "INFEASIBLE":
            return ""
        count = len(table["bundles"])
        return (
            f"{count} clients, each with {describe(bundle)}, do not fit the {len(found)} nodes "
            f"with the strategy {self._strategy}"
        )


class RayHandle(ClientHandle):
    """A client on one of the cluster's nodes.

    Attributes:
        agent: The agent of its node; None until there is one.
    """

    def __init__(self, instance_id: int, nodes: _Nodes) -> None:
        """Store the arguments.

        Args:
            instance_id: Number of the instance, from 1.
            nodes: Runs its coroutines.
        """
        self.instance_id = instance_id
        self.agent: Any = None
        self.waits_for = "waiting for Ray"
        self.end: Future[tuple[int, str]] = Future()
        self._nodes = nodes
        self._killed = False

    def exit_status(self) -> int | None:
        """Return the exit status: see `ClientHandle.exit_status`."""
        return self.end.result()[0] if self.end.done() else None

    def stderr(self) -> str:
        """Return the last lines of its standard error: see `ClientHandle.stderr`."""
        return self.end.result()[1] if self.end.done() else ""

    def state(self) -> str:
        """Return what it waits for: see `ClientHandle.state`."""
        return self.waits_for

    def terminate(self) -> None:
        """Ask the client to end: see `ClientHandle.terminate`."""
        self._nodes.do(self._signal(signal.SIGTERM))

    def kill(self) -> None:
        """Kill the client: see `ClientHandle.kill`."""
        if not self._killed:
            self._killed = True
            self._nodes.do(self._signal(signal.SIGKILL))

    def finish(self, status: int, stderr: str = "") -> None:
        """Record the end of the client, unless it is already known."""
        if not self.end.done():
            self.end.set_result((status, stderr))

    async def _signal(self, number: signal.Signals) -> None:
        """Send a signal; a client whose agent does not answer is lost with its node or cut off.

        A client that is cut off exits when it notices that the server has closed the connection.
        """
        if self.agent is None:
            self.finish(-number)
            return
        try:
            call = _ask(self.agent, "signal", self.instance_id, int(number))
            await asyncio.wait_for(call, _ANSWER_TIME)
        except (RayError, TimeoutError):
            if number == signal.SIGKILL:
                self.finish(-number)


class _Nodes:
    """A run's agents, and the thread that monitors them.

    Attributes:
        places: Instance to its placement group, its index in the group, and its resources.
    """

    def __init__(self, runtime_env: dict[str, Any] | None) -> None:
        self.places: dict[int, tuple[Any, int, Bundle]] = {}
        environment = dict(runtime_env or {})
        environment["env_vars"] = {**environment.get("env_vars", {}), **_LEAVE_CHILDREN}
        options: dict[str, Any] = {"num_cpus": 0, "max_concurrency": _CALLS}
        options["runtime_env"] = environment
        self._actor: Any = ray.remote(**options)(Agent)
        self._agents: dict[Any, Any] = {}
        self._here = Agent()  # this process's own node needs no other process
        self._own_node = ray.get_runtime_context().get_node_id()
        self._is_plain = runtime_env is None
        self._groups: list[Any] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def add(self, group: Any, instances: Sequence[int], bundle: Bundle) -> None:
        """Add a placement group with one bundle for each of the instances."""
        self._groups.append(group)
        self.places |= {number: (group, k, bundle) for k, number in enumerate(instances)}

    def start(self, number: int, address: str, token: str) -> RayHandle:
        """Arrange for a client to start as soon as its node is known; return immediately."""
        handle = RayHandle(number, self)
        self.do(self._live(handle, address, token))
        return handle

    def do(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine in the thread."""
        asyncio.run_coroutine_threadsafe(work, self._loop)

    def close(self) -> None:
        """End the agents with everything that they started, and release the reserved resources."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()
        if not ray.is_initialized():
            return
        for agent in self._agents.values():
            ray.kill(agent)
        for group in self._groups:
            remove_placement_group(group)

    async def _live(self, handle: RayHandle, address: str, token: str) -> None:
        """Start a client, on another node if its node is lost meanwhile, and wait for its end."""
        number = handle.instance_id
        try:
            while not handle.end.done():
                key, agent = await self._find_agent(handle)
                try:
                    await _ask(agent, "answer")
                    if handle.end.done():
                        return
                    handle.agent = agent
                    await _ask(agent, "start", number, address, token)
                    break
                except RayActorError as error:
                    handle.waits_for = f"its node was lost: {_first_line(error)}"
                    handle.agent = None
                    self._agents.pop(key, None)
                    await asyncio.sleep(_PAUSE)
            handle.waits_for = f"running on {self._describe(number)}"
            handle.finish(*await _ask(handle.agent, "follow", number))
        except RayActorError as error:
            handle.finish(1, f"Ray: {_first_line(error)}")
        except Exception as error:  # whatever it is, the run must learn of it
            handle.finish(1, f"Ray: {error}")

    async def _find_agent(self, handle: RayHandle) -> tuple[Any, Any]:
        """Wait until Ray has placed a client; return the agent there, preceded by its key."""
        group, index, bundle = self.places[handle.instance_id]
        while True:
            table = placement_group_table(group)
            node = table["bundles_to_node_id"][index]
            if table["state"] == "CREATED" and node:
                break
            free = {name: ray.available_resources().get(name, 0.0) for name in bundle}
            handle.waits_for = f"waiting for {describe(bundle)} (Ray has {describe(free)} free)"
            await asyncio.sleep(_PAUSE)
        handle.waits_for = "waiting for a Ray process to start"
        if node == self._own_node and self._is_plain and not bundle.get("GPU"):
            return node, self._here
        # Ray assigns GPUs to actors, so an agent with GPUs has exactly one client.
        key = (group.id, index if bundle.get("GPU") else node)
        if key not in self._agents:
            place = PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=index)
            options = {"scheduling_strategy": place, "num_gpus": bundle.get("GPU", 0)}
            self._agents[key] = self._actor.options(**options).remote()
        return key, self._agents[key]

    def _describe(self, number: int) -> str:
        group, index, _ = self.places[number]
        return f"node {placement_group_table(group)['bundles_to_node_id'][index][:8]}"


async def _ask(agent: Any, method: str, *arguments: Any) -> Any:
    """Call an agent's method and return the result; the agent may be in this process."""
    call = getattr(agent, method)
    return await (call(*arguments) if isinstance(agent, Agent) else call.remote(*arguments))


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
