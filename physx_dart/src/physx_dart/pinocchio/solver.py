"""Solver for the coupled impulses of contacts, limits, servos, and friction."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio

from physx_core.errors import UnknownOptionError
from physx_core.typing import Index, Vector
from physx_dart.pinocchio.contact_problem import ContactProblem

SOLVERS = ("pgs", "admm")
_NEWTON_STEPS = 12
_KINDS = {
    "pgs": (
        pinocchio.PGSConstraintSolver,
        pinocchio.PGSSolverSettings,
        pinocchio.PGSSolverResult,
    ),
    "admm": (
        pinocchio.ADMMConstraintSolver,
        pinocchio.ADMMSolverSettings,
        pinocchio.ADMMSolverResult,
    ),
}
_FEW, _MANY = (30, 1e-4), (300, 1e-11)
"""Maximum iterations of Pinocchio's solvers, and the errors in m/s and N s at which they stop."""
_MOST_KNOWN = 1000
"""Number of problem descriptions to keep; each takes a few KiB."""
_GOOD = 100.0
"""Error at which an iterative solution is accepted, as a multiple of an exact one's."""
_ENDLESS = 1e6
"""Finite bound used for infinity in Pinocchio's solvers."""


class ImpulseSolver:
    """Solves for the impulses of points with friction cones, and of rows with bounds.

    A few iterations of one of Pinocchio's solvers, starting from the impulses of the last step,
    usually show which points stick, slide, or separate; Newton's method then finds the impulses
    exactly. If it cycles, it restarts from zero, then from the results of many iterations of either
    solver: projected Gauss-Seidel fails for impacts of light links on heavy ones and for jammed
    joints, ADMM for some problems that Gauss-Seidel solves.

    Args:
        name: The solver to try first: ``"pgs"`` (projected Gauss-Seidel) or ``"admm"``.
    """

    def __init__(self, name: str) -> None:
        """Prepare the solver."""
        if name not in SOLVERS:
            raise UnknownOptionError("World.solver for pinocchio", [name], SOLVERS)
        self._order = sorted(SOLVERS, key=lambda each: each != name)
        self._solvers = {each: _KINDS[each][0]() for each in SOLVERS}
        self._points: dict[float, Any] = {}
        self._limits: dict[int, Any] = {}
        self._chains: dict[int, Any] = {}
        self._known: dict[tuple[bytes, ...], tuple[Any, Any]] = {}

    def solve(
        self,
        response: Vector,
        free: Vector,
        friction: Vector,
        least: Vector,
        most: Vector,
        guess: Vector,
        turning: tuple[Index, Vector] | None = None,
    ) -> Vector:
        """Return the impulses, shape (n,).

        Args:
            response: Velocities for unit impulses, shape (n, n): n is 3 k + m, or 3 k + m + 3 s.
            free: Velocities without impulses minus the target ones, shape (n,): of k points along
                two tangents and the normal, of m rows, then of s points about these axes.
            friction: Coefficients of the points, shape (k,).
            least: Smallest impulses of the rows, shape (m,); rows of limits, which only push upward
                (from 0 to infinity), come first.
            most: Largest impulses of the rows, shape (m,).
            guess: Impulses to start with, shape (n,).
            turning: These s points, as indices, and their largest angular impulses per normal
                impulse across and about the normal, in m, shape (s, 2).

        Raises:
            SimulationError: If a value is not finite.
        """
        problem = ContactProblem(response, free, friction, least, most, turning)
        best, least_error, good = guess, math.inf, problem.accuracy
        for begin in self._beginnings(problem, guess):
            if math.isfinite(begin.dot(begin)):
                found, error = problem.newton(begin, _NEWTON_STEPS)
                if error < least_error:
                    best, least_error = found, error
            if least_error < good:
                break
            good = _GOOD * problem.accuracy
        return best

    def _beginnings(self, problem: ContactProblem, guess: Vector) -> Iterator[Vector]:
        """Yield starting impulses for Newton's method."""
        yield self.iterate(problem, self._order[0], _FEW, guess)
        nothing = np.zeros(len(guess))
        yield nothing
        for name in self._order:
            yield self.iterate(problem, name, _MANY, nothing)

    def iterate(
        self, problem: ContactProblem, name: str, limits: tuple[int, float], guess: Vector
    ) -> Vector:
        """Return the result of one of Pinocchio's solvers, which know no friction against turning.

        Args:
            problem: The problem.
            name: Name of the solver.
            limits: Maximum number of iterations, and the accuracy at which it stops.
            guess: Impulses to start with.
        """
        matrix, free, turning = problem.matrix, problem.free, problem.turning_rows
        if turning:
            matrix, free, guess = matrix[:-turning, :-turning], free[:-turning], guess[:-turning]
        result = _KINDS[name][2]()
        result.setConstraintImpulseGuess(guess)
        models, settings = self._models(problem), _settings(name, *limits)
        delassus = pinocchio.DelassusOperatorDense(matrix)
        self._solvers[name].solve(delassus, free, *models, settings, result)
        found: Vector = result.retrieveConstraintImpulses()
        return np.concatenate([found, np.zeros(turning)]) if turning else found

    def _models(self, problem: ContactProblem) -> tuple[Any, Any]:
        """Return Pinocchio's description of a problem."""
        least, most = problem.least, problem.most
        key = problem.friction.tobytes(), least.tobytes(), most.tobytes()
        if key in self._known:
            return self._known[key]
        models, data = pinocchio.StdVec_ConstraintModel(), pinocchio.StdVec_ConstraintData()
        for coefficient in problem.friction:
            models.append(self._point(float(coefficient)))
        one_sided = int((np.isinf(least) != np.isinf(most)).sum())
        if one_sided:
            models.append(self._limit(one_sided))
        if one_sided < len(least):
            models.append(self._bounds_model(least[one_sided:], most[one_sided:]))
        for model in models:
            data.append(model.createData())
        if len(self._known) >= _MOST_KNOWN:
            self._known.clear()
        self._known[key] = models, data
        return models, data

    def _point(self, coefficient: float) -> Any:
        if coefficient not in self._points:
            model = pinocchio.PointContactConstraintModel(self._chain(1), 1)
            model.setFriction(coefficient)
            self._points[coefficient] = pinocchio.ConstraintModel(model)
        return self._points[coefficient]

    def _limit(self, length: int) -> Any:
        """Return a joint limit constraint of a dummy model."""
        if length not in self._limits:
            nothing = np.zeros(length)
            model = pinocchio.JointLimitConstraintModel(
                self._chain(length), _joints(length), nothing, nothing + np.inf, nothing + 1.0
            )
            model.makeSelectionMaximal()
            self._limits[length] = pinocchio.ConstraintModel(model)
        return self._limits[length]

    def _bounds_model(self, least: Vector, most: Vector) -> Any:
        """Return a constraint with bounds: the joint friction of a dummy model."""
        return pinocchio.ConstraintModel(
            pinocchio.JointFrictionConstraintModel(
                self._chain(len(least)),
                _joints(len(least)),
                np.maximum(least, -_ENDLESS),
                np.minimum(most, _ENDLESS),
            )
        )

    def _chain(self, length: int) -> Any:
        if length not in self._chains:
            model = pinocchio.Model()
            for place in range(length):
                nowhere = pinocchio.SE3.Identity()
                model.addJoint(0, pinocchio.JointModelRX(), nowhere, str(place))
            self._chains[length] = model
        return self._chains[length]


def _joints(length: int) -> Any:
    joints = pinocchio.StdVec_Index()
    joints.extend(range(1, length + 1))
    return joints


@functools.cache
def _settings(name: str, iterations: int, accuracy: float) -> Any:
    settings = _KINDS[name][1]()
    settings.max_iterations = iterations
    for kind in ("feasibility", "complementarity"):
        setattr(settings, f"absolute_{kind}_tol", accuracy)
        setattr(settings, f"relative_{kind}_tol", 0.0)
    return settings
