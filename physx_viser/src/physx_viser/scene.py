"""Scene: the objects of one environment instance on the page."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.components import Event
from physx_core.typing import Array
from physx_viser.shapes import DRAW, RobotNode, pose

if TYPE_CHECKING:
    from viser import SceneApi

Drag = Callable[["Item", int | None, Any], None]
"""Receives an object, the body of a robot or the number of a point, and viser's event."""
_POSE = {"position", "orientation"}
_MOVES = {"mesh": {"positions"}, "points": {"positions"}, "symbols": {"positions"}}


class Item:
    """An object.

    Attributes:
        name: Its name.
        kind: Its kind.
        values: Its options.
        node: What viser shows; None: nothing yet.
    """

    def __init__(self, name: str, kind: str) -> None:
        """Begin without options."""
        self.name, self.kind = name, kind
        self.values: dict[str, Any] = {}
        self.node: Any = None
        self.changed: set[str] = set()

    def points(self) -> Array:
        """Return points on it in the environment's frame, shape (n, 3)."""
        values = self.values
        if values.get("positions") is not None:
            found = values["positions"]
            lines = self.kind == "lines"
            return np.concatenate([np.zeros((0, 3)), *found]) if lines else np.asarray(found)
        if values.get("poses") is not None:
            return np.asarray(values["poses"])[:, :3]
        own = values.get("position")
        return np.atleast_2d(np.zeros(3) if own is None else np.asarray(own))


class Scene:
    """Collects what an instance draws, and sends it to the page when it is due.

    Attributes:
        items: The objects by name.
    """

    def __init__(self, api: SceneApi, root: str, drag: Drag) -> None:
        """Begin with an empty frame.

        Args:
            api: The page's scene.
            root: Name of the frame.
            drag: Called when somebody drags at an object that can be pulled.
        """
        self._api, self._drag = api, drag
        self._frame, self._root = api.add_frame(root, show_axes=False), root
        self.items: dict[str, Item] = {}
        self.pulls: list[str] = []
        self.ignored: set[str] = set()

    def move(self, offset: Array) -> None:
        """Place the frame in the world."""
        self._frame.position = offset

    def take(self, events: Iterable[Event]) -> None:
        """Note changes, which `draw` shows."""
        for event in events:
            for each in event.each():
                self._take(each)

    def _take(self, event: Event) -> None:
        if event.kind not in DRAW:
            self.ignored |= {event.kind} - {"controls", "view", "time"}
            return
        if event.action == "remove":
            item = self.items.pop(event.name, None)
            if item is not None and item.node is not None:
                item.node.remove()
            return
        item = self.items.setdefault(event.name, Item(event.name, event.kind))
        item.values |= event.values
        item.changed |= event.values.keys()
        if event.name in self.pulls:  # it keeps its node, which has one color, while it is pulled
            item.changed -= {"scalar_field", "vmin", "vmax"}

    def draw(self) -> None:
        """Send what has changed to the page."""
        for item in self.items.values():
            if item.changed:
                self._draw(item)
                item.changed.clear()

    def _draw(self, item: Item) -> None:
        node, values, changed = item.node, item.values, item.changed
        hidden = values.get("visible") is False
        if node is not None and not hidden and changed <= _POSE:
            for option, value in pose(values).items():
                setattr(node, option, value)
        elif node is not None and isinstance(node, RobotNode) and changed == {"poses"}:
            node.place(values["poses"])
        elif node is not None and not hidden and changed <= _MOVES.get(item.kind, set()):
            self._deform(item)
        else:
            if node is not None:
                node.remove()
            item.node = None if hidden else self._make(item)

    def _deform(self, item: Item) -> None:
        node, values = item.node, item.values
        if hasattr(node, "vertices"):
            node.vertices = np.asarray(values["positions"], np.float32)
        elif item.kind != "mesh" and len(values["positions"]) == len(node.batched_positions):
            node.batched_positions = np.asarray(values["positions"], np.float32)
        else:
            node.remove()
            item.node = self._make(item)

    def _make(self, item: Item) -> Any:
        values = item.values
        if item.name in self.pulls:
            values = {**values, "scalar_field": None}
        node = DRAW[item.kind](self._api, f"{self._root}/{item.name}", values)
        parts = node.shapes if isinstance(node, RobotNode) else [(node, None)]
        for part, body in parts if item.name in self.pulls else ():
            self._bind(part, item, body)
        return node

    def _bind(self, node: Any, item: Item, body: int | None) -> None:
        async def drag(event: Any) -> None:  # a coroutine, so that events keep their order
            self._drag(item, event.instance_index if body is None else body, event)

        node.on_drag(drag)

    def extent(self) -> tuple[Array, Array]:
        """Return the lower and upper corner of what is drawn."""
        found = [np.zeros((0, 3)), *(item.points() for item in self.items.values())]
        points = np.concatenate(found)
        if not len(points):
            return np.full(3, -0.5), np.full(3, 0.5)
        return points.min(axis=0), points.max(axis=0)
