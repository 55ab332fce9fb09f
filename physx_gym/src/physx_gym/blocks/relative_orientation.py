"""Orientation of one link relative to another, from the angles of the joints between them.

The rotation is a product of exponentials (R. W. Brockett, 1984): with the axes of the joints in a
reference pose, ``R = exp(a1 * d1) ... exp(an * dn) * R0``, where d are the joints' displacements
from that pose. Quaternions are x, y, z, w, in plain numbers, as there are only a few of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physx_core.rotations import (
    IDENTITY,
    Quaternion,
    Triple,
    from_axis_angle,
    invert,
    multiply,
    rotate,
    rotate_back,
)
from physx_core.typing import Vector
from physx_sim import Simulation
from physx_sim.errors import FeatureNotSupportedError


class RelativeOrientation:
    """Computes one link's orientation from another's.

    Attributes:
        joints: Names of the joints between them.
    """

    def __init__(self, simulation: Simulation, known: str, wanted: str) -> None:
        """Find the joints between two links of a robot.

        Args:
            simulation: Simulation that the links are in.
            known: Link whose orientation will be known.
            wanted: Link whose orientation is wanted.
        """
        self.joints: tuple[str, ...] = ()
        self._up: list[tuple[int, Triple]] = []
        self._down: list[tuple[int, Triple]] = []
        self._before = self._after = IDENTITY
        if known == wanted:
            return
        if "jacobian" not in simulation.features:
            raise FeatureNotSupportedError(simulation.engine, "jacobian", simulation.features)
        reference = _reference(simulation)
        poses = simulation.body_poses([known, wanted], reference)[:, 3:].tolist()
        self._before, self._after = tuple(poses[0]), tuple(poses[1])
        first, second = (_axes(simulation, name, reference) for name in (known, wanted))
        shared = first.keys() & second.keys()
        chains = [{j: a for j, a in axes.items() if j not in shared} for axes in (first, second)]
        self.joints = (*chains[0], *chains[1])
        places = {name: place for place, name in enumerate(self.joints)}
        self._up = [(places[name], axis) for name, axis in chains[0].items()]
        self._down = [(places[name], axis) for name, axis in chains[1].items()]

    def transfer(
        self,
        orientation: Quaternion,
        rate: Sequence[float],
        angles: Sequence[float],
        rates: Sequence[float],
    ) -> tuple[Quaternion, Triple]:
        """Return the orientation and angular velocity of the wanted link.

        Args:
            orientation: Of the known link, in the world.
            rate: Its angular velocity along its own axes, in rad/s.
            angles: Of the joints, in rad.
            rates: Of the joints, in rad/s.

        Returns:
            Quaternion in the world, and rad/s along the link's own axes.
        """
        if not self.joints:
            return orientation, (rate[0], rate[1], rate[2])
        first, back = _follow(self._up, angles, rates)
        second, forth = _follow(self._down, angles, rates)
        first, second = multiply(first, self._before), multiply(second, self._after)
        common = rotate(first, *rate)
        moved = [c - b + f for c, b, f in zip(common, back, forth, strict=True)]
        whole = multiply(orientation, multiply(invert(first), second))
        return whole, rotate_back(second, *moved)


def _follow(
    chain: list[tuple[int, Triple]], angles: Sequence[float], rates: Sequence[float]
) -> tuple[Quaternion, Triple]:
    """Return the rotation along a chain of joints, and the angular velocity at its end."""
    rotation: Quaternion = IDENTITY
    wx = wy = wz = 0.0
    for place, axis in chain:
        x, y, z = rotate(rotation, *axis)
        wx, wy, wz = wx + x * rates[place], wy + y * rates[place], wz + z * rates[place]
        rotation = multiply(rotation, from_axis_angle(axis, angles[place]))
    return rotation, (wx, wy, wz)


def _reference(simulation: Simulation) -> Vector:
    """Return positions with all joints at 0 and all bases aligned with the world's axes."""
    found = np.zeros(simulation.layout.nq)
    for part in simulation.layout.parts.values():
        if part.floating:
            found[part.positions.start + 6] = 1.0
    return found


def _axes(simulation: Simulation, body: str, reference: Vector) -> dict[str, Triple]:
    """Return the axes of the joints that rotate a link, those next to the base first."""
    jacobian = simulation.jacobian(body, reference)[3:]
    found = {}
    for name, place in simulation.layout.velocity_index.items():
        x, y, z = jacobian[:, place].tolist()
        if abs(x) + abs(y) + abs(z) > 0.5:
            found[name] = (x, y, z)
    return found
