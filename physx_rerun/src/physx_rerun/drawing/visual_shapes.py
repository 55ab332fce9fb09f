"""The visual shapes of a robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from physx_core.typing import Vector

MESH_TYPES = {
    ".dae": "model/vnd.collada+xml",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".obj": "model/obj",
    ".stl": "model/stl",
}
"""Mesh files that Rerun can draw, by suffix, and their media types."""


@dataclass(frozen=True)
class VisualShape:
    """A visual shape.

    Attributes:
        name: Name that is unique in the robot.
        body: Index of the body that it is attached to; None: the world.
        pose: Pose in the body's frame, a homogeneous matrix of shape (4, 4).
        kind: ``mesh``, ``box``, ``cylinder``, ``sphere`` or ``capsule``.
        size: In m: half edges of a box (3,); radius of a sphere (1,); radius and length (2,). For a
            mesh: scale factors (3,).
        mesh: File of a mesh.
        color: Red, green, blue and alpha in [0, 1] from the URDF; None: not specified there.
    """

    name: str
    body: int | None
    pose: Vector
    kind: str
    size: tuple[float, ...]
    mesh: Path | None
    color: tuple[float, ...] | None


@dataclass(frozen=True)
class Model:
    """The visual shapes of a robot.

    Attributes:
        shapes: The visual shapes whose files exist.
        missing: Names of mesh files that do not exist or that Rerun cannot draw.
        rest: Poses of the bodies with all joints at zero and the root at the origin,
            shape (bodies, 7), x, y, z in m and quaternion x, y, z, w.
    """

    shapes: list[VisualShape]
    missing: list[str]
    rest: Vector
