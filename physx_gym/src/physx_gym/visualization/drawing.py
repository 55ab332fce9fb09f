"""Drawing of simulated worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from physx_core import Closeable
from physx_core.components import Factory
from physx_core.processes import TemporaryFolder
from physx_core.typing import Vector
from physx_sim import (
    Backend,
    Box,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    Layout,
    Mesh,
    Robot,
    Simulation,
    Sphere,
    Stairs,
    World,
    WorldObject,
)
from physx_sim.engines import is_mjcf, read_robot, to_urdf

_GROUND, _MOVING, _RESTING = "#6d7885", "#ff7f0e", "#a3acb6"
_THICKNESS, _REACH = 0.01, 100.0  # of a drawn plane, and half its width, in m
_ROBOT = """<robot name="mesh"><link name="mesh"><visual><geometry>
<mesh filename={} scale="{scale} {scale} {scale}"/>
</geometry></visual></link></robot>"""


class WorldDrawing(Closeable):
    """Draws a world with a factory: robots by their visual shapes, objects, and the ground.

    Robots from MJCF files are drawn by their collision shapes.
    """

    def __init__(
        self,
        factory: Factory,
        world: World,
        backend: Backend,
        layout: Layout,
        title: str | None,
        *,
        follow: bool = True,
        view: Mapping[str, Sequence[float]] | None = None,
        look: Mapping[str, Any] | None = None,
    ) -> None:
        """Store the world; `show`, or `add`, draws it.

        Args:
            factory: Factory to draw with.
            world: The world to draw.
            backend: Engine that provides the robots given by name.
            layout: Order of the bodies.
            title: Title of the window; None: that of another world drawn with the factory.
            follow: Whether the camera follows the first robot whose base floats.
            view: Camera position: see `Factory.set_view`; None: one that shows everything.
            look: Color and alpha of everything that moves; None: its own.
        """
        self._look = look or {}
        self._view = view or {}
        self._factory, self._world, self._layout, self._backend = factory, world, layout, backend
        floating = (robot.name for robot in world.robots if not robot.fixed_base)
        self._title, self._followed = title, next(floating, None) if follow else None
        self._places = {name: place for place, name in enumerate(layout.names)}
        self._drawn: dict[str, tuple[list[float], bool]] = {}
        self._folder: TemporaryFolder | None = None
        self._is_added = False

    def show(self, simulation: Simulation) -> None:
        """Draw the present state of a simulation of the world.

        The first call adds everything, later ones move it.
        """
        poses, first = simulation.body_poses(self._layout.names), not self._is_added
        named = self._world.objects if "changes" in simulation.features else ()
        hidden = [each.name for each in named if simulation.body_settings(each.name).hidden]
        if first:
            self.add(poses)
        if hidden or not first:
            self.move(poses, hidden)

    def add(self, poses: Vector) -> None:
        """Add everything to the scene.

        Args:
            poses: Of everything in `Layout.names`, static bodies too, shape (names, 7).
        """
        self._is_added = True
        if self._world.ground is not None:
            _add_ground(self._factory, self._world.ground)
        if self._title is not None:
            self._factory.set_view(self._title, self._followed, **self._view)
        for robot in self._world.robots:
            self._add_robot(robot, poses[self._layout.parts[robot.name].bodies])
        for each in self._world.objects:
            pose = poses[self._places[each.name]]
            self._add_object(each, pose)
            self._drawn[each.name] = pose.tolist(), False

    def move(self, poses: Vector, hidden: Container[str] = ()) -> None:
        """Move everything to its present pose.

        Args:
            poses: As for `add`.
            hidden: Names of objects that are absent at present.
        """
        parts, factory = self._layout.parts, self._factory
        for robot in self._world.robots:
            factory.update_robot(robot.name, poses=poses[parts[robot.name].bodies])
        for each in self._world.objects:
            pose = poses[self._places[each.name]]
            shown, before = (pose.tolist(), each.name in hidden), self._drawn[each.name]
            if shown != before:
                look = {} if shown[1] == before[1] else {"visible": not shown[1]}
                self._move_object(each, pose, **look)
                self._drawn[each.name] = shown

    def close(self) -> None:
        """Delete temporary files."""
        if self._folder is not None:
            self._folder.close()
            self._folder = None

    def _add_robot(self, robot: Robot, poses: Vector) -> None:
        bodies = self._layout.bodies[self._layout.parts[robot.name].bodies]
        names = [body.removeprefix(f"{robot.name}/") for body in bodies]
        packages = {name: str(folder) for name, folder in robot.package_dirs.items()}
        urdf = str(self._model(robot))
        self._factory.add_robot(
            robot.name, urdf, names, package_dirs=packages, poses=poses, **self._look
        )

    def _model(self, robot: Robot) -> Path:
        """Return the URDF file of a robot, which may be given by its name in the backend."""
        urdf, path = robot.urdf, Path(robot.urdf)
        if is_mjcf(path):
            shown = dataclasses.replace(robot, collisions="shapes", feet={})
            return self._write(to_urdf(read_robot(shown, touching=True)))
        if isinstance(urdf, Path) or urdf.lower().endswith(".urdf") or path.is_file():
            return path
        return self._backend.robot_path(urdf) or path

    def _add_object(self, each: WorldObject, pose: Vector) -> None:
        factory = self._factory
        color = _RESTING if each.static else _MOVING
        tint = {"color": color} | dict(self._look)
        if isinstance(each, Mesh):
            urdf = str(self._as_robot(each))
            factory.add_robot(each.name, urdf, ["mesh"], poses=pose[None], **tint)
        else:
            look: dict[str, Any] = {"position": pose[:3], "orientation": pose[3:], **tint}
            if isinstance(each, Box):
                factory.add_box(each.name, 0.5 * np.array(each.size), **look)
            elif isinstance(each, Sphere):
                factory.add_sphere(each.name, each.radius, **look)
            elif isinstance(each, Capsule):
                factory.add_capsule(each.name, each.radius, each.length, **look)
            elif isinstance(each, Cylinder):
                factory.add_cylinder(each.name, each.radius, each.length, **look)

    def _as_robot(self, each: Mesh) -> Path:
        """Return a URDF file of a mesh, as viewers load mesh files in this form."""
        path = quoteattr(str(Path(each.path).absolute()))
        return self._write(_ROBOT.format(path, scale=each.scale))

    def _write(self, text: str) -> Path:
        """Return a temporary URDF file."""
        if self._folder is None:
            self._folder = TemporaryFolder("drawing-")
        folder = self._folder.path
        file = folder / f"{len(list(folder.iterdir()))}.urdf"
        file.write_text(text, encoding="utf-8")
        return file

    def _move_object(self, each: WorldObject, pose: Vector, **look: bool) -> None:
        factory = self._factory
        if isinstance(each, Mesh):
            factory.update_robot(each.name, poses=pose[None], **look)
        else:
            place: dict[str, Any] = {"position": pose[:3], "orientation": pose[3:], **look}
            if isinstance(each, Box):
                factory.update_box(each.name, **place)
            elif isinstance(each, Sphere):
                factory.update_sphere(each.name, **place)
            elif isinstance(each, Capsule):
                factory.update_capsule(each.name, **place)
            elif isinstance(each, Cylinder):
                factory.update_cylinder(each.name, **place)


def _add_ground(factory: Factory, ground: Ground | Stairs | HeightField) -> None:
    if isinstance(ground, HeightField):
        corner = (*ground.corner(), 0.0)
        given = {"position": corner, "color": _GROUND, "in_view": False}
        factory.add_height_field("ground", ground.heights, ground.spacing, **given)
        return
    plane = ground if isinstance(ground, Ground) else Ground()
    if isinstance(ground, Stairs):
        for number, (center, size) in enumerate(ground.boxes()):
            half = 0.5 * np.array(size)
            factory.add_box(f"stairs/{number}", half, position=center, color=_RESTING)
    normal = np.array(plane.normal)
    # Slightly below the ground, so that a viewer's own grid stays visible.
    place = normal * (plane.height - 0.5 * _THICKNESS - 1e-3)
    look: dict[str, Any] = {"position": place, "orientation": _upright(normal), "color": _GROUND}
    factory.add_box("ground", (_REACH, _REACH, 0.5 * _THICKNESS), in_view=False, **look)


def _upright(normal: Vector) -> Vector:
    """Return the quaternion x, y, z, w that turns the z axis to a normal."""
    axis = np.cross([0.0, 0.0, 1.0], normal)
    turn = np.array([*axis, 1.0 + normal[2]])
    length = float(np.linalg.norm(turn))
    return turn / length if length > 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
