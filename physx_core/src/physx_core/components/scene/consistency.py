"""Consistency: checks that an object's options fit each other and those set before."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from physx_core.components.scene.kinds import EMPTY_IS_UNSET, KINDS, Kind
from physx_core.errors import ConfigError

_LINKED = {"cells", "color", "heights", "scalar_field", "vmin", "vmax"}
"""Options whose changes must always be checked against others."""


@dataclass(frozen=True, slots=True)
class Known:
    """What changes to an object are checked against.

    Attributes:
        kind: Its kind.
        lengths: Length of each aligned option that is set.
        limits: Its ``vmin`` and ``vmax``, if set.
        largest: Largest index among a mesh's cells.
    """

    kind: str
    lengths: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    largest: int = -1

    def after(self, name: str, changes: Mapping[str, Any]) -> Known:
        """Return what is known after changes.

        Args:
            name: Name of the object.
            changes: Plain values of its options.

        Raises:
            ConfigError: If they do not fit.
        """
        spec = KINDS[self.kind]
        if self._surely_fit(changes, spec):
            return self
        lengths = self._aligned(name, changes, spec)
        return dataclasses.replace(
            self,
            lengths=lengths,
            limits=self._limited(name, changes),
            largest=self._indexed(name, changes, lengths),
        )

    def _surely_fit(self, changes: Mapping[str, Any], spec: Kind) -> bool:
        """Return whether changes have the same lengths as before, and need no closer look."""
        if not changes.keys().isdisjoint(_LINKED):
            return False
        for option in spec.aligned:
            value = changes.get(option)
            if value is not None and len(value) != self.lengths.get(option):
                return False
        return True

    def _aligned(self, name: str, changes: Mapping[str, Any], spec: Kind) -> dict[str, Any]:
        """Return the lengths; options that belong together must have the same length."""
        lengths = dict(self.lengths)
        if "color" in changes and "scalar_field" not in changes:
            lengths.pop("scalar_field", None)
        for option in spec.aligned:
            if option not in changes:
                continue
            value = changes[option]
            may_be_unset = option in EMPTY_IS_UNSET and option not in spec.required
            if value is None or (may_be_unset and not len(value)):
                lengths.pop(option, None)
            else:
                lengths[option] = value.shape if self.kind == "height_field" else len(value)
        if len(set(lengths.values())) > 1:
            first, *rest = lengths
            other = next(option for option in rest if lengths[option] != lengths[first])
            raise ConfigError(
                f'Object "{name}": {other} has length {lengths[other]}, but {first} has length '
                f"{lengths[first]}. Give both, with the same length."
            )
        return lengths

    def _indexed(self, name: str, changes: Mapping[str, Any], lengths: Mapping[str, Any]) -> int:
        """Return the largest index in a mesh's cells; it must be one of the vertices."""
        largest = self.largest
        if self.kind != "mesh" or not changes.keys() & {"positions", "cells"}:
            return largest
        if "cells" in changes:
            cells = changes["cells"]
            largest = int(cells.max()) if cells.size else -1
            if cells.size and cells.min() < 0:
                raise ConfigError(f'Object "{name}": cells has the negative index {cells.min()}.')
        count = lengths["positions"]
        if largest >= count:
            raise ConfigError(
                f'Object "{name}": cells has the index {largest}, but positions has only '
                f"the {count} vertices 0 to {count - 1}."
            )
        return largest

    def _limited(self, name: str, changes: Mapping[str, Any]) -> dict[str, float]:
        """Return the limits of the colormap, which must form a range."""
        limits = dict(self.limits)
        for option in changes.keys() & {"vmin", "vmax"}:
            limits[option] = changes[option]
        low, high = limits.get("vmin"), limits.get("vmax")
        if low is not None and high is not None and low >= high:
            raise ConfigError(
                f'Object "{name}": vmin is {low:g} but must be less than vmax, {high:g}.'
            )
        return limits
