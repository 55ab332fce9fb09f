"""UNet: convolutions on a regular grid, from fine to coarse and back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch

from physx_core import Field
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_torch.choices import make_activation
from physx_torch.networks.grid import (
    Border,
    GridLayout,
    find_layout,
    find_mismatches,
    grid_size,
    make_border,
)
from physx_torch.networks.network import TorchNetwork, reject_complex

Modules = list[torch.nn.Module]

GROUPS = 8
"""Largest number of channel groups in group normalization."""
_MOST_STEPS = 16
NORMALIZATIONS = ("none", "batch", "group")


class UNet(TorchNetwork):
    """U-shaped convolutional network (Ronneberger et al., 2015) in two or three dimensions.

    On the way down, each step convolves, stores the result, and halves the grid, with twice as many
    channels below; on the way up, each step doubles the grid, concatenates the stored result, and
    convolves. Convolutions have kernels of 3 points per axis, and are followed by a normalization
    and an activation.

    Normalization ``"none"``: initial weights preserve the variance of activations (He et al.,
    2015). ``"batch"``: by the mean and deviation of the batch, or of all batches for predictions:
    it trains fast at first, but varying batch statistics limit the accuracy, especially with small
    batches. ``"group"``: by those of each sample, in up to 8 groups of channels.

    A sample's field has the shape ``(*grid, channels)``, ``grid`` if there is one channel, or
    ``(points, channels)`` with the grid points in row-major order. Several `net_fields` are
    concatenated as channels; the output's channels are split into `pred_fields`.
    `UNetTransformation` pads the grid to the smallest size that the network accepts and crops the
    prediction; ``forward`` itself reads and returns padded grids.

    Attributes:
        size: Points of the grid along each axis; empty before `bind`.
        borders: Padding of each axis; empty before `bind`.
        layouts: Layout of the grid in each field, by name; empty before `bind`.
        data_scale: Factor of the targets.
    """

    default_transformation: ClassVar[str] = "torch/unet"

    def __init__(
        self,
        nb_dims: int,
        *,
        nb_input_channels: int = 1,
        nb_output_channels: int = 3,
        nb_first_layer_channels: int = 64,
        nb_steps: int = 3,
        two_sublayers: bool = True,
        border_mode: str = "valid",
        skip_merge: bool = False,
        data_scale: float = 1.0,
        normalization: str = "none",
        activation: str | type[torch.nn.Module] = "ReLU",
        positions: bool = False,
        input_size: Sequence[int] | None = None,
        **fields: Any,
    ) -> None:
        """Create the layers.

        Args:
            nb_dims: Number of grid axes, 2 or 3.
            nb_input_channels: Input values per point, over all fields.
            nb_output_channels: Predicted values per point, over all fields.
            nb_first_layer_channels: Channels of the finest level; they double with each level.
            nb_steps: Number of times that the grid is halved.
            two_sublayers: Whether to use two convolutions per level instead of one.
            border_mode: ``"valid"``: convolutions remove the outermost points, so no value depends
                on points beyond the padded grid; ``"same"``: they keep the size, which needs less
                padding.
            skip_merge: Whether to omit the skip connections, which makes it a convolutional encoder
                and decoder.
            data_scale: Factor of the targets in the loss, by which predictions are divided.
            normalization: ``"none"``, ``"batch"`` or ``"group"``, as described above.
            activation: Class, or name in `torch.nn` such as ``"SiLU"``.
            positions: Whether the network also reads the position of each point, as one more
                channel per axis from -1 to 1: for bodies that are fixed somewhere.
            input_size: Points of the grid along each axis; None: inferred from the fields' shapes.
            fields: ``net_fields``, ``opt_fields`` and ``pred_fields`` as in `TorchNetwork`.

        Raises:
            ConfigError: If an option is invalid.
        """
        super().__init__(**fields)
        channels = (nb_input_channels, nb_output_channels)
        _check_numbers(*channels, nb_first_layer_channels, nb_steps)
        _check_options(nb_dims, normalization, border_mode, data_scale)
        _check("input_size", input_size, _is_size(input_size, nb_dims), f"{nb_dims} integers")
        self.data_scale = float(data_scale)
        self.size: tuple[int, ...] = ()
        self.borders: list[Border] = []
        self.layouts: dict[str, GridLayout] = {}
        self._channels = channels
        self._given_size = None if input_size is None else tuple(input_size)
        self._dims, self._steps, self._same = nb_dims, nb_steps, border_mode == "same"
        self._sublayers = 2 if two_sublayers else 1
        self._merges, self._positions = not skip_merge, positions
        self._normalization, self._activation = normalization, activation
        self._make_layers(nb_first_layer_channels)

    def _make_layers(self, first: int) -> None:
        dims, (inputs, outputs) = self._dims, self._channels
        upwards = torch.nn.ConvTranspose2d if dims == 2 else torch.nn.ConvTranspose3d
        last = torch.nn.Conv2d if dims == 2 else torch.nn.Conv3d
        widths = [first * 2**level for level in range(self._steps + 1)]
        befores = [inputs + (dims if self._positions else 0), *widths]
        self.down = torch.nn.ModuleList(
            self._level(before, width) for before, width in zip(befores, widths, strict=False)
        )
        self.pool = torch.nn.MaxPool2d(2) if dims == 2 else torch.nn.MaxPool3d(2)
        below = list(reversed(widths))
        self.up = torch.nn.ModuleList(
            upwards(width, width // 2, kernel_size=2, stride=2) for width in below[:-1]
        )
        merged = 2 if self._merges else 1
        self.join = torch.nn.ModuleList(self._level(merged * w, w) for w in below[1:])
        self.last = last(first, outputs, kernel_size=1)
        if self._normalization == "none":
            self._initialize_weights()

    def _initialize_weights(self) -> None:
        """Draw weights that preserve the variance of activations through all layers."""
        for name, parameter in self.named_parameters():
            if name.endswith("bias"):
                torch.nn.init.zeros_(parameter)
            elif name.startswith("up."):  # each value below contributes one of each kernel's points
                torch.nn.init.normal_(parameter, std=parameter.shape[0] ** -0.5)
            elif parameter.dim() > 1:  # otherwise, it belongs to an activation
                followed_by: Literal["linear", "relu"] = "linear" if name[:4] == "last" else "relu"
                torch.nn.init.kaiming_normal_(parameter, nonlinearity=followed_by)

    def _level(self, before: int, channels: int) -> torch.nn.Sequential:
        """Return the convolutions of one level."""
        flat = self._dims == 2
        convolution = torch.nn.Conv2d if flat else torch.nn.Conv3d
        modules: Modules = []
        for number in range(self._sublayers):
            inputs = before if number == 0 else channels
            modules += [
                convolution(inputs, channels, kernel_size=3, padding=int(self._same)),
                *self._normalized(channels),
                make_activation("UNet.activation", self._activation, channels),
            ]
        return torch.nn.Sequential(*modules)

    def _normalized(self, channels: int) -> Modules:
        """Return the normalization layers of a level."""
        if self._normalization == "none":
            return []
        if self._normalization == "group":
            return [torch.nn.GroupNorm(math.gcd(channels, GROUPS), channels)]
        batch = torch.nn.BatchNorm2d if self._dims == 2 else torch.nn.BatchNorm3d
        return [batch(channels)]

    def bind(self, fields: Mapping[str, Field]) -> None:
        """Set the grid from the fields before the first batch.

        Raises:
            FieldsMismatchError: If a field is missing, has a free axis or another grid, or the
                number of channels of the fields differs from the network's.
        """
        super().bind(fields)
        self.reject_free_axes(fields)
        reject_complex(self, fields)
        mine = {name: fields[name] for name in (*self.net_fields, *self.opt_fields)}
        self.size = self._given_size or self._size_of(mine[self.net_fields[0]])
        wrong = find_mismatches(mine, self.size)
        if wrong:
            raise FieldsMismatchError("UNet needs values on one grid", wrong)
        found = {name: find_layout(field, self.size) for name, field in mine.items()}
        self.layouts = {name: item for name, item in found.items() if item is not None}
        self._check_channels("nb_input_channels", self._channels[0], self.net_fields)
        self._check_channels("nb_output_channels", self._channels[1], self.opt_fields)
        self.borders = [
            make_border(points, self._steps, self._sublayers, self._same) for points in self.size
        ]

    def _size_of(self, field: Field) -> tuple[int, ...]:
        size = grid_size(field.shape or (), self._dims)
        if size is None:
            text = f"shape {field.shape} is not a grid of {self._dims} axes: set input_size"
            raise FieldsMismatchError("UNet needs values on a grid", {field.name: text})
        return size

    def _check_channels(self, option: str, expected: int, names: Sequence[str]) -> None:
        counts = {name: self.layouts[name].channels for name in names}
        if sum(counts.values()) != expected:
            raise FieldsMismatchError(
                f"UNet.{option} is {expected} but must be {sum(counts.values())}, the number of "
                "values at each point of",
                {name: f"{count} at each point" for name, count in counts.items()},
            )

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Return the predictions for padded grids.

        Args:
            inputs: One tensor for each of `net_fields`, of shape (samples, *grid, channels).
        """
        x = inputs[0] if len(inputs) == 1 else torch.cat(inputs, dim=-1)
        x = x.to(self.last.weight.dtype).movedim(-1, 1)
        if self._positions:
            x = torch.cat([x, _grid_positions(x)], dim=1)
        kept: list[torch.Tensor] = []
        for level in self.down[:-1]:
            x = level(x)
            kept.append(x)
            x = self.pool(x)
        x = self.down[-1](x)
        for up, join in zip(self.up, self.join, strict=True):
            x, left = up(x), kept.pop()
            x = join(torch.cat([_crop_center(left, x), x], dim=1) if self._merges else x)
        output = self.last(x).movedim(1, -1)
        if len(self.opt_fields) == 1:
            return output
        return list(output.split([self.layouts[name].channels for name in self.opt_fields], -1))


def _crop_center(tensor: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Crop a tensor (samples, channels, *axes) at its center to the size of another."""
    for axis in range(2, tensor.dim()):
        surplus = tensor.shape[axis] - like.shape[axis]
        if surplus:
            tensor = tensor.narrow(axis, surplus // 2, like.shape[axis])
    return tensor


def _grid_positions(like: torch.Tensor) -> torch.Tensor:
    """Return the position of each point, from -1 to 1 along each axis, (samples, axes, *axes)."""
    axes = [
        torch.linspace(-1, 1, points, dtype=like.dtype, device=like.device)
        for points in like.shape[2:]
    ]
    positions = torch.stack(torch.meshgrid(*axes, indexing="ij"))
    return positions.expand(like.shape[0], *positions.shape)


def _positive(value: Any) -> bool:
    return type(value) is int and value > 0


def _is_size(given: Any, nb_dims: int) -> bool:
    if given is None:
        return True
    return isinstance(given, (list, tuple)) and len(given) == nb_dims and all(map(_positive, given))


def _check_numbers(inputs: Any, outputs: Any, first_layer: Any, steps: Any) -> None:
    channels = {"input": inputs, "output": outputs, "first_layer": first_layer}
    numbers = {f"nb_{name}_channels": value for name, value in channels.items()}
    for name, value in {**numbers, "nb_steps": steps}.items():
        _check(name, value, _positive(value), "a positive integer")
    _check("nb_steps", steps, steps <= _MOST_STEPS, f"at most {_MOST_STEPS}")


def _check_options(nb_dims: Any, normalization: Any, border_mode: Any, data_scale: Any) -> None:
    _check("nb_dims", nb_dims, nb_dims in (2, 3), "2 or 3")
    known = normalization in NORMALIZATIONS
    _check("normalization", normalization, known, '"none", "batch" or "group"')
    _check("border_mode", border_mode, border_mode in ("valid", "same"), '"valid" or "same"')
    _check("data_scale", data_scale, data_scale > 0, "positive")


def _check(option: str, value: Any, right: bool, wanted: str) -> None:
    if not right:
        raise ConfigError(f"UNet.{option} is {value!r} but must be {wanted}.")
