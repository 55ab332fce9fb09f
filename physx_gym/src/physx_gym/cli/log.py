"""``physx log``: show logs of robots' episodes as a table, a plot, or a replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro

from physx_core.cli import options_from, show, show_table
from physx_gym.telemetry.episode_log import TIME, Log
from physx_gym.telemetry.log_file import read_log


@dataclass
class ShowLog:
    """Show logs of episodes: as a table of columns, as a plot, or in the viewer."""

    files: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")]
    """The log files."""
    columns: tuple[str, ...] = ()
    """Only columns whose names begin with one of these; in a replay, only these are plotted."""
    plot: str | None = None
    """Write a plot of the columns of all files to this file."""
    replay: str | None = None
    """Write a viewer recording of all episodes, side by side, to this file (.rrd)."""
    ghosts: tuple[str, ...] = ()
    """Further log files whose motions the replay draws translucently over the first."""
    trajectories: tuple[str, ...] = ()
    """Names of bodies of the first log whose paths the replay draws."""
    contacts: bool = True
    """Whether the replay draws contact forces."""
    backend: str | None = None
    """Engine that provides the robots of the replay; by default that of each log, which may name
    only engines of installed plugins."""


def run(words: Sequence[str]) -> None:
    """Print each log as a table, or write a plot or a recording."""
    options = options_from(ShowLog, words, "log")
    logs = [read_log(file) for file in options.files]
    if options.plot is not None:
        from physx_gym.visualization.plotting import plot

        plot(logs, path=options.plot, columns=options.columns or None, enable_block_states=True)
        show(f"plot: {options.plot}")
    if options.replay is not None:
        from physx_gym.visualization.replaying import replay

        path = replay(
            logs,
            path=options.replay,
            backend=options.backend,
            plots=options.columns or True,
            contacts=options.contacts,
            trajectories=options.trajectories,
            ghosts=options.ghosts,
        )
        show(f"recording: {path}")
    if options.plot is None and options.replay is None:
        for log in logs:
            _print_table(log, options.columns)


def _print_table(log: Log, columns: tuple[str, ...]) -> None:
    """Print a summary of the recording, and a line for each column."""
    rows = len(log.time)
    duration = log.time[-1] - log.time[0] if rows else 0.0
    environment, backend = (log.constants.get(name, "?") for name in ("environment", "backend"))
    show(f"{log.path}: {environment} on {backend}, seed {log.constants.get('seed', '?')}")
    show(f"{rows} rows of {len(log.variables)} columns, {duration:g} s\n")
    chosen = [name for name in log.variables if name.startswith(columns or "") and name != TIME]
    numbers = ("min", "max", "mean", "last")
    lines = []
    for name in chosen:
        values = log.variables[name]
        figures = (values.min(), values.max(), np.mean(values), values[-1]) if rows else [""] * 4
        texts = [f"{figure:.4g}" if rows else "" for figure in figures]
        lines.append([name, *texts, log.units.get(name, "")])
    show_table(["column", *numbers, "unit"], lines, numbers=numbers)
