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


class ImpulseSolver:
    """Solves for the impulses of points with friction cones, and of rows with bounds.

    Args:
        name: ``"pgs"`` (projected Gauss-Seidel) or ``"admm"``.
    """

    def __init__(self, name: str) -> None:
        """Prepare the solver.

        Raises:
            UnknownOptionError: There is none of that name.
        """
        if name not in SOLVERS:
            raise UnknownOptionError("World.solver for pinocchio", [name], SOLVERS)
        if name == "pgs":
            self._kinds = pinocchio.PGSConstraintSolver, pinocchio.PGSSolverResult
            self._settings = pinocchio.PGSSolverSettings()
            self._settings.max_iterations = 5000
        else:
            self._kinds = pinocchio.ADMMConstraintSolver, pinocchio.ADMMSolverResult
            self._settings = pinocchio.ADMMSolverSettings()
        for kind in ("feasibility", "complementarity"):
            setattr(self._settings, f"absolute_{kind}_tol", _ACCURACY)
            setattr(self._settings, f"relative_{kind}_tol", 0.0)
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
        data = pinocchio.StdVec_ConstraintData()
        for model in models:
            data.append(model.createData())
        solver, result = self._kinds[0](), self._kinds[1]()
        delassus = pinocchio.DelassusOperatorDense(matrix)
        solver.solve(delassus, free, models, data, self._settings, result)
        return np.array(result.retrieveConstraintImpulses())

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
