"""ViserVisualizer: shows environments in a browser, and takes what a person does there."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import viser

from physx_core import Visualizer
from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.components import Event
from physx_core.config import at_least, options
from physx_core.errors import VisualizerError, listed
from physx_core.typing import Array
from physx_viser.scene import Item, Scene

_APART = 0.5
"""Time in s by which a simulation may be early or late; beyond, its clock is set anew."""


@dataclass
class Grip:
    """What the mouse has taken.

    Attributes:
        item: The object.
        node: Its node.
        at: The place of the node in the world's frame, as the browser knows it.
        to: Where the mouse is.
    """

    item: Item
    node: int
    at: Array
    to: Array


@options
@dataclass(eq=False)
class ViserVisualizer(Visualizer):
    """Shows environments on a page with a slider for each control, and lets people pull at them.

    Attributes:
        server: The page; None: it is closed.
        grips: What is pulled, by instance.
    """

    host: str = "127.0.0.1"
    """Address of the page; "0.0.0.0": anybody who reaches this machine can touch the simulation."""
    port: int = at_least(1, 8080)
    """Port of the page; if it is taken, the next one that is free."""
    strength: float = at_least(0, 10.0)
    """Force of a pull in N for each m that the mouse is away from what it has taken."""
    speed: float = at_least(0, 1.0)
    """Simulated seconds in a second, if environments have a `step_time`; 0: as fast as they can."""
    max_instances: int = at_least(1, 4)
    """How many instances are drawn."""
    rate: float = at_least(1, 30.0)
    """Pictures in a second."""

    clock: ClassVar[Clock] = SYSTEM_CLOCK

    def __post_init__(self) -> None:
        """Begin without a page."""
        self._reset()

    def _reset(self) -> None:
        self.server: viser.ViserServer | None = None
        self.grips: dict[int, Grip] = {}
        self._scenes: dict[int, Scene] = {}
        self._offsets: dict[int, Array] = {}
        self._sliders: list[Any] = []
        self._lines: dict[int, Any] = {}
        self._seconds: dict[int, float] = {}
        self._begun: dict[int, float] = {}
        self._drawn = float("-inf")

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Open the page: see `Observer.open`.

        Raises:
            VisualizerError: If no port is free.
        """
        self.close()
        try:
            with redirect_stdout(io.StringIO()):  # it prints a table
                self.server = viser.ViserServer(self.host, self.port, run_name, verbose=False)
        except OSError as error:
            raise VisualizerError(f"No page can be opened at {self.host}: {error}.") from error
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.scene.set_up_direction("+z")

    def announcements(self) -> Sequence[str]:
        """Tell where the page is: see `Observer.announcements`."""
        if self.server is None:
            return ()
        return [f"viewer: http://{self.server.get_host()}:{self.server.get_port()}"]

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Draw the events of one step; see `Observer.events`.

        Raises:
            VisualizerError: If a robot cannot be drawn.
        """
        if self.server is None or instance_id > self.max_instances:
            return
        scene = self._scenes.get(instance_id)
        if scene is None:
            scene = self._scenes[instance_id] = self._make_scene(instance_id)
        for event in events:
            if event.kind == "time":
                self._seconds[instance_id] = float(event.values["seconds"])
            elif event.kind == "controls":
                scene.pulls = list(event.values["pulls"])
                self._add_sliders(event.values)
            elif event.kind == "view" and event.action == "add":
                self._look(event.values)
        scene.take(events)
        now = self.clock.monotonic()
        if now - self._drawn >= 1 / self.rate:
            self._drawn = now
            self._draw()

    def _make_scene(self, instance_id: int) -> Scene:
        assert self.server is not None

        def drag(item: Item, part: int | None, event: Any) -> None:
            self.drag(instance_id, item, part, event)

        return Scene(self.server.scene, f"/{instance_id}", drag)

    def _look(self, values: Mapping[str, Any]) -> None:
        assert self.server is not None
        self.server.gui.set_panel_label(str(values["title"]))
        for option, place in (("position", "eye"), ("look_at", "target")):
            if values.get(place) is not None:
                setattr(self.server.initial_camera, option, np.asarray(values[place]))

    def _add_sliders(self, values: Mapping[str, Any]) -> None:
        """Add the sliders, which are those of all instances."""
        if self._sliders or self.server is None:
            return
        columns = (values["labels"], values["low"], values["high"], values["values"])
        for label, low, high, value in zip(*columns, strict=True):
            step = (high - low) / 200
            self._sliders.append(self.server.gui.add_slider(label, low, high, step, value))
        begin = [slider.value for slider in self._sliders]
        if begin:
            button = self.server.gui.add_button("as at the beginning")

            @button.on_click
            def _(_: Any) -> None:
                for slider, value in zip(self._sliders, begin, strict=True):
                    slider.value = value

        if values["pulls"]:
            self.server.gui.add_markdown(f"Drag with the mouse: {', '.join(values['pulls'])}")

    def _draw(self) -> None:
        assert self.server is not None
        with self.server.atomic():
            for number, scene in self._scenes.items():
                if number not in self._offsets and scene.items:
                    self._place(number)
                scene.draw()
            for number in [*self.grips, *self._lines]:
                self._draw_pull(number)

    def _place(self, number: int) -> None:
        """Place an instance beside the others, and the camera before all of them."""
        assert self.server is not None
        low, high = self._scenes[number].extent()
        size = float(np.linalg.norm(high - low)) or 1.0
        offset = np.array([0.0, (number - 1) * (1.3 * (high - low)[1] + 0.2 * size), 0.0])
        self._offsets[number] = offset
        self._scenes[number].move(offset)
        camera = self.server.initial_camera
        camera.look_at = 0.5 * (low + high + offset)
        camera.position = camera.look_at + np.array([1.3, -0.9, 0.7]) * max(size, offset[1])

    def _draw_pull(self, number: int) -> None:
        """Draw the line from what is pulled to the mouse."""
        assert self.server is not None
        line, grip = self._lines.pop(number, None), self.grips.get(number)
        if line is not None:
            line.remove()
        if grip is not None:
            ends = np.stack([self._held(number, grip), grip.to])[np.newaxis]
            red = (220, 40, 40)
            name = f"/pull/{number}"
            self._lines[number] = self.server.scene.add_line_segments(
                name, ends, red, thickness=3.0, thickness_units="screen"
            )

    # What a person does ---------------------------------------------------------------------

    def drag(self, instance_id: int, item: Item, part: int | None, event: Any) -> None:
        """Take, move or let go of an object, as viser's event tells."""
        grip = self.grips.get(instance_id)
        at, to = np.array(event.start_position), np.array(event.end_position)
        if event.phase == "end":
            self.grips.pop(instance_id, None)
        elif event.phase == "start" or grip is None or grip.item is not item:
            node = self._nearest(instance_id, item, at) if part is None else part
            self.grips[instance_id] = Grip(item, node, at, to)
        else:
            self.grips[instance_id] = Grip(item, grip.node, at, to)

    def _nearest(self, instance_id: int, item: Item, at: Array) -> int:
        distances = item.points() + self._offsets.get(instance_id, np.zeros(3)) - at
        return int(np.linalg.norm(distances, axis=1).argmin())

    def _held(self, instance_id: int, grip: Grip) -> Array:
        """Return where the node is now; for a body, the place on it that was taken."""
        if grip.item.kind not in ("mesh", "points", "symbols"):
            return grip.at
        here: Array = grip.item.points()[grip.node] + self._offsets[instance_id]
        return here

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return the sliders' values and the pull, as late as simulated time is: see `Observer`."""
        self._wait(instance_id)
        scene = self._scenes.get(instance_id)
        if self.server is None or scene is None:
            return ()
        grip, pull = self.grips.get(instance_id), [-1.0, 0.0, 0.0, 0.0, 0.0]
        if grip is not None and grip.item.name in scene.pulls:
            force = self.strength * (grip.to - self._held(instance_id, grip))
            pull = [scene.pulls.index(grip.item.name), grip.node, *force.tolist()]
        return [*(float(slider.value) for slider in self._sliders), *pull]

    def _wait(self, instance_id: int) -> None:
        """Hold an instance back until its simulated time has come."""
        seconds = self._seconds.get(instance_id)
        if not self.speed or seconds is None:
            return
        now, due = self.clock.monotonic(), seconds / self.speed
        begun = self._begun.setdefault(instance_id, now - due)
        if abs(now - begun - due) > _APART:
            begun = self._begun[instance_id] = now - due
        if (early := begun + due - now) > 0:
            self.clock.sleep(early)

    def close(self) -> None:
        """Close the page: see `Observer.close`."""
        server, ignored = (
            self.server,
            {kind for each in self._scenes.values() for kind in each.ignored},
        )
        self._reset()
        if server is not None:
            with redirect_stdout(io.StringIO()):
                server.stop()
        if ignored:
            warnings.warn(f"The page does not show: {listed(sorted(ignored))}.", stacklevel=2)
