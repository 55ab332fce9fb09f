"""URDF text of a robot model, for viewers, which draw no other robot files."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from physx_core.rotations import from_matrix_rows, to_roll_pitch_yaw
from physx_core.typing import Vector
from physx_sim.engines.models.robot_model import RobotModel
from physx_sim.engines.models.shapes import CollisionShape

_SIZES = {
    "box": '<box size="{} {} {}"/>',
    "sphere": '<sphere radius="{}"/>',
    "capsule": '<capsule radius="{}" length="{}"/>',
    "cylinder": '<cylinder radius="{}" length="{}"/>',
}


def to_urdf(model: RobotModel) -> str:
    """Return a URDF file with a robot's links, fixed to each other, and its collision shapes."""
    parts = ['<robot name="robot">']
    for body in model.bodies:
        parts.append(f"<link name={quoteattr(body.name)}>")
        parts += [_visual(shape) for shape in model.shapes if shape.body == body.name]
        parts.append("</link>")
        if body.parent >= 0:
            parts.append(
                f'<joint name={quoteattr(body.name)} type="fixed">'
                f"{_origin(body.pose[:3, 3], body.pose[:3, :3])}"
                f"<parent link={quoteattr(model.links[body.parent])}/>"
                f"<child link={quoteattr(body.name)}/></joint>"
            )
    return "".join([*parts, "</robot>"])


def _visual(shape: CollisionShape) -> str:
    if shape.mesh is not None:
        scale = _text(*shape.size)
        kind = f'<mesh filename={quoteattr(str(shape.mesh))} scale="{scale}"/>'
    else:
        kind = _SIZES[shape.kind].format(*shape.size)
    pose = _origin(shape.position, shape.rotation)
    return f"<visual>{pose}<geometry>{kind}</geometry></visual>"


def _origin(position: Vector, rotation: Vector) -> str:
    angles = to_roll_pitch_yaw(from_matrix_rows(rotation[None])[0].tolist())
    return f'<origin xyz="{_text(*position)}" rpy="{_text(*angles)}"/>'


def _text(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)
