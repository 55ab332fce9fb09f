"""Constraints of DART that hold two bodies together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from dartpy import constraint

from physx_sim.engines import Bond

_RETURN = 0.2
"""Fraction of a gap that is closed in each step; DART has one for all worlds of a process."""


def bonded(nodes: Sequence[Any], bond: Bond) -> Any:
    """Return a constraint between two bodies of DART, of which one may be None: the world.

    DART holds bodies as they are when the constraint is made, so one of them is moved for that.
    """
    nodes, frames = list(nodes), list(bond.frames)
    if nodes[0] is None or (nodes[1] is not None and _carries(nodes[0], nodes[1])):
        nodes.reverse()
        frames.reverse()
    moved, other = nodes
    there = frames[1] if other is None else other.getWorldTransform().matrix() @ frames[1]
    here = moved.getWorldTransform().matrix() @ frames[0]
    step = np.eye(4)
    step[:3, 3] = (there - here)[:3, 3]
    if bond.rigid:
        step = there @ np.linalg.inv(here)
    joint = moved.getParentJoint()
    place, parent = joint.getTransformFromParentBodyNode().matrix(), moved.getParentBodyNode()
    above = np.eye(4) if parent is None else parent.getWorldTransform().matrix()
    joint.setTransformFromParentBodyNode(np.linalg.inv(above) @ step @ above @ place)
    held = (moved,) if other is None else (moved, other)
    if bond.rigid:
        found = constraint.WeldJointConstraint(*held)
    else:
        found = constraint.BallJointConstraint(*held, there[:3, 3])
    joint.setTransformFromParentBodyNode(place)
    found.setErrorReductionParameter(_RETURN)
    return found


def _carries(body: Any, other: Any) -> bool:
    """Return whether a body moves another one along."""
    while other is not None:
        if other == body:
            return True
        other = other.getParentBodyNode()
    return False
