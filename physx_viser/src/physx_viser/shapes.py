"""Draws each kind of object as a node of viser's scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from physx_core.components import grid_mesh, map_values, parse_color
from physx_core.errors import VisualizerError
from physx_core.typing import Array

if TYPE_CHECKING:
    from viser import SceneApi

Values = Mapping[str, Any]
Draw = Callable[["SceneApi", str, Values], Any]
_BLUE, _SILVER = (0.3, 0.55, 0.9), (0.75, 0.78, 0.81)
_MESHES = (".dae", ".glb", ".obj", ".stl")


def rgb(values: Values, default: tuple[float, ...] = _BLUE) -> Any:
    """Return the color of an object, or of each of its points, as bytes."""
    field = values.get("scalar_field")
    if field is None or not np.size(field):
        color = values.get("color")
        return tuple(int(255 * part) for part in parse_color(color or default))
    flat = np.asarray(field, np.float64).ravel()
    low, high = values.get("vmin"), values.get("vmax")
    low = float(flat.min()) if low is None else low
    high = float(flat.max()) if high is None else high
    return map_values(flat, low, max(high, low + 1e-12), values.get("colormap") or "viridis")


def wxyz(quaternion: Array) -> Array:
    """Return a quaternion x, y, z, w in viser's order."""
    return np.roll(np.asarray(quaternion, np.float64), 1, axis=-1)


def pose(values: Values) -> dict[str, Any]:
    """Return where an object is, as viser's options."""
    found: dict[str, Any] = {}
    if values.get("position") is not None:
        found["position"] = np.asarray(values["position"], np.float64)
    if values.get("orientation") is not None:
        found["wxyz"] = wxyz(values["orientation"])
    return found


def _solid(make: Callable[[Values], trimesh.Trimesh]) -> Draw:
    def draw(scene: SceneApi, name: str, values: Values) -> Any:
        found = make(values)
        shade = {"color": rgb(values), "opacity": values.get("alpha"), "side": "double"}
        flat = len(found.faces) <= 12
        shade |= {"wireframe": bool(values.get("wireframe")), "flat_shading": flat}
        return scene.add_mesh_simple(name, found.vertices, found.faces, **shade, **pose(values))

    return draw


def _surface(scene: SceneApi, name: str, values: Values) -> Any:
    """Draw a mesh or a height field; viser has colors of vertices only in files."""
    if "heights" in values:
        points, cells = grid_mesh(np.asarray(values["heights"]), values["spacing"])
    else:
        points, cells = values["positions"], values["cells"]
    found, colors = trimesh.Trimesh(points, cells, process=False), rgb(values)
    if np.ndim(colors) == 1:
        return _solid(lambda _: found)(scene, name, values)
    found.visual = trimesh.visual.ColorVisuals(found, vertex_colors=colors)
    return scene.add_mesh_trimesh(name, found, **pose(values))


def _capsule(values: Values) -> trimesh.Trimesh:
    found = trimesh.creation.capsule(height=values["length"], radius=values["radius"])
    return found.apply_translation(-found.bounds.mean(axis=0))


def _points(scene: SceneApi, name: str, values: Values) -> Any:
    positions = np.asarray(values["positions"], np.float32)
    ball = trimesh.creation.icosphere(2, radius=values.get("size") or point_size(positions))
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(positions), 1))
    colors = rgb(values)
    return scene.add_batched_meshes_simple(
        name, ball.vertices, ball.faces, turns, positions, batched_colors=colors, lod="off"
    )


def point_size(positions: Array) -> float:
    """Return a radius for points without a size in m: 1 % of the box around them."""
    extent = float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) else 0.0
    return 0.01 * extent or 0.01


def _arrows(scene: SceneApi, name: str, values: Values) -> Any:
    ends = values["positions"] + np.asarray(values["vectors"])
    radius = 0.02 * float(np.linalg.norm(values["vectors"], axis=-1).max(initial=0.1))
    return scene.add_arrows(
        name,
        np.stack([values["positions"], ends], 1),
        rgb(values),
        shaft_radius=radius,
        head_radius=2.5 * radius,
        head_length=5 * radius,
    )


def _lines(scene: SceneApi, name: str, values: Values) -> Any:
    parts = [np.stack([line[:-1], line[1:]], 1) for line in values["positions"] if len(line) > 1]
    return scene.add_line_segments(
        name, np.concatenate([np.zeros((0, 2, 3)), *parts]), rgb(values), thickness=0.01
    )


class RobotNode:
    """A robot: a frame for each of its bodies, and their shapes.

    Attributes:
        shapes: Each shape, and the index of its body; None: it does not move.
    """

    def __init__(self, scene: SceneApi, name: str, values: Values) -> None:
        """Draw it at rest.

        Raises:
            VisualizerError: If its file cannot be read.
        """
        from physx_sim import read_visuals
        from physx_sim.errors import ModelError

        try:
            packages = values.get("package_dirs") or {}
            model = read_visuals(values["urdf"], values["bodies"], packages, _MESHES)
        except ModelError as error:
            text = f"The robot {values['urdf']} cannot be drawn: {error}."
            raise VisualizerError(text) from error
        self._root = scene.add_frame(name, show_axes=False)
        self._frames = [
            scene.add_frame(f"{name}/{place}", show_axes=False) for place in range(len(model.rest))
        ]
        self.shapes: list[tuple[Any, int | None]] = []
        for shape in model.shapes:
            of = name if shape.body is None else f"{name}/{shape.body}"
            self.shapes.append((_draw_link(scene, of, shape, values), shape.body))
        poses = values.get("poses")
        self.place(model.rest if poses is None else poses)

    def place(self, poses: Array) -> None:
        """Move its bodies, poses of shape (bodies, 7)."""
        for frame, each in zip(self._frames, poses, strict=True):
            frame.position, frame.wxyz = each[:3], wxyz(each[3:])

    def remove(self) -> None:
        """Remove it from the scene."""
        self._root.remove()


def _draw_link(scene: SceneApi, of: str, shape: Any, values: Values) -> Any:
    found, own = _link(shape), shape.color or (*_SILVER, 1.0)
    opacity = own[3] if values.get("alpha") is None else values["alpha"]
    return scene.add_mesh_simple(
        f"{of}/{shape.name}",
        found.vertices,
        found.faces,
        color=rgb({"color": values.get("color") or own[:3]}),
        opacity=None if opacity == 1.0 else opacity,
        position=shape.pose[:3, 3],
        wxyz=trimesh.transformations.quaternion_from_matrix(shape.pose),
    )


def _link(shape: Any) -> trimesh.Trimesh:
    """Return the triangles of a link's shape in its own frame."""
    if shape.kind == "mesh":
        return trimesh.load(shape.mesh, force="mesh").apply_scale(shape.size)
    if shape.kind == "box":
        return trimesh.creation.box(2 * np.array(shape.size))
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(3, radius=shape.size[0])
    if shape.kind == "cylinder":
        return trimesh.creation.cylinder(shape.size[0], shape.size[1])
    return _capsule({"radius": shape.size[0], "length": shape.size[1]})


DRAW: Mapping[str, Draw] = {
    "mesh": _surface,
    "points": _points,
    "symbols": _points,
    "arrows": _arrows,
    "lines": _lines,
    "box": _solid(lambda of: trimesh.creation.box(2 * np.asarray(of["half_sizes"]))),
    "sphere": _solid(lambda of: trimesh.creation.icosphere(3, radius=of["radius"])),
    "capsule": _solid(_capsule),
    "cylinder": _solid(lambda of: trimesh.creation.cylinder(of["radius"], of["length"])),
    "height_field": _surface,
    "robot": RobotNode,
}
"""How each kind is drawn; images, texts, curves, slices and volumes are not."""
