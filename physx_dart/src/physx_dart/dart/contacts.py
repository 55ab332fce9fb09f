"""Contacts from DART, copied to arrays; DART's own objects never leave this module."""

from __future__ import annotations

from typing import Any

import numpy as np

from physx_core.typing import Records
from physx_sim import CONTACT


class ContactReader:
    """Reads the contacts of a world in DART.

    Args:
        world: The world; it must outlive this reader.
        bodies: DART's bodies in the order of `Layout.names`.
        period: Length of a physics step, in s.
    """

    def __init__(self, world: Any, bodies: list[Any], period: float) -> None:
        self._world = world
        # As long as these Python objects are alive, DART keeps returning the same ones.
        self._bodies = {body: place for place, body in enumerate(bodies)}
        self._places: dict[Any, int] = {}

    def contacts(self) -> Records:
        """Return the contacts of the last step as an array of `CONTACT` records."""
        found = self._world.getLastCollisionResult().getContacts()
        records = np.zeros(len(found), CONTACT)
        bodies_a, bodies_b = records["body_a"], records["body_b"]
        points, forces, normals = records["point"], records["force"], records["normal"]
        depths = records["depth"]
        for row, contact in enumerate(found):
            first = self._place(contact.collisionObject1)
            second = self._place(contact.collisionObject2)
            if first <= second:
                bodies_a[row], bodies_b[row] = first, second
                forces[row], normals[row] = contact.force, contact.normal
            else:
                bodies_a[row], bodies_b[row] = second, first
                forces[row], normals[row] = -contact.force, -contact.normal
            points[row], depths[row] = contact.point, contact.penetrationDepth
        return records

    def clear_warm_start(self) -> None:
        """Drop references to DART's objects, which are about to be replaced."""
        self._places.clear()

    def _place(self, collision_object: Any) -> int:
        place = self._places.get(collision_object)
        if place is None:
            place = self._bodies[collision_object.getShapeFrame().getBodyNode()]
            self._places[collision_object] = place
        return place
