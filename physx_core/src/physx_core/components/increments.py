"""Increments: what a network predicts as the change of one of its inputs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from physx_core.components.network import Network
from physx_core.errors import ConfigError, listed
from physx_core.normalization import Normalization
from physx_core.typing import Tensors


class Increments:
    """Targets of a network that are changes since one of its inputs, in physical units.

    Of an input with several steps, it is the last one.
    """

    def __init__(self, network: Network, normalization: Mapping[str, Normalization]) -> None:
        """Find the targets.

        Args:
            network: The network.
            normalization: The normalization of its fields by name.

        Raises:
            ConfigError: If the network does not read the input, or reads the target.
        """
        given = {name: one.since for name, one in normalization.items() if one.since}
        for name, since in given.items():
            if since not in network.net_fields or name in network.net_fields:
                raise ConfigError(
                    f'The network learns the change of "{name}" since "{since}" (DatasetConfig.'
                    f"normalize), so it must read the second one and not the first one; it reads "
                    f"{listed(network.net_fields)}."
                )
        self._targets = {name: since for name, since in given.items() if name in network.opt_fields}
        pairs = zip(network.pred_fields, network.opt_fields, strict=False)
        self._predictions = {pred: given[opt] for pred, opt in pairs if opt in given}

    def __bool__(self) -> bool:
        return bool(self._targets)

    def of(self, targets: Tensors, inputs: Tensors) -> Tensors:
        """Return the targets, those of increments as changes.

        Args:
            targets: The network's `opt_fields`.
            inputs: Its `net_fields`.
        """
        changes = {
            name: targets[name] - _last(inputs[since], targets[name])
            for name, since in self._targets.items()
        }
        return {**targets, **changes}

    def add(self, prediction: Tensors, inputs: Tensors) -> Tensors:
        """Return a prediction of changes as that of values.

        Args:
            prediction: The network's `pred_fields`.
            inputs: Its `net_fields`.
        """
        values = {
            name: prediction[name] + _last(inputs[since], prediction[name])
            for name, since in self._predictions.items()
            if name in prediction
        }
        return {**prediction, **values}


def _last(values: Any, like: Any) -> Any:
    return values[:, -1] if values.ndim > like.ndim else values
