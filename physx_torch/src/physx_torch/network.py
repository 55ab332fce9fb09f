"""TorchNetwork: what every network of PyTorch has in common."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from physx_core import Network
from physx_core.errors import (
    ConfigError,
    FieldsMismatchError,
    MissingFieldError,
    UnknownOptionError,
    listed,
)
from physx_core.fields import Array, Batch
from physx_core.interfaces.environment import options_of
from physx_core.interfaces.network import Tensors
from physx_torch.devices import find_device
from physx_torch.parameters import check_match, read_tensors, write_tensors

DATA_TYPES = {"float32": torch.float32, "float64": torch.float64}
"""Names of the floating types that a network can compute in."""


class TorchNetwork(torch.nn.Module, Network):
    """Base of PyTorch networks: a module whose inputs and outputs are fields.

    A subclass makes its layers in the constructor and implements ``forward``, which gets the
    tensors of `net_fields` in that order, of shape (samples, *field shape), and returns those of
    `pred_fields`: one tensor, several in that order, or a dictionary by name.

    The names of the fields are class attributes of the subclass or arguments of the constructor.
    Where `opt_fields` are given and `pred_fields` are not, a prediction has the name of the field
    that it is compared with.

    Attributes:
        device: Where the parameters are.
        data_type: Floating type of parameters and tensors.
    """

    parameters_file: ClassVar[str] = "parameters.safetensors"
    default_optimization: ClassVar[str] = "torch/default"
    default_transformation: ClassVar[str] = "torch/default"

    def __init__(
        self,
        *,
        net_fields: str | Iterable[str] | None = None,
        opt_fields: str | Iterable[str] | None = None,
        pred_fields: str | Iterable[str] | None = None,
        **kwargs: Any,
    ) -> None:
        """Keep the names of the fields.

        Args:
            net_fields: Name or names of the fields that the network reads.
            opt_fields: Name or names of the fields that the loss compares the prediction with.
            pred_fields: Name or names of the fields that the network predicts.
            kwargs: Must be empty; a subclass takes its own options by name.

        Raises:
            UnknownOptionError: An option that no class of the network takes.
            ConfigError: Names are missing, are given twice, or do not fit together in number.
        """
        if kwargs:
            raise UnknownOptionError(type(self).__name__, kwargs, options_of(type(self)))
        super().__init__()
        own_names = opt_fields is not None or self.opt_fields != Network.opt_fields
        self.net_fields = _names("net_fields", net_fields, self.net_fields)
        self.opt_fields = _names("opt_fields", opt_fields, self.opt_fields)
        if pred_fields is None and self.pred_fields == Network.pred_fields and own_names:
            pred_fields = self.opt_fields
        self.pred_fields = _names("pred_fields", pred_fields, self.pred_fields)
        if len(self.pred_fields) != len(self.opt_fields):
            raise ConfigError(
                f"{type(self).__name__} predicts {listed(self.pred_fields)} but is compared with "
                f"{listed(self.opt_fields)}: each pred_field needs one opt_field."
            )
        self.device = torch.device("cpu")
        self.data_type = torch.float32

    @classmethod
    def set_seed(cls, seed: int) -> None:
        """Seed torch's random numbers, those of every device."""
        torch.manual_seed(seed)

    def predict(self, data: Tensors) -> Tensors:
        """Return ``{field: tensor}`` for `pred_fields` from the `net_fields` in `data`.

        Raises:
            MissingFieldError: `data` lacks one of `net_fields`.
            FieldsMismatchError: ``forward`` returned something else than `pred_fields`.
        """
        try:
            inputs = [data[name] for name in self.net_fields]
        except KeyError as error:
            raise MissingFieldError(
                f'{type(self).__name__} reads the field "{error.args[0]}", which is not given. '
                f"Given: {listed(data)}.",
                field=str(error.args[0]),
            ) from None
        if self.training:
            return self._by_field(self(*inputs))
        with torch.no_grad():
            return self._by_field(self(*inputs))

    def _by_field(self, output: Any) -> Tensors:
        names = self.pred_fields
        if isinstance(output, torch.Tensor) and len(names) == 1:
            return {names[0]: output}
        if isinstance(output, Mapping) and all(name in output for name in names):
            return {name: output[name] for name in names}
        if isinstance(output, (tuple, list)) and len(output) == len(names):
            return dict(zip(names, output, strict=True))
        given = listed(output) if isinstance(output, Mapping) else type(output).__name__
        if isinstance(output, (tuple, list)):
            given = f"{len(output)} values"
        raise FieldsMismatchError(
            f"{type(self).__name__}.forward() does not return its pred_fields",
            dict.fromkeys(names, f"expected; returned was: {given}"),
        )

    def set_train(self) -> None:
        """Get ready to be trained."""
        self.train()

    def set_eval(self) -> None:
        """Get ready to predict: no gradients are recorded."""
        self.eval()

    def set_device(self, device: str) -> None:
        """Move to ``"cpu"``, ``"cuda"``, ``"cuda:<index>"``, ``"mps"`` or ``"auto"``.

        ``"auto"`` is the first CUDA device if there is one, otherwise the processor.

        Raises:
            ConfigError: The device does not exist on this machine, or cannot hold the data type.
        """
        found = find_device(device)
        _check_type(self.data_type, found)
        self.device = found
        self.to(found)

    def set_data_type(self, data_type: str) -> None:
        """Compute in ``"float32"`` or ``"float64"``.

        Raises:
            ConfigError: Another type, or one that the device cannot hold.
        """
        if data_type not in DATA_TYPES:
            raise ConfigError(f'data_type is "{data_type}" but must be {listed(DATA_TYPES)}.')
        _check_type(DATA_TYPES[data_type], self.device)
        self.data_type = DATA_TYPES[data_type]
        self.to(self.data_type)

    def get_parameters(self) -> dict[str, torch.Tensor]:
        """Return the parameters that are trained by name; they are the network's own."""
        return dict(self.named_parameters())

    def nb_parameters(self) -> int:
        """Return how many numbers the parameters hold."""
        return sum(parameter.numel() for parameter in self.parameters())

    def save_parameters(self, path: Path) -> None:
        """Write parameters and buffers to a safetensors file.

        Raises:
            CheckpointError: The file cannot be written, or the state holds more than tensors.
        """
        write_tensors(path, self.state_dict())

    def load_parameters(self, path: Path) -> None:
        """Read parameters and buffers that `save_parameters` wrote, in any floating type.

        Raises:
            CheckpointError: The file is missing, damaged or of another architecture; the network
                is unchanged then.
        """
        tensors, _ = read_tensors(path)
        check_match(path, type(self).__name__, tensors, self.state_dict())
        self.load_state_dict(tensors)

    def numpy_to_tensor(self, batch: Batch) -> Tensors:
        """Return arrays as tensors on the network's device.

        Floating arrays get the network's data type; integers, booleans and complex numbers keep
        theirs. On the processor a writable array of the right type shares its memory.

        Args:
            batch: Arrays by field, each of shape (samples, *field shape).
        """
        return {name: self._tensor(array) for name, array in batch.items()}

    def _tensor(self, array: Array) -> torch.Tensor:
        tensor = torch.from_numpy(_plain(array))
        if tensor.is_floating_point():
            return tensor.to(self.device, self.data_type)
        return tensor.to(self.device)

    def tensor_to_numpy(self, tensors: Tensors) -> Batch:
        """Return tensors as arrays; those on the processor share their memory."""
        return {name: tensor.numpy(force=True) for name, tensor in tensors.items()}


def _plain(array: Array) -> Array:
    # torch takes neither read-only memory, nor foreign byte orders, nor negative strides.
    regular = array.flags.writeable and array.dtype.isnative
    if regular and (array.flags.c_contiguous or min(array.strides) >= 0):
        return array
    return np.array(array, dtype=array.dtype.newbyteorder("="), order="C")


def _names(
    option: str, given: str | Iterable[str] | None, default: str | Iterable[str]
) -> tuple[str, ...]:
    chosen = default if given is None else given
    names = (chosen,) if isinstance(chosen, str) else tuple(chosen)
    if not names or len(set(names)) != len(names) or not all(isinstance(n, str) for n in names):
        raise ConfigError(
            f"{option} is {chosen!r} but must be a field's name or several that differ."
        )
    return names


def _check_type(data_type: torch.dtype, device: torch.device) -> None:
    if device.type == "mps" and data_type == torch.float64:
        raise ConfigError('The device "mps" has no float64: use float32 or the device "cpu".')
