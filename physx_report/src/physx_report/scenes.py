"""Scenes: what environments have drawn, and which of it follows from a field."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from physx_core.components import Event
from physx_core.typing import Array, Batch, Index

Drawn: TypeAlias = Mapping[tuple[str, str], Array]
"""Numbers of objects by the object's name and the option."""

_FEWEST = 3
"""Number of independent numbers below which nothing is said to follow from a field."""
_MOST_COLUMNS = 64
_EXACT, _ROUNDED = 1e-5, 2e-6
"""How much of its changes, and of its size, a number may differ from what follows: rounding."""
_PLACES = ("position", "positions", "vectors")
_NOT_COPIED = ("scalar_field", "label", "labels", "color_bar", "colormap", "vmin", "vmax")


class Scene:
    """What an environment has drawn so far.

    Attributes:
        objects: Kind and options of each object by its name.
    """

    def __init__(self) -> None:
        """Begin empty."""
        self.objects: dict[str, tuple[str, dict[str, Any]]] = {}

    def take(self, events: Iterable[Event]) -> None:
        """Change it."""
        for event in (one for several in events for one in several.each()):
            if event.action == "remove":
                self.objects.pop(event.name, None)
            elif event.action == "add":
                self.objects[event.name] = event.kind, dict(event.values)
            elif event.name in self.objects:  # the simulated time is not
                self.objects[event.name][1].update(event.values)

    def numbers(self) -> dict[tuple[str, str], Array]:
        """Return the numbers of all objects that may follow from a field."""
        found = {}
        for name, (_, options) in self.objects.items():
            for option, value in options.items():
                values = np.concatenate(value) if _is_lines(value) else value
                if isinstance(values, np.ndarray) and values.dtype.kind == "f":
                    found[name, option] = values.astype(np.float64)
        return found


@dataclass(frozen=True)
class Link:
    """Numbers of an object of which each column is a factor times a field, plus a constant.

    Attributes:
        name: Name of the object.
        option: The option that has them.
        field: The field.
        columns: Of each column the places of its numbers, those of the field's, and the factor.
    """

    name: str
    option: str
    field: str
    columns: Sequence[tuple[Index, Index, float]]

    @property
    def is_place(self) -> bool:
        """Whether they are where something is."""
        return self.option in _PLACES

    def follow(self, drawn: Drawn, truth: Array, prediction: Array) -> Array:
        """Return what the environment would draw of a prediction.

        Args:
            drawn: What it has drawn of the truth.
            truth: The true values, shape (...).
            prediction: The predicted ones.
        """
        values = drawn[self.name, self.option]
        flat = values.ravel().copy()
        difference = (prediction - truth).ravel()
        for places, sources, factor in self.columns:
            flat[places] += factor * difference[sources]
        return flat.reshape(values.shape)


def find_links(frames: Sequence[Drawn], truth: Batch) -> list[Link]:
    """Find which numbers of objects follow from which field, to rounding.

    Args:
        frames: What was drawn of each row.
        truth: Fields by name, arrays of shape (rows, ...).
    """
    found = []
    for key in frames[0] if frames else ():
        series = [each.get(key) for each in frames]
        shape = series[0].shape if series[0] is not None else ()
        if any(each is None or each.shape != shape for each in series):
            continue
        values = np.stack([each for each in series if each is not None])
        for field, rows in truth.items():
            columns = _columns(values, rows.reshape(len(rows), -1).astype(np.float64))
            if columns:
                found.append(Link(*key, field, columns))
                break
    return found


def _columns(values: Array, field: Array) -> list[tuple[Index, Index, float]]:
    """Return how each column of numbers that changes follows from one of a field; empty: not."""
    flat = values.reshape(len(values), -1)
    for places in _layouts(values.shape[1:]):
        columns = [c for c in places.T if np.ptp(flat[:, c], axis=0).any()]
        if not columns:
            return []
        for sources in _layouts_of(field.shape[1], len(places)):
            matches = [_match(flat[:, c], field, c, sources) for c in columns]
            if all(matches):
                return [each for each in matches if each is not None]
    return []


def _layouts(shape: tuple[int, ...]) -> Iterator[Index]:
    """Yield the places of numbers in columns: by point, one for all, one for each."""
    places = np.arange(int(np.prod(shape)))
    if len(shape) == 2 and shape[1] <= 4:
        yield places.reshape(shape)
    yield places[:, None]
    if len(places) <= _MOST_COLUMNS:
        yield places[None]


def _layouts_of(size: int, length: int) -> Iterator[Index]:
    """Yield the places of a field's numbers in columns of a length."""
    if size % length == 0 and size // length <= _MOST_COLUMNS:
        places = np.arange(size)
        yield places.reshape(length, -1)
        yield places.reshape(-1, length).T


def _match(
    column: Array, field: Array, places: Index, sources: Index
) -> tuple[Index, Index, float] | None:
    changes = column - column.mean(axis=0)
    largest = float(np.abs(changes).max())
    allowed = _EXACT * largest + _ROUNDED * float(np.abs(column).max())
    if (len(column) - 1) * column.shape[1] < _FEWEST or largest < 50 * allowed:
        return None
    for source in sources.T:
        own = field[:, source] - field[:, source].mean(axis=0)
        square = float((own**2).sum())
        factor = float((changes * own).sum()) / square if square else 0.0
        if factor and np.abs(changes - factor * own).max() <= allowed:
            return places, source, factor
    return None


def begin_prediction(
    scene: Scene, links: Sequence[Link], truth: Batch, prediction: Batch
) -> list[Event]:
    """Return the events that show a prediction in the place of the truth, and the truth faintly.

    Args:
        scene: What the environment has drawn of the truth.
        links: What of it follows from the fields.
        truth: The true values of the row by field.
        prediction: The predicted ones.
    """
    drawn, events = scene.numbers(), []
    for name, option, faint in _changed(scene, links):
        kind, options = scene.objects[name]
        of = next(each for each in links if (each.name, each.option) == (name, option))
        values = of.follow(drawn, truth[of.field], prediction[of.field])
        events.append(Event("update", kind, (name,), {option: _split(values, options[option])}))
        if faint:
            events.append(Event("add", kind, (_faint(name),), _as_faint(kind, options)))
    return events


def end_prediction(scene: Scene, links: Sequence[Link]) -> list[Event]:
    """Return the events that show the truth again."""
    events = []
    for name, option, faint in _changed(scene, links):
        kind, options = scene.objects[name]
        events.append(Event("update", kind, (name,), {option: options[option]}))
        if faint:
            events.append(Event("remove", kind, (_faint(name),), {}))
    return events


def _changed(scene: Scene, links: Sequence[Link]) -> Iterator[tuple[str, str, bool]]:
    """Yield what a prediction changes, and whether the truth is drawn faintly beside it."""
    known: set[str] = set()
    for link in links:
        if link.name in scene.objects:
            is_first = link.is_place and link.name not in known
            known |= {link.name} if is_first else set()
            yield link.name, link.option, is_first


def _faint(name: str) -> str:
    return f"{name}, truth"


def _as_faint(kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    look = {"color": "black", "wireframe": True} if kind == "mesh" else {"color": "gray"}
    known = {name: value for name, value in options.items() if name not in _NOT_COPIED}
    return {**known, "alpha": 0.3, **look}


def _split(values: Array, like: Any) -> Any:
    """Return numbers in the form of an option: of several lines, one array for each."""
    if not _is_lines(like):
        return values.astype(like.dtype)
    ends = np.cumsum([len(each) for each in like])[:-1]
    return np.split(values.astype(like[0].dtype), ends)


def _is_lines(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and bool(value) and isinstance(value[0], np.ndarray)
