"""FC: fully connected network."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch

from physx_core import Field
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_torch.choices import make_activation
from physx_torch.networks.network import TorchNetwork, reject_complex


class FC(TorchNetwork):
    """Fully connected network.

    The values of all `net_fields` of a sample are concatenated in order and passed through the
    layers, with an activation after each layer but the last. The outputs are split into the
    prediction fields in order, with the shapes of `opt_fields`.

    Attributes:
        layers: The linear layers and activations.
        sizes: Numbers of inputs, of neurons of each hidden layer, and of outputs.
    """

    def __init__(
        self,
        layers: Sequence[int],
        *,
        activation: str | type[torch.nn.Module] = "PReLU",
        biases: bool | Sequence[bool] = True,
        output_shape: int | Sequence[int] | None = None,
        **fields: Any,
    ) -> None:
        """Create the layers.

        Args:
            layers: Numbers of inputs, of neurons of each hidden layer, and of outputs, for example
                ``[27, 256, 256, 9]``.
            activation: Class of an activation, or its name in `torch.nn`. ``"PReLU"`` learns a
                slope for each neuron.
            biases: Whether layers have a bias: one value for all, or one for each of the
                ``len(layers) - 1`` layers.
            output_shape: Shape of one sample's prediction; None: the shape of the field in
                `opt_fields`.
            fields: ``net_fields``, ``opt_fields`` and ``pred_fields`` as in `TorchNetwork`.

        Raises:
            ConfigError: If a list has the wrong length or content, or there is no such activation.
        """
        super().__init__(**fields)
        self.sizes = check_layer_sizes(f"{type(self).__name__}.layers", layers)
        flags = _flags(type(self).__name__, biases, len(self.sizes) - 1)
        self.layers = _stack(self.sizes, activation, flags)
        self._shape = self._fixed_shape(output_shape)
        self._set_shapes([self._shape or (self.sizes[-1],)])

    def _fixed_shape(self, given: int | Sequence[int] | None) -> tuple[int, ...] | None:
        if given is None:
            return None
        own = type(self).__name__
        shape = (given,) if isinstance(given, int) else tuple(given)
        if len(self.pred_fields) > 1:
            raise ConfigError(f"{own}.output_shape is only for one prediction field: omit it.")
        if math.prod(shape) != self.sizes[-1]:
            raise ConfigError(
                f"{own}.output_shape {shape} has {math.prod(shape)} values, but the last of layers "
                f"{list(self.sizes)} has {self.sizes[-1]}."
            )
        return shape

    def bind(self, fields: Mapping[str, Field]) -> None:
        """Set the shapes of the fields before the first batch.

        Raises:
            FieldsMismatchError: If a field is missing or has a free axis, its shape is unknown, or
                the number of values in the fields differs from the size of the first or last layer.
        """
        super().bind(fields)
        self.reject_free_axes(fields)
        reject_complex(self, fields)
        self._check("first", self.sizes[0], {name: fields[name] for name in self.net_fields})
        targets = {name: fields[name] for name in self.opt_fields}
        self._check("last", self.sizes[-1], targets)
        shapes = [tuple(field.shape or ()) for field in targets.values()]
        if self._shape is not None and shapes != [self._shape]:
            name = self.opt_fields[0]
            text = f"shape {shapes[0]}, but output_shape is {self._shape}"
            raise FieldsMismatchError(
                f"{type(self).__name__} does not fit the fields", {name: text}
            )
        self._set_shapes(shapes)

    def _set_shapes(self, shapes: list[tuple[int, ...]]) -> None:
        self._shapes = shapes
        self._is_flat = len(shapes) == 1 and len(shapes[0]) == 1

    def _check(self, which: str, size: int, fields: Mapping[str, Field]) -> None:
        unknown = {
            name: "its shape is not known before the first sample"
            for name, field in fields.items()
            if field.shape is None
        }
        if unknown:
            raise FieldsMismatchError(f"{type(self).__name__} does not fit the fields", unknown)
        counts = {name: math.prod(field.shape or ()) for name, field in fields.items()}
        if sum(counts.values()) != size:
            differences = {
                name: f"shape {fields[name].shape}, {count} values"
                for name, count in counts.items()
            }
            raise FieldsMismatchError(
                f"The {which} of {type(self).__name__}'s layers {list(self.sizes)} must be "
                f"{sum(counts.values())}, the number of values of",
                differences,
            )

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Return the predictions for the tensors of `net_fields`.

        Args:
            inputs: One tensor for each field, of shape (samples, *field shape).
        """
        first = inputs[0]  # a small network takes as long as a few calls of functions
        is_flat = len(inputs) == 1 and first.dim() == 2 and first.is_floating_point()
        output = self.layers(first if is_flat else self.concatenate(inputs))
        return output if self._is_flat else self.split_outputs(output)

    def concatenate(self, inputs: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the concatenated values of all fields of each sample, shape (samples, number).

        Args:
            inputs: One tensor for each field, of shape (samples, *field shape).
        """
        if len(inputs) == 1:
            return self._flatten(inputs[0])
        return torch.cat([self._flatten(tensor) for tensor in inputs], dim=1)

    def split_outputs(self, output: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Split outputs of shape (samples, number) into prediction fields with their shapes."""
        if len(self._shapes) == 1:
            return _reshape(output, self._shapes[0])
        parts = output.split([math.prod(shape) for shape in self._shapes], dim=1)
        return [_reshape(part, shape) for part, shape in zip(parts, self._shapes, strict=True)]

    def _flatten(self, tensor: torch.Tensor) -> torch.Tensor:
        if not tensor.is_floating_point():
            tensor = tensor.to(self.data_type)
        if tensor.dim() == 2:
            return tensor
        return tensor.unsqueeze(1) if tensor.dim() == 1 else tensor.flatten(1)


def _reshape(output: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    if len(shape) == 1:
        return output
    return output.unflatten(1, shape) if shape else output.squeeze(1)


def check_layer_sizes(
    option: str, given: Sequence[int], example: str = "[27, 256, 256, 9]"
) -> tuple[int, ...]:
    """Return numbers of neurons after validating them.

    Args:
        option: Name of the option, for error messages.
        given: At least two positive integers.
        example: Example for error messages.
    """
    sizes = () if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    right = all(type(size) is int and size > 0 for size in sizes)
    if len(sizes) < 2 or not right:
        raise ConfigError(
            f"{option} is {given!r} but must list the numbers of inputs, hidden neurons and "
            f"outputs, at least two positive integers, for example {example}."
        )
    return sizes


def _flags(own: str, given: bool | Sequence[bool], number: int) -> list[bool]:
    if isinstance(given, bool):
        return [given] * number
    flags = list(given) if isinstance(given, (list, tuple)) else []
    if len(flags) != number or not all(isinstance(flag, bool) for flag in flags):
        raise ConfigError(
            f"{own}.biases is {given!r} but must be True, False or {number} of them, one for each "
            "layer after the inputs."
        )
    return flags


def _stack(sizes: Sequence[int], activation: Any, biases: Sequence[bool]) -> torch.nn.Sequential:
    modules: list[torch.nn.Module] = []
    for (inputs, outputs), bias in zip(pairwise(sizes), biases, strict=True):
        if modules:
            modules.append(make_activation("FC.activation", activation, inputs))
        modules.append(torch.nn.Linear(inputs, outputs, bias=bias))
    return torch.nn.Sequential(*modules)
