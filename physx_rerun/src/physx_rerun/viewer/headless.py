"""Pictures of a recording, made by a viewer without a window."""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from PIL import Image
from rerun.experimental import ViewerClient

from physx_core.errors import VisualizerError
from physx_rerun.viewer.viewer import Viewer

T = TypeVar("T")
_TOP_BAR = 36  # height of the viewer's own menu bar in pixels, cut off
_QUIET_SECONDS = 0.4  # a viewer whose state stays the same for so long has loaded everything
_PATIENCE = 5  # equal pictures in a row of a recording that does lack something


def render_picture(
    rrd_path: str | Path,
    png_path: str | Path,
    size: tuple[int, int] = (1600, 900),
    step: int | None = None,
    timeline: str = "step",
    timeout: float = 120.0,
) -> Path:
    """Draw a recording at one time as a picture.

    Args:
        rrd_path: The recording, a ``.rrd`` file.
        png_path: Picture to write.
        size: Width and height in pixels.
        step: Position on the timeline, in ns on the timeline ``time``; None: its end.
        timeline: Name of the timeline.
        timeout: Longest time to take, in s.

    Returns:
        The picture's path.

    Raises:
        VisualizerError: The recording is missing or has no such timeline, there is no graphics
            driver, or the viewer fails or takes too long.
    """
    rrd_path, png_path = Path(rrd_path), Path(png_path)
    if not rrd_path.is_file():
        raise VisualizerError(f"There is no recording {rrd_path}.")
    with tempfile.TemporaryDirectory(prefix="physx-rerun-") as folder:
        viewer = start(size, Path(folder), str(rrd_path))
        try:
            viewer.wait_until_ready(timeout)
            camera = Camera(viewer, time.monotonic() + timeout)
            camera.wait_for_recording()
            camera.go_to(timeline, step)
            picture = Image.open(io.BytesIO(camera.shoot()))
        except OSError as error:
            viewer.check(wait=2.0)
            raise VisualizerError(f"The Rerun viewer drew no picture: {error}.") from error
        finally:
            viewer.end()
    png_path.parent.mkdir(parents=True, exist_ok=True)
    picture.crop((0, _TOP_BAR, size[0], size[1] + _TOP_BAR)).save(png_path)
    return png_path


def start(size: tuple[int, int], folder: Path, *options: str) -> Viewer:
    """Start a viewer that knows no earlier layouts and has no settings of the user's."""
    window = f"{size[0]}x{size[1] + _TOP_BAR}"
    places = {"XDG_DATA_HOME": str(folder), "XDG_CONFIG_HOME": str(folder)}
    return Viewer(0, ("--headless", "--window-size", window, *options), environment=places)


class Camera:
    """Asks a viewer for its state and for pictures, with patience while it is busy drawing.

    Attributes:
        deadline: When patience ends, as `time.monotonic` counts.
    """

    def __init__(self, viewer: Viewer, deadline: float) -> None:
        self._viewer, self.deadline = viewer, deadline
        self._client = ViewerClient.connect(f"rerun+http://{viewer.address}/proxy")

    def _ask(self, question: Callable[[], T]) -> T:
        while True:
            self._viewer.check()
            if time.monotonic() > self.deadline:
                raise VisualizerError("The Rerun viewer took too long to draw the picture.")
            try:
                return question()
            except OSError:  # it is busy, or it ended, which the check will tell
                time.sleep(0.1)

    def wait_for_recording(self) -> None:
        """Wait until the viewer knows the whole recording and its views."""
        known, since = "", time.monotonic()
        while True:
            state = self._ask(self._client.get_state)
            now = repr((state.loading, [r.timelines for r in state.recordings], len(state.views)))
            if now != known:
                known, since = now, time.monotonic()
            complete = state.recordings and state.recordings[0].timelines and state.views
            if complete and not state.loading and time.monotonic() - since > _QUIET_SECONDS:
                return
            time.sleep(0.1)

    def go_to(self, timeline: str, step: int | None) -> None:
        """Go to a position on a timeline, or to its end."""
        state = self._ask(self._client.get_state)
        known = {line.name: line for line in state.recordings[0].timelines}
        if timeline not in known:
            raise VisualizerError(
                f'The recording has no timeline "{timeline}". Timelines: {", ".join(known)}.'
            )
        position = known[timeline].end or 0 if step is None else step
        self._ask(lambda: self._client.set_time(timeline, sequence=position, play_state="paused"))

    def wait_for_position(self, timeline: str, position: int) -> None:
        """Wait until the viewer has what was recorded up to a position on a timeline."""
        while True:
            state = self._ask(self._client.get_state)
            lines = [line for recording in state.recordings for line in recording.timelines]
            if any(line.name == timeline and (line.end or 0) >= position for line in lines):
                return
            time.sleep(0.002)

    def scene(self) -> str | None:
        """Return the identity of the first three-dimensional view, None where there is none."""
        views = self._ask(self._client.get_state).views
        return next((view.view_id for view in views if view.view_class == "3D"), None)

    def glance(self, view_id: str | None = None) -> bytes:
        """Return a picture of what is drawn by now, of one view or of everything."""
        return self._ask(lambda: self._client.take_screenshot(view_id))

    def shoot(self, view_id: str | None = None) -> bytes:
        """Return a picture once everything is drawn, of one view or of everything.

        Rows and meshes come in while the viewer draws already: it is ready when two pictures in
        a row are equal and no view complains of something that it lacks.
        """
        picture, repeats = b"", 0
        while True:
            state = self._ask(self._client.get_state)
            lacks = any(view.reports for view in state.views)
            last, picture = picture, self.glance(view_id)
            repeats = repeats + 1 if picture == last else 0
            if repeats > (_PATIENCE if lacks else 0):
                return picture
