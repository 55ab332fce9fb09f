"""Subject: the component under test and what its checks need to create it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from physx_core.components import Parameter
from physx_core.config import NetworkConfig, from_plain
from physx_core.errors import ConfigError
from physx_core.fields import Field
from physx_core.plugins import resolve
from physx_core.typing import Batch

_UNKNOWN = "no_option_has_this_name"


@dataclass(frozen=True)
class Subject:
    """A component to check.

    Attributes:
        kind: Its kind, such as ``environment``.
        reference: Its reference.
        arguments: Keyword arguments for its constructor.
        options: What else its kind of check needs, as plain data: ``fields`` of a network, the
            ``network`` of an optimization or transformation, the ``parameters`` of a sampler.
        folder: An empty folder for this check.
        before: State of the process before the component was imported.
    """

    kind: str
    reference: str
    arguments: Mapping[str, Any]
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()
    before: Mapping[str, Any] | None = None

    def make(self, **more: Any) -> Any:
        """Return a new component; `more` holds additional constructor arguments."""
        made = resolve(self.kind, self.reference)
        return made(**self.arguments, **more) if callable(made) else made

    @property
    def fields(self) -> list[Field]:
        """The given fields; empty if there are none."""
        return [Field(**plain) for plain in self.options.get("fields", ())]

    @property
    def network(self) -> NetworkConfig | None:
        """The given network, or None."""
        plain = self.options.get("network")
        return None if plain is None else from_plain(NetworkConfig, plain)

    @property
    def parameters(self) -> list[Parameter]:
        """The given parameters; empty if there are none."""
        return [Parameter.from_dict(plain) for plain in self.options.get("parameters", ())]


Check: TypeAlias = Callable[[Subject], None]
"""Raises an exception if the component does not do what the check's name says."""


def refuses_unknown_options(subject: Subject, use: Check | None = None) -> None:
    """Check that a misspelt option is an error instead of being ignored.

    Args:
        subject: The component.
        use: Creates and starts to use it, for components that read options only then; None: creates
            it.
    """
    arguments = {**subject.arguments, _UNKNOWN: 1}
    try:
        (use or _create)(replace(subject, arguments=arguments))
    except Exception as error:
        if isinstance(error, TypeError | ConfigError) or _UNKNOWN in str(error):
            return
        raise
    raise AssertionError(
        "it accepts an unknown option, so a user's misspelling would have no effect: name the "
        "options, and pass **kwargs to super().__init__()"
    )


def _create(subject: Subject) -> None:
    close = getattr(subject.make(), "close", None)
    if callable(close):
        close()


def expect(condition: Any, message: str) -> None:
    """Raise an `AssertionError` with a message unless a condition holds."""
    if not condition:
        raise AssertionError(message)


def expect_equal(found: Batch, wanted: Batch, what: str) -> None:
    """Raise an `AssertionError` unless the arrays are bit-identical.

    Args:
        found: Arrays by name.
        wanted: The expected arrays.
        what: What differs, for the message: "the rows of the second run differ".
    """
    expect(found.keys() == wanted.keys(), f"{what}: {sorted(found)}, not {sorted(wanted)}")
    for name, values in wanted.items():
        one, other = np.asarray(found[name]), np.asarray(values)
        expect(one.shape == other.shape, f'{what}: "{name}" has {one.shape}, not {other.shape}')
        same = _bits(one) == _bits(other)
        if not same:
            places: Sequence[int] = np.flatnonzero(np.ravel(one) != np.ravel(other)).tolist()
            place = places[0] if places else 0
            expect(
                False,
                f'{what}: "{name}" first at element {place}: {np.ravel(one)[place]!r}, not '
                f"{np.ravel(other)[place]!r}",
            )


def expect_close(found: Any, wanted: Any, relative: float, what: str) -> None:
    """Raise an `AssertionError` unless numbers agree, relative to the largest one.

    Args:
        found: Numbers.
        wanted: The expected numbers, of the same shape.
        relative: Largest difference relative to the largest number, taken as at least 1e-9.
        what: What differs, for the message.
    """
    one, other = np.asarray(found, np.float64), np.asarray(wanted, np.float64)
    expect(one.shape == other.shape, f"{what}: shape {one.shape}, not {other.shape}")
    if not one.size:
        return
    expect(np.isfinite(one).all(), f"{what}: there are values that are not finite")
    scale = max(float(np.abs(other).max()), 1e-9)
    difference = float(np.abs(one - other).max()) / scale
    expect(difference <= relative, f"{what} by {difference:.2g} relative; allowed: {relative:g}")


def _bits(array: Any) -> bytes:
    return bytes(np.ascontiguousarray(array).tobytes())
