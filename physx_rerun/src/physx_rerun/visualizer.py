"""RerunVisualizer: an observer that shows a run in the Rerun viewer."""

from __future__ import annotations

import physx_rerun.viewer.messages  # isort: skip  # noqa: F401  (before Rerun is imported)

import contextlib
import re
import shlex
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import rerun as rr

from physx_core import Visualizer
from physx_core.components import Cursor, Event
from physx_core.config import at_least, options
from physx_core.errors import ConfigError, VisualizerError
from physx_core.fields import Field
from physx_core.typing import Array
from physx_rerun.drawing.changes import Changes
from physx_rerun.drawing.chunks import SIM_TIME, TIME, ChunkBuilder, Times
from physx_rerun.drawing.clock import SimulatedClock
from physx_rerun.drawing.dashboard import Dashboard
from physx_rerun.drawing.drawing import Drawing
from physx_rerun.drawing.windows import WindowLayout
from physx_rerun.viewer.cursor import USUAL_PORT, find_cursor
from physx_rerun.viewer.headless import render_picture
from physx_rerun.viewer.offscreen import OffscreenViewer
from physx_rerun.viewer.streams import RecordingStreams
from physx_rerun.viewer.viewer import Viewer, has_display, is_listening, start_web_viewer

MODES = ("save", "spawn", "connect", "web", "headless", "offscreen", "none")
FLUSH_SECONDS = 0.2
FLUSH_STEPS = 1000
FLUSH_BYTES = 8_000_000
_MARK = "picture"


@options
@dataclass(eq=False)
class RerunVisualizer(Visualizer):
    """Draws environments and training curves in the Rerun viewer and saves them as a recording.

    Attributes:
        viewer: The started viewer, or None.
        file: The recording's file, or None.
    """

    mode: str = field(default="save", metadata={"choices": MODES})
    """"save": only write a file; "spawn": open a viewer; "connect": show in running viewers;
    "web": serve a page for browsers; "headless": write a file, and a picture at the end;
    "offscreen": render pictures for `capture`; "none": neither draw nor write."""
    path: str | Path | None = None
    """The .rrd file; None: a new file in the session's folder, named after the run."""
    save: bool = True
    """Whether to write the file."""
    address: str | Sequence[str] | None = None
    """Viewers to connect to, each "HOST:PORT"; they can be started later, and restarted."""
    port: int = at_least(0, 0)
    """Port of the opened viewer; 0: any free one."""
    page_port: int = at_least(0, 0)
    """Port of the page of the mode "web"; 0: any free one."""
    memory_limit: str = "2GB"
    """Memory limit of the opened viewer, beyond which it drops the oldest rows."""
    picture: str | Path | None = None
    """Picture of the headless mode; None: next to the file, with the suffix .png."""
    picture_size: tuple[int, int] = (1600, 900)
    """Width and height in pixels of the pictures of the headless and offscreen modes."""
    detail: float = at_least(0, 3.0)
    """Size in pixels of the smallest mesh details drawn in offscreen pictures filled by a robot;
    0: all details, which take most of the time without a GPU."""
    max_instances: int = at_least(0, 4)
    """Number of instances to draw completely; for others, only numbers and texts are recorded."""
    every: int = at_least(1, 1)
    """Record every n-th step of an environment."""

    def __post_init__(self) -> None:
        """Check that the options are consistent, and start with an empty scene.

        Raises:
            ConfigError: If options are inconsistent.
        """
        self._check_options()
        self._reset()

    def _reset(self) -> None:
        self.viewer: Viewer | None = None
        self._offscreen: OffscreenViewer | None = None
        self._step, self._pictures, self._has_drawn = 0, 0, False
        self.file: Path | None = None
        self._announcements: list[str] = []
        self._outputs: list[str] = []
        self._run_name, self._session_dir = "run", Path()
        self._addresses: list[str] = []
        self._recording: RecordingStreams | None = None
        self._is_open = False
        self._begun = time.monotonic()
        self._flushed, self._waiting = float("-inf"), 0
        self._rows, self._layout = ChunkBuilder(), WindowLayout(1)
        self._drawings: dict[int, Drawing] = {}
        self._clocks: dict[int, SimulatedClock] = {}
        self._changes: dict[int, Changes] = {}
        self._dashboard = Dashboard(self._rows)
        self._positions: dict[str, int] = {}

    @classmethod
    def offscreen(cls, size: tuple[int, int]) -> Self:
        """Return one for pictures: see `Visualizer.offscreen`."""
        return cls(mode="offscreen", save=False, picture_size=size)

    @classmethod
    def cursor(cls) -> Cursor:
        """Return where the cursor stands: see `Visualizer.cursor`."""
        address = f"127.0.0.1:{USUAL_PORT}"
        return Cursor(*find_cursor(address), {"mode": "connect", "address": address})

    def _check_options(self) -> None:
        addresses = self._given_addresses()
        if self.mode == "connect" and not (addresses and all(map(_is_address, addresses))):
            raise ConfigError('mode "connect" needs address="HOST:PORT", or a list of addresses.')
        if self.mode != "connect" and self.address is not None:
            raise ConfigError(f'address is for mode "connect", not for "{self.mode}".')
        if self.mode != "headless" and self.picture is not None:
            raise ConfigError(f'picture is for mode "headless", not for "{self.mode}".')
        if self.mode != "web" and self.page_port:
            raise ConfigError(f'page_port is for mode "web", not for "{self.mode}".')
        if self.mode in ("save", "headless") and not self.save:
            raise ConfigError(f'mode "{self.mode}" needs the file: set save=True.')
        if min(self.picture_size) < 64:
            raise ConfigError(f"picture_size {self.picture_size} is smaller than 64 pixels.")

    def _given_addresses(self) -> list[str]:
        given = self.address or ()
        return [given] if isinstance(given, str) else list(given)

    # What the pipeline calls ----------------------------------------------------------------

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Connect to or start the viewer and choose the file; see `Observer.open`.

        Raises:
            VisualizerError: If a viewer cannot be started, for example without a display.
        """
        self._reset()
        if self.mode == "none":
            return
        self._run_name, self._layout = run_name, WindowLayout(instance_nb)
        self._session_dir = Path(session_dir)
        self._layout.has_time_panel = self.mode != "offscreen"
        if self.mode == "connect":
            self._addresses = self._given_addresses()
            self._announcements = [
                f"viewer: none at {address} yet; start one there with: "
                f"rerun --bind 127.0.0.1 --port {address.rpartition(':')[2]}"
                for address in self._addresses
                if not is_listening(address)
            ]
        if self.mode == "spawn":
            self._spawn()
        if self.mode == "web":
            limit = ("--server-memory-limit", self.memory_limit)
            self.viewer = start_web_viewer(self.port, self.page_port, *limit)
            self._addresses = [self.viewer.address]
            self._announcements = [f"viewer: {self.viewer.page}"]
        if self.mode == "offscreen":
            self._offscreen = OffscreenViewer(self.picture_size, self.memory_limit)
            self._addresses = [self._offscreen.address]
        if self.save:
            self.file = Path(self.path) if self.path else _unused_path(Path(session_dir), run_name)
        self._is_open = True

    def _spawn(self) -> None:
        if not has_display():
            raise VisualizerError(
                'mode "spawn" opens a window, but there is no display. Use mode "headless" for a '
                'picture, or mode "save" and open the file elsewhere with: rerun FILE.rrd'
            )
        options = ("--memory-limit", self.memory_limit, "--expect-data-soon")
        self.viewer = Viewer(self.port, options, detached=True)
        self.viewer.wait_until_ready()
        self.viewer.check(wait=1.0)  # it listens before its window opens
        self._addresses = [self.viewer.address]

    def announcements(self) -> Sequence[str]:
        """Tell where the viewer is, or how to start one: see `Observer.announcements`."""
        return self._announcements

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Draw the events of one step; see `Observer.events`.

        Raises:
            VisualizerError: If an event cannot be drawn.
            ConfigError: If a color or colormap does not exist.
        """
        if not self._is_open:
            return
        self._step = step
        clock = self._clocks.get(instance_id)
        if clock is None:
            clock = self._clocks[instance_id] = SimulatedClock()
        events = clock.read(events)
        self._has_drawn = self._has_drawn or bool(events)
        if self.every > 1:
            changes = self._changes.setdefault(instance_id, Changes())
            if changes.add(step, events) and step % self.every:
                return
            events = changes.pop()
        self._draw(instance_id, step, events)

    def _draw(self, instance_id: int, step: int, events: list[Event]) -> None:
        if instance_id not in self._drawings:
            self._drawings[instance_id] = Drawing(
                instance_id,
                self._rows,
                self._layout,
                draws_shapes=instance_id <= self.max_instances,
                resolution=self._resolution,
            )
        now = self._now()
        times = {"step": step, TIME: now}
        seconds = self._clocks[instance_id].seconds
        if seconds is not None:
            times[SIM_TIME] = seconds
            self._layout.has_sim_time = True
        self._drawings[instance_id].draw(events, times)
        self._flush_if_due(now)

    def _draw_changes(self) -> None:
        for instance_id, changes in self._changes.items():
            self._draw(instance_id, changes.step, changes.pop())

    def capture(self) -> Array | None:
        """Return a picture of the last step in the offscreen mode; see `Visualizer.capture`.

        Raises:
            VisualizerError: If the viewer ended or takes too long, or nothing was drawn.
        """
        if self._offscreen is None:
            return None
        self._draw_changes()
        self._pictures += 1
        # Rows arrive in order: once this one has arrived, all rows of the picture have.
        self._rows.add(_MARK, rr.Scalars, {_MARK: self._pictures}, scalars=[0.0])
        self._flush()
        return self._offscreen.picture(self._step, _MARK, self._pictures)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Add points to the curves of the training; see `Observer.scalars`."""
        if not self._is_open:
            return
        self._dashboard.scalars(values, self._times(step, timeline))
        self._flush_if_due()

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Show the histogram of the finite numbers; see `Observer.histograms`."""
        if not self._is_open:
            return
        self._dashboard.histograms(values, self._times(step, timeline))
        self._flush_if_due()

    def fields(self, fields: Sequence[Field]) -> None:
        """Store the units of the training's samples; see `Observer.fields`."""
        self._dashboard.fields(fields)

    def predictions(
        self, predicted: Mapping[str, Array], truth: Mapping[str, Array], step: int, timeline: str
    ) -> None:
        """Show predicted versus true values; see `Observer.predictions`."""
        if not self._is_open:
            return
        self._dashboard.predictions(predicted, truth, self._times(step, timeline))
        self._flush_if_due()

    def note(self, text: str) -> None:
        """Add the text to the notes; see `Observer.note`."""
        if not self._is_open:
            return
        self._dashboard.note(text, {**self._positions, TIME: self._now()})
        self._flush_if_due()

    def close(self) -> None:
        """Finish the file, disconnect the viewer, render the picture; see `Observer.close`.

        Raises:
            VisualizerError: If the picture cannot be rendered.
        """
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._draw_changes()
            self._flush()
        finally:
            if self._recording is not None:
                self._recording.close()
            if self._offscreen is not None:
                self._offscreen.close()
                self._offscreen = None
            if self.mode == "web" and self.viewer is not None:
                self.viewer.end()
        if self._recording is None:
            if self._clocks and not self._has_drawn:
                warnings.warn(
                    "Nothing was recorded, as the environment draws nothing: add objects to its "
                    "factory in init_visualization().",
                    stacklevel=2,
                )
            return
        self._recording = self._offscreen = None
        if self.file is None:
            return
        self._outputs.append(f"recording: {self.file}  (physx view {shlex.quote(str(self.file))})")
        if self.mode == "headless":
            picture = Path(self.picture) if self.picture else self.file.with_suffix(".png")
            render_picture(self.file, picture, self.picture_size, timeline=self._layout.timeline)
            self._outputs.append(f"picture: {picture}")

    def outputs(self) -> Sequence[str]:
        """Name the recording and the picture, if any: see `Observer.outputs`."""
        return self._outputs

    # Flushing -------------------------------------------------------------------------------

    def _describe(self) -> None:
        """Put the session's configuration into the recording; other folders have none."""
        path = self._session_dir / "config.toml"
        if (self._session_dir / "info.txt").is_file() and path.is_file():
            with contextlib.suppress(OSError, ValueError):
                self._dashboard.describe(path.read_text("utf-8"))

    def _times(self, step: int, timeline: str) -> Times:
        """Return the current position on all timelines of the training."""
        self._positions[timeline] = step
        self._layout.add_timeline(timeline)
        return {**self._positions, TIME: self._now()}

    @property
    def _resolution(self) -> float | None:
        """Size of a robot divided by that of its smallest details to draw; None: all details."""
        is_drawn_roughly = self.mode == "offscreen" and self.detail > 0
        return max(self.picture_size) / self.detail if is_drawn_roughly else None

    def _now(self) -> float:
        return time.monotonic() - self._begun

    def _flush_if_due(self, now: float | None = None) -> None:
        now = self._now() if now is None else now
        self._waiting += 1
        full = self._waiting >= FLUSH_STEPS or self._rows.nbytes >= FLUSH_BYTES
        if full or now - self._flushed >= FLUSH_SECONDS:
            self._flush()

    def _flush(self) -> None:
        chunks = self._rows.pop_chunks()
        self._flushed, self._waiting = self._now(), 0
        if self._recording is None:
            if not chunks:
                return
            self._describe()
            chunks += self._rows.pop_chunks()
            self._recording = RecordingStreams(
                f"physx {self._run_name} {self._layout.digest(self._dashboard.kinds)}",
                self._run_name,
                self.file,
                self._addresses,
                owns_viewer=self.viewer is not None or self._offscreen is not None,
            )
        if self._layout.changed or self._dashboard.changed:
            # Before the rows, so pictures of these rows have this layout.
            self._recording.write_blueprint(self._layout.blueprint(self._dashboard.cells()))
        self._recording.write(chunks)


def _is_address(text: str) -> bool:
    return re.fullmatch(r".+:\d{1,5}", text) is not None


def _unused_path(folder: Path, name: str) -> Path:
    """Return the path of a recording that does not exist yet."""
    path, number = folder / f"{name}.rrd", 2
    while path.exists():
        path, number = folder / f"{name}_{number}.rrd", number + 1
    return path
