"""Drawing: figures as SVG; the same numbers give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from physx_core.typing import Array
from physx_report.blocks import Figure

TRUTH, PREDICTION, MUTED = "#222222", "#d1495b", "#7a869a"
_CYCLE = ("#30638e", "#d1495b", "#2a9d8f", "#edae49", "#6d597a", "#7a869a")
_STYLE: Any = {
    "axes.prop_cycle": cycler(color=_CYCLE),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9,
    "image.cmap": "viridis",
    "svg.fonttype": "none",
    "svg.hashsalt": "physx",
}
_MOST_POINTS = 1000
_FEW = 8
"""Largest number of components that are drawn as a line each."""


@contextmanager
def figure(
    caption: str, rows: int = 1, columns: int = 1, *, width: float = 7.0, height: float = 2.4
) -> Iterator[tuple[list[Figure], list[Axes]]]:
    """Draw a figure.

    Args:
        caption: What it shows.
        rows: Number of rows of axes.
        columns: Number of columns.
        width: Width in inches.
        height: Height of a row in inches.

    Yields:
        A list that has the figure afterwards, and its axes, row by row.
    """
    found: list[Figure] = []
    with mpl.rc_context(_STYLE):
        canvas = Canvas((width, height * rows))
        where = _margins(width, height * rows, rows, columns)
        axes = canvas.subplots(rows, columns, squeeze=False, gridspec_kw=where)
        yield found, list(np.ravel(axes))
        content = io.StringIO()
        canvas.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
        found.append(Figure(content.getvalue(), caption))


def _margins(width: float, height: float, rows: int, columns: int) -> dict[str, float]:
    """Return where axes are in a figure, for labels of the usual size.

    Fixed places, as those that matplotlib finds ("constrained") cost as much time as all else.

    Args:
        width: Width of the figure in inches.
        height: Height in inches.
        rows: Number of rows of axes.
        columns: Number of columns.
    """
    left, right, bottom, top, across, down = 0.75, 0.15, 0.45, 0.3, 0.75, 0.75
    each = (width - left - right - across * (columns - 1)) / columns
    tall = (height - bottom - top - down * (rows - 1)) / rows
    return {
        "left": left / width,
        "right": 1 - right / width,
        "bottom": bottom / height,
        "top": 1 - top / height,
        "wspace": across / each,
        "hspace": down / tall,
    }


def curves(axes: Axes, known: Mapping[str, Mapping[int, float]], x: str) -> None:
    """Draw series of steps and values; long ones as the means of pieces."""
    for name, series in known.items():
        steps, values = np.array(list(series)), np.array(list(series.values()))
        size = -(-len(steps) // _MOST_POINTS)
        begins = np.arange(0, len(steps), size)
        counts = np.diff(begins, append=len(steps))
        axes.plot(steps[begins], np.add.reduceat(values, begins) / counts, label=name, lw=1.2)
    axes.set_xlabel(x)
    shown = np.concatenate([list(series.values()) for series in known.values()])
    if (shown > 0).all() and shown.max() > 20 * shown.min():
        axes.set_yscale("log")
    if len(known) > 1:
        axes.legend(frameon=False)


def compare(
    axes: Sequence[Axes], truth: Array, prediction: Array | None, label: str, axis_names: str
) -> None:
    """Draw values of an episode, and what was predicted of them.

    Few components are lines over the rows; more of them, of one axis, pictures of all rows; those
    of two axes are pictures of the row with the largest error, or the last one.

    Args:
        axes: One for the truth; three if there is a prediction: that, and the difference.
        truth: The values, shape (rows, ...).
        prediction: The predicted ones; None: there are none.
        label: Name and unit of the field.
        axis_names: What the rows are.
    """
    rows = len(truth)
    flat = truth.reshape(rows, -1)
    error = None if prediction is None else np.abs(prediction - truth).reshape(rows, -1)
    if flat.shape[1] <= _FEW:
        _lines(axes, flat, None if prediction is None else prediction.reshape(rows, -1), axis_names)
        axes[0].set_ylabel(label)
        return
    row = rows - 1 if error is None else int(np.argmax(error.mean(axis=1)))
    picture = truth[row]
    if picture.ndim == 1:
        shown = [truth.T, None if prediction is None else prediction.T]
        where = axis_names
    else:
        picture = picture if picture.ndim == 2 else picture.reshape(-1, picture.shape[-1])
        found = None if prediction is None else prediction[row].reshape(picture.shape)
        shown, where = [picture, found], f"at {axis_names} {row}"
    _pictures(axes, shown, label, where)


def scatter(axes: Axes, truth: Array, prediction: Array, label: str) -> None:
    """Draw predicted values against the true ones, and where they would be equal."""
    step = -(-truth.size // _MOST_POINTS)
    true, guess = truth.ravel()[::step], prediction.ravel()[::step]
    ends = min(true.min(), guess.min()), max(true.max(), guess.max())
    axes.plot(ends, ends, color=MUTED, lw=0.8)
    axes.plot(true, guess, ".", color=PREDICTION, ms=2)
    axes.set_xlabel(f"true {label}")
    axes.set_ylabel("predicted")


def _lines(axes: Sequence[Axes], truth: Array, prediction: Array | None, x: str) -> None:
    steps = np.arange(len(truth))
    axes[0].plot(steps, truth, color=TRUTH, lw=1.2)
    if prediction is not None:
        axes[0].plot(steps, prediction, color=PREDICTION, lw=1.2, ls=(0, (4, 2)))
        lines = axes[0].get_lines()
        axes[0].legend([lines[0], lines[-1]], ["truth", "prediction"], framealpha=0.7, fontsize=8)
    axes[0].set_xlabel(x)


def _pictures(axes: Sequence[Axes], shown: Sequence[Array | None], label: str, where: str) -> None:
    truth, prediction = shown
    assert truth is not None
    parts = [("truth", truth)]
    if prediction is not None:
        parts += [("prediction", prediction), ("difference", prediction - truth)]
    low = min(float(values.min()) for _, values in parts[:2])
    high = max(float(values.max()) for _, values in parts[:2])
    for place, (name, values) in zip(axes, parts, strict=False):
        most = float(np.abs(values).max()) or 1.0
        is_error = name == "difference"
        limits = (-most, most) if is_error else (low, high)
        image = place.imshow(
            values, vmin=limits[0], vmax=limits[1], cmap="RdBu" if is_error else None,
            aspect="auto", interpolation="nearest", origin="lower",
        )  # fmt: skip
        place.set_title(name, fontsize=9)
        place.set_xlabel(where)
        place.figure.colorbar(image, ax=place)
    axes[0].set_ylabel(label)


def are_lines(values: Array) -> bool:
    """Return whether `compare` draws values as lines in one of the axes."""
    return int(values[0].size) <= _FEW
