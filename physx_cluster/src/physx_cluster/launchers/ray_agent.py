"""Agent: starts and monitors a run's clients on one node of a Ray cluster."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal

from physx_core.workers import ClientProcess

_TRIM_EVERY = 60.0  # s


class Agent:
    """Runs clients as child processes, which outlive the agent, and end with their connection.

    It is a Ray actor, which Ray ends if the cluster's head is lost; the run then goes on with the
    clients. All methods are coroutines, so Ray runs any number of calls concurrently in one thread.
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
        client = ClientProcess(instance, address, token, detached=True)
        client.start()
        self._clients[instance] = client

    async def follow(self, instance: int) -> tuple[int, str]:
        """Wait until a client ends.

        Returns:
            Its exit status, negative for a signal, and the last lines of its standard error.
        """
        client = self._clients[instance]
        with contextlib.suppress(ProcessLookupError):
            while not await _ends(client, _TRIM_EVERY):
                client.trim_stderr()
        while (status := client.exit_status()) is None:  # not yet reaped
            await asyncio.sleep(0.01)
        return status, client.stderr()

    async def signal(self, instance: int, number: int) -> None:
        """Ask a client and its processes to exit, or kill them."""
        client = self._clients[instance]
        client.kill() if number == signal.SIGKILL else client.terminate()


async def _ends(client: ClientProcess, seconds: float) -> bool:
    """Return whether a process ends within some seconds, without polling."""
    loop = asyncio.get_running_loop()
    over = asyncio.Event()
    descriptor = os.pidfd_open(client.pid or 0)
    loop.add_reader(descriptor, over.set)
    try:
        await asyncio.wait_for(over.wait(), seconds)
    except TimeoutError:
        return False
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)
    return True
