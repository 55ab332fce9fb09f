"""Equality constraints of MJCF files: couplings of joints, and attachments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from physx_core.rotations import from_matrix_rows
from physx_sim import Attachment, Connect, JointCoupling, Mimic, Weld
from physx_sim.engines.models.mjcf_file import MjcfFile, moved, pose_of


class Equalities:
    """What holds joints and links together.

    Attributes:
        mimics: How joints follow others.
        couplings: Joints that are locked or follow a second one, and fixed tendons of a constant
            length or ratio.
        attachments: What holds links together.
        left_out: What no engine is told.

    Args:
        file: The file.
        joints: The robot's joints.
        links: Names of the robot's links by body.
    """

    def __init__(self, file: MjcfFile, joints: Iterable[int], links: Mapping[int, str]) -> None:
        self._file, self._own, self._links = file, frozenset(joints), links
        self.mimics: dict[str, Mimic] = {}
        self.couplings: list[JointCoupling] = []
        self.attachments: list[Attachment] = []
        model, kinds = file.model, file.mujoco.mjtEq
        readers = {
            kinds.mjEQ_JOINT: self._joints,
            kinds.mjEQ_TENDON: self._tendons,
            kinds.mjEQ_CONNECT: self._bodies,
            kinds.mjEQ_WELD: self._bodies,
        }
        untold = 0
        for place in range(model.neq):
            read = readers.get(kinds(int(model.eq_type[place])))
            pair = [int(model.eq_obj1id[place]), int(model.eq_obj2id[place])]
            if not (model.eq_active0[place] and read and read(place, pair)):
                untold += 1
        what = f"equality constraints ({untold}: what they hold together is free)"
        self.left_out = [what] if untold else []

    def _joints(self, place: int, pair: list[int]) -> bool:
        """Read an equality of one or two joints; return whether it is linear and of this robot."""
        data = self._file.model.eq_data[place]
        first = self._length({pair[0]: 1.0})
        if pair[1] < 0 or not data[1:5].any():
            return self._couple({pair[0]: 1.0}, first + float(data[0]))
        if data[2:5].any() or not self._own.issuperset(pair):
            return False
        offset = first + float(data[0]) - float(data[1]) * self._length({pair[1]: 1.0})
        follower, leader = map(self._file.joint_name, pair)
        if follower in self.mimics:
            return self._couple({pair[0]: 1.0, pair[1]: -float(data[1])}, offset)
        self.mimics[follower] = Mimic(leader, float(data[1]), offset)
        return True

    def _tendons(self, place: int, pair: list[int]) -> bool:
        """Read an equality of one or two tendons; return whether it is one of joints, as above."""
        data = self._file.model.eq_data[place]
        ratio = 0.0 if pair[1] < 0 else float(data[1])
        if pair[1] >= 0 and data[2:5].any():
            return False
        found: dict[int, float] = {}
        for tendon, factor in ((pair[0], 1.0), (pair[1], -ratio)):
            joints = self._file.joints_of_tendon(tendon) if factor else {}
            if joints is None:
                return False
            for joint, coefficient in joints.items():
                found[joint] = found.get(joint, 0.0) + factor * coefficient
        found = {joint: coefficient for joint, coefficient in found.items() if coefficient}
        return self._couple(found, self._length(found) + float(data[0]))

    def _length(self, joints: Mapping[int, float]) -> float:
        """Return a sum of reference positions of joints, given their coefficients."""
        model = self._file.model
        return sum(x * float(model.qpos0[model.jnt_qposadr[each]]) for each, x in joints.items())

    def _couple(self, joints: Mapping[int, float], offset: float) -> bool:
        """Add a coupling of joints; return whether they are of this robot."""
        if not joints or not self._own.issuperset(joints):
            return False
        named = {self._file.joint_name(joint): x for joint, x in joints.items()}
        self.couplings.append(JointCoupling(named, offset))
        return True

    def _bodies(self, place: int, pair: list[int]) -> bool:
        """Read what holds two links together; return whether both are of this robot."""
        found = _attachment(self._file, self._links, place, pair)
        self.attachments += [] if found is None else [found]
        return found is not None


def _attachment(
    file: MjcfFile, links: Mapping[int, str], place: int, pair: list[int]
) -> Attachment | None:
    """Return what holds two links together; None if one of them is not of this robot."""
    model, data = file.model, file.model.eq_data[place]
    weld = model.eq_type[place] == file.mujoco.mjtEq.mjEQ_WELD
    if model.eq_objtype[place] == file.mujoco.mjtObj.mjOBJ_SITE:
        first, second = (pose_of(model.site_pos[site], model.site_quat[site]) for site in pair)
        pair = [int(model.site_bodyid[site]) for site in pair]
    elif weld:
        first, second = pose_of(data[3:6], data[6:10]), moved(data[:3])
    else:
        first, second = moved(data[:3]), moved(data[3:6])
    if not set(pair) <= links.keys():
        return None
    one, other = (links[body] for body in pair)
    if not weld:
        return Connect(one, other, tuple(first[:3, 3].tolist()), tuple(second[:3, 3].tolist()))
    held = first @ np.linalg.inv(second)
    turn = from_matrix_rows(held[None, :3, :3])[0]
    return Weld(one, other, tuple(held[:3, 3].tolist()), tuple(turn.tolist()))
