"""ParameterAverage: the running mean of a network's parameters over the steps of a training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from physx_core.errors import CheckpointError

_FIRST = 10.0


class ParameterAverage:
    """The exponential mean of parameters, and of floating-point buffers such as running statistics.

    In evaluation mode the network has the mean, in training mode what it learns; the two change
    places without a copy. In early steps the mean is over fewer of them, so that it does not depend
    on the initial parameters for long.

    Attributes:
        steps: Number of steps averaged.
    """

    def __init__(self, module: torch.nn.Module, decay: float) -> None:
        """Average from the next step on.

        Args:
            module: The network, in training mode.
            decay: Share of the mean that a step leaves.
        """
        self.steps = 0
        self._decay, self._is_used = decay, False
        learned = [*module.parameters(), *module.buffers()]
        self._learned = [t for t in learned if t.is_floating_point() or t.is_complex()]
        self._other: list[torch.Tensor] = []

    def update(self) -> None:
        """Take in the parameters after a step."""
        with torch.no_grad():
            if not self._other:
                self._other = [tensor.detach().clone() for tensor in self._learned]
            share = min(self._decay, (1 + self.steps) / (_FIRST + self.steps))
            for mean, tensor in zip(self._other, self._learned, strict=True):
                mean.mul_(share).add_(tensor, alpha=1 - share)  # unlike lerp_, infinity stays so
        self.steps += 1

    def use(self, *, is_used: bool) -> None:
        """Let the network have the mean, or what it learns."""
        if is_used == self._is_used or not self._other:
            return
        self._is_used = is_used
        for i, tensor in enumerate(self._learned):
            tensor.data, self._other[i] = self._other[i], tensor.data

    def restart(self) -> None:
        """Forget the mean, as the network is about to get other parameters."""
        self.use(is_used=False)
        self.steps, self._other = 0, []

    def state(self) -> dict[str, Any]:
        """Return what is learned, and the number of steps, beside the network's stored mean."""
        learned = self._other if self._is_used else [tensor.detach() for tensor in self._learned]
        return {"steps": self.steps, "learned": learned if self.steps else []}

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`, when the network has got its stored mean.

        Raises:
            CheckpointError: If it is of another network.
        """
        learned: list[torch.Tensor] = list(state["learned"])
        if learned and [t.shape for t in learned] != [t.shape for t in self._learned]:
            raise CheckpointError("the averaged parameters are those of another network")
        self.restart()
        self.steps = int(state["steps"])
        self._other = [tensor.detach().clone() for tensor in self._learned] if learned else []
        with torch.no_grad():
            for tensor, stored in zip(self._learned, learned, strict=False):
                tensor.copy_(stored)
