"""SlurmLauncher: clients on the nodes of a Slurm cluster."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.components import ClientHandle, Launcher
from physx_core.errors import ClientError


class SlurmLauncher(Launcher):
    """Starts each client on a node of a Slurm cluster."""

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start the clients: see `Launcher.launch`."""
        raise ClientError(instances[0], "cannot be started on Slurm by this version.")
