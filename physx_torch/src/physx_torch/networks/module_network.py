"""ModuleNetwork: adapts a plain PyTorch module as a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch

from physx_core.errors import ConfigError, listed
from physx_torch.choices import choose, make, parameters_of
from physx_torch.networks.network import TorchNetwork


class ModuleNetwork(TorchNetwork):
    """A plain `torch.nn.Module` with names for its inputs and outputs.

    Its ``forward`` takes the tensors of `net_fields` in that order and returns one tensor, several
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
        module_kwargs: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        """Create the module.

        The keyword arguments of the module's constructor can be given beside the others, or in
        `module_kwargs`, which is necessary if it takes one of the names below itself.

        Args:
            module: Class of the module, or ``"package.module:Class"``, or ``"script.py:Class"``.
            net_fields: As in `TorchNetwork`.
            opt_fields: As in `TorchNetwork`.
            pred_fields: As in `TorchNetwork`.
            module_kwargs: Keyword arguments of the module's constructor; None: they are
                `arguments`.
            arguments: Keyword arguments of the module's constructor.

        Raises:
            ConfigError: If there is no such class, it rejects the arguments, does not create a
                plain module, or an argument is ambiguous.
        """
        super().__init__(net_fields=net_fields, opt_fields=opt_fields, pred_fields=pred_fields)
        names = {
            "net_fields": net_fields,
            "opt_fields": opt_fields,
            "pred_fields": pred_fields,
        }
        chosen = choose("module", module, {})
        given = [name for name, value in names.items() if value is not None]
        kwargs = _module_arguments(chosen, given, module_kwargs, arguments)
        made = make("module", torch.nn.Module, chosen, **kwargs)
        if not isinstance(made, torch.nn.Module):
            raise ConfigError(f"{module!r} returned {type(made).__name__}, not a torch.nn.Module.")
        if isinstance(made, TorchNetwork):
            raise ConfigError(
                f"{type(made).__name__} is a network already: choose it as NetworkConfig.network."
            )
        self.module = made

    def forward(self, *inputs: torch.Tensor) -> Any:
        """Return the module's output for the tensors of `net_fields`."""
        return self.module(*inputs)


def _module_arguments(
    module: Any,
    given: Iterable[str],
    module_kwargs: Mapping[str, Any] | None,
    arguments: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the arguments of the module.

    Args:
        module: Class of the module.
        given: Names of the arguments that the network takes itself.
        module_kwargs: Arguments that the user gave for the module, if any.
        arguments: Other arguments that the network does not take.
    """
    name = getattr(module, "__name__", repr(module))
    if module_kwargs is not None:
        if arguments:
            raise ConfigError(
                f"{listed(arguments)} and module_kwargs are given: put all arguments of {name} "
                "into module_kwargs."
            )
        return dict(module_kwargs)
    taken = set(parameters_of(module))
    for option in given:
        if option in taken:
            raise ConfigError(
                f'{name} takes an argument "{option}" itself, so it is ambiguous. '
                f"Put the arguments of {name} into module_kwargs={{...}}."
            )
    return dict(arguments)
