"""Replays of logs: in a viewer, in a file for a viewer, or as a film."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import checks, plugins
from physx_core.components import Factory, Visualizer
from physx_core.errors import LogError, VisualizerError
from physx_core.simulation import Backend
from physx_gym.show.drawing import WorldDrawing
from physx_gym.show.film import write_film
from physx_gym.show.rendering import PICTURE_SIZE, Picture, open_viewer
from physx_gym.telemetry.episode_log import Log
from physx_gym.telemetry.log_file import Source, as_logs

_FRAMES, _FRAMES_PER_ROW = 10_000, 100


def replay(
    logs: Source | Sequence[Source],
    *,
    compare: Sequence[Source] = (),
    path: str | Path | None = None,
    record_video_path: str | Path | None = None,
    frame_rate: float = 30.0,
    backend: Any = None,
    **viewer: Any,
) -> Path | None:
    """Show episodes side by side, all from their start.

    Without a path they are shown in a viewer's window.

    Args:
        logs: Logs, their files, or values of `RobotEnv.log_data`; one or several.
        compare: More of them.
        path: Recording to write for the viewer, ``.rrd``.
        record_video_path: Film to write: ``.mp4``, ``.gif``, ``.webp`` or ``.png``.
        frame_rate: Frames per simulated second. The viewer plays 30 per second.
        backend: Reference of the engine that provides the robots; None: the log's.
        viewer: Options of the viewer, as in ``RobotEnv.viewer_kwargs``.

    Returns:
        The written file; None if there is none.

    Raises:
        LogError: If a log cannot be read, or contains no states.
        PluginNotFoundError: If the viewer is not installed.
        VisualizerError: If the viewer cannot be opened, or cannot draw.
        ConfigError: If an option is invalid.
    """
    checks.positive("frame_rate", frame_rate)
    chosen = as_logs(logs, compare)
    motions = [_Motion(number, log, backend) for number, log in enumerate(chosen, 1)]
    count = max(motion.count_frames(frame_rate) for motion in motions)
    options: dict[str, Any] = {"max_instances": len(motions), **viewer}
    if record_video_path is not None:
        options = {"mode": "offscreen", "save": False, "picture_size": PICTURE_SIZE} | options
    elif path is not None:
        options = {"mode": "save", "path": path} | options
    else:
        options = {"mode": "spawn", "save": False} | options
    shown = open_viewer("replay", len(motions), **options)
    try:
        frames = _frames(shown, motions, count, frame_rate)
        if record_video_path is not None:
            return write_film(map(_picture, frames), Path(record_video_path), frame_rate)
        for _ in frames:
            pass
    finally:
        for motion in motions:
            motion.close()
        shown.close()
    return None if path is None else Path(path)


def _frames(
    shown: Visualizer, motions: Sequence[_Motion], count: int, frame_rate: float
) -> Iterator[Visualizer]:
    """Draw the frames one by one."""
    for frame in range(count):
        for motion in motions:
            motion.draw(shown, frame, frame / frame_rate)
        yield shown


def _picture(shown: Visualizer) -> Picture:
    picture = shown.capture()
    if picture is None:
        raise VisualizerError(f"{type(shown).__name__} cannot render pictures for a film.")
    return picture


class _Motion:
    """The motion in a log, drawn frame by frame."""

    def __init__(self, number: int, log: Log, backend: Any) -> None:
        """Rebuild the world of the log."""
        self._number, self._label = number, log.label
        states = log.trajectory()
        self._times, self._positions = states.times, states.positions
        self._duration = float(self._times[-1] - self._times[0])
        world, engine = log.world(), _backend(log, backend)
        self._simulation = engine.build(world)
        layout = self._simulation.layout
        if layout.nq != self._positions.shape[1]:
            raise LogError(
                f'The log "{log.label}" has {self._positions.shape[1]} positions, but its world '
                f"has {layout.nq}: the robot's file has changed since."
            )
        self._factory = Factory()
        title = f"{number}: {log.label}"
        self._drawing = WorldDrawing(self._factory, world, engine, layout, title)

    def count_frames(self, frame_rate: float) -> int:
        """Return how many frames show it, checking that a few rows do not claim to be an age."""
        count = 1 + self._duration * frame_rate + 1e-9
        most = max(_FRAMES, _FRAMES_PER_ROW * len(self._times))
        if not count <= most:
            raise LogError(
                f'The log "{self._label}" has {len(self._times)} rows of {self._duration:.4g} s in '
                f"all, which would be more than {most} frames. Lower the frame_rate."
            )
        return int(count)

    def draw(self, shown: Visualizer, frame: int, time: float) -> None:
        """Draw the state at a time after the start, in s."""
        moment = self._times[0] + time + 1e-9
        row = max(int(np.searchsorted(self._times, moment, "right")) - 1, 0)
        poses = self._simulation.body_poses(None, self._positions[row])
        if frame == 0:
            self._drawing.add(poses)
        else:
            self._drawing.move(poses)
        self._factory.set_time(time)
        shown.events(self._number, frame, self._factory.take_events())

    def close(self) -> None:
        """Free its resources."""
        self._drawing.close()
        self._simulation.close()


def _backend(log: Log, given: Any) -> Backend:
    """Return the engine of a log; a file may only name installed plugins, not code."""
    reference = given if given is not None else log.constants.get("backend")
    is_told = given is not None or log.path is None
    if not is_told and not (isinstance(reference, str) and ":" not in reference):
        raise LogError(
            f"The log {log.path} is of the engine {reference!r}, which is not an installed plugin. "
            'If you trust it, name it: --backend REFERENCE (in Python replay(..., backend="...")).'
        )
    found: Backend = plugins.resolve("backend", reference)
    return found
