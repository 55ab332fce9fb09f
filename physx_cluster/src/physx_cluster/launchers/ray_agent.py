"""Agent: starts and monitors a run's clients on one node of a Ray cluster."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal

from physx_core.workers import ClientProcess


class Agent:
    """Runs clients as child processes, which end with the agent's process, even if it is killed.

    It is a Ray actor or a plain object. All methods are coroutines, so Ray runs any number of calls
    concurrently in one thread.
    """

    def __init__(self) -> None:
        """Start without clients."""
        self._clients: dict[int, ClientProcess] = {}

    async def answer(self) -> None:
        """Do nothing; callers await this until the agent responds."""

    async def start(self, instance: int, address: str, token: str) -> None:
        """Start the client of an instance.

        Args:
            instance: Number of the instance, from 1.
            address: ``HOST:PORT`` of the run's server.
            token: The run's secret; the client gets it in its environment.
        """
        client = ClientProcess(instance, address, token)
        client.start()
        self._clients[instance] = client

    async def follow(self, instance: int) -> tuple[int, str]:
        """Wait until a client ends.

        Returns:
            Its exit status, negative for a signal, and the last lines of its standard error.
        """
        client = self._clients[instance]
        with contextlib.suppress(ProcessLookupError):
            await _ends(client)
        while (status := client.exit_status()) is None:  # not yet reaped
            await asyncio.sleep(0.01)
        return status, client.stderr()

    async def signal(self, instance: int, number: int) -> None:
        """Ask a client and its processes to exit, or kill them."""
        client = self._clients[instance]
        client.kill() if number == signal.SIGKILL else client.terminate()


async def _ends(client: ClientProcess) -> None:
    """Wait until a process ends, without polling."""
    loop = asyncio.get_running_loop()
    over = asyncio.Event()
    descriptor = os.pidfd_open(client.pid or 0)
    loop.add_reader(descriptor, over.set)
    try:
        await over.wait()
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)
