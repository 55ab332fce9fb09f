"""WindowLayout: lays out the viewer's windows for the drawn objects."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

import rerun as rr
import rerun.blueprint as rrb

from physx_core.typing import Array
from physx_rerun.drawing.chunks import SIM_TIME, TIME
from physx_rerun.drawing.framing import Frame
from physx_rerun.drawing.legends import legend

_BACKGROUND = (25, 28, 36)
_GRID = (58, 63, 76)

_ROW = 3  # largest number of scenes next to each other
_COLUMN = 4  # largest number of plots in a column

_Window = type[rrb.Spatial2DView | rrb.TensorView]
Container = rrb.Grid | rrb.Vertical | rrb.Horizontal | rrb.Tabs


@dataclass
class WindowLayout:
    """Registers scenes, plots and texts, and lays out the viewer's windows for them.

    Attributes:
        instance_nb: Number of environment instances that can draw.
        changed: Whether something was added since the last call of `blueprint`.
        has_time_panel: Whether to show the time panel.
        has_sim_time: Whether the simulated time is known.
    """

    instance_nb: int
    changed: bool = False
    has_time_panel: bool = True
    has_sim_time: bool = False
    _kinds: set[tuple[str, str]] = field(default_factory=set)
    _scenes: dict[int, Frame] = field(default_factory=dict)
    _plots: dict[str, dict[str, int]] = field(default_factory=dict)
    _windows: dict[str, dict[int, tuple[_Window, str]]] = field(default_factory=dict)
    _texts: dict[str, dict[int, str]] = field(default_factory=dict)
    _timelines: set[str] = field(default_factory=set)
    _titles: dict[int, str] = field(default_factory=dict)
    _cameras: dict[int, dict[str, Array]] = field(default_factory=dict)
    _followed: dict[int, str] = field(default_factory=dict)

    def set_view(self, instance_id: int, title: str, **camera: Array) -> None:
        """Set the title of an instance's window and place its camera."""
        self._titles[instance_id] = title
        self._cameras[instance_id] = camera
        self._kinds.add(("view", title))
        self.changed = True

    def follow(self, instance_id: int, entity: str, place: Array | None) -> None:
        """Make an instance's camera follow an entity, now at the position `place`, shape (3,)."""
        self._followed[instance_id] = entity
        if place is not None:  # the viewer looks there, regardless of the target
            self._cameras[instance_id] = {"target": place, **self._cameras.get(instance_id, {})}
        self._kinds.add(("follow", entity))
        self.changed = True

    def title(self, instance_id: int) -> str:
        """Return the title of an instance, by default its number."""
        return self._titles.get(instance_id, str(instance_id))

    def add_object(self, instance_id: int, kind: str, name: str) -> None:
        """Register a shape in the scene of an instance."""
        self.changed |= instance_id not in self._scenes
        self._scenes.setdefault(instance_id, Frame())
        self._kinds.add((kind, name))

    def add_plot(self, name: str, entity: str, timeline: str, curve_nb: int) -> None:
        """Register an entity with `curve_nb` curves in the plot with that name."""
        self._plots.setdefault(name, {})[entity] = curve_nb
        self._timelines.add(timeline)
        self._kinds.add(("plot", name))
        self.changed = True

    def add_timeline(self, timeline: str) -> None:
        """Register a timeline of something shown."""
        self._timelines.add(timeline)

    def add_text(self, instance_id: int, name: str, entity: str) -> None:
        """Register a text of an instance."""
        self._texts.setdefault(name, {})[instance_id] = entity
        self._kinds.add(("text", name))
        self.changed = True

    def add_window(self, instance_id: int, name: str, view: _Window, entity: str) -> None:
        """Register an entity of an instance with its own window."""
        self._windows.setdefault(name, {})[instance_id] = (view, entity)
        self._kinds.add((view.__name__, name))
        self.changed = True

    def frame(self, instance_id: int) -> Frame:
        """Return the view of an instance's camera, by default everything ever in the scene."""
        return self._scenes.setdefault(instance_id, Frame())

    def grow(self, instance_id: int) -> None:
        """Zoom out if something of an instance is out of view, unless its camera is placed."""
        is_placed = "eye" in self._cameras.get(instance_id, {}) or instance_id in self._followed
        if instance_id in self._scenes and not is_placed:
            self.changed |= self._scenes[instance_id].grow()

    def digest(self, kinds: Set[tuple[str, str]] = frozenset()) -> str:
        """Return a string that is the same for equal sets of objects and numbers of instances.

        Rerun stores a user's layout by application; runs that show the same things share it.

        Args:
            kinds: Further things shown.
        """
        text = repr((self.instance_nb, sorted(self._kinds | kinds)))
        return hashlib.sha256(text.encode()).hexdigest()[:8]

    @property
    def timeline(self) -> str:
        """Timeline that the viewer starts with: one on which everything is visible."""
        if self._scenes or self._texts or "step" in self._timelines:
            known = SIM_TIME if self.has_sim_time else "step"
            return known if self._timelines <= {"step"} else TIME
        return "batch" if "batch" in self._timelines else next(iter(self._timelines), TIME)

    def blueprint(self, further: Sequence[rrb.View | Container] = ()) -> rrb.Blueprint:
        """Return the windows: the scenes, and next to or below them the plots and texts.

        Two or three scenes are placed in a row above the rest, and cameras that are not placed by
        the environment have the same distance, for easy comparison.

        Args:
            further: More plots.
        """
        self.changed = False
        zoom = max((self._distance(each) for each in self._scenes), default=0.0)
        scenes = [self._scene_view(instance_id, zoom) for instance_id in sorted(self._scenes)]
        plots: list[rrb.View | Container] = [
            *(_plot_view(name, curves) for name, curves in self._plots.items()),
            *further,
            *(self._window_views(name, views) for name, views in self._windows.items()),
        ]
        texts = [self._text_views(name, entities) for name, entities in self._texts.items()]
        in_a_row = 1 < len(scenes) <= _ROW
        parts: list[Container] = []
        shares = []
        if scenes:
            columns = len(scenes) if in_a_row else math.ceil(math.sqrt(len(scenes)))
            parts.append(rrb.Grid(*scenes, grid_columns=columns))
            shares.append(3)
        if plots and (len(plots) > _COLUMN or not scenes):
            parts.append(_rows_of(plots))
            shares.append(3)
            plots = []
        if plots or texts:
            sizes = [*[2] * len(plots), *[1] * len(texts)]
            if in_a_row:
                parts.append(rrb.Horizontal(*plots, *texts, column_shares=sizes))
            else:
                parts.append(rrb.Vertical(*plots, *texts, row_shares=sizes))
            shares.append(2)
        return rrb.Blueprint(
            rrb.Vertical(*parts, row_shares=shares)
            if in_a_row
            else rrb.Horizontal(*parts, column_shares=shares),
            rrb.TimePanel(
                timeline=self.timeline, state="collapsed" if self.has_time_panel else "hidden"
            ),
            auto_layout=False,
            auto_views=False,
            collapse_panels=True,
        )

    def _text_views(self, name: str, entities: Mapping[int, str]) -> Container:
        several = self.instance_nb > 1
        return rrb.Tabs(
            *(
                rrb.TextDocumentView(
                    origin=entity, name=f"{name} {instance_id}" if several else name
                )
                for instance_id, entity in sorted(entities.items())
            )
        )

    def _window_views(self, name: str, views: Mapping[int, tuple[_Window, str]]) -> Container:
        several = self.instance_nb > 1
        return rrb.Tabs(
            *(
                view(origin=entity, name=f"{name} {instance_id}" if several else name)
                for instance_id, (view, entity) in sorted(views.items())
            )
        )

    def _distance(self, instance_id: int) -> float:
        """Return the distance from which a camera shows all of its scene; 0 if it is placed."""
        camera = self._cameras.get(instance_id, {})
        if "eye" in camera:
            return 0.0
        return self._scenes[instance_id].camera(camera.get("target"))[2]

    def _scene_view(self, instance_id: int, zoom: float) -> rrb.Spatial3DView:
        camera = self._cameras.get(instance_id, {})
        frame = self._scenes[instance_id]
        position, target, distance = frame.camera(camera.get("target"), zoom)
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=camera.get("eye", position),
            look_target=target,
            eye_up=(0.0, 0.0, 1.0),
            tracking_entity=self._followed.get(instance_id),
        )
        default = f"environment {instance_id}" if self.instance_nb > 1 else "environment"
        return rrb.Spatial3DView(
            origin=f"env_{instance_id}",
            name=self._titles.get(instance_id, default),
            background=rrb.Background(color=_BACKGROUND),
            line_grid=rrb.LineGrid3D(
                visible=True,
                spacing=10.0 ** math.floor(math.log10(distance / 2.6)),
                plane=rr.components.Plane3D.XY,
                stroke_width=1.0,
                color=_GRID,
            ),
            eye_controls=eye,
        )


def _rows_of(plots: Sequence[rrb.View | Container]) -> Container:
    """Return plots in rows of a square; unlike in a grid, those of the last row fill it."""
    count = math.ceil(math.sqrt(len(plots)))
    rows = [plots[first : first + count] for first in range(0, len(plots), count)]
    return rrb.Vertical(*(rrb.Horizontal(*row) for row in rows))


def _plot_view(name: str, curves: Mapping[str, int]) -> rrb.TimeSeriesView:
    shown = legend(sum(curves.values()))
    return rrb.TimeSeriesView(name=name, contents=list(curves), plot_legend=shown)
