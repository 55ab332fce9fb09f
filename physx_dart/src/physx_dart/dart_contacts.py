"""Reading DART's contacts and rays into arrays at once; DART's own objects never leave here."""

from __future__ import annotations

from typing import Any

import numpy as np
from dartpy import collision

from physx_core.interfaces.backend import CONTACT, RAY_HIT, Records, Vector


class ContactReader:
    """What touches in a world of DART.

    Args:
        world: The world; it must live as long as this reader.
        bodies: DART's bodies in the order of `Layout.names`.
        period: Length of a physics step, in s.
    """

    def __init__(self, world: Any, bodies: list[Any], period: float) -> None:
        self._world = world
        self._bodies = bodies  # as long as they are kept, DART gives the same Python objects
        self._places = {body: place for place, body in enumerate(bodies)}

    def contacts(self) -> Records:
        """Return the contacts of the last step: an array of `CONTACT` records."""
        found = self._world.getLastCollisionResult().getContacts()
        records = np.zeros(len(found), CONTACT)
        for row, contact in enumerate(found):
            first = self._place(contact.collisionObject1)
            second = self._place(contact.collisionObject2)
            sign = 1.0 if first <= second else -1.0
            records[row] = (
                min(first, second),
                max(first, second),
                contact.point,
                sign * contact.force,
                sign * contact.normal,
                contact.penetrationDepth,
            )
        return records

    def raycast(self, begins: Vector, ends: Vector) -> Records:
        """Return what rays meet first: an array of `RAY_HIT` records."""
        records = np.zeros(len(begins), RAY_HIT)
        records["body"] = -1
        group = self._world.getConstraintSolver().getCollisionGroup()
        option = collision.RaycastOption()
        option.mSortByClosest = True
        for record, begin, end in zip(records, begins, ends, strict=True):
            result = collision.RaycastResult()
            if not group.raycast(begin, end, option, result) or not result.hasHit():
                continue
            hit = result.mRayHits[0]
            record["hit"], record["body"] = True, self._place(hit.mCollisionObject)
            record["point"], record["normal"] = hit.mPoint, hit.mNormal
            record["fraction"] = hit.mFraction
        return records

    def _place(self, collision_object: Any) -> int:
        return self._places[collision_object.getShapeFrame().getBodyNode()]
