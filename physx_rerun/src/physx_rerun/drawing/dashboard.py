"""Dashboard: the curves, histograms, predictions and notes of a training."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from physx_core.fields import Field
from physx_core.typing import Array
from physx_rerun.drawing import colors
from physx_rerun.drawing.chunks import ChunkBuilder, Times
from physx_rerun.drawing.legends import legend

_BINS = 30
_POINTS = 2000  # largest number of predicted values shown per field
_FIELDS, _PREDICTIONS = "fields", "predictions"
_RUN = "run"
_LOSSES, _RATE = ("loss per epoch", "loss per batch"), "learning rate"
_QUANTILES = {"q05": "5 %", "q95": "95 %"}
_ONLINE = {
    "rows_per_s": "online: rates (1/s)",
    "batches_per_s": "online: rates (1/s)",
    "network_waits": "online: waiting (share of time)",
    "environments_wait": "online: waiting (share of time)",
    "rows_kept": "online: buffer (rows)",
    "mean_age": "online: buffer (rows)",
    "views": "online: views per row",
}
_GRAY = 0x9AA0AAFF
_ALL = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())


@dataclass
class _Plot:
    """A window with curves.

    Attributes:
        curves: Paths of the curves.
        logarithms: Paths of the curves of base-10 logarithms, shown in their place.
        colored: What has its own color.
        is_positive: Whether all values so far are positive, so they have logarithms.
        highest: End of an axis that starts at 0; 0: the axis fits the curves.
    """

    curves: list[str] = field(default_factory=list)
    logarithms: list[str] = field(default_factory=list)
    colored: list[str] = field(default_factory=list)
    is_positive: bool = True
    highest: float = 0.0


@dataclass(frozen=True)
class _Curve:
    """A number to show.

    Attributes:
        name: Name of the number.
        title: Title of its plot.
        label: Name in the legend.
        colored: What has its color: the curve, or the component that several curves belong to.
        spread: Its standard deviation, shown as a band; None: no band.
    """

    name: str
    title: str
    label: str
    colored: str
    spread: float | None = None


class Dashboard:
    """Shows what a training records; every number is also a separate curve in the recording.

    The loss is shown as its logarithm while it is positive: for batches as the mean of the last
    ones with their standard deviation, for epochs in one plot for training and validation.

    Attributes:
        changed: Whether the windows differ from those at the last call of `cells`.
    """

    def __init__(self, rows: ChunkBuilder) -> None:
        """Start without windows.

        Args:
            rows: Collects the rows.
        """
        self.changed = False
        self._rows = rows
        self._known: set[str] = set()
        self._plots: dict[str, _Plot] = {}
        self._tabs: dict[str, dict[str, rrb.View]] = {}
        self._limits: dict[str, tuple[float, float]] = {}
        self._units: dict[str, str] = {}

    @property
    def kinds(self) -> set[tuple[str, str]]:
        """What is shown, for `WindowLayout.digest`."""
        views = {(group, title) for group, tabs in self._tabs.items() for title in tabs}
        return views | {("plot", title) for title in self._plots}

    # What is recorded -----------------------------------------------------------------------

    def fields(self, fields: Iterable[Field]) -> None:
        """Store the units of fields: see `Observer.fields`."""
        self._units = {field.name: f" ({field.unit})" for field in fields if field.unit}

    def scalars(self, values: Mapping[str, float], times: Times) -> None:
        """Add points to curves: see `Observer.scalars`."""
        shown = {curve.name: curve for curve in _curves(values, self._units)}
        for name, value in values.items():
            curve = shown.get(name)
            if curve is None or curve.spread is not None:
                self._add(entity_of(name), times, value, name.rpartition("/")[2])
            if curve is None:
                continue
            plot = self._plots.setdefault(curve.title, _Plot())
            if curve.colored not in plot.colored:
                plot.colored.append(curve.colored)
            number = plot.colored.index(curve.colored)
            entity = entity_of(name if curve.spread is None else f"band/{name}")
            self._show(plot.curves, entity)
            self._add(entity, times, value, curve.label, number, curve.spread)
            if curve.title == _RATE and value > plot.highest:
                plot.highest, self.changed = 2.0 ** math.ceil(math.log2(value) + 0.1), True
            if curve.title in _LOSSES:
                self._add_logarithm(plot, curve, times, value, number)

    def histograms(self, values: Mapping[str, Array], times: Times) -> None:
        """Show histograms of the finite numbers: see `Observer.histograms`."""
        for name, array in values.items():
            finite = array[np.isfinite(array)]
            if not finite.size:
                continue
            counts, edges = np.histogram(finite, _BINS)
            middles = (edges[1:] + edges[:-1]) / 2
            chart = rr.BarChart(counts, abscissa=middles, widths=np.diff(edges))
            self._rows.add_archetype(entity_of(name), chart, times)
            group, _, label = name.partition("/")
            title = f"{group}: {label}" if label else group
            self._add_tab(group, rrb.BarChartView(origin=entity_of(name), name=title), title)

    def predictions(
        self, predicted: Mapping[str, Array], truth: Mapping[str, Array], times: Times
    ) -> None:
        """Show predicted versus true values: see `Observer.predictions`."""
        for name, values in predicted.items():
            entity = entity_of(f"{_PREDICTIONS}/{name}")
            pairs = np.column_stack([truth[name].ravel(), values.ravel()]).astype(np.float64)
            chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), _POINTS)).astype(np.intp)
            if name not in self._limits:
                self._limits[name] = self._add_square(name, entity, pairs[:, 0])
            low, high = self._limits[name]
            places = np.clip((pairs[chosen] - low) / (high - low), -0.05, 1.05) * [1, -1]
            several = values[0].size if values[0].size <= len(colors.CURVES) else 1
            self._rows.add(
                f"{entity}/values",
                rr.Points2D,
                times,
                positions=places.astype(np.float32),
                colors=colors.curves(several)[chosen % several],
                radii=np.full(len(places), -2.0, np.float32),  # in points of the screen
            )

    def note(self, text: str, times: Times) -> None:
        """Add a line to the notes."""
        self._rows.add_archetype("run/notes", rr.TextLog(text), times)
        self._add_tab(_RUN, rrb.TextLogView(origin="run/notes", name="notes"), "notes")

    def describe(self, configuration: str) -> None:
        """Show the run's configuration, given as TOML, and make it the properties of the run."""
        text = f"```toml\n{configuration}\n```"
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._rows.add_static("run/configuration", document)
        properties: dict[str, Any] = dict(_flatten(tomllib.loads(configuration)))
        self._rows.add_static("__properties/configuration", rr.AnyValues(**properties))
        view = rrb.TextDocumentView(origin="run/configuration", name="configuration")
        self._add_tab(_RUN, view, "configuration")

    # The windows ----------------------------------------------------------------------------

    def cells(self) -> list[rrb.View | rrb.Tabs]:
        """Return the windows, the losses first; empty if no numbers were recorded."""
        self.changed = False
        first = [title for title in (*_LOSSES, _RATE) if title in self._plots]
        groups: dict[str, list[rrb.View]] = {title: [self._view(title)] for title in first}
        groups[_PREDICTIONS] = list(self._tabs.get(_PREDICTIONS, {}).values())
        for title in self._plots:
            if title not in first:
                groups.setdefault(title.partition(": ")[0], []).append(self._view(title))
        for group, tabs in self._tabs.items():
            if group not in (_PREDICTIONS, _RUN):
                groups.setdefault(group, []).extend(tabs.values())
        if self._known:
            groups.setdefault(_RATE, []).extend(self._tabs.get(_RUN, {}).values())
        return [v[0] if len(v) == 1 else rrb.Tabs(*v) for v in groups.values() if v]

    def _view(self, title: str) -> rrb.View:
        plot = self._plots[title]
        logarithms = plot.logarithms if plot.is_positive else []
        return rrb.TimeSeriesView(
            name=f"{title} (log10)" if logarithms else title,
            contents=logarithms or plot.curves,
            plot_legend=legend(len(plot.curves)),
            axis_x=rrb.TimeAxis(view_range=_ALL),
            axis_y=rrb.ScalarAxis(range=(0.0, plot.highest)) if plot.highest else None,
        )

    def _add_tab(self, group: str, view: rrb.View, title: str) -> None:
        tabs = self._tabs.setdefault(group, {})
        if title not in tabs:
            tabs[title], self.changed = view, True

    # Curves ---------------------------------------------------------------------------------

    def _show(self, curves: list[str], entity: str) -> None:
        if entity not in curves:
            curves.append(entity)
            self.changed = True

    def _add_logarithm(
        self, plot: _Plot, curve: _Curve, times: Times, value: float, number: int
    ) -> None:
        """Add the logarithm of a loss, if it is positive."""
        if not value > 0:
            self.changed |= plot.is_positive and not math.isnan(value)
            plot.is_positive &= math.isnan(value)
            return
        spread = None if curve.spread is None else math.log10(1 + curve.spread / value)
        entity = entity_of(f"log10/{curve.name}")
        self._show(plot.logarithms, entity)
        self._add(entity, times, math.log10(value), curve.label, number, spread)

    def _add(
        self,
        entity: str,
        times: Times,
        value: float,
        label: str,
        number: int = 0,
        spread: float | None = None,
    ) -> None:
        """Add a point to a curve, with a band if its standard deviation is given."""
        if entity not in self._known:
            self._known.add(entity)
            look: dict[str, Any] = {"names": [label], "colors": colors.curves(1, number)}
            if spread is not None:
                self._rows.add_static(entity, rr.Measurements.from_fields(**look))
            elif "epoch" in times:  # few points, perhaps a single one
                points = rr.SeriesPoints(**look, marker_sizes=[2.5])
                self._rows.add_static(entity, rr.SeriesLines(**look, widths=[1.5]), points)
            else:
                self._rows.add_static(entity, rr.SeriesLines(**look, widths=[1.5]))
        if spread is None:
            self._rows.add(entity, rr.Scalars, times, scalars=[float(value)])
        else:
            band = {"values": [float(value)], "variances": [float(spread) ** 2]}
            self._rows.add(entity, rr.Measurements, times, **band)

    # Predictions ----------------------------------------------------------------------------

    def _add_square(self, name: str, entity: str, truth: Array) -> tuple[float, float]:
        """Add the square of true and predicted values; return the limits of its axes."""
        low, high = float(truth.min()), float(truth.max())
        margin = 0.05 * (high - low) or 0.05 * abs(low) or 1.0
        low, high = low - margin, high + margin
        corners = [[0, 0], [1, 0], [1, -1], [0, -1], [0, 0]]
        lines = rr.LineStrips2D([corners, [[0, 0], [1, -1]]], colors=[_GRAY], radii=[-0.7])
        self._rows.add_static(entity, lines)
        texts = {(0.0, 0.05): low, (0.5, 0.05): "true", (1.0, 0.05): high}
        texts |= {(-0.1, 0.0): low, (-0.1, -0.5): "predicted", (-0.1, -1.0): high}
        labels = [text if isinstance(text, str) else f"{text:.3g}" for text in texts.values()]
        places = rr.Points2D(
            list(texts), labels=labels, show_labels=True, radii=[0.0], colors=[_GRAY]
        )
        self._rows.add_static(f"{entity}/axes", places)
        bounds = rrb.VisualBounds2D(x_range=[-0.3, 1.1], y_range=[-1.1, 0.15])
        title = f"{name}: predicted vs. true{self._units.get(name, '')}"
        view = rrb.Spatial2DView(origin=entity, name=title, visual_bounds=bounds)
        self._add_tab(_PREDICTIONS, view, title)
        return low, high


def entity_of(name: str) -> str:
    """Return the entity path of a number's name."""
    return "/".join(["run", *map(rr.escape_entity_path_part, name.split("/"))])


def _curves(values: Mapping[str, float], units: Mapping[str, str]) -> Iterator[_Curve]:
    """Yield the curves to show for some numbers; `units` are those of fields."""
    for name in values:
        group, _, label = name.rpartition("/")
        if group.startswith(f"{_FIELDS}/"):
            of, _, component = group.removeprefix(f"{_FIELDS}/").partition("/")
            title = f"{_FIELDS}: {of}{units.get(of, '')}"
            if label == "mean":
                text = f"{component} mean ± deviation".lstrip()
                yield _Curve(name, title, text, component, values.get(f"{group}/std"))
            elif label in _QUANTILES:
                text = f"{component} {_QUANTILES[label]}".lstrip()
                yield _Curve(name, title, text, component)
        elif f"{group}/variance" in values and label in ("mean", "variance", "batch"):
            if label == "mean":
                spread = math.sqrt(max(0.0, values[f"{group}/variance"]))
                text = "mean ± deviation"
                yield _Curve(name, f"{group} per batch", text, text, spread)
        elif not label.startswith("training_"):
            yield _Curve(name, _title(group, label), label, label)


def _flatten(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the entries of nested tables as strings."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value)


def _title(group: str, label: str) -> str:
    """Return the title of a number's plot."""
    if group == "online":
        return _ONLINE.get(label, "online: others")
    if label in ("training", "validation"):
        return f"{group} per epoch"
    if label == "batch":
        return f"{group} per batch"
    return group or label.replace("_", " ")
