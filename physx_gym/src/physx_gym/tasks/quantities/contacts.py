"""What touches what, and with which forces, in the last physics step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physx_core.errors import ComponentNotFoundError
from physx_core.typing import Vector
from physx_gym.tasks.quantities.bodies import BodyPoses, BodyVelocities
from physx_gym.tasks.quantities.quantity import Moment, Quantity


@dataclass(frozen=True)
class ContactForces(Quantity):
    """Sum of the contact forces on each of some bodies, shape (bodies, 3), in N, in the world.

    Attributes:
        bodies: Names in the layout.
    """

    bodies: tuple[str, ...]

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
class VerticalForceShares(Quantity):
    """Which share of the robot's weight each of some bodies carries, shape (bodies,).

    They sum to 1 where a robot stands still on these bodies alone.

    Attributes:
        bodies: Names in the layout, for example the feet.
    """

    bodies: tuple[str, ...]

    def compute(self, moment: Moment) -> Vector:
        """Return the shares."""
        from physx_gym.tasks.quantities.dynamics import MassAndMomentum

        mass = float(moment.get(MassAndMomentum())[0])
        weight = mass * float(np.linalg.norm(moment.simulator.world.gravity))
        return np.asarray(moment.get(ContactForces(self.bodies))[:, 2] / weight)


@dataclass(frozen=True)
class Touching(Quantity):
    """Whether two of some bodies touch each other.

    Attributes:
        bodies: Names in the layout, for example the feet; those of a static object too.
    """

    bodies: tuple[str, ...]

    def compute(self, moment: Moment) -> bool:
        """Return whether there is a contact between two of them."""
        places = _places(moment, self.bodies)
        contacts = moment.contacts()
        return any(
            int(a) in places and int(b) in places
            for a, b in zip(contacts["body_a"], contacts["body_b"], strict=True)
        )


@dataclass(frozen=True)
class HighestContactForce(Quantity):
    """The largest contact force on any of some bodies, in N.

    Attributes:
        bodies: Names in the layout.
    """

    bodies: tuple[str, ...]

    def compute(self, moment: Moment) -> float:
        """Return the force."""
        return float(np.linalg.norm(moment.get(ContactForces(self.bodies)), axis=1).max())


@dataclass(frozen=True)
class SlipVelocity(Quantity):
    """How fast the fastest contact of some bodies slides along the surface it touches, in m/s.

    Contacts with what never moves count; 0 without any.

    Attributes:
        bodies: Names in the layout.
    """

    bodies: tuple[str, ...]

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
    """Return the row of each body by its place in `Layout.names`."""
    names = moment.simulator.layout.names
    for body in bodies:
        if body not in names:
            raise ComponentNotFoundError("body", body, "The simulation", names)
    return {names.index(body): row for row, body in enumerate(bodies)}
