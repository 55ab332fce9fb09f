"""RLAgent: what acts in an environment that is driven from another process."""

from __future__ import annotations

from typing import Any

from physx_core.errors import UsageError


class RLAgent:
    """What acts and observes; a subclass implements `set_action` and `get_data`."""

    def set_action(self, action: Any) -> None:
        """Take the action of the next physics steps; called once for each action.

        Args:
            action: Any value of JSON, as the client sent it.
        """
        raise UsageError(f"{type(self).__name__} does not implement set_action(action).")

    def get_data(self, request: Any, storage: Any) -> None:
        """Write what is asked for into the message.

        Args:
            request: Any value of JSON, by convention a list of names.
            storage: Message for the agent's data; `physx_remote.fill` writes arrays.
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
