"""Renders pictures and films of a recording with a viewer without a window."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from PIL import Image
from rerun.experimental import ViewerClient

from physx_core.errors import ConfigError, VisualizerError
from physx_core.processes import TemporaryFolder
from physx_rerun.drawing.chunks import TIME
from physx_rerun.viewer.viewer import Viewer

T = TypeVar("T")
_TOP_BAR = 36  # height of the viewer's menu bar in pixels, which is cropped
_QUIET_SECONDS = 0.4  # without a change of state, after which everything counts as loaded
_SCENES, _CURVES = ("step", "row"), ("epoch", "batch")
_TIMELINES = (*_SCENES, *_CURVES)  # in order of preference
_NOTES = 30  # frames after which the viewer's startup notifications are gone
_QUALITY = 60  # of a film's pictures, from 0 to 100
_PATIENCE = 5  # equal pictures in a row, after which missing assets are ignored


def render_picture(
    rrd_path: str | Path,
    png_path: str | Path,
    size: tuple[int, int] = (1600, 900),
    at: float | None = None,
    timeline: str | None = None,
    timeout: float = 120.0,
) -> Path:
    """Render a recording at one time as a picture.

    Args:
        rrd_path: The recording, a ``.rrd`` file.
        png_path: Picture to write.
        size: Width and height in pixels.
        at: Position on the timeline, in s on ``sim_time`` and ``time``; None: its end.
        timeline: Name of the timeline; None: see `choose_timeline`.
        timeout: Time limit in s.

    Returns:
        The picture's path.

    Raises:
        VisualizerError: If the recording is missing or does not contain the time, there is no
            graphics driver, or the viewer fails or takes too long.
    """
    [picture] = _pictures(Path(rrd_path), size, [at], timeline, timeout)
    png_path = Path(png_path)
    png_path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(png_path)
    return png_path


def render_film(
    rrd_path: str | Path,
    film_path: str | Path,
    size: tuple[int, int] = (800, 480),
    frames: int = 50,
    frame_rate: float = 12.5,
    timeline: str | None = None,
    timeout: float = 600.0,
) -> Path:
    """Render a recording as a film: a looping animation for browsers.

    Args:
        rrd_path: The recording, a ``.rrd`` file.
        film_path: Film to write, a ``.webp`` file.
        size: Width and height in pixels.
        frames: Number of pictures, at equal distances from the start to the end of the timeline,
            both included.
        frame_rate: Pictures per second.
        timeline: Name of the timeline; None: see `choose_timeline`.
        timeout: Time limit in s.

    Returns:
        The film's path.

    Raises:
        ConfigError: If the film is not a ``.webp`` file, or has fewer than two pictures.
        VisualizerError: As in `render_picture`.
    """
    film_path = Path(film_path)
    if film_path.suffix.lower() != ".webp":
        raise ConfigError(f"A film must be a .webp file, not {film_path.name}.")
    if frames < 2:
        raise ConfigError(f"A film needs at least 2 frames, not {frames}.")
    shares = [frame / (frames - 1) for frame in range(frames)]
    first, *others = _pictures(Path(rrd_path), size, shares, timeline, timeout, by_share=True)
    film_path.parent.mkdir(parents=True, exist_ok=True)
    look: dict[str, Any] = {"quality": _QUALITY, "method": 6, "loop": 0}
    duration = round(1000 / frame_rate)
    first.save(film_path, save_all=True, append_images=others, duration=duration, **look)
    return film_path


def choose_timeline(known: Collection[str]) -> str:
    """Return the timeline on which most of a recording is visible.

    Scenes are on ``step`` or ``row``, the curves of a training on ``epoch`` and ``batch``, and all
    of them on ``time``: a recording with both is empty in part on any other.

    Args:
        known: The recording's timelines.
    """
    if TIME in known and any(n in known for n in _SCENES) and any(n in known for n in _CURVES):
        return TIME
    return next((name for name in _TIMELINES if name in known), next(iter(known)))


def _pictures(
    recording: Path,
    size: tuple[int, int],
    times: Sequence[float | None],
    timeline: str | None,
    timeout: float,
    *,
    by_share: bool = False,
) -> Iterator[Image.Image]:
    """Yield pictures of a recording at the given times: see `Camera.find`."""
    if not recording.is_file():
        raise VisualizerError(f"There is no recording {recording}.")
    with TemporaryFolder("rerun-") as folder:
        viewer = start_viewer(size, folder.path, str(recording))
        try:
            viewer.wait_until_ready(timeout=timeout)
            camera = Camera(viewer, time.monotonic() + timeout)
            camera.wait_for_recording()
            for at in times:
                camera.go_to(*camera.find(timeline, at, by_share=by_share))
                picture = Image.open(io.BytesIO(camera.wait_for_picture())).convert("RGB")
                yield picture.crop((0, _TOP_BAR, size[0], size[1] + _TOP_BAR))
        except OSError as error:
            viewer.check(wait=2.0)
            raise VisualizerError(f"The Rerun viewer did not render a picture: {error}.") from error
        finally:
            viewer.end()


def start_viewer(size: tuple[int, int], folder: Path, *options: str) -> Viewer:
    """Start a viewer without the user's settings and layouts; its files are put in a folder."""
    window = f"{size[0]}x{size[1] + _TOP_BAR}"
    places = dict.fromkeys(("XDG_DATA_HOME", "XDG_CONFIG_HOME", "TMPDIR"), str(folder))
    return Viewer(0, ("--headless", "--window-size", window, *options), environment=places)


class Camera:
    """Requests a viewer's state and pictures, retrying while it is busy.

    Attributes:
        deadline: Time at which to give up, as of `time.monotonic`.
    """

    def __init__(self, viewer: Viewer, deadline: float) -> None:
        self._viewer, self.deadline = viewer, deadline
        self._client = ViewerClient.connect(f"rerun+http://{viewer.address}/proxy")

    def _request(self, call: Callable[[], T]) -> T:
        while True:
            self._viewer.check()
            if time.monotonic() > self.deadline:
                raise VisualizerError("The Rerun viewer took too long to draw the picture.")
            try:
                return call()
            except OSError:  # it is busy, or has ended, which the check reports
                time.sleep(0.1)

    def wait_for_recording(self) -> None:
        """Wait until the viewer has loaded the recording and its views, and shows nothing else."""
        known, since = "", time.monotonic()
        while True:
            state = self._request(self._client.get_state)
            now = repr((state.loading, [r.timelines for r in state.recordings], len(state.views)))
            if now != known:
                known, since = now, time.monotonic()
            complete = state.recordings and state.recordings[0].timelines and state.views
            if complete and not state.loading and time.monotonic() - since > _QUIET_SECONDS:
                break
            time.sleep(0.1)
        for _ in range(_NOTES):  # a request lets a frame pass without drawing it
            self._request(self._client.get_state)

    def find(
        self, timeline: str | None, at: float | None, *, by_share: bool = False
    ) -> tuple[str, int]:
        """Return a timeline and the viewer's integer for a time on it, as in `render_picture`.

        With `by_share`, `at` is a fraction of the timeline, from 0 to 1.
        """
        state = self._request(self._client.get_state)
        known = {line.name: line for line in state.recordings[0].timelines}
        if timeline is None:
            timeline = choose_timeline(known)
        if timeline not in known:
            raise VisualizerError(
                f'The recording has no timeline "{timeline}". Timelines: {", ".join(known)}.'
            )
        line = known[timeline]
        unit = 1 if line.time_type == "sequence" else 1_000_000_000  # the viewer counts ns
        start, end = line.start or 0, line.end or 0
        if by_share and at is not None:
            return timeline, round(start + at * (end - start))
        position = end if at is None else round(at * unit)
        if not start <= position <= end:
            raise VisualizerError(
                f'The timeline "{timeline}" begins at {start / unit:g} and ends at '
                f"{end / unit:g}: there is nothing at {at:g}."
            )
        return timeline, position

    def go_to(self, timeline: str, position: int) -> None:
        """Go to a position on a timeline."""
        self._request(
            lambda: self._client.set_time(timeline, sequence=position, play_state="paused")
        )

    def wait_for_position(self, timeline: str, position: int) -> str | None:
        """Wait until the viewer has received all rows up to a position on a timeline.

        Returns:
            The id of the first three-dimensional view; None if there is none.
        """
        while True:
            state = self._request(self._client.get_state)
            lines = [line for recording in state.recordings for line in recording.timelines]
            if any(line.name == timeline and (line.end or 0) >= position for line in lines):
                views = (view.view_id for view in state.views if view.view_class == "3D")
                return next(views, None)
            time.sleep(0.002)

    def screenshot(self, view_id: str | None = None) -> bytes:
        """Return a picture of the current state of one view, or of the window."""
        return self._request(lambda: self._client.take_screenshot(view_id))

    def wait_for_picture(self, view_id: str | None = None) -> bytes:
        """Return a picture of one view, or of the window, once everything is drawn.

        The viewer draws while rows and meshes arrive: a picture is complete when it equals the
        previous one and no view reports a missing asset.
        """
        picture, repeats = b"", 0
        while True:
            state = self._request(self._client.get_state)
            lacks = any(view.reports for view in state.views)
            last, picture = picture, self.screenshot(view_id)
            repeats = repeats + 1 if picture == last else 0
            if repeats > (_PATIENCE if lacks else 0):
                return picture
