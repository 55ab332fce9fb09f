"""Layouts of HDF5 files with trajectories: The Well, PDEBench, robomimic.

Each row is a step of a trajectory, with its numbers in the fields ``episode`` and ``step``, and its
``time`` where the file has one. Coordinates and constants are kept in the dataset's ``info``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import Field, Role
from physx_core.typing import Array, Index
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns
from physx_formats.table import Notes

_SPACE = "xyz"
_MOST_NUMBERS = 4096
"""Largest number of values that ``info`` holds of an array."""
_MOST_TRAJECTORIES = 10_000_000
_COORDINATE = re.compile(r"([xyzt])-coordinate")
_Read = Callable[[int, int], Array]
"""Returns the rows of a trajectory from one step to another."""


@dataclass(frozen=True)
class _Series:
    """A field of all trajectories.

    Attributes:
        reads: Reads the rows of each trajectory.
        shape: Shape of a row.
        dtype: Type of the values.
        axes: Names of the axes, or nothing.
        role: Role of the field.
        unit: Unit of the values.
    """

    reads: Sequence[_Read]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    axes: tuple[str, ...] = ()
    role: Role = "training"
    unit: str = ""


class _Column:
    """The rows of a field, one trajectory after another; see `Column`."""

    problem = ""

    def __init__(self, place: str, series: _Series, lengths: Index) -> None:
        """Keep where the trajectories begin.

        Args:
            place: Name and file, for messages.
            series: The field.
            lengths: Number of rows of each trajectory.
        """
        self.shape = (int(lengths.sum()), *series.shape)
        self.dtype, self.unit = series.dtype, series.unit
        self._place, self._reads = place, series.reads
        self._ends: Index = np.cumsum(lengths)
        self._lengths = lengths

    def read(self, start: int, count: int) -> Array:
        """Return rows."""
        parts: list[Array] = []
        while count > 0:
            number = int(np.searchsorted(self._ends, start, side="right"))
            begin = start - int(self._ends[number] - self._lengths[number])
            end = min(begin + count, int(self._lengths[number]))
            try:
                parts.append(np.asarray(self._reads[number](begin, end)))
            except (OSError, RuntimeError) as error:
                raise ExchangeError(f"{self._place} cannot be read: {error}.") from error
            start, count = start + end - begin, count - (end - begin)
        return np.concatenate(parts) if parts else np.empty((0, *self.shape[1:]), self.dtype)


def read_layout(path: Path, file: Any) -> tuple[Columns, Notes] | None:
    """Return the columns of a file by mode and field, and notes; None: it has no known layout.

    Args:
        path: The file, for messages.
        file: The same, open.
    """
    for name, find in _LAYOUTS.items():
        found = find(file)
        if found is None:
            continue
        modes, info = found
        columns: Columns = {}
        fields: dict[str, dict[str, Field]] = {}
        for mode, (lengths, series) in modes.items():
            known = fields.setdefault(mode, {})
            for label, each in (_numbers(lengths) | series).items():
                place = f'"{label}" of {path}'
                columns[f"{mode}/{label}"] = _Column(place, each, lengths)
                known[label] = Field(
                    re.sub(r"\W", "_", label), each.shape, each.dtype, each.unit, each.role,
                    each.axes if "/" not in label else (),
                )  # fmt: skip
        noted = {
            mode: {field.name: field for field in known.values()} for mode, known in fields.items()
        }
        return columns, Notes(noted, {"layout": name, **info})
    return None


_Found = tuple[dict[str, tuple[Index, dict[str, _Series]]], dict[str, Any]]


def _numbers(lengths: Index) -> dict[str, _Series]:
    """Return the numbers of trajectories and of steps."""
    kind = np.dtype(np.int64)

    def repeated(number: int) -> _Read:
        return lambda begin, end: np.full(end - begin, number, kind)

    def counted(begin: int, end: int) -> Array:
        return np.arange(begin, end, dtype=kind)

    reads = [repeated(number) for number in range(len(lengths))]
    return {
        "episode": _Series(reads, (), kind, role="additional"),
        "step": _Series([counted] * len(lengths), (), kind, role="additional"),
    }


def _stacked(
    dataset: Any,
    lengths: Index,
    axes: tuple[str, ...],
    *,
    by_sample: bool = True,
    by_time: bool = True,
) -> _Series:
    """Return a field of which one array has all trajectories and steps, as far as it varies."""
    count, steps = len(lengths), int(lengths.max(initial=0))
    wanted = (count,) * by_sample + (steps,) * by_time
    own = dataset.shape[: len(wanted)]
    if len(own) < len(wanted) or own[:by_sample] != wanted[:by_sample] or own[-1:] < wanted[-1:]:
        raise ExchangeError(
            f'"{dataset.name}" has the shape {dataset.shape}, but the file has {count} '
            f"trajectories of {steps} steps."
        )

    def read(number: int) -> _Read:
        def rows(begin: int, end: int) -> Array:
            place = (number,) if by_sample else ()
            if by_time:
                found: Array = dataset[(*place, slice(begin, end))]
                return found
            values = np.asarray(dataset[place])
            return np.broadcast_to(values, (end - begin, *values.shape))

        return rows

    shape = dataset.shape[by_sample + by_time :]
    role: Role = "training" if by_time and shape else "additional"
    return _Series(
        [read(number) for number in range(count)], shape, dataset.dtype,
        axes if len(axes) == len(shape) else (), role, _unit(dataset),
    )  # fmt: skip


def _unit(dataset: Any) -> str:
    unit = dataset.attrs.get("unit", dataset.attrs.get("units", ""))
    return unit if isinstance(unit, str) else ""


def _is_group(item: Any) -> bool:
    return hasattr(item, "keys")


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _plain(values: Any) -> Any:
    """Return numbers or text as plain data for ``info``; None: they are too many."""
    if getattr(values, "size", 1) > _MOST_NUMBERS:
        return None
    array = np.asarray(values[()] if hasattr(values, "id") else values)
    if array.dtype.kind not in "biufSUO":
        return None
    if array.dtype.kind in "SUO":
        array = np.vectorize(_text, otypes=[object])(array)
    return array.tolist()


def _constants(found: Mapping[str, Any]) -> dict[str, Any]:
    plain = {name: _plain(values) for name, values in found.items()}
    return {name: value for name, value in plain.items() if value is not None}


# The Well ---------------------------------------------------------------------------------------


def _the_well(file: Any) -> _Found | None:
    """Read ``t0_fields`` to ``t2_fields``, of shape (trajectories, steps, coordinates, ...)."""
    if not {"dimensions", "t0_fields"} <= set(file) or "n_trajectories" not in file.attrs:
        return None
    dimensions, count = file["dimensions"], int(file.attrs["n_trajectories"])
    space = tuple(map(_text, dimensions.attrs.get("spatial_dims", ())))
    time = dimensions["time"]
    varying = [each for k in range(3) for each in file.get(f"t{k}_fields", {}).values()]
    if count != 1 and not any(_says(each, "sample_varying") for each in varying):
        raise ExchangeError(f'"{file.filename}" has no field that varies between trajectories.')
    if count > _MOST_TRAJECTORIES:
        raise ExchangeError(f'"{file.filename}" claims that it has {count:,} trajectories.')
    lengths = np.full(count, time.shape[-1], np.int64)
    series = {"time": _stacked(time, lengths, (), by_sample=_says(time, "sample_varying"))}
    for order, more in enumerate(((), ("channel",), ("channel", "component"))):
        for name, each in file.get(f"t{order}_fields", {}).items():
            series[name] = _stacked(
                each, lengths, (*space, *more),
                by_sample=_says(each, "sample_varying"), by_time=_says(each, "time_varying"),
            )  # fmt: skip
    constants = {}
    for name, each in file.get("scalars", {}).items():
        varies = {f"by_{n}": _says(each, f"{n}_varying") for n in ("sample", "time")}
        if any(varies.values()):
            series[name] = _stacked(each, lengths, (), **varies)
        else:
            constants[name] = each
    coordinates = {name: dimensions[name] for name in space if name in dimensions}
    info = {"coordinates": _constants(coordinates), "parameters": _constants(constants)}
    return {"training": (lengths, series)}, info


def _says(dataset: Any, name: str) -> bool:
    return bool(dataset.attrs.get(name, False))


# PDEBench ---------------------------------------------------------------------------------------


def _pdebench(file: Any) -> _Found | None:
    """Read arrays of shape (trajectories, steps, coordinates) beside ``t-coordinate``."""
    coordinates = {found[1]: file[found[0]] for found in map(_COORDINATE.fullmatch, file) if found}
    space = tuple(name for name in _SPACE if name in coordinates)
    names = [n for n in file if not _COORDINATE.fullmatch(n) and not _is_group(file[n])]
    moving = [n for n in names if file[n].ndim >= len(space) + 2]
    if not space or not moving:
        return None
    count, steps = file[moving[0]].shape[:2]
    lengths, series = np.full(count, steps, np.int64), {}
    if "t" in coordinates and len(coordinates["t"]) >= steps:
        series["time"] = _stacked(coordinates["t"], lengths, (), by_sample=False)
    for name in names:
        each = file[name]
        by_time = name in moving
        if each.shape[: 1 + by_time] != (count, steps)[: 1 + by_time]:
            return None
        series[name] = _stacked(each, lengths, _with_channel(space, each.ndim - 1 - by_time),
                                by_time=by_time)  # fmt: skip
    found = {name: coordinates[name] for name in space}
    return {"training": (lengths, series)}, {"coordinates": _constants(found)}


def _pdebench_groups(file: Any) -> _Found | None:
    """Read a group for each trajectory, ``0000/data`` of shape (steps, coordinates, channels)."""
    groups = [file[name] for name in sorted(file) if _is_group(file[name])]
    if not groups or len(groups) != len(file) or any("data" not in each for each in groups):
        return None
    if any("grid" not in each or _is_group(each["data"]) for each in groups):
        return None
    grid = groups[0]["grid"]
    space = tuple(name for name in _SPACE if name in grid)
    series = {"data": _listed([each["data"] for each in groups])}
    axes = _with_channel(space, len(series["data"].shape))
    series["data"] = _Series(**{**vars(series["data"]), "axes": axes})
    if all("t" in each["grid"] for each in groups):
        series["time"] = _listed([each["grid"]["t"] for each in groups])
    lengths = np.array([len(each["data"]) for each in groups])
    return {"training": (lengths, series)}, {
        "coordinates": _constants({name: grid[name] for name in space})
    }


def _with_channel(space: tuple[str, ...], dims: int) -> tuple[str, ...]:
    return (*space, "channel") if dims == len(space) + 1 else space


def _listed(datasets: Sequence[Any], role: Role = "training") -> _Series:
    """Return a field of which each trajectory has an array of its own."""

    def read(dataset: Any) -> _Read:
        return lambda begin, end: dataset[begin:end]

    shapes = {each.shape[1:] for each in datasets}
    if len(shapes) > 1:
        raise ExchangeError(f'"{datasets[0].name}" has rows of different shapes: {shapes}.')
    first = datasets[0]
    role = role if first.ndim > 1 else "additional"
    kind = np.result_type(*(each.dtype for each in datasets))
    return _Series([read(each) for each in datasets], first.shape[1:], kind, (), role, _unit(first))


# robomimic --------------------------------------------------------------------------------------


def _robomimic(file: Any) -> _Found | None:
    """Read a group for each demonstration, ``data/demo_0``, and which are for validation."""
    demos = file.get("data")
    if not _is_group(demos) or not demos or any("actions" not in demos[name] for name in demos):
        return None
    names = sorted(demos, key=lambda name: (len(name), name))
    valid = {_text(name) for name in file["mask/valid"][()]} if "mask/valid" in file else set()
    modes = {}
    for mode, own in (
        ("training", [name for name in names if name not in valid]),
        ("validation", [name for name in names if name in valid]),
    ):
        groups = [demos[name] for name in own]
        if not groups:
            continue
        lengths = np.array([len(each["actions"]) for each in groups])
        series = {
            name: _listed([each[name] for each in groups])
            for name in _arrays(groups[0])
            if all(name in each and len(each[name]) == len(each["actions"]) for each in groups)
        }
        modes[mode] = lengths, series
    return modes, {"parameters": _constants(dict(demos.attrs))}


def _arrays(group: Any, prefix: str = "") -> Iterator[str]:
    for name, item in group.items():
        if _is_group(item):
            yield from _arrays(item, f"{prefix}{name}/")
        elif item.ndim:
            yield f"{prefix}{name}"


_LAYOUTS: dict[str, Callable[[Any], _Found | None]] = {
    "The Well": _the_well,
    "PDEBench": _pdebench,
    "PDEBench, a group for each trajectory": _pdebench_groups,
    "robomimic": _robomimic,
}
