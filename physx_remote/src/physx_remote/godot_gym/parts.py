"""RLAgent and RLEnvWorld: the two parts of an environment that another process drives."""

from __future__ import annotations

from typing import Any

from physx_core.errors import UsageError


class _Part:
    """Common base of agents and worlds; a subclass implements `get_data`."""

    def get_data(self, request: Any, storage: Any) -> None:
        """Write the requested data into the message.

        Args:
            request: Any JSON value, by convention a list of names.
            storage: Message for this part's data; `physx_remote.fill` writes arrays into it.

        Raises:
            UsageError: If the subclass does not implement it.
        """
        raise UsageError(f"{type(self).__name__} does not implement get_data(request, storage).")

    def reset(self, arguments: Any = None) -> None:
        """Start an episode; called only if the user's `RLEnvironment._reset` calls it."""

    def configure(self, configuration: Any) -> None:
        """Apply a configuration, which may be any JSON value."""

    def _physics_process(self, delta: float) -> None:
        """Run once per physics frame, before physics is stepped.

        Args:
            delta: Length of the frame in s.
        """


class RLAgent(_Part):
    """The part that acts and observes; a subclass implements `set_action` and `get_data`."""

    def set_action(self, action: Any) -> None:
        """Set the action for the next physics steps; called once per action.

        Args:
            action: Any JSON value, as the client sent it.

        Raises:
            UsageError: If the subclass does not implement it.
        """
        raise UsageError(f"{type(self).__name__} does not implement set_action(action).")


class RLEnvWorld(_Part):
    """The world around the agent; a subclass implements `get_data`."""
