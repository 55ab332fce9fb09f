"""States as rows of tensors, and gradients by their coordinates and by small motions."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, float64

from physx_core.rotations import (
    cross_rows,
    invert_rows,
    multiply_rows,
    rotate_back_rows,
    rotate_rows,
)
from physx_core.typing import Vector
from physx_sim import Layout
from physx_sim.errors import SimulationError


def as_rows(
    names: Sequence[str], given: Sequence[Tensor], widths: Sequence[int]
) -> tuple[list[Tensor], torch.Size, torch.dtype]:
    """Return tensors as rows, shape (n, width) each, in double precision on the CPU.

    Returns:
        The rows, the leading axes that the tensors have together, and the type that holds all.

    Raises:
        SimulationError: If the last axis of one of them has another length.
    """
    for name, tensor, width in zip(names, given, widths, strict=True):
        if tensor.shape[-1:] != (width,):
            raise SimulationError(
                f"{name} have shape {tuple(tensor.shape)} but need (..., {width})."
            )
    leading = torch.broadcast_shapes(*(tensor.shape[:-1] for tensor in given))
    dtype = functools.reduce(torch.promote_types, (tensor.dtype for tensor in given))
    return [_as_rows(tensor, leading) for tensor in given], leading, dtype


def _as_rows(tensor: Tensor, leading: torch.Size) -> Tensor:
    tensor = tensor.to("cpu", float64)
    if len(leading) == 1 and tensor.shape[:-1] == leading:
        return tensor
    return tensor.expand(*leading, -1).reshape(math.prod(leading), tensor.shape[-1])


def to_position_gradients(layout: Layout, positions: Vector, by_motion: Vector) -> Vector:
    """Return gradients by position coordinates, (n, nq), from those by small motions."""
    found = np.empty(positions.shape)
    for part in layout.parts.values():
        mine, along = found[:, part.positions], by_motion[:, part.velocities]
        if part.floating:
            _write_base(mine, positions[:, part.positions.start + 3 :][:, :4], along)
            mine[:, 7:] = along[:, 6:]
        else:
            mine[:] = along
    return found


def to_motion_gradients(layout: Layout, positions: Vector, by_position: Vector) -> Vector:
    """Return gradients by small motions, (n, nv), from those by position coordinates, (n, nq)."""
    found = np.empty((len(positions), layout.nv))
    for part in layout.parts.values():
        mine, given = found[:, part.velocities], by_position[:, part.positions]
        if part.floating:
            quaternion = positions[:, part.positions.start + 3 :][:, :4]
            mine[:, :3] = rotate_back_rows(quaternion, given[:, :3])
            turned = multiply_rows(invert_rows(quaternion), given[:, 3:7])
            mine[:, 3:6] = 0.5 * turned[:, :3]
            mine[:, 6:] = given[:, 7:]
        else:
            mine[:] = given
    return found


def _write_base(found: Vector, quaternion: Vector, by_motion: Vector) -> None:
    """Write gradients by x, y, z and the quaternion x, y, z, w of a base into `found` (n, 7..).

    In the base's frame, a change dp of the position is R^T dp, and a change du of the quaternion u
    is the rotation 2 Im(u* du) / |u|^2.

    Args:
        found: The first seven columns are written.
        quaternion: Quaternion of the base, x, y, z, w, shape (n, 4).
        by_motion: Gradients by translations along and rotations about the base's axes, (n, 6..).
    """
    length = np.sqrt((quaternion**2).sum(axis=1, keepdims=True))
    unit = quaternion / length
    axis, w, turned = unit[:, :3], unit[:, 3:], by_motion[:, 3:6]
    found[:, :3] = rotate_rows(unit, by_motion[:, :3])
    found[:, 3:6] = 2 / length * (w * turned + cross_rows(axis, turned))
    found[:, 6] = -2 / length[:, 0] * (axis * turned).sum(axis=1)
