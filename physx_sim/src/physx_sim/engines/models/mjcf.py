"""Robot models from MJCF files.

MuJoCo compiles the file, and what physx simulates is read from the result: defaults, classes,
inertias from shapes and the like are then what MuJoCo makes of them. A body with several joints
becomes a chain of links, of which all but the last have no mass and are named after their joint;
one whose last joint is not at its origin is fixed to such a link. What no engine is told, such as
actuators, is named in the model's warnings.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.errors import listed
from physx_core.rotations import from_axis_angle, to_matrix
from physx_core.typing import Vector
from physx_sim import JointSettings, Robot
from physx_sim.engines.models.mjcf_equalities import Equalities
from physx_sim.engines.models.mjcf_file import WORLD, MjcfFile, moved, pose_of
from physx_sim.engines.models.rigid_bodies import Joint, RigidBody
from physx_sim.engines.models.robot_model import RobotModel, check_names, coupled
from physx_sim.engines.models.shapes import CollisionShape, material_of, shape_of_foot, simplified
from physx_sim.errors import ModelError

_NO_MASS = 0.0, np.zeros(3), np.zeros((3, 3))


def mjcf_robots(path: str | Path, **options: Any) -> tuple[Robot, ...]:
    """Return the robots of an MJCF file, where they are in the file.

    Args:
        path: The file.
        options: Options of all robots, as in `Robot`.

    Returns:
        A robot that consists of everything attached to the world, named ``world``, if any of it can
        move or touch; then one for each body with a free joint, named after the body.

    Raises:
        ModelError: If MuJoCo cannot compile the file, or the package mujoco is not installed.
    """
    file = MjcfFile(Path(path).absolute())
    found = []
    if file.attached or file.solid(0):
        found.append(Robot(path, WORLD, **{"root": WORLD, **options}))
    for body in file.floating:
        pose = {"position": file.model.body_pos[body].tolist()}
        w, x, y, z = file.model.body_quat[body].tolist()
        pose["orientation"] = [x, y, z, w]
        name = file.body_name(body)
        found.append(Robot(path, name, **{"root": name, "fixed_base": False, **pose, **options}))
    return tuple(found)


def read_mjcf(robot: Robot, path: Path, *, touching: bool) -> RobotModel:
    """Read a robot's MJCF file.

    Args:
        robot: The robot's description.
        path: Its file.
        touching: Whether to read its collision shapes.
    """
    file = MjcfFile(path)
    root = file.root(robot)
    links = _Links(file, robot, root)
    names = [body.name for body in links.found]
    joints = [body.joint.name for body in links.found if body.joint is not None]
    for kind, known in (("links", names), ("joints", joints)):
        if len(set(known)) < len(known):
            raise ModelError(f"its {kind} need different names, but are called {listed(known)}")
    check_names(robot, names, joints)
    shapes = _Shapes(file, robot, list(links.places))
    by_body = {body: names[place] for body, place in links.places.items()}
    equalities = Equalities(file, links.joints, by_body)
    left_out = [*_left_out(file, links), *equalities.left_out, *shapes.left_out]
    if robot.fixed_base and root in file.floating:
        left_out.append("the free joint of its root body (fixed_base=False lets it float)")
    warnings = (f"physx leaves out {'; '.join(left_out)}",) if left_out else ()
    solid = tuple(shapes.found if touching else ())
    attachments = tuple(equalities.attachments)
    model = RobotModel(path, tuple(links.found), solid, warnings, attachments)
    return coupled(robot, model, equalities.mimics, equalities.couplings)


class _Links:
    """The links of a robot.

    Attributes:
        found: The links, parents before children.
        places: The link of each body, as an index.
        joints: The file's joints.
    """

    def __init__(self, file: MjcfFile, robot: Robot, root: int) -> None:
        self._file, self._robot = file, robot
        name = WORLD if root == 0 else file.body_name(root)
        inertia = _NO_MASS if root == 0 else self._inertia(root)
        self.found = [RigidBody(name, -1, np.eye(4), None, np.zeros(3), *inertia)]
        self.places = {root: 0}
        self.joints: list[int] = []
        apart = set(file.floating)
        for body in range(1, file.model.nbody):
            parent = int(file.model.body_parentid[body])
            if body != root and parent in self.places and body not in apart:
                self._add(body, self.places[parent])

    def _add(self, body: int, parent: int) -> None:
        model, name = self._file.model, self._file.body_name(body)
        pose = pose_of(model.body_pos[body], model.body_quat[body])
        anchor, inertia = np.zeros(3), self._inertia(body)
        joints = self._file.joints(body)
        for number in joints:
            joint, axis = self._joint(number), model.jnt_axis[number].copy()
            here = model.jnt_pos[number]
            pose = pose @ moved(here - anchor) @ self._reference(number, joint.unit, axis)
            anchor = here
            last = number == joints[-1] and not anchor.any()
            mass, link = (inertia, name) if last else (_NO_MASS, f"{name}.{joint.name}")
            parent = self._append(RigidBody(link, parent, pose, joint, axis, *mass))
            pose = np.eye(4)
        if not joints or anchor.any():
            still = RigidBody(name, parent, pose @ moved(-anchor), None, np.zeros(3), *inertia)
            parent = self._append(still)
        self.places[body] = parent
        self.joints += joints

    def _append(self, link: RigidBody) -> int:
        self.found.append(link)
        return len(self.found) - 1

    def _inertia(self, body: int) -> tuple[float, Vector, Vector]:
        """Return mass, center of mass and moments of inertia of a body in its own frame."""
        model = self._file.model
        factor = float(self._robot.mass_factors.get(self._file.body_name(body), 1.0))
        turn = pose_of(np.zeros(3), model.body_iquat[body])[:3, :3]
        moments = factor * (turn * model.body_inertia[body]) @ turn.T
        return factor * float(model.body_mass[body]), model.body_ipos[body].copy(), moments

    def _reference(self, joint: int, unit: str, axis: Vector) -> Vector:
        """Return the joint's motion from its reference position to 0."""
        model = self._file.model
        back = -float(model.qpos0[model.jnt_qposadr[joint]])
        if unit == "m":
            return moved(back * axis)
        found = np.eye(4)
        found[:3, :3] = to_matrix(from_axis_angle(axis.tolist(), back))
        return found

    def _joint(self, joint: int) -> Joint:
        model, kinds = self._file.model, self._file.mujoco.mjtJoint
        name = self._file.joint_name(joint)
        kind, place = kinds(int(model.jnt_type[joint])), model.jnt_dofadr[joint]
        if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
            raise ModelError(f'joint "{name}" is a ball, which is not supported: use three hinges')
        settings = self._robot.joints.get(name, JointSettings())
        lower, upper = model.jnt_range[joint].tolist()
        limited = bool(model.jnt_limited[joint])
        strongest = np.inf
        if model.jnt_actfrclimited[joint]:
            strongest = float(np.abs(model.jnt_actfrcrange[joint]).max())
        return Joint(
            name,
            lower if limited else -np.inf,
            upper if limited else np.inf,
            np.inf,
            strongest,
            settings.mode,
            settings.gain,
            "m" if kind == kinds.mjJNT_SLIDE else "rad",
            **settings.resistance(
                damping=float(model.dof_damping[place]),
                friction=float(model.dof_frictionloss[place]),
                stiffness=float(model.jnt_stiffness[joint]),
                rest=float(model.qpos_spring[model.jnt_qposadr[joint]]),
                armature=float(model.dof_armature[place]),
            ),
            mimic=None,
        )


class _Shapes:
    """The collision shapes of bodies.

    Attributes:
        found: The shapes.
        left_out: What no engine is told.
    """

    def __init__(self, file: MjcfFile, robot: Robot, bodies: list[int]) -> None:
        self._file, self._robot = file, robot
        self.found: list[CollisionShape] = []
        self._odd: dict[str, int] = {}
        for body in bodies:
            name = WORLD if body == 0 else file.body_name(body)
            if name in robot.feet:
                self.found.append(shape_of_foot(robot, name))
            elif robot.collisions != "none":
                shapes = [self._shape(geom, name) for geom in file.solid(body)]
                self.found += [shape for shape in shapes if shape is not None]
        self.left_out = [f"{what} ({count})" for what, count in self._odd.items()]

    def _shape(self, geom: int, link: str) -> CollisionShape | None:
        model, kinds = self._file.model, self._file.mujoco.mjtGeom
        kind = kinds(int(model.geom_type[geom]))
        size, pose = model.geom_size[geom], pose_of(model.geom_pos[geom], model.geom_quat[geom])
        found: tuple[float, ...]
        mesh = None
        if kind == kinds.mjGEOM_BOX:
            name, found = "box", tuple((2 * size).tolist())
        elif kind == kinds.mjGEOM_SPHERE:
            name, found = "sphere", (float(size[0]),)
        elif kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            name = "capsule" if kind == kinds.mjGEOM_CAPSULE else "cylinder"
            found = float(size[0]), 2 * float(size[1])
        elif kind == kinds.mjGEOM_ELLIPSOID:
            name, found, turn = _capsule_of(size)
            pose[:3, :3] = pose[:3, :3] @ turn
            self._count("the form of ellipsoids, now capsules of their length and mean width")
        elif kind == kinds.mjGEOM_MESH:
            mesh, found, offset = self._mesh(int(model.geom_dataid[geom]))
            name, pose = "mesh", pose @ offset
        if kind == kinds.mjGEOM_MESH and mesh is None:
            self._count("collision meshes that are not in a file")
        elif kind in (kinds.mjGEOM_HFIELD, kinds.mjGEOM_SDF):
            self._count("height fields and distance fields: use World(ground=HeightField(...))")
        else:
            place = pose[:3, 3].copy(), pose[:3, :3].copy()
            material = self._material(geom)
            shape = CollisionShape(name, found, *place, link, mesh=mesh, **material)
            return simplified(shape, self._robot.collisions)
        return None

    def _material(self, geom: int) -> dict[str, Any]:
        """Return what a geom is made of; its ``condim`` says which kinds of friction it has."""
        kinds = ("friction", "torsional_friction", "rolling_friction")
        count = {4: 2, 6: 3}.get(int(self._file.model.geom_condim[geom]), 1)
        values = self._file.model.geom_friction[geom].tolist()
        return material_of(self._robot, **dict(zip(kinds[:count], values, strict=False)))

    def _count(self, what: str) -> None:
        self._odd[what] = self._odd.get(what, 0) + 1

    def _mesh(self, mesh: int) -> tuple[Path | None, tuple[float, ...], Vector]:
        """Return file and scale of a mesh, and its frame's pose before MuJoCo centered it."""
        model = self._file.model
        names = bytes(model.paths)
        begin = int(model.mesh_pathadr[mesh])
        centered = pose_of(model.mesh_pos[mesh], model.mesh_quat[mesh])
        offset: Vector = np.asarray(np.linalg.inv(centered), np.float64)
        if begin < 0:
            return None, (1.0, 1.0, 1.0), offset
        name = names[begin : names.index(b"\0", begin)].decode()
        path = self._file.path.parent / name
        return path, tuple(model.mesh_scale[mesh].tolist()), offset


def _left_out(file: MjcfFile, links: _Links) -> Iterator[str]:
    """Yield what of a file no engine is told, and what that changes."""
    model, option = file.model, file.model.opt
    acting = model.tendon_limited | model.tendon_actfrclimited
    for forces in ("stiffness", "damping", "frictionloss", "armature"):
        acting = acting | (getattr(model, f"tendon_{forces}") != 0)
    for count, what, effect in (
        (model.nu, "actuators", "command the joints, with JointSettings or Motors"),
        (int(acting.sum()), "tendons", "neither their forces nor their limits act"),
        (model.npair + model.nexclude, "contact pairs", "Robot(self_collisions=...) decides"),
        (model.nflex, "deformable bodies", "they are missing"),
        (model.nplugin, "plugins", "they do not run"),
        (model.nmocap, "mocap bodies", "they stand still"),
    ):
        if count:
            yield f"{what} ({count}: {effect})"
    joints = links.joints
    places = model.jnt_dofadr[joints]
    uneven = model.jnt_actfrclimited[joints] & (model.jnt_actfrcrange[joints].sum(axis=1) != 0)
    solid = [geom for body in links.places for geom in file.solid(body)]
    for found, what in (
        (option.density or option.viscosity, "the fluid (there is no drag)"),
        (model.ngravcomp, "gravity compensation"),
        (option.disableflags, "flags that switch parts of the physics off"),
        (model.jnt_stiffnesspoly[joints].any(), "the nonlinear part of springs"),
        (model.dof_dampingpoly[places].any(), "the nonlinear part of dampers"),
        (model.jnt_springyield[joints].any(), "springs that yield"),
        (uneven.any(), "that torques have a smaller limit in one direction"),
        ((model.geom_condim[solid] < 3).any(), "that some contacts have no friction (condim 1)"),
        (model.geom_margin[solid].any(), "margins of contacts"),
    ):
        if found:
            yield what
    if not np.allclose(option.gravity, (0.0, 0.0, -9.81)):
        yield f"the gravity (World(gravity={tuple(option.gravity.tolist())}))"
    planes = [geom for geom in file.geoms(0) if geom not in file.solid(0)]
    if (0 not in links.places and len(file.geoms(0))) or planes:
        yield "what is fixed to the world (World(ground=..., objects=...))"


def _capsule_of(size: Vector) -> tuple[str, tuple[float, ...], Vector]:
    """Return a capsule in the place of an ellipsoid with given semi-axes, and its axes."""
    longest = int(np.argmax(size))
    across = np.delete(size, longest)
    radius = float(np.sqrt(across.prod()))
    length = 2 * max(float(size[longest]) - radius, 0.0)
    axes = np.roll(np.eye(3), 2 - longest, axis=1)
    return ("capsule", (radius, length), axes) if length > 0 else ("sphere", (radius,), axes)
