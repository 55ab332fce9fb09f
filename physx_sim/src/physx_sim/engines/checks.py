"""Validation of the arguments that callers pass to a simulation."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np

from physx_core.errors import listed, nearest
from physx_core.typing import Vector
from physx_sim import Layout, finite_rows, finite_vector
from physx_sim.errors import SimulationError


def integer(name: str, given: Any, least: int) -> int:
    """Return a value as an integer."""
    try:
        number = operator.index(given)
    except TypeError:
        raise SimulationError(f"{name} is {given!r} but must be an integer.") from None
    if number < least:
        what = "must not be negative" if least == 0 else f"must be at least {least}"
        raise SimulationError(f"{name} is {number} but {what}.")
    return number


class LayoutChecks:
    """Validates states and body names against a simulation's layout."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._bodies = {name: place for place, name in enumerate(layout.names)}
        self._floating = [part for part in layout.parts.values() if part.floating]

    def positions(self, given: Any) -> Vector:
        """Return positions as a new vector (nq,) with normalized quaternions."""
        q = finite_vector("positions", given, self._layout.nq)
        for part in self._floating:
            base = slice(part.positions.start + 3, part.positions.start + 7)
            length = math.hypot(*q[base].tolist())
            if not abs(length - 1.0) <= 1e-3:
                raise SimulationError(
                    f'The quaternion of "{part.name}" (positions {base.start} to {base.stop - 1}, '
                    f"in the order x, y, z, w) has length {length:g}, not 1."
                )
            q[base] /= length
        return q

    def velocities(self, name: str, given: Any) -> Vector:
        """Return velocities, accelerations, or torques as a new vector (nv,)."""
        return finite_vector(name, given, self._layout.nv)

    def rows(self, positions: Any, **others: Any) -> list[Vector]:
        """Return many states as new arrays: positions (n, nq), then the others (n, nv)."""
        q, nv = finite_rows("positions", positions, self._layout.nq), self._layout.nv
        rows = [finite_rows(name, values, nv) for name, values in others.items()]
        if any(len(each) != len(q) for each in rows):
            counts = (f"{len(each)} {name}" for name, each in zip(others, rows, strict=True))
            raise SimulationError(
                f"There are {len(q)} positions, {', '.join(counts)}; each state needs one row of "
                "each."
            )
        for part in self._floating:
            quaternions = q[:, part.positions.start + 3 : part.positions.start + 7]
            lengths = np.sqrt((quaternions**2).sum(axis=1, keepdims=True))
            if not (np.abs(lengths - 1.0) <= 1e-3).all():
                raise SimulationError(
                    f'A quaternion of "{part.name}" (x, y, z, w) has length '
                    f"{lengths[np.argmax(np.abs(lengths - 1.0))].item():g}, not 1."
                )
            quaternions /= lengths
        return [q, *rows]

    def body(self, name: Any) -> int:
        """Return the index of a body in `Layout.names`."""
        place = self._bodies.get(name) if isinstance(name, str) else None
        if place is None:
            raise SimulationError(
                f'There is no link "{name}".{nearest(str(name), self._bodies)} '
                f"Links: {listed(self._bodies)}."
            )
        return place

    def bodies(self, names: Any) -> list[int]:
        """Return the indices of bodies in `Layout.names`; None: all moving bodies."""
        if names is None:
            return list(range(len(self._layout.bodies)))
        if isinstance(names, str):
            raise SimulationError(f'names is the string "{names}" but must be a list of names.')
        try:
            return [self._bodies[name] for name in names]
        except (KeyError, TypeError):
            pass
        try:
            return [self.body(name) for name in names]
        except TypeError:
            raise SimulationError(f"names is {names!r} but must be a list of names.") from None

    def part(self, name: Any) -> int:
        """Return the index of a robot or moving object in `Layout.parts`."""
        known = list(self._layout.parts)
        if name not in known:
            raise SimulationError(
                f'There is no moving robot or object "{name}".{nearest(str(name), known)} '
                f"Available: {listed(known)}."
            )
        return known.index(name)
