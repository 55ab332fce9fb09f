"""TorchNetwork: base class of PyTorch networks."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch

from physx_core import Field, Network
from physx_core.components import Group, options_of
from physx_core.errors import (
    ConfigError,
    FieldsMismatchError,
    FieldTypeError,
    MissingFieldError,
    UnknownOptionError,
    UsageError,
    listed,
)
from physx_core.typing import Array, Batch, Tensors
from physx_torch.devices import find_device
from physx_torch.networks.averaging import ParameterAverage
from physx_torch.parallel import join_group
from physx_torch.storage.parameters import check_match, read_shapes, read_tensors, write_tensors

_ABOUT_TYPES = re.compile("type|implemented for")
"""Matches torch's errors about the types of tensors."""
_WIDEST = {"f": 8, "c": 16}

DATA_TYPES = {"float32": torch.float32, "float64": torch.float64}
"""Floating-point types that a network can compute in, by name."""
_LACKS_GRADIENTS = "does not require grad"
"""In what torch raises if a forward function differentiates while no gradients are recorded."""


class TorchNetwork(torch.nn.Module, Network):
    """Base of PyTorch networks: a module whose inputs and outputs are fields.

    A subclass creates its layers in the constructor and implements ``forward``, which takes the
    tensors of `net_fields` in order, of shape (samples, *field shape), and returns those of
    `pred_fields`: one tensor, several in order, or a dictionary by name.

    In evaluation mode no gradients are recorded, unless an input requires gradients, or ``forward``
    itself differentiates, for example ``torch.autograd.grad(energy.sum(), position,
    create_graph=True)``: that works in training, validation and prediction alike. The first
    evaluation finds out, and the graph ends with each call. ``create_graph=self.training`` saves
    time.

    The names of the fields are class attributes of the subclass or arguments of the constructor.
    With `opt_fields` but no `pred_fields`, predictions have the names of their targets.

    Attributes:
        device: Device of the parameters.
        data_type: Floating-point type of parameters and tensors.
        differentiates: Whether ``forward`` differentiates; known after the first prediction.
        average: The mean of the parameters over the steps of a training, with which the network
            predicts, and which it stores; None: there is none.
    """

    parameters_file: ClassVar[str] = "parameters.safetensors"
    default_optimization: ClassVar[str] = "torch/default"
    default_transformation: ClassVar[str] = "torch/default"
    export_forms: ClassVar[Sequence[str]] = ("onnx", "torchscript", "pt2")
    exporter: ClassVar[str] = "physx_torch.export:export_network"

    def __init__(
        self,
        *,
        net_fields: str | Iterable[str] | None = None,
        opt_fields: str | Iterable[str] | None = None,
        pred_fields: str | Iterable[str] | None = None,
        **kwargs: Any,
    ) -> None:
        """Set the names of the fields.

        Args:
            net_fields: Name or names of the input fields.
            opt_fields: Name or names of the target fields.
            pred_fields: Name or names of the predicted fields.
            kwargs: Must be empty; a subclass takes its own options by name.

        Raises:
            UnknownOptionError: If no class of the network accepts an option.
            ConfigError: If names are missing or duplicate.
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
        self.device = torch.device("cpu")
        self.data_type = torch.float32
        self._training_forward: Callable[..., Any] | None = None
        self.differentiates = False
        self.average: ParameterAverage | None = None

    @classmethod
    def set_seed(cls, seed: int) -> None:
        """Seed torch's random numbers on all devices."""
        torch.manual_seed(seed)

    @classmethod
    def check_arguments(cls, arguments: Mapping[str, Any], path: Path) -> None:
        """Validate arguments from a checkpoint against its parameters, before creating a network.

        Raises:
            CheckpointError: If the parameters do not belong to such a network.
        """
        shapes = read_shapes(path)
        try:
            with torch.device("meta"):  # where tensors take no memory
                made = cls(**arguments)
        except RuntimeError:  # it needs tensor values; invalid arguments are detected later
            return
        check_match(path, cls.__name__, shapes, made._state())

    @classmethod
    def join_group(cls, device: str) -> Group:
        """Join the processes that torchrun started to train this network together.

        Raises:
            ConfigError: If the device does not exist, or the processes cannot connect.
        """
        return join_group(device)

    def predict(self, data: Tensors) -> Tensors:
        """Return ``{field: tensor}`` for `pred_fields` from the `net_fields` in `data`.

        Raises:
            MissingFieldError: If `data` lacks one of `net_fields`.
            FieldsMismatchError: If ``forward`` does not return `pred_fields`.
        """
        try:
            inputs = list(map(data.__getitem__, self.net_fields))
        except KeyError as error:
            raise MissingFieldError(
                f'{type(self).__name__} reads the field "{error.args[0]}", which is missing. '
                f"Given: {listed(data)}.",
                field=str(error.args[0]),
            ) from None
        if self.training:
            return self._by_field(self(*inputs))
        return self._evaluate(inputs)

    def _evaluate(self, inputs: Sequence[torch.Tensor]) -> Tensors:
        """Predict in evaluation mode, recording gradients only if something asks for them."""
        for tensor in inputs:
            if tensor.requires_grad:
                return self._by_field(self(*inputs))
        if not self.differentiates:
            recorded = torch.is_grad_enabled()
            torch.set_grad_enabled(False)  # in half the time of torch.no_grad()
            try:
                return self._by_field(self(*inputs))
            except RuntimeError as error:
                if _LACKS_GRADIENTS not in str(error):
                    raise
            finally:
                torch.set_grad_enabled(recorded)
            self.differentiates = True
        with torch.enable_grad():
            prediction = self._by_field(self(*inputs))
        # Detached, so that nothing of the graph outlives this call.
        return {name: tensor.detach() for name, tensor in prediction.items()}

    def forward(self, *inputs: torch.Tensor) -> Any:
        """Return the tensors of `pred_fields`; implemented by subclasses.

        Args:
            inputs: The tensors of `net_fields` in order, of shape (samples, *field shape).

        Raises:
            UsageError: If the subclass does not implement it.
        """
        raise UsageError(f"{type(self).__name__} does not implement forward().")

    def __call__(self, *inputs: Any) -> Any:
        """Return the result of ``forward`` for the tensors of `net_fields`."""
        try:
            if self.training and self._training_forward is not None:
                return self._training_forward(*inputs)
            return super().__call__(*inputs)
        except (RuntimeError, TypeError) as error:
            found = self._find_other_types(inputs) if _ABOUT_TYPES.search(str(error)) else None
            if found is None:
                raise
            raise found from error

    def _find_other_types(self, inputs: Iterable[torch.Tensor]) -> FieldTypeError | None:
        """Return the error for inputs that are not real numbers; None if all are."""
        others = {
            name: str(tensor.dtype).removeprefix("torch.")
            for name, tensor in zip(self.net_fields, inputs, strict=False)
            if isinstance(tensor, torch.Tensor) and not tensor.is_floating_point()
        }
        if not others:
            return None
        text = ", ".join(f'"{name}" ({kind})' for name, kind in others.items())
        return FieldTypeError(
            f"{type(self).__name__}.forward() does not accept the types of its inputs: {text}. "
            "Integers, booleans and complex numbers are passed as such, for embeddings, masks and "
            "complex layers. To compute with them as real numbers, convert them in forward(), for "
            "example x.to(torch.float32), or store them as floating-point numbers.",
            field=next(iter(others)),
        )

    def set_training_forward(self, forward: Callable[..., Any] | None) -> None:
        """Replace ``forward`` in training mode; None: do not replace it.

        Used by optimizations that compile it or compute in mixed precision.
        """
        self._training_forward = forward

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
            dict.fromkeys(names, f"expected; returned: {given}"),
        )

    def with_gradients(self, tensors: Tensors) -> Tensors:
        """Return tensors with respect to whose `net_fields` predictions can be differentiated."""
        leaves = {
            name: tensors[name].detach().requires_grad_()
            for name in self.net_fields
            if tensors[name].is_floating_point() or tensors[name].is_complex()
        }
        return {**tensors, **leaves}

    def join_tensors(self, parts: Sequence[torch.Tensor], axis: int = 0) -> torch.Tensor:
        """Return tensors joined along an axis that exists."""
        return torch.cat(list(parts), dim=axis)

    def set_train(self) -> None:
        """Switch to training mode."""
        self.train()

    def set_eval(self) -> None:
        """Switch to evaluation mode, without recording gradients."""
        if self.training:  # visiting all layers takes as long as a small network's prediction
            self.eval()

    def train(self, mode: bool = True) -> Self:
        """Switch to training or evaluation mode, and to the parameters of that mode."""
        if self.average is not None:
            self.average.use(is_used=not mode)
        return super().train(mode)

    def set_device(self, device: str) -> None:
        """Move to ``"cpu"``, ``"cuda"``, ``"cuda:<index>"``, ``"mps"`` or ``"auto"``.

        ``"auto"`` is the first CUDA device if there is one, else the CPU.

        Raises:
            ConfigError: If the device does not exist, or does not support the data type.
        """
        found = find_device(device)
        _check_type(self.data_type, found)
        self.device = found
        self.to(found)

    def set_data_type(self, data_type: str) -> None:
        """Compute in ``"float32"`` or ``"float64"``.

        Raises:
            ConfigError: If the type is a different one, or not supported by the device.
        """
        if data_type not in DATA_TYPES:
            raise ConfigError(f'data_type is "{data_type}" but must be {listed(DATA_TYPES)}.')
        _check_type(DATA_TYPES[data_type], self.device)
        self.data_type = DATA_TYPES[data_type]
        self._apply(lambda tensor: _to_precision(tensor, self.data_type))

    def get_parameters(self) -> dict[str, torch.Tensor]:
        """Return the trainable parameters by name, not copies."""
        return dict(self.named_parameters())

    def get_gradients(self) -> dict[str, torch.Tensor]:
        """Return the gradients of the last step by parameter, not copies."""
        named = self.named_parameters()
        return {name: p.grad for name, p in named if p.grad is not None}

    def set_gradients(self, gradients: Mapping[str, torch.Tensor]) -> None:
        """Set the gradients, as returned by `get_gradients`; other parameters get none.

        Raises:
            ValueError: If a parameter is missing or has another shape.
        """
        own = self.get_parameters()
        for name, gradient in gradients.items():
            if name not in own or own[name].shape != gradient.shape:
                raise ValueError(f"there is no parameter {name} of shape {tuple(gradient.shape)}")
        for name, parameter in own.items():
            found = gradients.get(name)
            parameter.grad = None if found is None else found.to(parameter.device, parameter.dtype)

    def nb_parameters(self) -> int:
        """Return the number of real numbers in the parameters; complex numbers count twice."""
        return sum(p.numel() * (2 if p.is_complex() else 1) for p in self.parameters())

    def find_not_finite(self) -> str:
        """Return the name of a parameter or buffer that is not finite; empty if there is none.

        Buffers may contain infinity, as masks do.
        """
        for name, parameter in self.named_parameters():
            if not torch.isfinite(parameter).all():
                return name
        for name, buffer in self.named_buffers():
            if torch.isnan(buffer).any():
                return name
        return ""

    def save_parameters(self, path: Path) -> None:
        """Write parameters and buffers, those of evaluation mode, to a safetensors file.

        Raises:
            CheckpointError: If the file cannot be written, or the state contains non-tensors.
        """
        if self.average is None:
            write_tensors(path, self._state())
            return
        self.average.use(is_used=True)
        try:
            write_tensors(path, self._state())
        finally:
            self.average.use(is_used=not self.training)

    def load_parameters(self, path: Path) -> None:
        """Read parameters and buffers written by `save_parameters`, in any floating-point type.

        Raises:
            CheckpointError: If the file is missing, damaged or from another architecture; the
                network is then unchanged.
        """
        check_match(path, type(self).__name__, read_shapes(path), self._state())
        if self.average is not None:
            self.average.restart()
        self.load_state_dict(read_tensors(path)[0])

    def _state(self) -> dict[str, Any]:
        """Return parameters, buffers and extra states, without other entries of the state."""
        return {
            name: value
            for name, value in self.state_dict().items()
            if isinstance(value, torch.Tensor) or name.endswith("_extra_state")
        }

    def numpy_to_tensor(self, batch: Batch) -> Tensors:
        """Return arrays as tensors on the network's device.

        Floating-point arrays of any precision are converted to the network's data type, complex
        ones to the complex type of that precision, integers to int64, which indices and class
        labels need; booleans stay booleans. On the CPU, writable arrays of the right type share
        memory.

        Args:
            batch: Arrays by field, each of shape (samples, *field shape).

        Raises:
            FieldTypeError: If an integer does not fit into int64.
        """
        on_cpu, own, tensors = self.device.type == "cpu", self.data_type, {}
        for name, array in batch.items():
            dtype = array.dtype
            if dtype.char in "fd" and dtype.isnative and array.flags.carray:  # nearly always
                tensor = torch.from_numpy(array)
                is_own = on_cpu and tensor.dtype is own  # as of a training's batches
                tensors[name] = tensor if is_own else tensor.to(self.device, own)
            else:
                tensors[name] = self._tensor(name, array)
        return tensors

    def _tensor(self, name: str, array: Array) -> torch.Tensor:
        kind = array.dtype.kind
        if kind in "iu" and array.dtype != np.int64:
            array = _to_int64(name, array)
        elif array.dtype.itemsize > _WIDEST.get(kind, np.inf):  # unknown to torch
            array = array.astype(np.float64 if kind == "f" else np.complex128)
        tensor = torch.from_numpy(_to_compatible(array))
        return _to_precision(tensor, self.data_type).to(self.device)

    def tensor_to_numpy(self, tensors: Tensors) -> Batch:
        """Return tensors as arrays; those on the CPU share memory."""
        arrays = {}
        for name, tensor in tensors.items():
            is_plain = tensor.is_cpu and not (tensor.requires_grad or tensor.is_conj())
            arrays[name] = tensor.numpy(force=not is_plain or tensor.is_neg())  # costs more
        return arrays


def _to_int64(name: str, array: Array) -> Array:
    if array.dtype.kind == "u" and array.dtype.itemsize == 8 and array.size:
        largest = array.max()
        if largest > np.iinfo(np.int64).max:
            raise FieldTypeError(
                f'The field "{name}" contains {largest}, which does not fit into int64, the type '
                "of integers in networks: store it as floating-point numbers.",
                field=name,
            )
    return array.astype(np.int64)


def reject_complex(network: TorchNetwork, fields: Mapping[str, Field]) -> None:
    """Check that a network that computes with real numbers has no complex fields.

    Raises:
        FieldsMismatchError: If it has.
    """
    names = (*network.net_fields, *network.opt_fields)
    found = [name for name in names if np.dtype(fields[name].dtype).kind == "c"]
    if found:
        text = "complex: store its real and imaginary parts as fields"
        raise FieldsMismatchError(
            f"{type(network).__name__} computes with real numbers", dict.fromkeys(found, text)
        )


def _to_compatible(array: Array) -> Array:
    # torch does not accept read-only memory, foreign byte orders, or negative strides.
    flags = array.flags
    regular = flags.writeable and array.dtype.isnative
    if regular and (flags.c_contiguous or min(array.strides) >= 0):
        return array
    return np.array(array, dtype=array.dtype.newbyteorder("="), order="C")


def _names(
    option: str, given: str | Iterable[str] | None, default: str | Iterable[str]
) -> tuple[str, ...]:
    chosen = default if given is None else given
    names = (chosen,) if isinstance(chosen, str) else tuple(chosen)
    if not names or len(set(names)) != len(names) or not all(isinstance(n, str) for n in names):
        raise ConfigError(
            f"{option} is {chosen!r} but must be one field name or several different ones."
        )
    return names


def _to_precision(tensor: torch.Tensor, data_type: torch.dtype) -> torch.Tensor:
    """Convert floating-point and complex tensors to a precision; leave others unchanged."""
    if tensor.is_complex():
        return tensor.to(data_type.to_complex())
    return tensor.to(data_type) if tensor.is_floating_point() else tensor


def _check_type(data_type: torch.dtype, device: torch.device) -> None:
    if device.type == "mps" and data_type == torch.float64:
        raise ConfigError(
            'The device "mps" does not support float64: use float32 or the device "cpu".'
        )
