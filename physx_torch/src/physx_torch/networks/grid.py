"""Grids: the layout of a regular grid in a field, and its padding for a UNet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch

from physx_core import Field


class Border(NamedTuple):
    """Padding of one axis of a grid, and the part of the output that corresponds to the grid.

    Attributes:
        size: Points of the grid along the axis.
        before: Points added before the grid.
        after: Points added after the grid.
        start: Point of the output that corresponds to the first point of the grid.
    """

    size: int
    before: int
    after: int
    start: int

    @property
    def padded(self) -> int:
        """Number of points of the padded axis."""
        return self.before + self.size + self.after


def make_border(size: int, steps: int, sublayers: int, same: bool) -> Border:
    """Return the smallest padding with which a UNet predicts a value for each point of an axis.

    Each of the `steps` halves the axis, whose size must be even, on the way down, and doubles it on
    the way up. If convolutions do not pad (`same` is False), the `sublayers` convolutions of each
    level remove one point at each end.

    Args:
        size: Points of the grid along the axis.
        steps: Number of times that the axis is halved.
        sublayers: Convolutions per level.
        same: Whether convolutions keep the size.
    """
    factor = 2**steps
    if same:
        missing = -size % factor
        return Border(size, missing // 2, missing - missing // 2, missing // 2)
    lost = 2 * sublayers
    deepest = -(-(size + lost * (factor - 1)) // factor)  # points at the exit of the lowest level
    output = factor * deepest - lost * (factor - 1)
    margin = ((factor * (deepest + lost) + lost * (factor - 1)) - output) // 2
    surplus = output - size
    start = surplus // 2
    return Border(size, margin + start, margin + surplus - start, start)


class GridLayout(NamedTuple):
    """Layout of a grid's values in a field.

    Attributes:
        shape: Shape of the field.
        channels: Values at each point.
    """

    shape: tuple[int, ...]
    channels: int


def grid_size(shape: Sequence[int], nb_dims: int) -> tuple[int, ...] | None:
    """Return the grid of a shape, with or without a channel axis; None if it does not match."""
    return tuple(shape[:nb_dims]) if len(shape) in (nb_dims, nb_dims + 1) else None


def find_layout(field: Field, size: tuple[int, ...]) -> GridLayout | None:
    """Return the layout of a grid in a field; None if the field does not contain one.

    A field has the axes of the grid, or one axis with all points in row-major order, optionally
    followed by a channel axis.
    """
    shape = tuple(field.shape or ())
    for points in (size, (math.prod(size),)):
        if shape[: len(points)] == points and len(shape) - len(points) in (0, 1):
            return GridLayout(shape, shape[-1] if len(shape) > len(points) else 1)
    return None


def to_grid(tensor: torch.Tensor, size: Sequence[int], channels: int) -> torch.Tensor:
    """Return a field's tensor with shape (samples, *size, channels)."""
    return tensor.reshape(-1, *size, channels)


def pad(tensor: torch.Tensor, borders: Sequence[Border]) -> torch.Tensor:
    """Return a grid (samples, *size, channels), padded with zeros."""
    widths = [0, 0]
    for axis in reversed(borders):
        widths += [axis.before, axis.after]
    return torch.nn.functional.pad(tensor, widths) if any(widths) else tensor


def crop(tensor: torch.Tensor, borders: Sequence[Border]) -> torch.Tensor:
    """Return the part of an output (samples, *axes, channels) that corresponds to the grid."""
    for number, axis in enumerate(borders, 1):
        tensor = tensor.narrow(number, axis.start, axis.size)
    return tensor


def find_mismatches(fields: Mapping[str, Field], size: tuple[int, ...]) -> dict[str, str]:
    """Return an error for each field that does not contain a grid of this size."""
    return {
        name: f"shape {field.shape} is not a grid of {' x '.join(map(str, size))} points"
        for name, field in fields.items()
        if find_layout(field, size) is None
    }
