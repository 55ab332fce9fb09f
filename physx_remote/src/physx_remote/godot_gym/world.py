"""RLEnvWorld: everything beside the agent in an environment that is driven from elsewhere."""

from __future__ import annotations

from typing import Any

from physx_core.errors import UsageError


class RLEnvWorld:
    """The world around the agent; a subclass implements `get_data`."""

    def get_data(self, request: Any, storage: Any) -> None:
        """Write what is asked for into the message.

        Args:
            request: Any value of JSON, by convention a list of names.
            storage: Message for the world's data; `physx_remote.fill` writes arrays.
        """
        raise UsageError(f"{type(self).__name__} does not implement get_data(request, storage).")

    def reset(self, arguments: Any = None) -> None:
        """Begin anew; called by the environment's `_reset` where the user has it so."""

    def configure(self, configuration: Any) -> None:
        """Take a configuration: any value of JSON."""

    def _physics_process(self, delta: float) -> None:
        """Do what is to be done in each physics frame, before physics is stepped.

        Args:
            delta: Length of the frame, in s.
        """
