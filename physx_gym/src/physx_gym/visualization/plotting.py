"""Plots of logs: one figure with a plot for each group of columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physx_core.errors import MissingLibraryError, listed
from physx_gym.errors import LogError
from physx_gym.telemetry.episode_log import TIME, Log
from physx_gym.telemetry.log_file import Source, as_logs
from physx_gym.telemetry.standard_columns import BASE_POSITION, BASE_VELOCITY
from physx_gym.visualization.display import has_display

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH, _HEIGHT = 5.0, 2.6  # of each plot, in inches
_COLUMNS = 3
_LEGEND = 8  # number of names that fit into a plot
_STYLES: tuple[Any, ...] = ("-", "--", ":", "-.")
_ORDER = ("state.q", "state.v", "state.a", "sensor", "motor", "action")

Groups = dict[str, list[str]]


def plot(
    logs: Source | Sequence[Source],
    *,
    enable_block_states: bool = False,
    compare: Sequence[Source] = (),
    columns: str | Iterable[str] | None = None,
    path: str | Path | None = None,
    show: bool | None = None,
) -> Figure:
    """Plot columns over time: states, sensors, motors, then registered variables.

    Args:
        logs: Logs, their files, or values of `RobotEnv.log_data`; one or several.
        enable_block_states: Whether to show the states of blocks too.
        compare: More logs. All are drawn into the same plots, each with its own line style.
        columns: Prefixes of the names of the columns to plot: one or several.
        path: File to write, for example ``.png`` or ``.pdf``.
        show: Whether to open a window; None: if there is a display and no path.

    Returns:
        The figure.

    Raises:
        LogError: If a log cannot be read, or there is nothing to plot.
        MissingLibraryError: If Matplotlib is not installed.
    """
    chosen = as_logs(logs, compare)
    groups = groups_of(chosen, columns, enable_block_states)
    if show is None:
        show = path is None and has_display()
    figure = _figure(len(groups), show)
    for (title, names), axes in zip(groups.items(), figure.axes, strict=True):
        _draw(axes, title, names, chosen)
    if len(chosen) > 1:
        _name_logs(figure, chosen)
    if path is not None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
    if show:
        import matplotlib.pyplot as plt

        plt.show()
    return figure


def groups_of(
    logs: Sequence[Log], columns: str | Iterable[str] | None, enable_block_states: bool
) -> Groups:
    """Return the columns of each plot by its title."""
    wanted = (columns,) if isinstance(columns, str) else tuple(columns or ("",))
    known = list(dict.fromkeys(name for log in logs for name in log.variables if name != TIME))
    groups: Groups = {}
    for name in known:
        is_block_state = not name.startswith("state.") and ".state." in name
        if name.startswith(wanted) and (enable_block_states or not is_block_state):
            groups.setdefault(_title(name), []).append(name)
    if not groups:
        first = {name.partition(".")[0] for name in known}
        raise LogError(
            f"There is nothing to plot: no column begins with {listed(wanted)}. "
            f"Columns begin with: {listed(first)}."
        )
    return dict(sorted(groups.items(), key=lambda group: _rank(group[0])))


def _title(name: str) -> str:
    """Return the title of the plot that a column belongs to.

    Sensors of a kind share a plot for each quantity; everything else is grouped by prefix.
    """
    parts = name.split(".")
    if parts[0] == "state" and parts[-1] in (*BASE_POSITION, *BASE_VELOCITY):
        return ".".join([*parts[:-1], "base"])
    if len(parts) > 1 and parts[-1].isdigit() and len(parts) > 2:
        parts = parts[:-1]
    elif len(parts) > 1 and parts[0] != "sensor":
        return ".".join(parts[:-1])
    if parts[0] == "sensor":
        return ".".join([*parts[:2], parts[-1]])
    return ".".join(parts)


def label_of(name: str, title: str) -> str:
    """Return the label of a curve: the name of its column without the title of the plot."""
    if title.startswith("sensor."):
        kind, _, quantity = title.rpartition(".")
        rest = name.removeprefix(f"{kind}.")
        sensor, _, number = rest.partition(f".{quantity}")
        return sensor + number
    return name.removeprefix(f"{title.removesuffix('.base')}.")


def _rank(title: str) -> int:
    ranks = (place for place, begin in enumerate(_ORDER) if title.startswith(begin))
    return next(ranks, len(_ORDER))


def _figure(count: int, show: bool) -> Figure:
    """Return a figure with plots; one that is not shown does not need a window system."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingLibraryError("Plotting", "matplotlib", "plot", "physx-gym") from error
    wide = min(count, _COLUMNS)
    high = -(-count // wide)
    size = (wide * _WIDTH, high * _HEIGHT)
    options: dict[str, Any] = {"figsize": size, "layout": "constrained"}
    if show:
        from matplotlib import pyplot as plt

        figure: Figure = plt.figure(**options)
    else:
        figure = Figure(**options)
    for number in range(count):
        figure.add_subplot(high, wide, number + 1)
    return figure


def _draw(axes: Axes, title: str, names: Sequence[str], logs: Sequence[Log]) -> None:
    """Draw columns of all logs into one plot."""
    units: Mapping[str, str] = {}
    for number, log in enumerate(logs):
        units = {**units, **log.units}
        for place, name in enumerate(names):
            if name in log.variables:
                label = label_of(name, title) if number == 0 else None
                style = _STYLES[number % len(_STYLES)]
                look: dict[str, Any] = {"color": f"C{place % 10}", "linestyle": style}
                axes.plot(log.time, log.variables[name], linewidth=1.0, label=label, **look)
    found = {units.get(name, "") for name in names}
    axes.set_title(title, fontsize="medium")
    axes.set_xlabel("time (s)", fontsize="small")
    axes.set_ylabel(next(iter(found)) if len(found) == 1 else "", fontsize="small")
    axes.tick_params(labelsize="small")
    axes.grid(alpha=0.3)
    axes.margins(x=0)
    if len(names) <= _LEGEND:
        axes.legend(fontsize="xx-small", loc="best", framealpha=0.5, ncols=1 + len(names) // 5)


def _name_logs(figure: Figure, logs: Sequence[Log]) -> None:
    from matplotlib.lines import Line2D

    styles = (_STYLES[number % len(_STYLES)] for number in range(len(logs)))
    lines = [Line2D([], [], color="black", linestyle=style) for style in styles]
    names = [f"{number}: {log.label}" for number, log in enumerate(logs, 1)]
    figure.legend(lines, names, loc="outside upper center", ncols=len(logs), fontsize="small")
