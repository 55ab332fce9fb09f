"""Derivatives of a step, through its contacts and other constraints.

A step without constraints is differentiated by Pinocchio. The impulses of constraints solve a
problem that is piecewise smooth, and are differentiated implicitly: at the solution, not along the
iterations that found it. Where bodies move by dq, the same impulses act through another Jacobian
and another mass matrix, and the constraints ask for other velocities; the impulses change by what
is then missing. Where contacts share a load that they could share otherwise, this change is one of
many, but that of the velocities is not.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio

from physx_core.rotations import cross_rows, to_matrix
from physx_core.typing import Vector
from physx_dart.pinocchio.constraints import Solved
from physx_dart.pinocchio.contact_problem import ContactProblem, unit
from physx_dart.pinocchio.contacts import ContactPoints, joined
from physx_dart.pinocchio.robot import PinocchioRobot
from physx_dart.pinocchio.ties import FASTEST_JOINT
from physx_sim import StepDerivatives
from physx_sim.errors import SimulationError

_UNSOLVED = 1e3
"""Error of impulses, as a multiple of an exact solution's, above which they are not differentiated:
implicit derivatives are those at a solution."""


class GroupDerivatives:
    """Derivatives of the last step of robots whose constraints were solved together.

    Velocities are those of the stepping models, one robot after the other.
    """

    def __init__(self, robots: Sequence[PinocchioRobot], period: float) -> None:
        """Differentiate the velocities after the step.

        Args:
            robots: The robots.
            period: Length of the step, in s.

        Raises:
            SimulationError: If the step has no derivatives.
        """
        ends = itertools.accumulate((robot.nv for robot in robots), initial=0)
        spans = [slice(*pair) for pair in itertools.pairwise(ends)]
        self._robots, self._period = list(zip(robots, spans, strict=True)), period
        nv = self._nv = spans[-1].stop
        self._after = np.concatenate([robot.allowed for robot in robots])
        # Columns: positions, velocities, torques, and the target velocities of motors.
        self._change = np.zeros((nv, 4, nv))
        for robot, span in self._robots:
            for number, block in enumerate(robot.free_derivatives()):
                self._change[span, number, span] = block
        found = [robot.last_step()[2] for robot in robots]
        self._parts = [part for part in found if part is not None]
        solved = self._parts[0].solved if self._parts else None
        if solved is not None and len(solved.impulses):
            self._constrain(self._with_resting(solved))
        for robot, span in self._robots:
            if robot.gyrates:
                by_q, by_v, by_allowed = robot.gyroscopic_derivatives()
                self._change[span] += np.tensordot(by_allowed, self._change[span], 1)
                self._change[span, 0, span] += by_q
                self._change[span, 1, span] += by_v

    def _with_resting(self, solved: Solved) -> Solved:
        """Return the problem with the friction of joints at rest, which did not need to act."""
        first, more = 0, []
        for part, (_, span) in zip(self._parts, self._robots, strict=True):
            more.append(first + part.joints.resting(self._after[span][part.joints.base :]))
            first += len(part.joints.columns)
        rows = np.setdiff1d(joined(more), solved.rows)
        if not len(rows):
            return solved
        columns = self._columns()[rows]
        last = len(solved.impulses) - _turning_rows(solved)
        nothing = np.zeros(len(rows))
        along, free, impulses = (
            np.concatenate([before[:last], more, before[last:]])
            for before, more in (
                (solved.along, unit(self._nv).take(columns, 0)),
                (solved.free, nothing),
                (solved.impulses, nothing),
            )
        )
        spread = solved.inverse.dot(along.T)
        least, most = (
            joined([getattr(part.joints, name) for part in self._parts])[rows]
            for name in ("least", "most")
        )
        return replace(
            solved,
            along=along,
            spread=spread,
            response=along.dot(spread),
            free=free,
            least=np.concatenate([solved.least, least]),
            most=np.concatenate([solved.most, most]),
            impulses=impulses,
        )

    def _columns(self) -> Vector:
        """Return the velocity of each row of all joints."""
        parts = zip(self._parts, self._robots, strict=True)
        return joined([part.joints.columns + span.start for part, (_, span) in parts])

    def _constrain(self, solved: Solved) -> None:
        """Add what the impulses change."""
        problem = ContactProblem(
            *(solved.response, solved.free, solved.friction, solved.least, solved.most),
            solved.turning,
        )
        if not problem.error(solved.impulses) < _UNSOLVED * problem.accuracy:
            raise SimulationError(
                "A step has no derivatives where its impulses were not solved to accuracy."
            )
        nv, slopes = self._nv, np.zeros((len(solved.impulses), self._nv))
        caused, pushed, first = solved.spread.dot(solved.impulses), np.zeros((nv, nv)), 0
        spin = len(solved.impulses) - _turning_rows(solved)
        for part, (robot, span) in zip(self._parts, self._robots, strict=True):
            pushed[span, span] = -_momentum_slopes(robot, caused[span])
            if (points := part.touching) is not None:
                end = first + 3 * len(points.gaps)
                spun = spin + (0 if points.spins is None else 3 * len(points.spins.points))
                impulses = solved.impulses[first:end], solved.impulses[spin:spun]
                after = self._after[span]
                found = _point_slopes(robot, points, impulses, after, self._period)
                slopes[first:end, span], slopes[spin:spun, span], forces = found
                pushed[span, span] += forces
                first, spin = end, spun
        change = self._change.reshape(nv, -1)
        change[:, :nv] += solved.inverse.dot(pushed)
        missing = solved.along.dot(change)
        missing[:, :nv] += slopes
        of_joints = slice(first, first + len(solved.rows))
        places, columns = np.arange(of_joints.start, of_joints.stop), self._columns()
        at = columns[solved.rows]
        motors = joined([part.joints.motors() for part in self._parts])[solved.rows]
        limits = [
            part.joints.slopes(robot.last_step()[0][robot.nq - robot.nv + robot.base :])
            for part, (robot, _) in zip(self._parts, self._robots, strict=True)
        ]
        missing[places, at] -= joined(limits)[solved.rows]
        missing[places, 3 * nv + at] -= motors
        for tie, speed in enumerate(solved.pace.tolist(), of_joints.stop):
            if abs(speed) < FASTEST_JOINT:
                missing[tie, :nv] += solved.along[tie] / self._period
        change += solved.spread.dot(problem.slope(solved.impulses).dot(missing))

    def in_layout(self) -> StepDerivatives:
        """Return the derivatives of the step in the convention of `physx_sim.layout`."""
        nv, change, period = self._nv, self._change, self._period
        commands = []
        state, before, after = (np.eye(2 * nv) for _ in range(3))
        state[nv:, :nv], state[nv:, nv:] = change[:, 0], change[:, 1]
        driven = np.zeros((2 * nv, nv))
        for robot, span in self._robots:
            commands.append(np.arange(span.start + robot.base, span.stop))
            driven[nv:, span] = change[:, 2, span] * robot.forces() + change[:, 3, span]
            q, v, _ = robot.last_step()
            moved, by_motion = unit(robot.nv), unit(robot.nv)
            if robot.base:
                motion = period * robot.native()[1]
                moved, by_motion = pinocchio.dIntegrate(robot.model_in_motion, q, motion)
                _to_world(before, span.start, nv, q, v)
                _to_base(after, span.start, nv, *robot.native())
            moves = slice(span.start, span.stop)
            state[moves, moves] = moved
            state[moves] += period * by_motion @ state[nv + span.start : nv + span.stop]
            driven[moves] = period * by_motion @ driven[nv + span.start : nv + span.stop]
        driven = driven[:, np.concatenate(commands)]
        return StepDerivatives(after @ state @ before, after @ driven)


def _turning_rows(solved: Solved) -> int:
    """Return the number of rows of points that resist turning."""
    return 0 if solved.turning is None else 3 * len(solved.turning[0])


def _to_world(found: Vector, at: int, nv: int, q: Vector, v: Vector) -> None:
    """Write how changes along a base's axes change its native positions and velocities."""
    turn = to_matrix(q[3:7])
    place, speed = slice(at, at + 3), slice(nv + at, nv + at + 3)
    found[place, place] = found[speed, speed] = turn
    found[speed, at + 3 : at + 6] = -turn @ _across(turn.T @ v[:3])


def _to_base(found: Vector, at: int, nv: int, q: Vector, v: Vector) -> None:
    """Write how changes of a base's native state change its positions and twist."""
    turn = to_matrix(q[3:7]).T
    place, speed = slice(at, at + 3), slice(nv + at, nv + at + 3)
    found[place, place] = found[speed, speed] = turn
    found[speed, at + 3 : at + 6] = _across(turn @ v[:3])


def _across(vector: Vector) -> Vector:
    """Return the matrix of the cross product with a vector."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _momentum_slopes(robot: PinocchioRobot, velocities: Vector) -> Vector:
    """Return the derivative of the mass matrix times velocities by positions, (nv, nv)."""
    model, data, q = robot.model_in_motion, robot.data, robot.last_step()[0]
    nothing = np.zeros(robot.nv)
    with_weight, *_ = pinocchio.computeRNEADerivatives(model, data, q, nothing, velocities)
    found: Vector = with_weight - pinocchio.computeGeneralizedGravityDerivatives(model, data, q)
    return found


def _point_slopes(
    robot: PinocchioRobot,
    points: ContactPoints,
    impulses: tuple[Vector, Vector],
    velocities: Vector,
    period: float,
) -> tuple[Vector, Vector, Vector]:
    """Return derivatives by positions of what contact points do at given impulses and velocities.

    Args:
        robot: The robot.
        points: The points.
        impulses: Along their axes, shape (3 k,), and angular, of those that resist turning, (3 s,).
        velocities: Velocities of the robot, shape (nv,).
        period: Length of the step, in s.

    Returns:
        Derivatives of the points' velocities along their axes minus the target ones, (3 k, nv), of
        the angular velocities, (3 s, nv), and of the impulses exerted on the joints, (nv, nv).
    """
    q, before, _ = robot.last_step()
    joints, centers = robot.contact_finder.anchors(points, before)
    model, data = robot.model_in_motion, robot.data
    # Twists of unit velocities and of joints are about the world's origin: linear, angular.
    twists = np.ascontiguousarray(pinocchio.computeJointJacobians(model, data, q).reshape(6, -1).T)
    supports, carriers = robot.supports, robot.carriers
    line, turn = twists[:, :3], twists[:, 3:]
    motions = (supports * velocities) @ twists
    # A velocity's axis turns what its joint carries, and moves relative to the joint's parent.
    relative = motions[joints][:, None] - motions[robot.parents][None]
    carried = supports[joints][:, :, None]
    linear = cross_rows(turn, relative[..., :3]) + cross_rows(line, relative[..., 3:])
    angular = cross_rows(turn, relative[..., 3:])
    normals = points.axes[:, 2]
    forces = np.einsum("kij,ki->kj", points.axes, impulses[0].reshape(-1, 3))
    moves = line + cross_rows(turn, centers[:, None])
    gaps = np.einsum("kj,kvj->kv", normals, moves)
    moves -= (0.5 * (points.gaps < 0))[:, None, None] * gaps[:, :, None] * normals[:, None]
    moves *= carried
    speeds = linear + cross_rows(angular, points.points[:, None])
    speeds *= carried
    speeds += cross_rows(motions[joints][:, None, 3:], moves)
    rows = points.axes @ speeds.transpose(0, 2, 1)
    rows[:, 2] += points.bias_slopes(period)[:, None] * gaps * carried[:, :, 0]
    wrenches = np.concatenate([forces, cross_rows(points.points, forces)], axis=1)
    spinning = np.zeros(0, np.intp) if points.spins is None else points.spins.points
    axes = points.axes[spinning]
    spins = axes @ (angular * carried)[spinning].transpose(0, 2, 1)
    wrenches[spinning, 3:] += np.einsum("kij,ki->kj", axes, impulses[1].reshape(-1, 3))
    borne = carried[:, :, 0].T @ wrenches
    turned = cross_rows(turn, borne[:, 3:]) + cross_rows(line, borne[:, :3])
    exerted = carriers * (cross_rows(turn, borne[:, :3]) @ line.T + turned @ turn.T)
    moments = cross_rows(moves, forces[:, None])
    exerted += np.einsum("kv,vd,kud->vu", carried[:, :, 0], turn, moments)
    return rows.reshape(-1, robot.nv), spins.reshape(-1, robot.nv), exerted
