"""Solver for the impulses of contacts, limits, servos, and friction together."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio

from physx_core.errors import SimulationError, UnknownOptionError
from physx_core.typing import Vector
from physx_dart.pinocchio.contact_problem import ContactProblem

SOLVERS = ("pgs", "admm")
_NEWTON_STEPS = 12
_ITERATIONS = 300
"""Iterations of Pinocchio's solvers; Newton's method improves what they find."""
_ACCURACY = 1e-11
"""Of velocities, in m/s, and impulses."""
_GOOD = 100.0
"""Error at which an iterated solution is accepted, as a multiple of an exact one's."""
_ENDLESS = 1e6
"""Finite bound that stands for infinity in Pinocchio's solvers."""


class ImpulseSolver:
    """Solves for the impulses of points with friction cones, and of rows with bounds.

    Newton's method mostly finds them exactly in a few steps, from the impulses of the last step in
    one or two. If it cycles, it continues from the results of Pinocchio's solvers, one after the
    other: projected Gauss-Seidel fails for impacts of light links on heavy ones and for jammed
    joints, ADMM for some problems that the former solves.

    Args:
        name: The solver to try first: ``"pgs"`` (projected Gauss-Seidel) or ``"admm"``.
    """

    def __init__(self, name: str) -> None:
        """Prepare the solver."""
        if name not in SOLVERS:
            raise UnknownOptionError("World.solver for pinocchio", [name], SOLVERS)
        gauss_seidel = (
            pinocchio.PGSConstraintSolver,
            pinocchio.PGSSolverResult,
            _accurate(pinocchio.PGSSolverSettings()),
        )
        admm = (
            pinocchio.ADMMConstraintSolver,
            pinocchio.ADMMSolverResult,
            _accurate(pinocchio.ADMMSolverSettings()),
        )
        self._solvers = {"pgs": gauss_seidel, "admm": admm}
        self._order = sorted(SOLVERS, key=lambda each: each != name)
        self._points: dict[float, Any] = {}
        self._limits: dict[int, Any] = {}
        self._chains: dict[int, Any] = {}

    def solve(
        self,
        response: Vector,
        free: Vector,
        friction: Vector,
        least: Vector,
        most: Vector,
        guess: Vector | None = None,
    ) -> Vector:
        """Return the impulses, shape (3 k + m,).

        Args:
            response: Velocities for unit impulses, shape (3 k + m, 3 k + m).
            free: Velocities without impulses minus the wanted ones, shape (3 k + m,): of k points
                along two tangents and the normal, then of m rows.
            friction: Coefficients of the points, shape (k,).
            least: Smallest impulses of the rows, shape (m,); rows with one bound come first.
            most: Largest impulses, likewise.
            guess: Impulses to begin with, shape (3 k + m,).
        """
        if not math.isfinite(free.sum() + response.sum()):
            raise SimulationError("The state is no longer finite. Use a smaller period.")
        problem = ContactProblem(response, free, friction, least, most)
        good = problem.accuracy
        if guess is not None and guess.any():
            best, least_error = problem.newton(guess, _NEWTON_STEPS)
            if least_error < good:
                return best
        best, least_error = problem.newton(np.zeros(len(free)), _NEWTON_STEPS)
        for name in self._order:
            if least_error < good:
                break
            good = _GOOD * problem.accuracy
            begin = self.iterate(problem, name)
            if np.isfinite(begin).all():
                found, error = problem.newton(begin, _NEWTON_STEPS)
                if error < least_error:
                    best, least_error = found, error
        return best

    def iterate(self, problem: ContactProblem, name: str) -> Vector:
        """Return the result of one of Pinocchio's solvers, ``"pgs"`` or ``"admm"``."""
        models = pinocchio.StdVec_ConstraintModel()
        for coefficient in problem.friction:
            models.append(self._point(float(coefficient)))
        size, least, most = 3 * len(problem.friction), problem.least, problem.most
        one_sided = int((np.isinf(least) != np.isinf(most)).sum())
        if one_sided:
            models.append(self._limit(one_sided))
        if one_sided < len(least):
            models.append(self._bounds_model(least[one_sided:], most[one_sided:]))
        data = pinocchio.StdVec_ConstraintData()
        for model in models:
            data.append(model.createData())
        # Pinocchio's limits only push upward.
        signs = np.ones(len(problem.free))
        signs[size:][np.isinf(least) & np.isfinite(most)] = -1.0
        delassus = pinocchio.DelassusOperatorDense(problem.matrix * np.outer(signs, signs))
        kind, result_of, settings = self._solvers[name]
        result = result_of()
        kind().solve(delassus, signs * problem.free, models, data, settings, result)
        return signs * result.retrieveConstraintImpulses()

    def _point(self, coefficient: float) -> Any:
        if coefficient not in self._points:
            model = pinocchio.PointContactConstraintModel(self._chain(1), 1)
            model.setFriction(coefficient)
            self._points[coefficient] = pinocchio.ConstraintModel(model)
        return self._points[coefficient]

    def _limit(self, length: int) -> Any:
        """Return a limit constraint of joints of a dummy model."""
        if length not in self._limits:
            nothing = np.zeros(length)
            model = pinocchio.JointLimitConstraintModel(
                self._chain(length), _joints(length), nothing, nothing + np.inf, nothing + 1.0
            )
            model.makeSelectionMaximal()
            self._limits[length] = pinocchio.ConstraintModel(model)
        return self._limits[length]

    def _bounds_model(self, least: Vector, most: Vector) -> Any:
        """Return a constraint with bounds: joint friction of a dummy model."""
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


def _accurate(settings: Any) -> Any:
    """Return settings with which a solver iterates until its result is accurate."""
    settings.max_iterations = _ITERATIONS
    for kind in ("feasibility", "complementarity"):
        setattr(settings, f"absolute_{kind}_tol", _ACCURACY)
        setattr(settings, f"relative_{kind}_tol", 0.0)
    return settings
