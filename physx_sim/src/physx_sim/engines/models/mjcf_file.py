"""MJCF files as MuJoCo compiles them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.errors import listed, nearest
from physx_core.files import read_content
from physx_core.origin import install_hint
from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim import Robot
from physx_sim.errors import ModelError

WORLD = "world"
"""Root link of what is attached to the world."""
_LARGEST = 2**24
"""Maximum size of a file, in bytes, without those that it includes."""
_MOST = 400
"""Maximum number of bodies, as of links in a URDF file."""
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_ELEMENT = re.compile(rb"<([A-Za-z][\w:.-]*)")


def is_mjcf(path: Path) -> bool:
    """Return whether a file's root element is ``mujoco``; a missing file is none."""
    try:
        text = read_content(path.resolve(), _LARGEST)
    except OSError:
        return False
    first = _ELEMENT.search(_COMMENT.sub(b"", text))
    return first is not None and first[1] == b"mujoco"


class MjcfFile:
    """A compiled file.

    Attributes:
        mujoco: The package.
        model: MuJoCo's model.
        floating: Bodies with a free joint.
        attached: Other bodies whose parent is the world.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.mujoco = path, _mujoco()
        log = self.mujoco.MjLogConfig.get()
        log.logto_file = log.logto_console = False
        log.set()
        try:
            self.model: Any = self.mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise ModelError(f"MuJoCo cannot read {path}: {error}") from error
        if self.model.nbody > _MOST + 1:
            raise ModelError(f"{path} has {self.model.nbody - 1} bodies; a model may have {_MOST}")
        model, free = self.model, int(self.mujoco.mjtJoint.mjJNT_FREE)
        roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
        self.floating = [b for b in roots if [*model.jnt_type[self.joints(b)]] == [free]]
        self.attached = [body for body in roots if body not in self.floating]

    def joints(self, body: int) -> range:
        """Return the joints of a body."""
        first = int(self.model.body_jntadr[body])
        return range(first, first + int(self.model.body_jntnum[body]))

    def geoms(self, body: int) -> range:
        """Return the geoms of a body."""
        first = int(self.model.body_geomadr[body])
        return range(first, first + int(self.model.body_geomnum[body]))

    def solid(self, body: int) -> list[int]:
        """Return the geoms of a body that can touch, without planes."""
        model, plane = self.model, int(self.mujoco.mjtGeom.mjGEOM_PLANE)
        return [
            geom
            for geom in self.geoms(body)
            if (model.geom_contype[geom] or model.geom_conaffinity[geom])
            and model.geom_type[geom] != plane
        ]

    def joints_of_tendon(self, tendon: int) -> dict[int, float] | None:
        """Return the coefficients of the joints in a fixed tendon; None: it is a spatial one."""
        model = self.model
        first = int(model.tendon_adr[tendon])
        wraps = slice(first, first + int(model.tendon_num[tendon]))
        if (model.wrap_type[wraps] != self.mujoco.mjtWrap.mjWRAP_JOINT).any():
            return None
        found: dict[int, float] = {}
        pairs = zip(model.wrap_objid[wraps].tolist(), model.wrap_prm[wraps].tolist(), strict=True)
        for joint, coefficient in pairs:
            found[joint] = found.get(joint, 0.0) + coefficient
        return found

    def body_name(self, body: int) -> str:
        """Return the name of a body, or its number if it has none."""
        return str(self.model.body(body).name) or f"body{body}"

    def joint_name(self, joint: int) -> str:
        """Return the name of a joint, or its number if it has none."""
        return str(self.model.joint(joint).name) or f"joint{joint}"

    def root(self, robot: Robot) -> int:
        """Return the body that is a robot's root link; 0: the world."""
        names = {self.body_name(body): body for body in self.floating}
        trees = len(names) + bool(self.attached)
        names |= {WORLD: 0} if self.attached or self.solid(0) or not names else {}
        if not robot.root and trees > 1:
            raise ModelError(
                f"it has several trees: choose one with Robot(root=...), or take all with "
                f"mjcf_robots(...). Roots: {listed(names)}"
            )
        if robot.root and robot.root not in names:
            near = nearest(robot.root, names)
            raise ModelError(f'no tree has the root "{robot.root}".{near} Roots: {listed(names)}')
        root = names[robot.root] if robot.root else next(iter(names.values()))
        if root == 0 and not robot.fixed_base:
            alone = self.attached if len(self.attached) == 1 else []
            if not alone or len(self.joints(alone[0])):
                raise ModelError(
                    "its root link is the world, which cannot float; use fixed_base=True"
                )
            root = alone[0]
        return root


def pose_of(position: Vector, quaternion: Vector) -> Vector:
    """Return a pose with MuJoCo's quaternion w, x, y, z as a homogeneous matrix (4, 4)."""
    w, x, y, z = quaternion.tolist()
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = to_matrix((x, y, z, w)), position
    return found


def moved(motion: Vector) -> Vector:
    """Return a motion without a turn as a homogeneous matrix (4, 4)."""
    found = np.eye(4)
    found[:3, 3] = motion
    return found


def _mujoco() -> Any:
    try:
        import mujoco  # only MJCF files need it
    except ImportError as error:
        raise ModelError(
            f"MJCF files are compiled by the package mujoco, which cannot be imported: {error}. "
            f"{install_hint('physx-sim', 'mjcf')}"
        ) from error
    return mujoco
