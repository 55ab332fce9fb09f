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

    Its ``forward`` takes the tensors of `net_fields` in order and returns one tensor, several in
    the order of `pred_fields`, or a dictionary by those names.

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

        Keyword arguments of the module's constructor can be passed along with the others, or in
        `module_kwargs`, which is necessary if their names include one of the names below.

        Args:
            module: Class of the module, ``"package.module:Class"``, or ``"script.py:Class"``.
            net_fields: As in `TorchNetwork`.
            opt_fields: As in `TorchNetwork`.
            pred_fields: As in `TorchNetwork`.
            module_kwargs: Keyword arguments of the module's constructor; None: use `arguments`.
            arguments: Keyword arguments of the module's constructor.

        Raises:
            ConfigError: If the class does not exist, rejects the arguments, or does not create a
                plain module, or if an argument is ambiguous.
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
                f"{type(made).__name__} is already a network: set it as NetworkConfig.network."
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
    """Return the module's arguments.

    Args:
        module: Class of the module.
        given: Names of the arguments that the network itself takes.
        module_kwargs: Arguments that the user passed for the module, if any.
        arguments: Other arguments, which the network does not take.
    """
    name = getattr(module, "__name__", repr(module))
    if module_kwargs is not None:
        if arguments:
            raise ConfigError(
                f"Both {listed(arguments)} and module_kwargs are set: put all arguments of {name} "
                "into module_kwargs."
            )
        return dict(module_kwargs)
    taken = set(parameters_of(module))
    for option in given:
        if option in taken:
            raise ConfigError(
                f'{name} also takes an argument "{option}", which makes it ambiguous. '
                f"Put the arguments of {name} into module_kwargs={{...}}."
            )
    return dict(arguments)
