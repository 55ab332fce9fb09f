"""World descriptions: plain, picklable data from which every backend builds a simulation."""

from __future__ import annotations

from physx_core.simulation.description.ground import Ground, HeightField, Stairs
from physx_core.simulation.description.objects import (
    Box,
    Capsule,
    Cylinder,
    Mesh,
    Sphere,
    WorldObject,
)
from physx_core.simulation.description.robot import JointSettings, Robot
from physx_core.simulation.description.world import World
from physx_core.simulation.description.wrench import Wrench

__all__ = [
    "Box",
    "Capsule",
    "Cylinder",
    "Ground",
    "HeightField",
    "JointSettings",
    "Mesh",
    "Robot",
    "Sphere",
    "Stairs",
    "World",
    "WorldObject",
    "Wrench",
]
