"""Normalization: what the fields of a network are shifted and scaled by, and how it is chosen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from physx_core.errors import ConfigError, DatasetError, listed, nearest
from physx_core.fields import CHANNEL, Field
from physx_core.statistics import RunningStatistics, check_statistic
from physx_core.typing import Array

METHODS = (
    *("none", "component", "channel", "field"),
    *("log-component", "log-channel", "log-field"),
)
"""How a field may be normalized: not at all; or with one mean and deviation for each component,
each entry of its axis ``"channel"``, or all of the field; ``log-``: its natural logarithm is."""

Normalize = bool | Mapping[str, str]
"""Whether fields are normalized, or the method of some of them by name."""

_STATISTICS = ("mean", "std", "minimum", "maximum")


@dataclass(frozen=True)
class Normalization:
    """Statistics of a field, or of its logarithm; mean and standard deviation normalize it.

    Their shape, such as (2, 1, 1) for the channels of a picture, broadcasts to that of a value.

    Attributes:
        mean: Mean, float64, in the field's unit.
        std: Standard deviation, float64, in the field's unit; 1 where the values are constant, so
            that normalization only shifts them to 0.
        minimum: Smallest value, float64, in the field's unit; None if unknown.
        maximum: Largest value, like `minimum`.
        log: Whether all of them, without unit, are those of the natural logarithm of the field.
    """

    mean: Array
    std: Array
    minimum: Array | None = None
    maximum: Array | None = None
    log: bool = False

    def arrays(self) -> dict[str, Array]:
        """Return the known statistics by name, for a file or another process."""
        known = ((name, getattr(self, name)) for name in _STATISTICS)
        found = {name: values for name, values in known if values is not None}
        return found | {"log": np.array(1.0)} if self.log else found

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], shape: tuple[int, ...]) -> Normalization:
        """Return the normalization that `arrays` described.

        Args:
            arrays: The statistics by name, possibly from an untrusted source.
            shape: Shape of the field.

        Raises:
            ValueError: If they are not the finite statistics of such a field.
        """
        if not {"mean", "std"} <= arrays.keys() <= {*_STATISTICS, "log"}:
            raise ValueError(f"the statistics {sorted(arrays)} are not those of a normalization")
        own = arrays["mean"].shape
        if np.broadcast_shapes(own, shape) != shape:
            raise ValueError(f"statistics of shape {own} are not those of values of shape {shape}")
        known = {name: check_statistic(name, arrays[name], own) for name in arrays if name != "log"}
        return cls(**known, log="log" in arrays)


class Measured(NamedTuple):
    """What statistics are of.

    Attributes:
        field: Name of the stored field.
        pooled: Axes of its values that they are pooled over.
        log: Whether they are those of its natural logarithm.
    """

    field: str
    pooled: tuple[int, ...]
    log: bool

    def of(self, rows: Array) -> Array:
        """Return what they are computed from.

        Args:
            rows: Rows of the field.

        Raises:
            DatasetError: If the logarithm of a value does not exist.
        """
        if not self.log:
            return rows
        wrong = rows[rows <= 0]
        if wrong.size:
            raise DatasetError(
                f'The field "{self.field}" has the value {wrong[0]}, whose logarithm does not '
                "exist: normalize it without (DatasetConfig.normalize)."
            )
        return np.log(rows, dtype=np.float64)


class _Choice(NamedTuple):
    """How one field is normalized."""

    name: str
    by: str
    measured: Measured


def measured(normalize: Normalize, fields: Mapping[str, Field]) -> list[Measured]:
    """Return the statistics that the normalization of stored fields needs.

    Args:
        normalize: Whether fields are normalized, or how: see `compute_normalization`.
        fields: The stored fields by name.

    Raises:
        ConfigError: As `compute_normalization`.
    """
    return list(dict.fromkeys(each.measured for each in _choices(normalize, fields, fields)))


def compute_normalization(
    normalize: Normalize,
    fields: Mapping[str, Field],
    stored: Mapping[str, Field],
    statistics: Callable[[Measured], RunningStatistics | None],
) -> dict[str, Normalization]:
    """Return the normalization of the floating-point fields by name.

    By default, or if a table does not name it, a field is normalized like the field that it is
    `like`, by its statistics; otherwise by those of each channel, or of the whole field, if it has
    two or more named axes; and by those of each component if it has not.

    Args:
        normalize: False: none is normalized; True: by default; a table: the method of some of them,
            one of `METHODS`, by name.
        fields: The fields, stored ones or windows of them.
        stored: The stored fields by name.
        statistics: Returns statistics of a stored field; None: there are none.

    Raises:
        ConfigError: If the table names a field or a method that does not exist, or the field does
            not fit it.
        DatasetError: If a value has no logarithm.
    """
    found = {}
    for name, by, of in _choices(normalize, fields, stored):
        known = statistics(of)
        if known is None or not known.count:
            continue
        known = known.pool() if by == "field" else known
        mean, std = known.mean, known.std
        resolution = 4 * np.finfo(np.float64).eps * np.abs(mean)
        arrays = mean, np.where(std > resolution, std, 1.0), known.minimum, known.maximum
        mean, std, least, most = (_fitted(a, by, fields[name], stored[of.field]) for a in arrays)
        found[name] = Normalization(mean, std, least, most, of.log)
    return found


def check_methods(where: str, normalize: Normalize) -> None:
    """Check the methods of a table.

    Raises:
        ConfigError: If there is no such method.
    """
    for name, method in normalize.items() if isinstance(normalize, Mapping) else ():
        if method not in METHODS:
            raise ConfigError(
                f"{where}: {name} is {method!r} but must be one of {listed(METHODS)}."
            )


def _choices(
    normalize: Normalize, fields: Mapping[str, Field], stored: Mapping[str, Field]
) -> Iterator[_Choice]:
    table: Mapping[str, str] = normalize if isinstance(normalize, Mapping) else {}
    check_methods("normalize", table)
    known = {**stored, **fields}
    for name in table:
        if name not in known:
            raise ConfigError(
                f'normalize names the field "{name}", which does not exist.{nearest(name, known)} '
                f"Fields: {listed(known)}."
            )
        if not known[name].has_statistics and table[name] != "none":
            raise ConfigError(
                f'normalize: the field "{name}" has values of type {known[name].numpy_dtype}, '
                "which are not normalized."
            )
    for name, field in fields.items() if normalize is not False else ():
        if field.has_statistics:
            names = _quantities(field, stored)
            given = next((table[each] for each in names if each in table), "")
            of = stored[names[-1]]
            method = given or _default(of)
            if method != "none":
                yield _choice(name, method, of)


def _quantities(field: Field, stored: Mapping[str, Field]) -> list[str]:
    """Return the names of a field, and of those that are the same quantity, the last a root."""
    names, other = [field.name], field.like or stored[field.name].like
    while other in stored and other not in names:
        names.append(other)
        other = stored[other].like
    return names


def _default(of: Field) -> str:
    if not of.pooled:
        return "component"
    return "channel" if CHANNEL in of.axes else "field"


def _choice(name: str, method: str, of: Field) -> _Choice:
    by = method.removeprefix("log-")
    if by == "channel" and CHANNEL not in of.axes:
        raise ConfigError(
            f'normalize: {name} is {method!r}, but the field "{of.name}" has no axis named '
            f'"{CHANNEL}": name its axes in Field(..., axes=...), or normalize it by "field".'
        )
    pooled = () if by == "component" else of.pooled
    return _Choice(name, by, Measured(of.name, pooled, method.startswith("log-")))


def _fitted(values: Array, by: str, field: Field, of: Field) -> Array:
    """Return statistics of a stored field in a shape that broadcasts to values of another one."""
    if by == "field":
        return values.reshape(())
    if by == "channel":
        place = (field if CHANNEL in field.axes else of).axes
        values = values.reshape(-1, *(1,) * (len(place) - 1 - place.index(CHANNEL)))
    shape: Any = field.shape or ()
    try:
        fits = np.broadcast_shapes(values.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ConfigError(
            f'normalize: the field "{field.name}" of shape {shape} cannot have the statistics of '
            f'each {by} of "{of.name}", of shape {of.shape}: normalize it by another method.'
        )
    return values
