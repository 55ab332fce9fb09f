"""Rows that always hold: attachments, couplings of joints, and wheels that roll without slip."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio

from physx_core.rotations import cross_rows
from physx_core.typing import Index, Vector
from physx_dart.pinocchio.contacts import supports_of
from physx_dart.pinocchio.robot import PinocchioRobot
from physx_dart.pinocchio.wheels import Wheels
from physx_sim import Ground, World
from physx_sim.engines import Bond

_RETURN = 0.2
"""Fraction of a gap that is closed in each step."""
_FASTEST_RETURN = 1.0
"""Maximum speed at which it is closed, in m/s or rad/s."""
_STUCK = 1e-9
"""Motion of a point per motion of a joint below which it cannot move."""
FASTEST_JOINT = 10.0
"""Maximum speed at which joints return to where their couplings hold, as to their limits."""


class Ties:
    """What holds bodies and joints together at all times, whatever impulse that takes."""

    def __init__(self, robots: Sequence[PinocchioRobot], world: World) -> None:
        self._robots, self._period = robots, world.period
        self._links = [(place, link) for place, each in enumerate(robots) for link in each.frames]
        self._supports = [supports_of(each.model_in_motion) for each in robots]
        self._bonds: dict[int, Bond] = {}
        self._couplings = {
            place: each.model.coupling_rows
            for place, each in enumerate(robots)
            if each.model.followers or each.model.couplings
        }
        self._wheels = {
            place: Wheels(each, world.ground)
            for place, each in enumerate(robots)
            if each.model.wheels and isinstance(world.ground, Ground)
        }
        self.robots = frozenset([*self._couplings, *self._wheels])

    def __bool__(self) -> bool:
        """Return whether anything is held."""
        return bool(self.robots)

    def bind(self, number: int, bond: Bond) -> None:
        """Hold two bodies together until `unbind`."""
        self._bonds[number] = bond
        self._note()

    def unbind(self, number: int) -> None:
        """Stop holding two bodies together."""
        del self._bonds[number]
        self._note()

    def _note(self) -> None:
        """Note which robots are held."""
        bodies = [body for bond in self._bonds.values() for body in bond.bodies if body >= 0]
        bound = (self._links[body][0] for body in bodies)
        self.robots = frozenset([*self._couplings, *self._wheels, *bound])

    def move_ground(self, surface: Vector) -> None:
        """Let the surface of the ground move along itself, in m/s, shape (3,)."""
        for wheels in self._wheels.values():
            wheels.surface = surface.copy()

    def rows(self, coupled: Sequence[int]) -> tuple[Vector, Vector]:
        """Return the Jacobian of all rows, shape (m, nv), and the velocities along them (m,).

        Args:
            coupled: Robots whose velocities, one after the other, are the columns.
        """
        robots = [self._robots[place] for place in coupled]
        ends = np.cumsum([0, *(robot.nv for robot in robots)])
        motions = [robot.place_joints() for robot in robots]
        blocks, aims = [np.zeros((0, ends[-1]))], [np.zeros(0)]
        for at, place in enumerate(coupled):
            for own, speeds in self._of_robot(place, motions[at]):
                rows = np.zeros((len(own), ends[-1]))
                rows[:, ends[at + 1] - own.shape[1] : ends[at + 1]] = own
                blocks.append(rows)
                aims.append(speeds)
        for bond in self._bonds.values():
            rows, speeds = self._of_bond(bond, coupled, ends, motions)
            blocks.append(rows)
            aims.append(speeds)
        return np.concatenate(blocks), np.concatenate(aims)

    def _of_robot(self, place: int, motions: Vector) -> Iterator[tuple[Vector, Vector]]:
        """Yield rows of couplings, whose columns are joints, and of wheels, with velocities."""
        robot = self._robots[place]
        if place in self._couplings:
            joint_rows, sums = self._couplings[place]
            speeds = (sums - joint_rows.dot(robot.joint_positions())) / self._period
            yield joint_rows, np.clip(speeds, -FASTEST_JOINT, FASTEST_JOINT)
        if place in self._wheels:
            yield _moving(*self._wheels[place].rows(motions, self._supports[place]))

    def _of_bond(
        self, bond: Bond, coupled: Sequence[int], ends: Index, motions: Sequence[Vector]
    ) -> tuple[Vector, Vector]:
        """Return the rows of a bond, shape (m, nv), and the velocities along them, (m,)."""
        poses, jacobians = [], []
        for body, frame in zip(bond.bodies, bond.frames, strict=True):
            pose, wide = frame, np.zeros((6, ends[-1]))
            if body >= 0:
                place, link = self._links[body]
                at = coupled.index(place)
                pose, jacobian = self._moved(place, link, frame, motions[at])
                wide[:, ends[at] : ends[at + 1]] = jacobian
            poses.append(pose)
            jacobians.append(wide)
        (first, second), turn = poses, poses[0][:3, :3].T
        parts = 6 if bond.rigid else 3
        relative = jacobians[1] - jacobians[0]
        relative = np.concatenate([turn @ relative[:3], turn @ relative[3:]])
        gap = np.concatenate(
            [
                turn @ (second[:3, 3] - first[:3, 3]),
                pinocchio.log3(turn @ second[:3, :3]) if bond.rigid else (),
            ]
        )
        speeds = -_RETURN / self._period * gap
        return _moving(relative[:parts], np.clip(speeds, -_FASTEST_RETURN, _FASTEST_RETURN))

    def _moved(
        self, place: int, frame: int, inner: Vector, motions: Vector
    ) -> tuple[Vector, Vector]:
        """Return the pose of a frame on a link, and its Jacobian in the world frame, (6, nv)."""
        robot = self._robots[place]
        link = robot.model_in_motion.frames[frame]
        joint = robot.data.oMi[link.parentJoint]
        pose: Vector = (joint * link.placement).homogeneous @ inner
        jacobian = motions * self._supports[place][link.parentJoint]
        jacobian[:3] += cross_rows(jacobian[3:].T, pose[:3, 3][None]).T
        return pose, jacobian


def _moving(rows: Vector, speeds: Vector) -> tuple[Vector, Vector]:
    """Return the rows along which something can move: joints hold the others anyway."""
    moves = (np.abs(rows) > _STUCK).any(axis=1)
    return rows[moves], speeds[moves]
