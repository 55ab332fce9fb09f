"""MuJoCo's model of a world, built from what physx read from its files.

MuJoCo's own URDF loader is not used: it merges links, rejects moments of inertia that no body of
positive density can have, and ignores what physx adds to a file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from physx_core.rotations import to_matrix
from physx_core.typing import Index, Vector
from physx_sim import Ground, HeightField, Mimic, Stairs
from physx_sim.engines import (
    CollisionShape,
    Joint,
    LoadedBody,
    LoadedRobot,
    MovableBody,
    Parts,
    RigidBody,
    Static,
    check_loaded,
    read_vertices,
)
from physx_sim.errors import ModelError

_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
_ALL, _STATIC, _MOVING, _OWN = (1 << 31) - 1, 1, 2, 2
"""Bits of MuJoCo's collision masks: static, moving and, from `_OWN` on, one for each robot."""
_STEPS, _DAMPING, _IMPEDANCE = 2.0, 2.0, (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Time constant in steps, damping ratio, and impedance of the nearly rigid constraints."""
SPARE = 16
"""Number of attachments that a world can get at a time in addition to those that it starts with."""
_DEEP = 10.0
"""Depth of a height field below its lowest point, in m."""


@dataclass(frozen=True)
class WorldModel:
    """A world in MuJoCo.

    Attributes:
        model: MuJoCo's model.
        bodies: The model's body for each link and object, in the order of `Layout.bodies`.
        owners: For each shape of the model, the index of its owner in `Layout.names`.
        spare: Equality constraints for attachments.
    """

    model: Any
    bodies: Index
    owners: Index
    spare: range


class ModelBuilder:
    """Builds a `WorldModel` from the parts of a world."""

    def __init__(self, parts: Parts) -> None:
        self._parts, self._spec = parts, mujoco.MjSpec()
        self._spec.compiler.degree = False
        self._hard = {"solref": (_STEPS * parts.world.period, _DAMPING), "solimp": _IMPEDANCE}
        self._moments: list[Vector] = []
        self._masses: list[float] = []
        self._owners: list[int] = []
        shapes = [shape for movable in parts.movables for shape in movable.model.shapes]
        frictions = {float(x.friction) for x in (*shapes, *(each.what for each in parts.statics))}
        # Of two shapes, MuJoCo uses the friction of the one with the higher priority.
        self._priorities = {mu: i for i, mu in enumerate(sorted(frictions, reverse=True))}

    def build(self) -> WorldModel:
        """Return the model, with MuJoCo's default options."""
        for place, movable in enumerate(self._parts.movables):
            self._add_movable(place, movable)
        count = len(self._moments)
        if self._parts.world.contacts != "none":
            for place, static in enumerate(self._parts.statics):
                self._add_static(static, count + place)
        coupled, spare = len(self._spec.equalities), len(self._parts.attachments) + SPARE
        for _ in range(spare):
            kind, body = mujoco.mjtEq.mjEQ_WELD, mujoco.mjtObj.mjOBJ_BODY
            added = self._spec.add_equality(type=kind, objtype=body, name1="0", name2="world")
            added.active, added.solref, added.solimp = False, *self._hard.values()
        try:
            model = self._spec.compile()
        except ValueError as error:
            raise ModelError(f"MuJoCo cannot load this world: {error}.") from error
        bodies = np.array([model.body(str(place)).id for place in range(count)], np.intp)
        owners = np.array(
            [self._owners[int(model.geom(i).name)] for i in range(model.ngeom)], np.intp
        )
        model.body_mass[bodies], model.body_inertia[bodies] = self._masses, self._moments
        mujoco.mj_setConst(model, mujoco.MjData(model))
        first = 0
        for movable in self._parts.movables:
            last = first + len(movable.model.links)
            check_loaded("mujoco", movable, _loaded(model, movable, bodies[first:last]))
            first = last
        return WorldModel(model, bodies, owners, range(coupled, coupled + spare))

    # Robots and objects ---------------------------------------------------------------------

    def _add_movable(self, place: int, movable: MovableBody) -> None:
        added: list[Any] = []
        first = len(self._moments)
        for body in movable.model.bodies:
            if body.parent < 0:
                turn = to_matrix(movable.orientation)
                new = self._add_body(self._spec.worldbody, body, np.array(movable.position), turn)
                if not movable.fixed_base:
                    new.add_freejoint()
            else:
                pose, parent = body.pose, added[body.parent]
                new = self._add_body(parent, body, pose[:3, 3], pose[:3, :3])
            if body.joint is not None:
                self._add_joint(new, body.joint, body.axis, f"{place} {body.joint.name}")
                if (
                    body.parent == 0 and movable.fixed_base
                ):  # else it collides with its fixed parent
                    self._spec.add_exclude(bodyname1=new.parent.name, bodyname2=new.name)
            added.append(new)
        for follower, leader, mimic in movable.model.followers:
            names = (f"{place} {movable.model.joints[each].name}" for each in (follower, leader))
            self._couple(mimic, *names)
        masks = self._masks(place, movable)
        for shape in movable.model.shapes:
            link = 0 if movable.is_object else movable.model.links.index(shape.body)
            self._add_shape(added[link], shape, first + link, **masks)

    def _add_body(self, parent: Any, body: RigidBody, position: Vector, turn: Vector) -> Any:
        """Add a link; its mass, which may be 0, and its moments of inertia are set later."""
        new = parent.add_body(name=str(len(self._moments)), pos=position, quat=quaternion_of(turn))
        moments, axes = np.linalg.eigh(body.inertia)
        axes[:, 2] *= np.linalg.det(axes)  # a rotation, not a reflection
        new.explicitinertial, new.mass, new.inertia = True, 1.0, (1.0, 1.0, 1.0)
        new.ipos, new.iquat = body.center, quaternion_of(axes)
        self._masses.append(body.mass)
        self._moments.append(moments)
        return new

    def _couple(self, mimic: Mimic, follower: str, leader: str) -> None:
        """Make a joint follow another, given their names in the model."""
        kind = mujoco.mjtEq.mjEQ_JOINT
        added = self._spec.add_equality(type=kind, name1=follower, name2=leader)
        added.data[:5] = mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0
        added.solref, added.solimp = self._hard.values()

    def _add_joint(self, new: Any, joint: Joint, axis: Vector, name: str) -> None:
        kind = mujoco.mjtJoint
        added = new.add_joint(axis=axis, frictionloss=joint.friction, armature=joint.armature)
        added.name = name
        added.type = kind.mjJNT_SLIDE if joint.unit == "m" else kind.mjJNT_HINGE
        added.damping, added.springref = (joint.damping, 0.0, 0.0), joint.rest
        added.stiffness = (joint.stiffness, 0.0, 0.0)
        if np.isfinite(joint.upper) and joint.mode != "velocity":
            added.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            added.range = joint.lower, joint.upper
        for option, value in self._hard.items():
            setattr(added, f"{option}_limit", value)
            setattr(added, f"{option}_friction", value)

    def _masks(self, place: int, movable: MovableBody) -> dict[str, int]:
        if self._parts.world.contacts == "static":
            own = 0 if movable.moves else _STATIC | _MOVING
            return {"contype": own, "conaffinity": _STATIC if movable.moves else 0}
        if movable.is_object or movable.self_collisions:
            return {"contype": _MOVING, "conaffinity": _ALL}
        if place + _OWN > 30:
            raise ModelError("MuJoCo has room for 29 robots. Use contacts='static' or 'none'.")
        own = 1 << place + _OWN
        return {"contype": own, "conaffinity": _ALL & ~own}

    # Shapes ---------------------------------------------------------------------------------

    def _add_static(self, static: Static, owner: int) -> None:
        what, world = static.what, self._spec.worldbody
        more: dict[str, Any] = {"contype": _STATIC | _MOVING, "conaffinity": 0}
        if isinstance(what, CollisionShape):
            turn = quaternion_of(to_matrix(static.orientation))
            frame = world.add_frame(pos=static.position, quat=turn)
            self._add_shape(world, what, owner, **more).set_frame(frame)
        elif isinstance(what, HeightField):
            self._add_heights(what, owner, **more)
        else:
            plane = what if isinstance(what, Ground) else Ground()
            quat, normal = np.zeros(4), np.array(plane.normal)
            mujoco.mju_quatZ2Vec(quat, normal)
            pose = {"size": (0.0, 0.0, 1.0), "pos": plane.height * normal, "quat": quat}
            kind = mujoco.mjtGeom.mjGEOM_PLANE
            self._add_geom(world, kind, owner, what.friction, **pose, **more)
            for center, size in what.boxes() if isinstance(what, Stairs) else ():
                pose = {"size": 0.5 * np.array(size), "pos": center}
                self._add_geom(world, _SHAPES["box"], owner, what.friction, **pose, **more)

    def _add_heights(self, field: HeightField, owner: int, **more: Any) -> None:
        (rows, columns), (x, y) = field.heights.T.shape, field.corner()
        low, high = float(field.heights.min()), float(field.heights.max())
        half = 0.5 * (np.array(field.heights.shape) - 1) * field.spacing
        added = self._spec.add_hfield(name="ground", nrow=rows, ncol=columns)
        added.size, added.userdata = (*half, max(high - low, 1e-9), _DEEP), field.heights.T.ravel()
        more |= {"pos": (x + half[0], y + half[1], low), "hfieldname": "ground"}
        kind = mujoco.mjtGeom.mjGEOM_HFIELD
        self._add_geom(self._spec.worldbody, kind, owner, field.friction, **more)

    def _add_shape(self, body: Any, shape: CollisionShape, owner: int, **more: Any) -> Any:
        more |= {"pos": shape.position, "quat": quaternion_of(shape.rotation)}
        if shape.mesh is not None:
            more["meshname"] = f"mesh {len(self._owners)}"
            vertices = read_vertices(shape.mesh, shape.size)
            self._spec.add_mesh(name=more["meshname"], uservert=vertices.ravel())
        else:  # MuJoCo takes half the edges and lengths, but full radii
            halves = 0.5 * np.array(shape.size)
            halves[0] *= 1 if shape.kind == "box" else 2
            more["size"] = [*halves, 0.0, 0.0][:3]
        return self._add_geom(body, _SHAPES[shape.kind], owner, shape.friction, **more)

    def _add_geom(self, body: Any, kind: Any, owner: int, friction: float, **more: Any) -> Any:
        more |= {"name": str(len(self._owners)), "friction": (float(friction), 0.0, 0.0)}
        self._owners.append(owner)
        priority = self._priorities[float(friction)]
        return body.add_geom(type=kind, condim=3, priority=priority, **self._hard, **more)


def _loaded(model: Any, movable: MovableBody, bodies: Index) -> LoadedRobot:
    """Return what MuJoCo holds of a robot or object, for `check_loaded`."""
    poses = _matrices(model.body_pos[bodies], model.body_quat[bodies])
    if not movable.fixed_base:
        poses[0] = np.eye(4)
    turns = _matrices(model.body_ipos[bodies], model.body_iquat[bodies])[:, :3, :3]
    inertia = np.einsum("nij,nj,nkj->nik", turns, model.body_inertia[bodies], turns)
    values = zip(model.body_mass[bodies], model.body_ipos[bodies], inertia, strict=True)
    moving = [body.joint is not None for body in movable.model.bodies]
    joints = model.body_jntadr[bodies[moving]]
    places = model.jnt_dofadr[joints]
    limits = {"damping": model.dof_damping[places], "friction": model.dof_frictionloss[places]}
    return LoadedRobot(
        poses,
        model.jnt_axis[joints],
        [LoadedBody((link,), *each) for link, each in enumerate(values)],
        limits,
    )


def _matrices(positions: Vector, quaternions: Vector) -> Vector:
    """Return poses, given as positions (n, 3) and quaternions w, x, y, z, as matrices (n, 4, 4)."""
    found = np.tile(np.eye(4), (len(positions), 1, 1))
    for pose, position, (w, x, y, z) in zip(found, positions, quaternions, strict=True):
        pose[:3, :3], pose[:3, 3] = to_matrix((x, y, z, w)), position
    return found


def quaternion_of(rotation: Vector) -> Vector:
    """Return the quaternion w, x, y, z of a rotation matrix."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, rotation.ravel())
    return found
