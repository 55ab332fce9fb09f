"""Normalization: what the fields of a network are shifted and scaled by, and how it is chosen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from physx_core.errors import ConfigError, DatasetError, listed, nearest
from physx_core.fields import CHANNEL, Field
from physx_core.statistics import RunningStatistics, check_statistic
from physx_core.typing import Array, Batch

METHODS = (
    *("none", "component", "channel", "field"),
    *("log-component", "log-channel", "log-field"),
    "increment",
)
"""How a field may be normalized: not at all; or with one mean and deviation for each component,
each entry of its axis ``"channel"``, or all of the field; ``log-``: its natural logarithm is;
``increment``: its change since the field that is the same quantity, or ``increment:FIELD``, is, as
by default."""

Normalize = bool | Mapping[str, str]
"""Whether fields are normalized, or the method of some of them by name."""

_INCREMENT = "increment"
_STATISTICS = ("mean", "std", "minimum", "maximum")
_ROUNDING = 4 * np.finfo(np.float64).eps
"""Smallest relative deviation that is no rounding error."""


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
        since: The field that they are those of the change since; "": they are of the field itself.
    """

    mean: Array
    std: Array
    minimum: Array | None = None
    maximum: Array | None = None
    log: bool = False
    since: str = ""

    @property
    def is_constant(self) -> Array:
        """Where all values are the same, up to rounding, of the shape of `std`."""
        if self.minimum is None or self.maximum is None:
            return np.zeros(np.shape(self.std), bool)
        found: Array = self.maximum - self.minimum <= _ROUNDING * np.abs(self.mean)
        return found

    def arrays(self) -> dict[str, Array]:
        """Return the known statistics by name, for a file or another process."""
        known = ((name, getattr(self, name)) for name in _STATISTICS)
        found = {name: values for name, values in known if values is not None}
        found |= {"log": np.array(1.0)} if self.log else {}
        return found | ({"since": _letters(self.since)} if self.since else {})

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], shape: tuple[int, ...]) -> Normalization:
        """Return the normalization that `arrays` described.

        Args:
            arrays: The statistics by name, possibly from an untrusted source.
            shape: Shape of the field.

        Raises:
            ValueError: If they are not the finite statistics of such a field.
        """
        if not {"mean", "std"} <= arrays.keys() <= {*_STATISTICS, "log", "since"}:
            raise ValueError(f"the statistics {sorted(arrays)} are not those of a normalization")
        own = arrays["mean"].shape
        if np.broadcast_shapes(own, shape) != shape:
            raise ValueError(f"statistics of shape {own} are not those of values of shape {shape}")
        known = {n: check_statistic(n, arrays[n], own) for n in _STATISTICS if n in arrays}
        since = bytes(arrays.get("since", np.empty(0)).astype(np.uint8)).decode()
        return cls(**known, log="log" in arrays, since=since)


class Measured(NamedTuple):
    """What statistics are of.

    Attributes:
        field: Name of the stored field; of increments, of the field of batches.
        pooled: Axes of its values that they are pooled over.
        log: Whether they are those of its natural logarithm.
        since: The field of batches that they are those of the change since; "": of none.
    """

    field: str
    pooled: tuple[int, ...]
    log: bool = False
    since: str = ""

    @property
    def names(self) -> list[str]:
        """The fields that they are computed from."""
        return [self.field, self.since] if self.since else [self.field]

    def of(self, batch: Batch) -> Array:
        """Return what they are computed from.

        Args:
            batch: Rows of the fields.

        Raises:
            DatasetError: If the logarithm of a value does not exist.
        """
        rows = batch[self.field]
        if self.since:
            before = batch[self.since]
            before = before if before.ndim == rows.ndim else before[:, -1]
            return np.subtract(rows, before, dtype=np.float64)
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
    """How one field is normalized; `of` is the stored field whose quantity it is."""

    name: str
    by: str
    of: Field
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
    for name, by, of, what in _choices(normalize, fields, stored):
        known = statistics(what)
        if known is None or not known.count:
            continue
        known = known.pool() if by == "field" else known
        mean, std = known.mean, known.std
        arrays = (
            mean,
            np.where(std > _ROUNDING * np.abs(mean), std, 1.0),
            known.minimum,
            known.maximum,
        )
        mean, std, least, most = (_fitted(a, by, fields[name], of) for a in arrays)
        found[name] = Normalization(mean, std, least, most, what.log, what.since)
    return found


def check_methods(where: str, normalize: Normalize) -> None:
    """Check the methods of a table.

    Raises:
        ConfigError: If there is no such method.
    """
    for name, method in normalize.items() if isinstance(normalize, Mapping) else ():
        if method not in METHODS and not method.startswith(_INCREMENT + ":"):
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
            given = [(each, table[each]) for each in names if each in table]
            own = [by for each, by in given if each == name or not by.startswith(_INCREMENT)]
            of = stored[names[-1]]
            method = own[0] if own else _default(of)
            if method.startswith(_INCREMENT):
                yield _increment(name, method, of, fields, stored)
            elif method != "none":
                yield _choice(name, method, of)


def _quantities(field: Field, stored: Mapping[str, Field]) -> list[str]:
    """Return the names of a field, and of those that are the same quantity, the last a root."""
    names, other = [field.name], field.like or stored[field.name].like
    while other in stored and other not in names:
        names.append(other)
        other = stored[other].like
    return names


def _increment(
    name: str, method: str, of: Field, fields: Mapping[str, Field], stored: Mapping[str, Field]
) -> _Choice:
    """Return how a field is normalized by its change since another one."""
    kept = {n for n, each in fields.items() if n != name and each.has_statistics}
    same = [n for n in fields if n in kept and _quantities(fields[n], stored)[-1] == of.name]
    since = method.removeprefix(_INCREMENT).removeprefix(":")
    if not since and len(same) != 1:
        what = f"{listed(same)} are" if same else "no other field is"
        raise ConfigError(
            f'normalize: {name} is "{_INCREMENT}", but {what} the same quantity '
            f'(Field(..., like=...), or a window): name the field, as "{_INCREMENT}:past".'
        )
    since = since or same[0]
    if since not in kept:
        raise ConfigError(
            f'normalize: {name} is "{method}", but there is no field "{since}" of numbers to '
            f"subtract.{nearest(since, kept)} Fields: {listed(sorted(kept))}."
        )
    shape, before = fields[name].shape or (), fields[since].shape or ()
    if shape != (of.shape or ()) or shape not in (before, before[1:]):
        raise ConfigError(
            f'normalize: the change of "{name}", of shape {shape}, since "{since}", of shape '
            f'{before}, is not that of one step of "{of.name}", of shape {of.shape}.'
        )
    return _Choice(name, _default(of), of, Measured(name, of.pooled, since=since))


def _letters(name: str) -> Array:
    return np.frombuffer(name.encode(), np.uint8)


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
    return _Choice(name, by, of, Measured(of.name, pooled, method.startswith("log-")))


def _fitted(values: Array, by: str, field: Field, of: Field) -> Array:
    """Return statistics of a stored field in a shape that broadcasts to values of another one."""
    if by == "field":
        return values.reshape(())
    if by == "channel":
        place = (field if CHANNEL in field.axes else of).axes
        values = values.reshape(-1, *(1,) * (len(place) - 1 - place.index(CHANNEL)))
    shape = field.entry_shape
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
