"""OptimizationState: what an optimization keeps between two steps, in a checkpoint's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.optim.lr_scheduler import LRScheduler

from physx_core.errors import CheckpointError
from physx_torch.networks.network import TorchNetwork
from physx_torch.storage.attributes import Attributes
from physx_torch.storage.state import random_state, read_state, set_random_state, write_state

_ANOTHER = (
    "Start another training from its network: NetworkConfig.network_dir (--network.network-dir)."
)


@dataclass(frozen=True)
class OptimizationState:
    """The parts of an optimization that have state, besides the network's parameters.

    Attributes:
        network: The network that is trained.
        optimizer: The optimizer.
        scheduler: The scheduler, if any.
        scaler: The scaler of gradients in float16, if any.
        interval: When the scheduler is stepped, "epoch" or "step".
        learned_by_loss: Parameters of the loss that are trained too, by name.
        attributes: Further state, found in the attributes of the optimization and of its loss.
    """

    network: TorchNetwork
    optimizer: torch.optim.Optimizer
    scheduler: LRScheduler | None
    scaler: torch.amp.GradScaler | None
    interval: str | None
    learned_by_loss: Mapping[str, torch.nn.Parameter]
    attributes: Attributes

    def write(
        self,
        path: Path,
        attributes: Mapping[str, Any],
        accumulated: int,
        lost: Mapping[str, str],
    ) -> None:
        """Write the state, and that of torch's random numbers.

        Args:
            path: The file.
            attributes: What `Attributes.save` returned.
            accumulated: Number of batches whose gradients wait for the next step.
            lost: Paths of attributes that cannot be saved, with the reasons.
        """
        state: dict[str, Any] = {
            "kinds": self._kinds,
            "optimizer": self.optimizer.state_dict(),
            "random": random_state(self.network.device),
            "attributes": attributes,
        }
        if lost:
            state["lost"] = lost
        for name, item in (("scheduler", self.scheduler), ("scaler", self.scaler)):
            if item is not None:
                state[name] = item.state_dict()
        if self.scheduler is not None:
            state["interval"] = self.interval
        if self.network.average is not None:
            state["average"] = self.network.average.state()
        if accumulated:
            state["accumulated"] = accumulated
            state["gradients"] = self.network.get_gradients()
            state["gradients of the loss"] = gradients_of(self.learned_by_loss)
        write_state(path, state)

    def read(self, path: Path) -> int:
        """Restore the state from a file; return the number of batches that wait for the next step.

        Raises:
            CheckpointError: If the file is missing, damaged, or for another optimizer or scheduler,
                or lacks some of the state.
        """
        state = read_state(path)
        self._check_fits(path, state)
        try:
            self.optimizer.load_state_dict(state["optimizer"])
            accumulated: int = state.get("accumulated", 0)
            self.network.set_gradients(state.get("gradients", {}))
        except (KeyError, ValueError) as error:
            raise CheckpointError(f"{path} is from another network: {error}.") from error
        for name, parameter in self.learned_by_loss.items():
            gradient = state.get("gradients of the loss", {}).get(name)
            parameter.grad = None if gradient is None else gradient.to(parameter)
        for name, item in (("scheduler", self.scheduler), ("scaler", self.scaler)):
            if item is not None:
                item.load_state_dict(state[name])
        if self.network.average is not None:
            self.network.average.load(state["average"])
        try:
            self.attributes.load(state.get("attributes", {}), self.network.device)
        except CheckpointError as error:
            raise CheckpointError(f"{path} does not fit: {error}. {_ANOTHER}") from error
        set_random_state(state["random"], self.network.device)
        return accumulated

    def _check_fits(self, path: Path, state: Mapping[str, Any]) -> None:
        if state.get("kinds") != self._kinds:
            found, own = (" and ".join(kinds) for kinds in (state.get("kinds", []), self._kinds))
            raise CheckpointError(f"{path} is the state of {found or 'nothing'}, not of {own}.")
        former = state.get("interval", "epoch")
        if self.scheduler is not None and former != self.interval:
            raise CheckpointError(
                f"The scheduler of {path} was stepped every {former}, not every "
                f'{self.interval}: set NetworkConfig.scheduler_interval="{former}" '
                f"(--network.scheduler-interval {former}) to continue."
            )
        if lost := state.get("lost"):
            raise CheckpointError(
                f"{path} lacks a part of the state: {describe(lost)}. A resumed training would "
                f"differ. {_ANOTHER}"
            )

    @property
    def _kinds(self) -> list[str]:
        used = (self.optimizer, self.scheduler, self.scaler, self.network.average)
        return [type(item).__name__ for item in used if item is not None]


def gradients_of(parameters: Mapping[str, torch.nn.Parameter]) -> dict[str, torch.Tensor]:
    """Return the gradients of those parameters that have one."""
    return {name: p.grad for name, p in parameters.items() if p.grad is not None}


def describe(lost: Mapping[str, str]) -> str:
    """Return what cannot be saved, and why, in words."""
    return "; ".join(f'"{path}" {reason}' for path, reason in lost.items())
