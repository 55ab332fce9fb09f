"""Pictures of a recording, made by a viewer without a window."""

from __future__ import annotations

import io
import tempfile
import time
from pathlib import Path

from PIL import Image
from rerun.experimental import Recording, Timeline, ViewerClient, ViewerState

from physx_core.errors import VisualizerError
from physx_rerun.viewer import Viewer

_TOP_BAR = 36  # height of the viewer's own menu bar in pixels, cut off
_QUIET_SECONDS = 0.4  # a viewer whose state stays the same for so long has loaded everything


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
    deadline = time.monotonic() + timeout
    with tempfile.TemporaryDirectory(prefix="physx-rerun-") as folder:
        viewer = _start(rrd_path, size, Path(folder))
        try:
            viewer.wait_until_ready(timeout)
            client = ViewerClient.connect(f"rerun+http://{viewer.address}/proxy")
            state = _loaded(viewer, client, deadline)
            position = _position(state.recordings[0], timeline, step)
            client.set_time(timeline, sequence=position, play_state="paused")
            _settle(viewer, client, position, deadline)
            picture = Image.open(io.BytesIO(client.take_screenshot()))
        except (RuntimeError, OSError) as error:
            viewer.check(wait=2.0)
            raise VisualizerError(f"The Rerun viewer drew no picture: {error}.") from error
        finally:
            viewer.end()
    png_path.parent.mkdir(parents=True, exist_ok=True)
    picture.crop((0, _TOP_BAR, size[0], size[1] + _TOP_BAR)).save(png_path)
    return png_path


def _start(rrd_path: Path, size: tuple[int, int], folder: Path) -> Viewer:
    """Start a viewer that knows no earlier layouts and has no settings of the user's."""
    window = f"{size[0]}x{size[1] + _TOP_BAR}"
    places = {"XDG_DATA_HOME": str(folder), "XDG_CONFIG_HOME": str(folder)}
    return Viewer(0, ("--headless", "--window-size", window, str(rrd_path)), environment=places)


def _loaded(viewer: Viewer, client: ViewerClient, deadline: float) -> ViewerState:
    """Return the viewer's state once it holds the whole recording and shows its views."""
    seen, since = "", time.monotonic()
    while True:
        state = _state(viewer, client, deadline)
        known = repr((state.loading, [r.timelines for r in state.recordings], len(state.views)))
        if known != seen:
            seen, since = known, time.monotonic()
        complete = state.recordings and state.recordings[0].timelines and state.views
        if complete and not state.loading and time.monotonic() - since > _QUIET_SECONDS:
            return state
        time.sleep(0.1)


def _state(viewer: Viewer, client: ViewerClient, deadline: float) -> ViewerState:
    viewer.check()
    if time.monotonic() > deadline:
        raise VisualizerError("The Rerun viewer took too long to draw the picture.")
    return client.get_state()


def _position(recording: Recording, timeline: str, step: int | None) -> int:
    known: dict[str, Timeline] = {line.name: line for line in recording.timelines}
    if timeline not in known:
        raise VisualizerError(
            f'The recording has no timeline "{timeline}". Timelines: {", ".join(known)}.'
        )
    return known[timeline].end or 0 if step is None else step


def _settle(viewer: Viewer, client: ViewerClient, position: int, deadline: float) -> None:
    """Wait until the viewer is at the position, with meshes and plots drawn at least once."""
    while _state(viewer, client, deadline).recordings[0].current_time != position:
        time.sleep(0.05)
    client.take_screenshot(max_size=64)
