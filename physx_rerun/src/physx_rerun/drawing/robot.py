"""Draws robots: the visual shapes of a URDF, each attached to the frame of its link."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import rerun as rr

from physx_core.errors import MissingLibraryError, VisualizerError
from physx_core.rotations import from_matrix_rows, rotate_rows
from physx_core.typing import Array
from physx_rerun.drawing import colors
from physx_rerun.drawing.chunks import ChunkBuilder, Times
from physx_rerun.drawing.meshes import corners_of_mesh
from physx_rerun.drawing.triangles import SimpleMesh, simple_mesh

if TYPE_CHECKING:
    from physx_sim import VisualModel, VisualShape

MESH_TYPES = {
    ".dae": "model/vnd.collada+xml",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".obj": "model/obj",
    ".stl": "model/stl",
}
"""Mesh files that Rerun can draw, by suffix, and their media types."""

_SILVER = (0.75, 0.78, 0.81, 1.0)

DrawnShape: TypeAlias = "tuple[str, VisualShape]"
"""Entity of a shape, and the shape."""


def draw_robot(
    rows: ChunkBuilder,
    entity: str,
    values: dict[str, Any],
    frames: Sequence[str],
    world: str,
    resolution: float | None = None,
) -> tuple[list[DrawnShape], Array]:
    """Draw the visual shapes of a robot; warn of mesh files that do not exist.

    Args:
        rows: Collects the rows.
        entity: Path of the robot's entity.
        values: Options of the robot; ``simple`` is set to simplified meshes' colors by entity.
        frames: Names of the bodies' frames.
        world: Name of the frame of shapes without a body.
        resolution: Size of the robot divided by that of its smallest details to draw; None: draw
            meshes unmodified.

    Returns:
        The shapes drawn, and the bodies' poses with all joints at zero, shape (bodies, 7).
    """
    model = read_model(values)
    if model.missing:
        warnings.warn(
            f"{len(model.missing)} meshes of {values['urdf']} are not drawn: Rerun found no mesh "
            f"file {model.missing[0]}. Set the folder of each package in package_dirs.",
            stacklevel=2,
        )
    drawn = []
    detail = None if resolution is None else _extent(model) / resolution
    for shape in model.shapes:
        path = f"{entity}/{rr.escape_entity_path_part(shape.name)}"
        frame = world if shape.body is None else frames[shape.body]
        simple = _simplified(shape, detail)
        if simple is not None:
            values.setdefault("simple", {})[path] = colors.pack_rgba(simple.colors)
        rows.add_static(path, rr.CoordinateFrame(frame), _geometry(shape, simple))
        drawn.append((path, shape))
    return drawn, model.rest


def read_model(values: Mapping[str, Any]) -> VisualModel:
    """Read the robot's URDF file."""
    try:
        from physx_sim import read_visuals
        from physx_sim.errors import ModelError
    except ModuleNotFoundError as error:
        raise MissingLibraryError(
            "Drawing a robot", "physx-sim", "robots", "physx-rerun"
        ) from error
    urdf, packages = values["urdf"], values.get("package_dirs") or {}
    try:
        return read_visuals(urdf, values["bodies"], packages, MESH_TYPES)
    except ModelError as error:
        raise VisualizerError(f"The robot {urdf} cannot be drawn: {error}.") from error


def place_shapes(
    rows: ChunkBuilder, shapes: Sequence[DrawnShape], times: Times, *, is_visible: bool
) -> None:
    """Place a robot's shapes in the frames of their bodies; hidden shapes are scaled to zero."""
    for path, shape in shapes:
        scale = shape.size if shape.kind == "mesh" else (1.0, 1.0, 1.0)
        rows.add(
            path,
            rr.InstancePoses3D,
            times,
            translations=_center(shape)[np.newaxis],
            quaternions=from_matrix_rows(shape.pose[np.newaxis, :3, :3]),
            scales=np.array([scale if is_visible else (0.0, 0.0, 0.0)]),
        )


def tint_robot(
    rows: ChunkBuilder, shapes: Sequence[DrawnShape], values: dict[str, Any], times: Times
) -> None:
    """Set the color and opacity of a robot's shapes, by default those of the URDF.

    Args:
        rows: Collects the rows.
        shapes: The shapes.
        values: The robot's values.
        times: Time of the change.
    """
    color, alpha = values.get("color"), values.get("alpha")
    for path, shape in shapes:
        own = shape.color
        file_colors = values.get("simple", {}).get(path)
        if color is None and alpha is None and own is None and shape.kind == "mesh":
            if file_colors is not None:
                rows.add(path, rr.Mesh3D, times, vertex_colors=file_colors)
            continue
        if color is not None:
            tint = colors.rgba(color, 1.0 if alpha is None else alpha)
        else:
            default = (1.0, 1.0, 1.0, 1.0) if shape.kind == "mesh" else _SILVER
            red, green, blue, opacity = own or default
            tint = colors.rgba((red, green, blue), opacity if alpha is None else alpha)
        if file_colors is not None:  # replaced by the tint
            rows.add(path, rr.Mesh3D, times, albedo_factor=tint, vertex_colors=file_colors[:0])
            continue
        archetype, option = _LOOKS[shape.kind]
        rows.add(path, archetype, times, **{option: tint})


_LOOKS: dict[str, tuple[type[Any], str]] = {
    "mesh": (rr.Asset3D, "albedo_factor"),
    "box": (rr.Boxes3D, "colors"),
    "cylinder": (rr.Cylinders3D, "colors"),
    "capsule": (rr.Capsules3D, "colors"),
    "sphere": (rr.Ellipsoids3D, "colors"),
}


def corners_of(shapes: Sequence[VisualShape]) -> Array:
    """Return the corners of a body's shapes and its origin in its frame, shape (n, 3)."""
    found = [np.zeros((1, 3))]
    for shape in shapes:
        if shape.mesh is None:
            corners = _SIGNS * _half_extents(shape)
        else:
            box = shape.size * corners_of_mesh(shape.mesh)
            corners = np.where(_SIGNS > 0, box[-1], box[0])
        found.append(corners @ shape.pose[:3, :3].T + shape.pose[:3, 3])
    return np.concatenate(found)


def _extent(model: VisualModel) -> float:
    """Return the diagonal of the box around a robot at rest in m."""
    found = [model.rest[:, :3]]
    for shape in model.shapes:
        points = corners_of([shape])
        if shape.body is not None:
            pose = model.rest[shape.body]
            points = rotate_rows(pose[3:], points) + pose[:3]
        found.append(points)
    return float(np.linalg.norm(np.ptp(np.concatenate(found), axis=0)))


_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def _half_extents(shape: VisualShape) -> Array:
    """Return a shape's half extents along its axes."""
    if shape.kind == "box":
        return np.array(shape.size)
    radius, length = shape.size[0], shape.size[-1]
    ends = {"sphere": radius, "cylinder": 0.5 * length, "capsule": 0.5 * length + radius}
    return np.array([radius, radius, ends[shape.kind]])


def _center(shape: VisualShape) -> Array:
    if shape.kind != "capsule":
        return shape.pose[:3, 3]
    return (shape.pose @ np.array([0.0, 0.0, -shape.size[1] / 2, 1.0]))[:3]


def _simplified(shape: VisualShape, detail: float | None) -> SimpleMesh | None:
    """Return a mesh without details; None: draw the original."""
    factor = max(map(abs, shape.size))
    if shape.mesh is None or not factor:
        return None
    return simple_mesh(shape.mesh, detail / factor if detail else None)


def _geometry(shape: VisualShape, simple: SimpleMesh | None) -> Any:
    if simple is not None:
        return rr.Mesh3D(
            vertex_positions=simple.positions,
            vertex_normals=simple.normals,
            triangle_indices=simple.cells,
        )
    if shape.mesh is not None:
        media_type = MESH_TYPES[shape.mesh.suffix.lower()]
        return rr.Asset3D(path=shape.mesh, media_type=media_type)
    if shape.kind == "box":
        return rr.Boxes3D(half_sizes=[shape.size], fill_mode="solid")
    radius, length = shape.size[0], shape.size[-1]
    if shape.kind == "sphere":
        return rr.Ellipsoids3D(half_sizes=[(radius, radius, radius)], fill_mode="solid")
    kind = rr.Cylinders3D if shape.kind == "cylinder" else rr.Capsules3D
    return kind(lengths=[length], radii=[radius], fill_mode="solid")
