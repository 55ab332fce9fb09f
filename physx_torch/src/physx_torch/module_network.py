"""ModuleNetwork: any plain PyTorch module as a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch

from physx_core.errors import ConfigError
from physx_torch.choices import choose, make
from physx_torch.network import TorchNetwork


class ModuleNetwork(TorchNetwork):
    """A `torch.nn.Module` that knows nothing of physx, with names for its inputs and outputs.

    Its ``forward`` gets the tensors of `net_fields` in that order and returns one tensor, several
    in the order of `pred_fields`, or a dictionary by those names.

    Attributes:
        module: The module.
    """

    def __init__(
        self,
        module: str | Callable[..., torch.nn.Module],
        *,
        net_fields: str | Iterable[str] | None = None,
        opt_fields: str | Iterable[str] | None = None,
        pred_fields: str | Iterable[str] | None = None,
        **module_kwargs: Any,
    ) -> None:
        """Make the module.

        Args:
            module: Class of the module, or ``"package.module:Class"``, or ``"script.py:Class"``.
            net_fields: As in `TorchNetwork`.
            opt_fields: As in `TorchNetwork`.
            pred_fields: As in `TorchNetwork`.
            module_kwargs: Keyword arguments of the module's constructor.

        Raises:
            ConfigError: There is no such class, it refuses the arguments, or is no plain module.
        """
        super().__init__(net_fields=net_fields, opt_fields=opt_fields, pred_fields=pred_fields)
        made = make("module", choose("module", module, {}), **module_kwargs)
        if not isinstance(made, torch.nn.Module):
            raise ConfigError(f"{module!r} made a {type(made).__name__}, not a torch.nn.Module.")
        if isinstance(made, TorchNetwork):
            raise ConfigError(
                f"{type(made).__name__} is a network already: choose it as NetworkConfig.network."
            )
        self.module = made

    def forward(self, *inputs: torch.Tensor) -> Any:
        """Return what the module makes of the tensors of `net_fields`."""
        return self.module(*inputs)
