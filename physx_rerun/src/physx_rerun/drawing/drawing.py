"""Drawing: converts the events of one environment instance to rows of Rerun archetypes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from physx_core.components import Event
from physx_core.errors import VisualizerError, listed
from physx_core.typing import Array
from physx_rerun.drawing import colors
from physx_rerun.drawing.chunks import ChunkBuilder, Times
from physx_rerun.drawing.robot import corners_of, draw_robot, tint_robot
from physx_rerun.drawing.windows import WindowLayout

DEFAULT_COLOR = "silver"
_SCREEN_POINTS = -3.0  # Rerun reads a negative radius as one in points of the screen.
_SCREEN_LINES = -1.5
_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass
class Item:
    """A drawn object.

    Attributes:
        kind: Kind of the object.
        name: Its name.
        entity: Path of its entity.
        values: All options set so far.
        is_new: Whether it is being added.
        limits: Smallest and largest value of its scalar field so far.
        edges: Pairs of vertices of a wireframe mesh, shape (edges, 2).
    """

    kind: str
    name: str
    entity: str
    values: dict[str, Any] = field(default_factory=dict)
    is_new: bool = True
    limits: tuple[float, float] = (np.inf, -np.inf)
    edges: Array | None = None


class Drawing:
    """Draws one environment instance under ``env_<instance_id>/``."""

    def __init__(
        self,
        instance_id: int,
        rows: ChunkBuilder,
        layout: WindowLayout,
        *,
        draws_shapes: bool,
        pixels: int | None = None,
    ) -> None:
        """Set the targets of the drawing.

        Args:
            instance_id: Number of the instance.
            rows: Collects the rows.
            layout: Lays out the windows.
            draws_shapes: Whether to draw shapes; otherwise only numbers and texts are recorded.
            pixels: Size of the pictures that are rendered; None: a person looks at it.
        """
        self._pixels = pixels
        self._id, self._rows, self._layout, self._draws_shapes = (
            instance_id,
            rows,
            layout,
            draws_shapes,
        )
        self._origin = f"env_{instance_id}"
        self._drawn: dict[str, Item] = {}
        self._frames: list[str] = []
        self._poses: list[Array] = []
        self._has_world = False
        self._followed: str | None = None
        self._draw_kind: dict[str, Callable[[Item, dict[str, Any], Times], None]] = {
            "mesh": self._mesh,
            "points": self._points,
            "arrows": self._arrows,
            "lines": self._lines,
            "box": self._box,
            "sphere": self._sphere,
            "capsule": self._capsule,
            "text": self._text,
            "scalars": self._scalars,
            "robot": self._robot,
        }

    def draw(self, events: Iterable[Event], times: Times) -> None:
        """Draw the events of one step."""
        for event in events:
            self._draw(event, times)
        self._follow()
        if self._frames:
            poses = np.concatenate(self._poses)
            self._rows.add_many(
                f"{self._origin}/tf",
                rr.Transform3D,
                times,
                translation=poses[:, :3],
                quaternion=poses[:, 3:],
                child_frame=self._frames,
                parent_frame=[self._world] * len(poses),
            )
            self._frames, self._poses = [], []

    def _draw(self, event: Event, times: Times) -> None:
        if event.kind not in (*self._draw_kind, "view"):
            raise VisualizerError(
                f'Rerun cannot draw "{event.name}": it is of the unknown kind "{event.kind}". '
                f"Kinds: {listed(self._draw_kind)}."
            )
        if not self._draws_shapes and event.kind not in ("scalars", "text"):
            return
        if event.kind == "view" and event.action == "add":
            values = dict(event.values)
            self._followed = values.pop("follow", None)
            self._layout.set_view(self._id, **values)
            return
        if event.action == "add":
            entity = "/".join(rr.escape_entity_path_part(part) for part in event.name.split("/"))
            self._drawn[event.name] = Item(event.kind, event.name, f"{self._origin}/{entity}")
        drawn = self._drawn.get(event.name)
        if drawn is None:
            raise VisualizerError(
                f'Instance {self._id} changes "{event.name}", which it has not added. '
                f"Objects: {listed(self._drawn)}."
            )
        changes = dict(event.values)
        drawn.values.update(changes)
        if drawn.is_new and event.kind not in ("scalars", "text"):
            self._register(drawn)
        self._draw_kind[event.kind](drawn, changes, times)
        drawn.is_new = False

    def _follow(self) -> None:
        """Let the camera follow the configured object, once it is drawn."""
        drawn = self._drawn.get(self._followed or "")
        if drawn is not None:
            # The first shape of a robot belongs to its root link, if that has any.
            shapes = drawn.values.get("shapes", ())
            self._layout.follow(self._id, shapes[0][0] if shapes else drawn.entity)
            self._followed = None

    # Frames ----------------------------------------------------------------------------------

    @property
    def _world(self) -> str:
        return f"{self._origin}/world"

    def _register(self, drawn: Item) -> None:
        if not self._has_world:
            self._has_world = True
            self._rows.add_static(self._origin, rr.CoordinateFrame(self._world))
            self._rows.add_static(self._origin, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._layout.add_object(self._id, drawn.kind, drawn.name)
        if drawn.kind not in ("robot", "box", "sphere", "capsule"):
            self._rows.add_static(drawn.entity, rr.CoordinateFrame(self._world))

    def _set_poses(self, frames: list[str], poses: Array) -> None:
        self._frames += frames
        self._poses.append(poses)

    def _pose(self, drawn: Item, changes: dict[str, Any], reach: Array) -> None:
        frame = f"{self._origin}/{drawn.name}"
        if drawn.is_new:
            self._rows.add_static(drawn.entity, rr.CoordinateFrame(frame))
        elif "position" not in changes and "orientation" not in changes:
            return
        position = drawn.values.get("position", np.zeros(3))
        orientation = drawn.values.get("orientation", _IDENTITY)
        self._set_poses([frame], np.concatenate([position, orientation])[None])
        self._layout.place(self._id, drawn.name, np.array([position - reach, position + reach]))

    # Looks -----------------------------------------------------------------------------------

    def _colors(self, drawn: Item, changes: dict[str, Any]) -> Array | None:
        """Return the object's colors, one or one per value; None if they do not change."""
        if not drawn.is_new and not changes.keys() & {"color", "alpha", "scalar_field"}:
            return None
        values = drawn.values
        alpha = 1.0 if values.get("alpha") is None else values["alpha"]
        if "color" in changes and "scalar_field" not in changes:
            values.pop("scalar_field", None)
        shown = values.get("scalar_field")
        if shown is None or not len(shown):
            return colors.rgba(values.get("color") or DEFAULT_COLOR, alpha)
        low, high = drawn.limits
        drawn.limits = (min(low, float(np.nanmin(shown))), max(high, float(np.nanmax(shown))))
        return colors.map_values(shown, drawn.limits, values.get("colormap") or "viridis", alpha)

    def _fill(self, drawn: Item, changes: dict[str, Any]) -> dict[str, Any]:
        look: dict[str, Any] = {}
        tint = self._colors(drawn, changes)
        if tint is not None:
            look["colors"] = tint
        if drawn.is_new or "wireframe" in changes:
            wireframe = drawn.values.get("wireframe")
            mode = rr.components.FillMode.MajorWireframe if wireframe else "solid"
            look["fill_mode"] = [mode]
        return look

    def _add(self, drawn: Item, archetype: type[Any], times: Times, look: dict[str, Any]) -> None:
        if look:
            self._rows.add(drawn.entity, archetype, times, **look)

    # Kinds -----------------------------------------------------------------------------------

    def _mesh(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look: dict[str, Any] = {}
        positions, cells = drawn.values["positions"], drawn.values["cells"]
        if drawn.is_new:
            self._rows.add_static(drawn.entity, rr.Mesh3D.from_fields(triangle_indices=cells))
            self._layout.place(self._id, drawn.name, positions)
        if drawn.is_new or changes.keys() & {"positions", "wireframe"}:
            wireframe = bool(drawn.values.get("wireframe"))
            shown = positions[:0] if wireframe else positions
            look["vertex_positions"] = shown
            look["vertex_normals"] = _normals(shown, cells)
            if wireframe or "wireframe" in changes:
                self._edges(drawn, positions if wireframe else None, cells, times)
        tint = self._colors(drawn, changes)
        if tint is not None:
            has_field = drawn.values.get("scalar_field") is not None
            look["vertex_colors"] = tint if has_field else tint[:0]
            look["albedo_factor"] = (tint[:1] | 0xFFFFFF00) if has_field else tint
            if drawn.values.get("wireframe"):
                edges = f"{drawn.entity}/edges"
                self._rows.add(edges, rr.LineStrips3D, times, colors=tint[:1])
        self._add(drawn, rr.Mesh3D, times, look)

    def _edges(self, drawn: Item, positions: Array | None, cells: Array, times: Times) -> None:
        entity = f"{drawn.entity}/edges"
        if drawn.edges is None:
            pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
            drawn.edges = np.unique(pairs, axis=0)
            thin = rr.LineStrips3D.from_fields(radii=[_SCREEN_LINES / 2])
            self._rows.add_static(entity, rr.CoordinateFrame(self._world), thin)
        strips = np.zeros((0, 2, 3)) if positions is None else positions[drawn.edges]
        self._rows.add(entity, rr.LineStrips3D, times, strips=strips)

    def _points(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look = {"positions": changes["positions"]} if "positions" in changes else {}
        self._add(drawn, rr.Points3D, times, look | self._stroke(drawn, changes, _SCREEN_POINTS))

    def _arrows(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        names = {"positions": "origins", "vectors": "vectors"}
        look = {names[name]: changes[name] for name in names if name in changes}
        self._add(drawn, rr.Arrows3D, times, look | self._stroke(drawn, changes, _SCREEN_LINES))

    def _lines(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look = {"strips": [changes["positions"]]} if "positions" in changes else {}
        self._add(drawn, rr.LineStrips3D, times, look | self._stroke(drawn, changes, _SCREEN_LINES))

    def _stroke(self, drawn: Item, changes: dict[str, Any], default: float) -> dict[str, Any]:
        if drawn.is_new:
            self._layout.place(self._id, drawn.name, drawn.values["positions"])
        look: dict[str, Any] = {}
        tint = self._colors(drawn, changes)
        if tint is not None:
            look["colors"] = tint
        if drawn.is_new or "size" in changes:
            size = drawn.values.get("size")
            look["radii"] = np.array([default if size is None else size], np.float32)
        return look

    def _box(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        half = drawn.values["half_sizes"]
        if drawn.is_new:
            self._rows.add_static(drawn.entity, rr.Boxes3D.from_fields(half_sizes=[half]))
        self._pose(drawn, changes, half)
        self._add(drawn, rr.Boxes3D, times, self._fill(drawn, changes))

    def _sphere(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        radius, look = drawn.values["radius"], self._fill(drawn, changes)
        if "radius" in changes:
            look["half_sizes"] = np.full((1, 3), radius, np.float32)
        self._pose(drawn, changes, np.full(3, radius))
        self._add(drawn, rr.Ellipsoids3D, times, look)

    def _capsule(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        radius, length = drawn.values["radius"], drawn.values["length"]
        look = self._fill(drawn, changes)
        if changes.keys() & {"radius", "length"}:
            look["radii"], look["lengths"] = np.array([radius]), np.array([length])
            look["translations"] = np.array([[0.0, 0.0, -length / 2]])
        self._pose(drawn, changes, np.full(3, radius + length / 2))
        self._add(drawn, rr.Capsules3D, times, look)

    def _text(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        if drawn.is_new:
            markdown = rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN)
            self._rows.add_static(drawn.entity, markdown)
            if self._draws_shapes:
                self._layout.add_text(self._id, drawn.name, drawn.entity)
        if "content" in changes:
            content = str(changes["content"])
            self._rows.add(drawn.entity, rr.TextDocument, times, text=[content])

    def _scalars(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        labels = drawn.values["labels"]
        if drawn.is_new:
            prefix = f"{self._layout.title(self._id)}: " if self._layout.instance_nb > 1 else ""
            shift = (self._id - 1) * len(labels) if self._layout.instance_nb > 1 else 0
            lines = colors.curves(len(labels), shift)
            names = [prefix + label for label in labels]
            self._rows.add_static(drawn.entity, rr.SeriesLines(names=names, colors=lines))
            if self._draws_shapes:
                unit = drawn.values.get("unit")
                title = f"{drawn.name} ({unit})" if unit else drawn.name
                self._layout.add_plot(title, drawn.entity, "step", len(labels))
        values = changes.get("values")
        if values is None:
            return
        if len(values) != len(labels):
            raise VisualizerError(
                f'The scalars "{drawn.name}" have {len(labels)} labels but {len(values)} values.'
            )
        self._rows.add(drawn.entity, rr.Scalars, times, scalars=values)

    def _robot(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        values = drawn.values
        frames = [f"{self._origin}/{drawn.name}/{body}" for body in values["bodies"]]
        if drawn.is_new:
            values["shapes"], rest = draw_robot(
                self._rows, drawn.entity, values, frames, self._world, self._pixels
            )
            if changes.get("poses") is None:
                changes["poses"] = rest
        if drawn.is_new or changes.keys() & {"color", "alpha"}:
            tint_robot(self._rows, values, times)
        poses = changes.get("poses")
        if poses is None:
            return
        if len(poses) != len(frames):
            raise VisualizerError(
                f'The robot "{drawn.name}" has {len(frames)} bodies but got {len(poses)} poses.'
            )
        self._set_poses(frames, poses)
        if drawn.is_new:
            corners = corners_of([shape for _, shape in values["shapes"]], poses)
            self._layout.place(self._id, drawn.name, corners)


def _normals(positions: Array, cells: Array) -> Array:
    """Return the unit normals of a mesh's vertices: area-weighted means of the triangles'."""
    normals = np.zeros_like(positions)
    if not len(positions) or not len(cells):
        return normals
    corners = positions[cells]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for axis in range(3):
        weights = np.repeat(faces[:, axis], 3)
        normals[:, axis] = np.bincount(cells.ravel(), weights, minlength=len(positions))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.maximum(lengths, 1e-12)
