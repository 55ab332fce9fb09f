"""Replays of logs: in a viewer, in a file for a viewer, or as a film."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import checks, plugins
from physx_core.components import Factory, Visualizer
from physx_core.errors import VisualizerError
from physx_core.typing import Vector
from physx_gym.errors import LogError
from physx_gym.tasks.trajectory import Trajectory
from physx_gym.telemetry.episode_log import Log
from physx_gym.telemetry.log_file import Source, as_logs
from physx_gym.visualization.drawing import WorldDrawing
from physx_gym.visualization.film import write_film
from physx_gym.visualization.plotting import Groups, groups_of
from physx_gym.visualization.rendering import PICTURE_SIZE, Picture, open_viewer
from physx_gym.visualization.replayed import Contacts, Line, Moved, Plots, Scene, row_at
from physx_sim import Backend, World

_FRAMES, _FRAMES_PER_ROW = 10_000, 100
_POINTS = 1000  # of a drawn path, approximately
_LESS_TELLING = ("state.a", "motor.command")  # columns that are plotted only if requested
_GHOST = {"color": "skyblue", "alpha": 0.35}


def replay(
    logs: Source | Sequence[Source],
    *,
    compare: Sequence[Source] = (),
    path: str | Path | None = None,
    record_video_path: str | Path | None = None,
    frame_rate: float = 30.0,
    backend: Any = None,
    plots: bool | str | Iterable[str] = True,
    contacts: bool = True,
    trajectories: Sequence[str] = (),
    ghosts: Source | Trajectory | Sequence[Source | Trajectory] = (),
    **viewer: Any,
) -> Path | None:
    """Show episodes side by side, all from their start: their motions and plots.

    What `RobotEnv._draw` drew is drawn again. Without a path, they are shown in a viewer's window.

    Args:
        logs: Logs, their files, or values of `RobotEnv.log_data`; one or several.
        compare: More logs.
        path: Recording to write for the viewer, ``.rrd``.
        record_video_path: Film to write: ``.mp4``, ``.gif``, ``.webp`` or ``.png``.
        frame_rate: Frames per simulated second. The viewer plays 30 per second.
        backend: Reference of the engine that provides the robots; None: the log's.
        plots: Whether to plot the columns of the logs, or prefixes of the names of those to plot;
            a film has no plots.
        contacts: Whether to draw contact forces as arrows, with one scale for each log.
        trajectories: Names of bodies of the first log whose paths are drawn as lines.
        ghosts: Logs, or trajectories in the world of the first log, that are drawn translucently
            over it.
        viewer: Options of the viewer, as in ``RobotEnv.viewer_kwargs``.

    Returns:
        The written file; None if there is none.

    Raises:
        LogError: If a log cannot be read, or contains no states, or there is nothing to plot.
        SimulationError: If `trajectories` names an unknown body.
        PluginNotFoundError: If the viewer is not installed.
        VisualizerError: If the viewer cannot be opened, or cannot draw.
        ConfigError: If an option is invalid.
    """
    frame_rate = checks.positive("frame_rate", frame_rate)
    chosen = as_logs(logs, compare)
    plotted = plots is not False and record_video_path is None
    groups = _groups(chosen, plots) if plotted else {}
    motions = [
        _Motion(number, log, backend, groups, contacts) for number, log in enumerate(chosen, 1)
    ]
    several = isinstance(ghosts, Sequence) and not isinstance(ghosts, str)
    given: Any = ghosts if several else [ghosts]
    for ghost in given:
        is_log = not isinstance(ghost, Trajectory)
        motions[0].add_ghost(as_logs(ghost)[0] if is_log else ghost, backend)
    motions[0].add_lines(trajectories)
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


def _groups(logs: Sequence[Log], plots: Any) -> Groups:
    """Return the columns to plot: those requested, by default the most informative ones."""
    groups = groups_of(logs, None if plots is True else plots, enable_block_states=False)
    if plots is not True:
        return groups
    return {title: names for title, names in groups.items() if not title.startswith(_LESS_TELLING)}


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


class _Body:
    """A world in motion, at the times of its states."""

    def __init__(
        self, label: str, states: Trajectory, world: World, engine: Backend, **drawn: Any
    ) -> None:
        """Build the world; `drawn` are options of `WorldDrawing`."""
        self._positions = states.positions
        self.times = states.times - states.times[0]
        self.simulation = engine.build(world)
        layout = self.simulation.layout
        if layout.nq != states.positions.shape[1]:
            raise LogError(
                f'The log "{label}" has {states.positions.shape[1]} positions, but its world '
                f"has {layout.nq}: the robot's file has changed since."
            )
        self._drawing = WorldDrawing(world=world, backend=engine, layout=layout, **drawn)
        self._is_drawn = False
        self.moved: Moved | None = None

    def poses(self, time: float, names: Sequence[str] | None = None) -> Vector:
        """Return the poses of bodies at a time after the start, in s."""
        return self.simulation.body_poses(names, self._positions[row_at(self.times, time)])

    def draw(self, time: float) -> None:
        """Draw it at a time."""
        poses, hidden = self.poses(time, self.simulation.layout.names), set[str]()
        if self.moved is not None:
            self.moved.move(poses, time)
            hidden = self.moved.hidden
        if not self._is_drawn:
            self._drawing.add(poses)
        if self._is_drawn or hidden:
            self._drawing.move(poses, hidden)
        self._is_drawn = True

    def close(self) -> None:
        """Free its resources."""
        self._drawing.close()
        self.simulation.close()


class _Motion:
    """The motion in a log, drawn frame by frame."""

    def __init__(self, number: int, log: Log, backend: Any, groups: Groups, contacts: bool) -> None:
        """Rebuild the world of the log."""
        self._number, self._log = number, log
        self._factory = Factory()
        self._world, self._engine = log.world(), _backend(log, backend)
        drawn = {"factory": self._factory, "title": f"{number}: {log.label}"}
        view = log.constants.get("view") or None
        states = log.trajectory()
        self._body = _Body(log.label, states, self._world, self._engine, view=view, **drawn)
        self._body.moved = Moved(log, self._body.simulation.layout)
        self._ghosts: list[_Body] = []
        self._beside: list[Scene | Contacts | Line] = [Scene(self._factory, log)]
        if contacts and len(log.contacts):
            self._beside.append(Contacts(self._factory, log, self._reach()))
        self._plots = Plots(self._factory, log, groups)

    def _reach(self) -> float:
        """Return the size of what moves, in m."""
        return float(np.linalg.norm(np.ptp(self._body.poses(0.0)[:, :3], axis=0)))

    def add_ghost(self, ghost: Log | Trajectory, backend: Any) -> None:
        """Draw another motion translucently over this one."""
        states = ghost.trajectory() if isinstance(ghost, Log) else ghost
        world, engine, label = self._world, self._engine, "ghost"
        if isinstance(ghost, Log):
            world, engine, label = ghost.world(), _backend(ghost, backend), ghost.label
        prefix = f"ghost{len(self._ghosts) + 1}_"
        world = dataclasses.replace(
            world,
            ground=None,
            robots=[dataclasses.replace(each, name=prefix + each.name) for each in world.robots],
            objects=[
                dataclasses.replace(each, name=prefix + each.name)
                for each in world.objects
                if not each.static
            ],
        )
        drawn = {"factory": self._factory, "title": None, "look": _GHOST}
        self._ghosts.append(_Body(label, states, world, engine, **drawn))

    def add_lines(self, bodies: Sequence[str]) -> None:
        """Draw the paths of bodies."""
        names = [bodies] if isinstance(bodies, str) else list(bodies)
        if not names:
            return
        times = self._body.times[:: max(1, len(self._body.times) // _POINTS)]
        ways = np.stack([self._body.poses(time, names)[:, :3] for time in times], axis=1)
        self._beside += [
            Line(self._factory, name, way) for name, way in zip(names, ways, strict=True)
        ]

    def count_frames(self, frame_rate: float) -> int:
        """Return how many frames show it, rejecting a few rows that claim a huge duration."""
        rows, duration = len(self._body.times), float(self._body.times[-1])
        count = 1 + duration * frame_rate + 1e-9
        most = max(_FRAMES, _FRAMES_PER_ROW * rows)
        if not count <= most:
            raise LogError(
                f'The log "{self._log.label}" has {rows} rows that cover {duration:.4g} s, '
                f"which would take more than {most} frames. Lower the frame_rate."
            )
        return int(count)

    def draw(self, shown: Visualizer, frame: int, time: float) -> None:
        """Draw the state at a time after the start, in s, and plot all rows up to it."""
        if frame == 0:
            self._factory.set_time(time)
        self._body.draw(time)
        for ghost in self._ghosts:
            ghost.draw(time)
        for each in self._beside:
            each.draw(time)
        drawn = self._factory.take_events()
        for row_time in self._plots.rows_until(time):
            self._factory.set_time(row_time)
            shown.events(self._number, frame, self._factory.take_events())
        self._factory.set_time(time)
        shown.events(self._number, frame, [*drawn, *self._factory.take_events()])

    def close(self) -> None:
        """Free its resources."""
        for body in (self._body, *self._ghosts):
            body.close()


def _backend(log: Log, given: Any) -> Backend:
    """Return the engine of a log; a file may only name installed plugins, not code."""
    reference = given if given is not None else log.constants.get("backend")
    is_told = given is not None or log.path is None
    if not is_told and not (isinstance(reference, str) and ":" not in reference):
        raise LogError(
            f"The log {log.path} is of the engine {reference!r}, which is not an installed plugin. "
            'If you trust it, name it: --backend REFERENCE (in Python, replay(..., backend="...")).'
        )
    found: Backend = plugins.resolve("backend", reference)
    return found
