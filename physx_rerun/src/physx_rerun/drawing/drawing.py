"""Drawing: converts the events of one environment instance to rows of Rerun archetypes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from physx_core.components import Event, vertex_normals
from physx_core.errors import VisualizerError, listed
from physx_core.typing import Array
from physx_rerun.drawing import colors, surfaces
from physx_rerun.drawing.bodies import Bodies
from physx_rerun.drawing.chunks import Chunk, ChunkBuilder, Times
from physx_rerun.drawing.framing import RIGHT, extremes
from physx_rerun.drawing.items import Item
from physx_rerun.drawing.robot import corners_of, draw_robot, place_shapes, tint_robot
from physx_rerun.drawing.windows import WindowLayout

DEFAULT_COLOR = "silver"
_SCREEN_POINTS = -3.0  # Rerun reads a negative radius as one in points of the screen.
_SCREEN_LINES = -1.5
_FEW = 600  # triangles of a mesh whose edges are drawn
_EDGES = colors.rgba((0.1, 0.12, 0.16), 0.6)
_REMEMBERED = 1000  # sets of names
_SYMBOL_SIZE = 0.02  # as a fraction of the scene's size
_BAR_PARTS = 64
_DENSITY = 4.0  # optical density of a volume's largest values
_MOVES = {"position", "orientation"}
_RIGID = {"box", "sphere", "capsule", "cylinder", "height_field", "slice", "volume"}
_COLORING = {"color", "alpha", "scalar_field", "values", "colormap", "vmin", "vmax"}
_COLORING |= {"wireframe", "symbol"}  # which need the colors in another form
_PARTS = ("/color_bar", "/color_bar/values", "/edges", "/labels", "/slices")
"""What an object may consist of in addition to its own entity."""
_VOLUME_MAPS = {
    "gray": rr.components.Colormap.Grayscale,
    "inferno": rr.components.Colormap.Inferno,
    "magma": rr.components.Colormap.Magma,
    "plasma": rr.components.Colormap.Plasma,
    "Spectral": rr.components.Colormap.Spectral,
    "turbo": rr.components.Colormap.Turbo,
    "twilight": rr.components.Colormap.Twilight,
    "viridis": rr.components.Colormap.Viridis,
}


class Drawing:
    """Draws one environment instance under ``env_<instance_id>/``."""

    def __init__(
        self,
        instance_id: int,
        rows: ChunkBuilder,
        layout: WindowLayout,
        *,
        draws_shapes: bool,
        resolution: float | None = None,
    ) -> None:
        """Set the targets of the drawing.

        Args:
            instance_id: Number of the instance.
            rows: Collects the rows.
            layout: Lays out the windows.
            draws_shapes: Whether to draw shapes; otherwise, only numbers and texts are recorded.
            resolution: Size of a robot divided by that of its smallest details to draw; None:
                draw all details.
        """
        self._resolution = resolution
        self._id, self._rows, self._layout = instance_id, rows, layout
        self._draws_shapes = draws_shapes
        self._origin = f"env_{instance_id}"
        self._world = f"tf#/{self._origin}"  # the frame that Rerun assigns to the origin
        self._drawn: dict[str, Item] = {}
        self._moved: dict[tuple[str, ...], Array] = {}
        self._bodies = Bodies(f"{self._origin}/tf")
        self._lives: dict[str, int] = {}
        self._has_world = False
        self._followed: str | None = None
        self._draw_kind: dict[str, Callable[[Item, dict[str, Any], Times], None]] = {
            "mesh": self._mesh,
            "height_field": self._mesh,
            "slice": self._mesh,
            "volume": self._volume,
            "points": self._points,
            "arrows": self._arrows,
            "lines": self._lines,
            "symbols": self._symbols,
            "box": self._box,
            "sphere": self._sphere,
            "capsule": self._round,
            "cylinder": self._round,
            "image": self._image,
            "text": self._text,
            "scalars": self._scalars,
            "robot": self._robot,
        }
        rows.sources.append(self._pop)

    def draw(self, events: Iterable[Event], times: Times) -> None:
        """Draw the events of one step."""
        for event in events:
            if event.action == "update" and event.values.keys() <= _MOVES:
                places = self._places(event.names)
                if places is not None:
                    self._bodies.move(places, times, event.values)
                    continue
            if event.kind == "scalars" and event.action == "update":
                drawn = self._drawn.get(event.name)
                if drawn is not None and len(event.names) == 1 and not drawn.is_new:
                    self._scalars(drawn, event.values, times)
                    continue
            for one in event.each() if len(event.names) > 1 else (event,):
                self._draw(one, times)
        self._follow()

    def _places(self, names: tuple[str, ...]) -> Array | None:
        """Return the indices of rigid bodies; None if some of the objects are not rigid."""
        places = self._moved.get(names)
        if places is None:
            drawn = [self._drawn.get(name) for name in names]
            found = [each.bodies for each in drawn if each is not None and each.kind in _RIGID]
            if len(found) == len(names):
                if len(self._moved) >= _REMEMBERED:
                    self._moved.clear()
                self._moved[names] = places = np.concatenate(found)
        return places

    def _draw(self, event: Event, times: Times) -> None:
        if event.kind == "controls" and event.action == "add":
            return
        if event.kind not in {*self._draw_kind, "view", "controls"}:
            raise VisualizerError(
                f'Rerun cannot draw "{event.name}" of the unknown kind "{event.kind}". '
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
            self._drawn[event.name] = Item(event.kind, event.name)
            self._moved.clear()
        drawn = self._drawn.get(event.name)
        if drawn is None:
            raise VisualizerError(
                f'Instance {self._id} changes "{event.name}", which it has not added. '
                f"Objects: {listed(self._drawn)}."
            )
        if event.action == "remove":
            self._hide(drawn, times)
            del self._drawn[event.name]
            self._moved.clear()
        else:
            self._change(drawn, dict(event.values), times)

    def _change(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        was_hidden, is_first = drawn.is_hidden, drawn.frame is None
        drawn.values.update(changes)
        if "color" in changes and "scalar_field" not in changes:
            drawn.values.pop("scalar_field", None)
        moves = {name: changes[name] for name in _MOVES & changes.keys()}
        if is_first:
            self._register(drawn)
        elif drawn.is_hidden and not was_hidden:
            self._hide(drawn, times)
        elif was_hidden and not drawn.is_hidden:
            drawn.is_new, drawn.barred, changes = True, None, dict(drawn.values)
        if drawn.kind in _RIGID and (moves or is_first):
            self._bodies.move(drawn.bodies, times, moves)
        if drawn.kind == "robot" or not drawn.is_hidden:
            self._draw_kind[drawn.kind](drawn, changes, times)
            drawn.is_new = False

    def _hide(self, drawn: Item, times: Times) -> None:
        if drawn.kind == "robot":
            place_shapes(self._rows, drawn.shapes, times, is_visible=False)
        else:
            inner = f"{drawn.entity}/"
            if not any(other.entity.startswith(inner) for other in self._drawn.values()):
                self._rows.add(drawn.entity, rr.Clear, times, is_recursive=[True])
                return
            for part in ("", *_PARTS):  # other objects are below it
                self._rows.add(f"{drawn.entity}{part}", rr.Clear, times, is_recursive=[False])

    def _follow(self) -> None:
        """Make the camera follow the configured object once it is drawn."""
        if self._followed is None:
            return
        drawn = self._drawn.get(self._followed)
        if drawn is not None:
            # The first shape of a robot belongs to its root link, if that has one.
            entity, place = drawn.shapes[0][0] if drawn.shapes else drawn.entity, None
            if len(drawn.bodies):
                (place,) = self._bodies.in_world(int(drawn.bodies[0]), np.zeros((1, 3)))
            self._layout.follow(self._id, entity, place)
            self._followed = None

    def _pop(self) -> list[Chunk]:
        """Return and clear the moves of bodies, and inform the camera of all positions."""
        frame = self._layout.frame(self._id) if self._has_world else None
        chunks = self._bodies.pop(frame)
        for drawn in self._drawn.values():
            if drawn.seen and frame is not None:
                margin = drawn.values.get("size") or 0.0
                low, high = extremes(np.concatenate(drawn.seen))
                frame.see(low - margin, high + margin)
                drawn.seen = []
        self._layout.grow(self._id)
        return chunks

    # Frames ----------------------------------------------------------------------------------

    def _register(self, drawn: Item) -> None:
        """Assign a frame to an object: its own if it is rigid, else the world's."""
        life = self._lives[drawn.name] = self._lives.get(drawn.name, 0) + 1
        name = drawn.name if life == 1 else f"{drawn.name} ({life})"
        entity = "/".join(map(rr.escape_entity_path_part, name.split("/")))
        # Everything below the origin is drawn in the scene.
        folder = f"images/{self._origin}" if drawn.kind == "image" else self._origin
        drawn.entity = f"{folder}/{entity}"
        drawn.frame = self._world
        if drawn.kind in ("scalars", "text", "image"):
            return
        if not self._has_world:
            self._has_world = True
            self._rows.add_static(self._origin, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._layout.add_object(self._id, drawn.kind, drawn.name)
        if drawn.kind in _RIGID:
            drawn.frame = self._rows.next_frame()
            drawn.bodies = self._bodies.add([drawn.frame])
            self._rows.add_static(drawn.entity, rr.CoordinateFrame(drawn.frame))

    def _see(self, drawn: Item, points: Array) -> None:
        """Keep points of an object, given in its frame, in view."""
        if not drawn.in_view or not len(points):
            return
        if drawn.kind not in _RIGID:
            drawn.seen.append(points)
        else:
            self._bodies.set_box(int(drawn.bodies[0]), points)

    # Looks -----------------------------------------------------------------------------------

    def _colors(self, drawn: Item, changes: dict[str, Any], times: Times) -> Array | None:
        """Return the object's colors, one in total or one per value; None if they do not change."""
        if not drawn.is_new and not changes.keys() & _COLORING:
            return None
        values = drawn.values
        shown = values.get("values" if drawn.kind == "slice" else "scalar_field")
        if shown is None or not shown.size:
            return colors.rgba(values.get("color") or DEFAULT_COLOR, drawn.alpha)
        limits = drawn.widen(shown)
        self._color_bar(drawn, limits, times)
        return colors.map_values(shown.ravel(), limits, drawn.colormap, drawn.alpha)

    def _color_bar(self, drawn: Item, limits: tuple[float, float], times: Times) -> None:
        """Draw a color bar for the limits next to the object."""
        if not drawn.values.get("color_bar") or limits == drawn.barred:
            return
        points = self._points_of(drawn)
        levels = np.linspace(*limits, _BAR_PARTS + 1)
        tints = np.tile(colors.map_values(levels, limits, drawn.colormap, 1.0), 2)
        corners, cells, ticks = surfaces.bar_beside(points, RIGHT, _BAR_PARTS)
        bar, texts = f"{drawn.entity}/color_bar", f"{drawn.entity}/color_bar/values"
        drawn.barred = limits
        self._rows.add(
            bar,
            rr.Mesh3D,
            times,
            vertex_positions=corners,
            triangle_indices=cells,
            vertex_colors=tints,
        )
        labels = [f"{level:.4g}" for level in (limits[0], sum(limits) / 2, limits[1])]
        labels[-1] += f"  {drawn.name}"
        self._rows.add(
            texts, rr.Points3D, times, positions=ticks, labels=labels, radii=np.zeros(1, np.float32)
        )
        self._layout.frame(self._id).see(*extremes(np.concatenate([corners, ticks])))

    def _points_of(self, drawn: Item) -> Array:
        """Return points of an object in the world frame."""
        if drawn.kind in surfaces.GRIDS:
            corners = surfaces.corners_of_grid(drawn.kind, drawn.values)
            return self._bodies.in_world(int(drawn.bodies[0]), corners)
        return drawn.values["positions"]

    def _fill(self, drawn: Item, changes: dict[str, Any], times: Times) -> dict[str, Any]:
        look: dict[str, Any] = {}
        tint = self._colors(drawn, changes, times)
        if tint is not None:
            look["colors"] = tint
        if drawn.is_new or "wireframe" in changes:
            wireframe = drawn.values.get("wireframe")
            mode = rr.components.FillMode.MajorWireframe if wireframe else "solid"
            look["fill_mode"] = [mode]
        if "size" in changes:
            look["line_radii"] = _radius(changes["size"], _SCREEN_LINES)
        if "label" in changes:
            look["labels"] = [] if changes["label"] is None else [changes["label"]]
        return look

    def _add(self, drawn: Item, archetype: type[Any], times: Times, look: dict[str, Any]) -> None:
        if look:
            self._rows.add(drawn.entity, archetype, times, **look)

    # Surfaces and volumes --------------------------------------------------------------------

    def _mesh(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look: dict[str, Any] = {}
        values, wireframe = drawn.values, bool(drawn.values.get("wireframe"))
        heights = values.get("heights", values.get("values"))
        grid = () if heights is None else heights.shape
        reshaped = drawn.is_new or grid != drawn.grid
        reshaped = reshaped or bool(changes.keys() & {"cells", "spacing", "wireframe"})
        drawn.grid = grid
        has_other_lines = wireframe and "size" in changes
        if reshaped or has_other_lines or changes.keys() & {"positions", "heights"}:
            positions, cells = surfaces.mesh_of(drawn.kind, values)
            self._see(drawn, positions)
            shown = positions[:0] if wireframe else positions
            look["vertex_positions"] = shown
            if drawn.kind != "slice":  # without normals, its colors are not shaded
                look["vertex_normals"] = vertex_normals(shown, cells)
            if reshaped:
                look["triangle_indices"] = cells[:0] if wireframe else cells
                drawn.edges = None
            few = drawn.kind == "mesh" and len(cells) <= _FEW
            has_edges = bool(values.get("wireframe", few))
            if has_edges or "wireframe" in changes:
                self._edges(drawn, positions if has_edges else None, cells, times)
                if has_edges and not wireframe and reshaped:
                    edges = f"{drawn.entity}/edges"
                    self._rows.add(edges, rr.LineStrips3D, times, colors=_EDGES)
        tint = self._colors(drawn, changes, times)
        if tint is not None:
            has_field = drawn.kind == "slice" or values.get("scalar_field") is not None
            look["vertex_colors"] = tint if has_field and not wireframe else tint[:0]
            look["albedo_factor"] = (tint[:1] | 0xFFFFFF00) if has_field else tint
            if wireframe:
                edges = f"{drawn.entity}/edges"
                self._rows.add(edges, rr.LineStrips3D, times, colors=tint[:1])
        self._add(drawn, rr.Mesh3D, times, look)

    def _edges(self, drawn: Item, positions: Array | None, cells: Array, times: Times) -> None:
        entity = f"{drawn.entity}/edges"
        if drawn.edges is None:
            drawn.edges = surfaces.edges_of(cells)
            if drawn.kind in _RIGID:
                self._rows.add_static(entity, rr.CoordinateFrame(str(drawn.frame)))
        self._rows.add(
            entity,
            rr.LineStrips3D,
            times,
            strips=np.zeros((0, 2, 3)) if positions is None else positions[drawn.edges],
            radii=_radius(drawn.values.get("size"), _SCREEN_LINES / 2),
        )

    def _volume(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        if not drawn.is_new and not changes.keys() & {*_COLORING, "spacing"}:
            return
        values = drawn.values["values"]
        low, high = drawn.widen(values)
        self._see(drawn, surfaces.corners_of_grid("volume", drawn.values))
        self._color_bar(drawn, (low, high), times)
        share = np.clip((values - low) / max(high - low, 1e-30), 0.0, 1.0)
        known = _VOLUME_MAPS.get(drawn.colormap)
        if known is None:
            warnings.warn(
                f'Rerun cannot draw volumes in "{drawn.colormap}", only in {listed(_VOLUME_MAPS)}: '
                f'"{drawn.name}" is drawn in viridis.',
                stacklevel=2,
            )
        self._rows.add_archetype(
            drawn.entity,
            rr.Volume3D(
                np.ascontiguousarray(share.astype(np.float16).transpose(2, 1, 0)),
                voxel_size=drawn.values["spacing"],
                value_range=(0.0, 1.0),
                colormap=known or _VOLUME_MAPS["viridis"],
                gamma=1.0,
                optical_density=_DENSITY * drawn.alpha,
            ),
            times,
        )
        slices = f"{drawn.entity}/slices"
        if drawn.is_new:
            self._layout.add_window(self._id, drawn.name, rrb.TensorView, slices)
        tensor = rr.Tensor(values, dim_names=("x", "y", "z"), value_range=(low, high))
        self._rows.add_archetype(slices, tensor, times)

    # Points and lines ------------------------------------------------------------------------

    def _points(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look = {"positions": changes["positions"]} if "positions" in changes else {}
        if look:
            self._see(drawn, look["positions"])
        look |= self._stroke(drawn, changes, times, _SCREEN_POINTS)
        self._add(drawn, rr.Points3D, times, look)

    def _arrows(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        names = {"positions": "origins", "vectors": "vectors"}
        look: dict[str, Any] = {names[name]: changes[name] for name in names if name in changes}
        if look:
            positions, vectors = drawn.values["positions"], drawn.values["vectors"]
            self._see(drawn, np.concatenate([positions, positions + vectors]))
        look |= self._stroke(drawn, changes, times, _SCREEN_LINES)
        self._add(drawn, rr.Arrows3D, times, look)

    def _lines(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look = {"strips": changes["positions"]} if "positions" in changes else {}
        if look:
            self._see(drawn, np.concatenate(look["strips"]))
        look |= self._stroke(drawn, changes, times, _SCREEN_LINES)
        self._add(drawn, rr.LineStrips3D, times, look)

    def _symbols(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        values = drawn.values
        look: dict[str, Any] = {}
        if values.get("size") is None:
            size = max(self._layout.frame(self._id).size, _size(values["positions"]))
            values["size"] = _SYMBOL_SIZE * size or 0.05
        name, positions = values.get("symbol", "circle"), values["positions"]
        if drawn.is_new or changes.keys() & {"positions", "orientations", "size", "symbol"}:
            self._see(drawn, positions)
            look["strips"] = surfaces.symbol_lines(
                name, positions, values.get("orientations"), values["size"]
            )
        tint = self._colors(drawn, changes, times)
        if tint is not None:
            parts = len(surfaces.SYMBOLS[name])
            look["colors"] = np.repeat(tint, parts) if len(tint) > 1 else tint
        if drawn.is_new:
            look["radii"] = _radius(None, _SCREEN_LINES)
        self._add(drawn, rr.LineStrips3D, times, look)
        labels = values.get("labels") or []
        if "labels" in changes or (labels and "positions" in changes):
            look = {"labels": labels, "radii": np.zeros(1, np.float32)}
            look["positions"] = positions if labels else positions[:0]
            self._rows.add(f"{drawn.entity}/labels", rr.Points3D, times, **look)

    def _stroke(
        self, drawn: Item, changes: dict[str, Any], times: Times, default: float
    ) -> dict[str, Any]:
        look: dict[str, Any] = {}
        tint = self._colors(drawn, changes, times)
        if tint is not None:
            look["colors"] = tint
        if drawn.is_new or "size" in changes:
            look["radii"] = _radius(drawn.values.get("size"), default)
        if "labels" in changes:
            look["labels"] = changes["labels"] or []
        return look

    # Solids ----------------------------------------------------------------------------------

    def _box(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look = self._fill(drawn, changes, times)
        if "half_sizes" in changes:
            half = changes["half_sizes"]
            look["half_sizes"] = half[np.newaxis]
            self._see(drawn, np.stack([-half, half]))
        self._add(drawn, rr.Boxes3D, times, look)

    def _sphere(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look = self._fill(drawn, changes, times)
        if "radius" in changes:
            half = np.full((1, 3), changes["radius"], np.float32)
            look["half_sizes"] = half
            self._see(drawn, np.concatenate([-half, half]))
        self._add(drawn, rr.Ellipsoids3D, times, look)

    def _round(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        look, is_capsule = self._fill(drawn, changes, times), drawn.kind == "capsule"
        if changes.keys() & {"radius", "length"}:
            radius, length = drawn.values["radius"], drawn.values["length"]
            look["radii"], look["lengths"] = np.array([radius]), np.array([length])
            if is_capsule:
                look["translations"] = np.array([[0.0, 0.0, -length / 2]])
            half = np.array([radius, radius, length / 2 + (radius if is_capsule else 0.0)])
            self._see(drawn, np.stack([-half, half]))
        self._add(drawn, rr.Capsules3D if is_capsule else rr.Cylinders3D, times, look)

    def _robot(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        values = drawn.values
        if not drawn.shapes and not drawn.bodies.size:
            frames = [self._rows.next_frame() for _ in values["bodies"]]
            drawn.shapes, rest = draw_robot(
                self._rows, drawn.entity, values, frames, self._world, self._resolution
            )
            drawn.bodies = self._bodies.add(frames)
            if changes.get("poses") is None:
                changes["poses"] = rest
            if drawn.in_view:
                self._see_robot(drawn)
        if drawn.is_new:
            place_shapes(self._rows, drawn.shapes, times, is_visible=not drawn.is_hidden)
        if drawn.is_new or changes.keys() & {"color", "alpha"}:
            tint_robot(self._rows, drawn.shapes, values, times)
        poses = changes.get("poses")
        if poses is not None:
            place = {"position": poses[:, :3], "orientation": poses[:, 3:]}
            self._bodies.move(drawn.bodies, times, place)

    def _see_robot(self, drawn: Item) -> None:
        """Keep a robot's shapes and the origins of its bodies in view."""
        for number, body in enumerate(drawn.bodies):
            shapes = [shape for _, shape in drawn.shapes if shape.body == number]
            self._bodies.set_box(int(body), corners_of(shapes))
        fixed = [shape for _, shape in drawn.shapes if shape.body is None]
        if fixed:
            self._layout.frame(self._id).see(*extremes(corners_of(fixed)))

    # Windows next to the scene ---------------------------------------------------------------

    def _image(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        if drawn.is_new:
            self._layout.add_window(self._id, drawn.name, rrb.Spatial2DView, drawn.entity)
        self._rows.add_archetype(drawn.entity, rr.Image(changes["image"]), times)

    def _text(self, drawn: Item, changes: dict[str, Any], times: Times) -> None:
        if drawn.is_new:
            markdown = rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN)
            self._rows.add_static(drawn.entity, markdown)
            if self._draws_shapes:
                self._layout.add_text(self._id, drawn.name, drawn.entity)
        if "content" in changes:
            content = str(changes["content"])
            self._rows.add(drawn.entity, rr.TextDocument, times, text=[content])

    def _scalars(self, drawn: Item, changes: Mapping[str, Any], times: Times) -> None:
        if drawn.is_new:
            labels = drawn.values["labels"]
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
        if values is not None:
            self._rows.add(drawn.entity, rr.Scalars, times, scalars=values)


def _radius(size: float | None, default: float) -> Array:
    return np.array([default if size is None else size], np.float32)


def _size(points: Array) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
