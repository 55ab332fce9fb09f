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
from physx_sim import Ground, HeightField, Stairs
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
LAG = 2 * _STEPS * _DAMPING**2 + 1
"""Steps of a motion, by which a contact lags behind what pushes it: damping by stiffness, and the
step itself."""
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
        made: For each shape of the model, its number in the order in which they were added.
        statics: The model's body for each static body.
        spare: Equality constraints for attachments.
    """

    model: Any
    bodies: Index
    owners: Index
    made: Index
    statics: Index
    spare: range

    def write_masses(self, parts: Parts) -> None:
        """Write the masses and moments of inertia of all links and objects."""
        model, at = self.model, self.bodies
        links = [body for movable in parts.movables for body in movable.model.bodies]
        model.body_mass[at] = [body.mass for body in links]
        model.body_inertia[at] = [np.linalg.eigh(body.inertia)[0] for body in links]

    def derive(self) -> None:
        """Compute what MuJoCo derives from what was written, also from which shapes may touch."""
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def write_frictions(self, parts: Parts) -> None:
        """Write the coefficients of friction of all shapes.

        Of two shapes, MuJoCo uses all friction of the one with the higher priority, or the larger
        of equal ones.
        """
        whats: list[Any] = [s for movable in parts.movables for s in movable.model.shapes]
        for owner, static in enumerate(parts.statics, len(self.bodies)):
            whats += [static.what] * int((self.owners == owner).sum())
        found = [(x.friction, x.torsional_friction, x.rolling_friction) for x in whats]
        ranks = {mu: rank for rank, mu in enumerate(sorted({mu for mu, *_ in found}, reverse=True))}
        self.model.geom_friction[:] = np.array(found)[self.made]
        turning = self.model.geom_friction[:, 1:]
        dimensions = np.select([turning[:, 1] > 0, turning[:, 0] > 0], [6, 4], 3)
        # All contacts have as many if `ContactRows` changes their coefficients.
        self.model.geom_condim[:] = dimensions.max() if len(ranks) > 1 else dimensions
        self.model.geom_priority[:] = np.array([ranks[mu] for mu, *_ in found], int)[self.made]

    def write_heights(self, parts: Parts) -> None:
        """Write the heights of the ground."""
        other = ModelBuilder(parts).ground_alone()
        (mine,) = (self.model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD).nonzero()[0]
        (its,) = (other.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD).nonzero()[0]
        for name in ("geom_pos", "geom_size", "geom_aabb", "geom_rbound"):
            getattr(self.model, name)[mine] = getattr(other, name)[its]
        trees = [(self.model, self.model.geom_bodyid[mine]), (other, other.geom_bodyid[its])]
        to, source = (
            model.bvh_aabb[model.body_bvhadr[body] :][: model.body_bvhnum[body]]
            for model, body in trees
        )
        to[:] = source
        self.model.hfield_size[:], self.model.hfield_data[:] = other.hfield_size, other.hfield_data


class ModelBuilder:
    """Builds a `WorldModel` from the parts of a world."""

    def __init__(self, parts: Parts) -> None:
        self._parts, self._spec = parts, mujoco.MjSpec()
        self._spec.compiler.degree = False
        self._hard = {"solref": (_STEPS * parts.world.period, _DAMPING), "solimp": _IMPEDANCE}
        self._count = 0
        self._owners: list[int] = []

    def build(self) -> WorldModel:
        """Return the model, with MuJoCo's default options."""
        for place, movable in enumerate(self._parts.movables):
            self._add_movable(place, movable)
        count, touching = self._count, self._parts.world.contacts != "none"
        statics = self._parts.statics if touching else ()
        for place, static in enumerate(statics):
            self._add_static(static, place, count)
        coupled, spare = len(self._spec.equalities), len(self._parts.attachments) + SPARE
        for _ in range(spare):
            kind, body = mujoco.mjtEq.mjEQ_WELD, mujoco.mjtObj.mjOBJ_BODY
            added = self._spec.add_equality(type=kind, objtype=body, name1="0", name2="world")
            added.active, added.solref, added.solimp = False, *self._hard.values()
        model = self._compile()
        bodies = np.array([model.body(str(place)).id for place in range(count)], np.intp)
        made = np.array([int(model.geom(i).name) for i in range(model.ngeom)], np.intp)
        names = [f"static {place}" for place in range(len(statics))]
        world = WorldModel(
            model,
            bodies,
            np.array(self._owners, np.intp)[made],
            made,
            np.array([model.body(name).id for name in names], np.intp),
            range(coupled, coupled + spare),
        )
        world.write_masses(self._parts)
        if len(made):
            world.write_frictions(self._parts)
        world.derive()
        first = 0
        for movable in self._parts.movables:
            last = first + len(movable.model.links)
            check_loaded("mujoco", movable, _loaded(model, movable, bodies[first:last]))
            first = last
        return world

    def ground_alone(self) -> Any:
        """Return a model of the ground without anything else."""
        self._add_static(self._parts.statics[0], 0, 0)
        return self._compile()

    def _compile(self) -> Any:
        try:
            return self._spec.compile()
        except ValueError as error:
            raise ModelError(f"MuJoCo cannot load this world: {error}.") from error

    # Robots and objects ---------------------------------------------------------------------

    def _add_movable(self, place: int, movable: MovableBody) -> None:
        added: list[Any] = []
        first = self._count
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
        self._couple(place, movable)
        masks = self._masks(place, movable)
        for shape in movable.model.shapes:
            link = 0 if movable.is_object else movable.model.links.index(shape.body)
            self._add_shape(added[link], shape, first + link, **masks)

    def _add_body(self, parent: Any, body: RigidBody, position: Vector, turn: Vector) -> Any:
        """Add a link; its mass, which may be 0, and its moments of inertia are set later."""
        new = parent.add_body(name=str(self._count), pos=position, quat=quaternion_of(turn))
        _, axes = np.linalg.eigh(body.inertia)
        axes[:, 2] *= np.linalg.det(axes)  # a rotation, not a reflection
        new.explicitinertial, new.mass, new.inertia = True, 1.0, (1.0, 1.0, 1.0)
        new.ipos, new.iquat = body.center, quaternion_of(axes)
        self._count += 1
        return new

    def _couple(self, place: int, movable: MovableBody) -> None:
        """Couple joints: a tendon has the length of a sum of their positions."""
        for number, (row, length) in enumerate(zip(*movable.model.coupling_rows, strict=True)):
            tendon = self._spec.add_tendon(name=f"{place} {number}")
            for joint in np.flatnonzero(row):
                tendon.wrap_joint(f"{place} {movable.model.joints[joint].name}", row[joint])
            kind = mujoco.mjtEq.mjEQ_TENDON
            added = self._spec.add_equality(type=kind, name1=tendon.name)
            added.data[:5] = length, 0.0, 0.0, 0.0, 0.0
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

    def _add_static(self, static: Static, place: int, first: int) -> None:
        """Add an object or the ground; the index of its owner counts from `first`."""
        what, owner = static.what, first + place
        body = self._spec.worldbody.add_body(name=f"static {place}")
        body.explicitinertial, body.mass, body.inertia = True, 1.0, (1.0, 1.0, 1.0)
        more: dict[str, Any] = {"contype": _STATIC | _MOVING, "conaffinity": 0}
        if isinstance(what, CollisionShape):
            body.mocap, body.pos = True, static.position
            body.quat = quaternion_of(to_matrix(static.orientation))
            self._add_shape(body, what, owner, **more)
        elif isinstance(what, HeightField):
            self._add_heights(body, what, owner, **more)
        else:
            plane = what if isinstance(what, Ground) else Ground()
            quat, normal = np.zeros(4), np.array(plane.normal)
            mujoco.mju_quatZ2Vec(quat, normal)
            pose = {"size": (0.0, 0.0, 1.0), "pos": plane.height * normal, "quat": quat}
            self._add_geom(body, mujoco.mjtGeom.mjGEOM_PLANE, owner, **pose, **more)
            for center, size in what.boxes() if isinstance(what, Stairs) else ():
                pose = {"size": 0.5 * np.array(size), "pos": center}
                self._add_geom(body, _SHAPES["box"], owner, **pose, **more)

    def _add_heights(self, body: Any, field: HeightField, owner: int, **more: Any) -> None:
        (rows, columns), (x, y) = field.heights.T.shape, field.corner()
        low, high = float(field.heights.min()), float(field.heights.max())
        half = 0.5 * (np.array(field.heights.shape) - 1) * field.spacing
        added = self._spec.add_hfield(name="ground", nrow=rows, ncol=columns)
        added.size, added.userdata = (*half, max(high - low, 1e-9), _DEEP), field.heights.T.ravel()
        more |= {"pos": (x + half[0], y + half[1], low), "hfieldname": "ground"}
        self._add_geom(body, mujoco.mjtGeom.mjGEOM_HFIELD, owner, **more)

    def _add_shape(self, body: Any, shape: CollisionShape, owner: int, **more: Any) -> None:
        more |= {"pos": shape.position, "quat": quaternion_of(shape.rotation)}
        if shape.mesh is not None:
            more["meshname"] = f"mesh {len(self._owners)}"
            vertices = read_vertices(shape.mesh, shape.size)
            self._spec.add_mesh(name=more["meshname"], uservert=vertices.ravel())
        else:  # MuJoCo takes half the edges and lengths, but full radii
            halves = 0.5 * np.array(shape.size)
            halves[0] *= 1 if shape.kind == "box" else 2
            more["size"] = [*halves, 0.0, 0.0][:3]
        self._add_geom(body, _SHAPES[shape.kind], owner, **more)

    def _add_geom(self, body: Any, kind: Any, owner: int, **more: Any) -> None:
        """Add a shape, without friction."""
        more |= {"name": str(len(self._owners)), "friction": (0.0, 0.0, 0.0)}
        self._owners.append(owner)
        body.add_geom(type=kind, condim=3, **self._hard, **more)


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
