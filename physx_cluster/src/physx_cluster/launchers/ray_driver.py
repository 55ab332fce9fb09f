"""Driver: connects to Ray in a process of its own, and has agents start a run's clients.

Started as ``python -m physx_cluster.launchers.ray_driver DESCRIPTOR``, that of a socket to the run.
Ray ends each process that is connected to a cluster whose head node is lost; as that is not the
run's, the run goes on with the clients that it has.
"""

from __future__ import annotations

import asyncio
import signal
import socket
import sys
from collections.abc import Coroutine, Mapping, Sequence
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError
from ray.util.placement_group import (
    placement_group,
    placement_group_table,
    remove_placement_group,
)
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from physx_cluster.launchers.messages import Messages
from physx_cluster.launchers.ray_agent import Agent
from physx_cluster.launchers.ray_connection import RayConnection
from physx_cluster.placement.bundles import Bundle, describe, find_misfit, share_of_processors
from physx_core.errors import ConfigError
from physx_core.processes import BackgroundThread

_CALLS = 100_000  # concurrent calls of one agent: two for each client
# A Ray process kills its children when it is told to exit: the clients, whose own children would
# survive.
_LEAVE_CHILDREN = {"RAY_kill_child_processes_on_worker_exit": "false"}
_ANSWER_TIME = 1.0  # s, for an agent that is asked to kill a client
_LOOK_TIME = 2.0  # s, for Ray to find nodes
_PAUSE = 0.25


class Driver:
    """A run's agents on the nodes of a cluster, and the thread that monitors them."""

    def __init__(self, messages: Messages, options: Mapping[str, Any]) -> None:
        """Connect to the cluster.

        Args:
            messages: To and from the run.
            options: Those of `RayLauncher`, by name; `elastic` in addition.

        Raises:
            ConfigError: If there is no such cluster.
        """
        self._messages, self._options = messages, options
        self._connection = RayConnection(options["address"])
        environment = dict(options["runtime_env"] or {})
        environment["env_vars"] = {**environment.get("env_vars", {}), **_LEAVE_CHILDREN}
        actor: dict[str, Any] = {"num_cpus": 0, "max_concurrency": _CALLS}
        actor["runtime_env"] = environment
        self._actor: Any = ray.remote(**actor)(Agent)
        self._agents: dict[Any, Any] = {}
        self._own_node = ray.get_runtime_context().get_node_id()
        self._is_plain = options["runtime_env"] is None
        self._groups: list[Any] = []
        self._places: dict[int, tuple[Any, int, Bundle]] = {}
        self._clients: dict[int, _Client] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = BackgroundThread(self._loop.run_forever, "physx-ray")
        self._thread.start()

    @property
    def host(self) -> str | None:
        """Address at which all nodes reach this machine; None: all nodes are on this machine."""
        return self._connection.host

    def launch(self, keys: Mapping[int, int], address: str, token: str) -> str:
        """Start clients as soon as their nodes are known.

        Args:
            keys: Instance to the key of its client, which is never used again.
            address: ``HOST:PORT`` of the run's server.
            token: The run's secret.

        Returns:
            Why there is no place for them; empty if there is, or may be.
        """
        without = [number for number in keys if number not in self._places]
        groups = [[number] for number in without] if self._options["elastic"] else [without]
        for group in groups if without else ():
            if misfit := self._reserve(group, len(without)):
                return misfit
        for number, key in keys.items():
            client = self._clients[key] = _Client(number, key, self._messages)
            self._do(self._live(client, address, token))
        return ""

    def signal(self, key: int, number: int) -> None:
        """Send a signal to a client."""
        self._do(self._clients[key].signal(number))

    def close(self) -> None:
        """End the agents, release the reserved resources, and disconnect."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        for agent in self._agents.values():
            ray.kill(agent)
        for group in self._groups:
            remove_placement_group(group)
        self._connection.close()

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop)

    def _reserve(self, instances: Sequence[int], total: int) -> str:
        """Reserve the resources of some of all clients; return why that is impossible, if so."""
        found = self._connection.nodes()
        needs = dict(self._options["needs"])
        if needs["CPU"] is None:
            needs["CPU"] = share_of_processors(found, total)
        bundle: Bundle = {name: float(need) for name, need in needs.items() if need}
        group = placement_group([bundle] * len(instances), strategy=self._options["strategy"])
        self._groups.append(group)
        self._places |= {number: (group, k, bundle) for k, number in enumerate(instances)}
        if self._options["elastic"]:
            return find_misfit(found, bundle)
        return "" if group.wait(_LOOK_TIME) else self._find_reason(group, bundle)

    def _find_reason(self, group: Any, bundle: Bundle) -> str:
        """Return why Ray can never place a group on the current nodes; empty if it may."""
        found = self._connection.nodes()
        if misfit := find_misfit(found, bundle):
            return misfit
        table = placement_group_table(group)
        if table["stats"]["scheduling_state"] != "INFEASIBLE":
            return ""
        count, strategy = len(table["bundles"]), self._options["strategy"]
        return (
            f"{count} clients, each with {describe(bundle)}, do not fit the {len(found)} nodes "
            f"with the strategy {strategy}"
        )

    async def _live(self, client: _Client, address: str, token: str) -> None:
        """Start a client, on another node if its node is lost meanwhile, and wait for its end."""
        number = client.instance_id
        try:
            while not client.has_ended:
                key, agent = await self._find_agent(client)
                if agent is None:
                    client.say("here")
                    return
                try:
                    await agent.answer.remote()
                    if client.has_ended:
                        return
                    client.agent = agent
                    await agent.start.remote(number, address, token)
                    break
                except RayActorError as error:
                    client.waits(f"its node was lost: {_first_line(error)}")
                    client.agent = None
                    self._agents.pop(key, None)
                    await asyncio.sleep(_PAUSE)
            client.waits(f"running on {self._describe(number)}")
            client.finish(*await client.agent.follow.remote(number))
        except RayActorError as error:
            # Without its head, Ray loses all agents, but their clients go on. Then this call does
            # not return: Ray ends this process.
            self._connection.nodes()
            client.finish(1, f"Ray: {_first_line(error)}")
        except Exception as error:  # whatever it is, the run must learn of it
            client.finish(1, f"Ray: {error}")

    async def _find_agent(self, client: _Client) -> tuple[Any, Any]:
        """Wait until Ray has placed a client; return the agent there, preceded by its key.

        On the run's own node there is no agent: the run starts the client itself.
        """
        group, index, bundle = self._places[client.instance_id]
        while True:
            table = placement_group_table(group)
            node = table["bundles_to_node_id"][index]
            if table["state"] == "CREATED" and node:
                break
            free = {name: ray.available_resources().get(name, 0.0) for name in bundle}
            client.waits(f"waiting for {describe(bundle)} (Ray has {describe(free)} free)")
            await asyncio.sleep(_PAUSE)
        client.waits("waiting for a Ray process to start")
        if node == self._own_node and self._is_plain and not bundle.get("GPU"):
            return node, None
        # Ray assigns GPUs to actors, so an agent with GPUs has exactly one client.
        key = (group.id, index if bundle.get("GPU") else node)
        if key not in self._agents:
            place = PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=index)
            options = {"scheduling_strategy": place, "num_gpus": bundle.get("GPU", 0)}
            self._agents[key] = self._actor.options(**options).remote()
        return key, self._agents[key]

    def _describe(self, number: int) -> str:
        group, index, _ = self._places[number]
        return f"node {placement_group_table(group)['bundles_to_node_id'][index][:8]}"


class _Client:
    """A client on one of the cluster's nodes, as told to the run.

    Attributes:
        instance_id: Number of its instance, from 1.
        agent: The agent of its node; None until there is one.
        has_ended: Whether it has ended, as far as is known.
    """

    def __init__(self, instance_id: int, key: int, messages: Messages) -> None:
        self.instance_id, self.has_ended = instance_id, False
        self.agent: Any = None
        self._key, self._messages, self._state = key, messages, ""

    def say(self, what: str, **values: Any) -> None:
        """Tell the run something about it."""
        self._messages.send(say=what, key=self._key, **values)

    def waits(self, state: str) -> None:
        """Tell the run what it waits for, if that is new."""
        if state != self._state:
            self._state = state
            self.say("state", state=state)

    def finish(self, status: int, stderr: str = "") -> None:
        """Tell the run that it has ended, unless it was told before."""
        if not self.has_ended:
            self.has_ended = True
            self.say("end", status=status, stderr=stderr)

    async def signal(self, number: int) -> None:
        """Send a signal; a client whose agent does not answer is lost with its node or cut off.

        A client that is cut off exits when it notices that the server has closed the connection.
        """
        if self.agent is None:
            self.finish(-number)
            return
        try:
            call = self.agent.signal.remote(self.instance_id, number)
            await asyncio.wait_for(call, _ANSWER_TIME)
        except (RayError, TimeoutError):
            if number == signal.SIGKILL:
                self.finish(-number)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def main(descriptor: int) -> None:
    """Do what the run asks until it closes the connection."""
    messages = Messages(socket.socket(fileno=descriptor))
    options = messages.receive()
    if options is None:
        return
    try:
        driver = Driver(messages, options)
    except Exception as error:  # Ray has no class for that it cannot be started
        known = isinstance(error, ConfigError)
        messages.send(refusal=str(error) if known else f"Ray does not start: {_first_line(error)}")
        return
    messages.send(host=driver.host)
    while (message := messages.receive()) is not None:
        if "signal" in message:
            driver.signal(message["key"], message["signal"])
            continue
        try:
            misfit = driver.launch(dict(message["keys"]), message["address"], message["token"])
        except (RayError, RuntimeError, ValueError) as error:
            misfit = _first_line(error)
        messages.send(misfit=misfit)
    driver.close()


if __name__ == "__main__":
    main(int(sys.argv[1]))
