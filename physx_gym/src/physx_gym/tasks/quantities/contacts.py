"""Quantities of the contacts in the last physics step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physx_core.errors import ComponentNotFoundError
from physx_core.typing import Vector
from physx_gym.tasks.quantities.bodies import BodiesQuantity, BodyPoses, BodyVelocities
from physx_gym.tasks.quantities.dynamics import MassAndMomentum
from physx_gym.tasks.quantities.quantity import Moment


@dataclass(frozen=True)
class ContactForces(BodiesQuantity):
    """Total contact force on each body, shape (bodies, 3), in N, in the world frame."""

    def compute(self, moment: Moment) -> Vector:
        """Return the forces."""
        forces = np.zeros((len(self.bodies), 3))
        places = _places(moment, self.bodies)
        for contact in moment.contacts():
            for body, sign in ((contact["body_a"], 1.0), (contact["body_b"], -1.0)):
                row = places.get(int(body))
                if row is not None:
                    forces[row] += sign * contact["force"]
        return forces


@dataclass(frozen=True)
class VerticalForceShares(BodiesQuantity):
    """Fraction of the robot's weight that each body carries, shape (bodies,).

    They sum to 1 if the robot stands still on these bodies alone.
    """

    def compute(self, moment: Moment) -> Vector:
        """Return the fractions."""
        mass = float(moment.get(MassAndMomentum())[0])
        weight = mass * float(np.linalg.norm(moment.simulator.world.gravity))
        return np.asarray(moment.get(ContactForces(self.bodies))[:, 2] / weight)


@dataclass(frozen=True)
class BodiesInContact(BodiesQuantity):
    """Whether any two of the bodies, which may be static objects, touch each other."""

    def compute(self, moment: Moment) -> bool:
        """Return whether there is a contact between two of them."""
        places = _places(moment, self.bodies)
        contacts = moment.contacts()
        return any(
            int(a) in places and int(b) in places
            for a, b in zip(contacts["body_a"], contacts["body_b"], strict=True)
        )


@dataclass(frozen=True)
class HighestContactForce(BodiesQuantity):
    """The largest contact force on any of the bodies, in N."""

    def compute(self, moment: Moment) -> float:
        """Return the force."""
        return float(np.linalg.norm(moment.get(ContactForces(self.bodies)), axis=1).max())


@dataclass(frozen=True)
class SlipVelocity(BodiesQuantity):
    """Speed, in m/s, of the bodies' fastest contact along the surface that it touches.

    The touched surfaces are assumed to be at rest; 0 without contacts.
    """

    def compute(self, moment: Moment) -> float:
        """Return the velocity."""
        places = _places(moment, self.bodies)
        fastest = 0.0
        for contact in moment.contacts():
            row = places.get(int(contact["body_a"]))
            if row is None or int(contact["body_b"]) in places:
                continue
            velocity = moment.get(BodyVelocities(self.bodies))[row]
            arm = contact["point"] - moment.get(BodyPoses(self.bodies))[row, :3]
            moving = velocity[:3] + np.cross(velocity[3:], arm)
            along = moving - contact["normal"] * (moving @ contact["normal"])
            fastest = max(fastest, float(np.linalg.norm(along)))
        return fastest


def _places(moment: Moment, bodies: tuple[str, ...]) -> dict[int, int]:
    """Return the row of each body by its index in `Layout.names`."""
    names = moment.simulator.layout.names
    for body in bodies:
        if body not in names:
            raise ComponentNotFoundError("body", body, "The simulation", names)
    return {names.index(body): row for row, body in enumerate(bodies)}
