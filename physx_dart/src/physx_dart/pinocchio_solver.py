"""Impulses of contacts, limits, servos and friction together, by Pinocchio's own solvers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio

from physx_core.errors import SimulationError, UnknownOptionError
from physx_core.interfaces.backend import Vector

SOLVERS = ("pgs", "admm")
_REGULARIZATION = 1e-9
"""Share that is added to the diagonal, as DART's solver does."""
_ACCURACY = 1e-11
"""Of velocities, in m/s, and impulses."""


_MOST_ITERATIONS = 1000


class ImpulseSolver:
    """Solves for the impulses of points with friction cones, and of rows with bounds.

    Where the solver that is asked for does not come to an end, the other one takes over: that of
    Gauss-Seidel fails at impacts of light links on heavy ones, ADMM at some that the first finds.

    Args:
        name: Which comes first: ``"pgs"`` (projected Gauss-Seidel) or ``"admm"``.
    """

    def __init__(self, name: str) -> None:
        """Prepare the solver.

        Raises:
            UnknownOptionError: There is none of that name.
        """
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
        self._solvers = (gauss_seidel, admm) if name == "pgs" else (admm, gauss_seidel)
        self._points: dict[float, Any] = {}
        self._chains: dict[int, Any] = {}

    def solve(
        self, response: Vector, free: Vector, friction: Vector, least: Vector, most: Vector
    ) -> Vector:
        """Return the impulses, shape (3 k + m,).

        Args:
            response: Velocities for unit impulses, shape (3 k + m, 3 k + m).
            free: Velocities without impulses, less what is wanted, shape (3 k + m,): of k points
                along two tangents and the normal, then of m rows.
            friction: Coefficients of the points, shape (k,).
            least: Smallest impulses of the rows, shape (m,).
            most: Largest impulses, likewise.

        Raises:
            SimulationError: They are no numbers.
        """
        if not np.isfinite(free).all() or not np.isfinite(response).all():
            raise SimulationError("The state is no longer finite. Use a smaller period.")
        matrix = response + np.diag(_REGULARIZATION * np.diag(response))
        models = pinocchio.StdVec_ConstraintModel()
        for coefficient in friction:
            models.append(self._point(float(coefficient)))
        if len(least):
            models.append(self._rows(least, most))
        impulses, least_error = np.zeros(len(free)), np.inf
        for kind, result_of, settings in self._solvers:
            data = pinocchio.StdVec_ConstraintData()
            for model in models:
                data.append(model.createData())
            solver, result = kind(), result_of()
            delassus = pinocchio.DelassusOperatorDense(matrix)
            solver.solve(delassus, free, models, data, settings, result)
            error = max(result.primal_feasibility, result.dual_feasibility, result.complementarity)
            if error < least_error:
                impulses, least_error = np.array(result.retrieveConstraintImpulses()), error
            if result.converged:
                break
        return impulses

    def _point(self, coefficient: float) -> Any:
        if coefficient not in self._points:
            model = pinocchio.PointContactConstraintModel(self._chain(1), 1)
            model.setFriction(coefficient)
            self._points[coefficient] = pinocchio.ConstraintModel(model)
        return self._points[coefficient]

    def _rows(self, least: Vector, most: Vector) -> Any:
        """Return a constraint with bounds: that of friction in joints of a made-up model."""
        joints = pinocchio.StdVec_Index()
        joints.extend(range(1, len(least) + 1))
        chain = self._chain(len(least))
        return pinocchio.ConstraintModel(
            pinocchio.JointFrictionConstraintModel(chain, joints, least, most)
        )

    def _chain(self, length: int) -> Any:
        if length not in self._chains:
            model = pinocchio.Model()
            for place in range(length):
                nowhere = pinocchio.SE3.Identity()
                model.addJoint(0, pinocchio.JointModelRX(), nowhere, str(place))
            self._chains[length] = model
        return self._chains[length]


def _accurate(settings: Any) -> Any:
    """Return settings with which a solver goes on until its result is accurate."""
    settings.max_iterations = _MOST_ITERATIONS
    for kind in ("feasibility", "complementarity"):
        setattr(settings, f"absolute_{kind}_tol", _ACCURACY)
        setattr(settings, f"relative_{kind}_tol", 0.0)
    return settings
