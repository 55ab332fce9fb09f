"""Which fields an edited dataset has."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from physx_core.errors import ConfigError, listed, nearest
from physx_core.fields import RESERVED, Field


class EditedFields:
    """Which fields there will be."""

    def __init__(
        self,
        keep: Collection[str],
        drop: Collection[str],
        cast: Mapping[str, DTypeLike],
        units: Mapping[str, str],
        rename: Mapping[str, str],
    ) -> None:
        self._keep, self._drop, self._cast = set(keep), set(drop), cast
        self._units, self._rename = units, rename
        self._named = {*keep, *drop, *cast, *units, *rename}
        self._seen: set[str] = set()
        taken = [name for name in RESERVED if name in {*drop, *cast, *units, *rename}]
        if taken:
            raise ConfigError(f'"{taken[0]}" says which trajectory a row belongs to: it must stay.')
        if self._keep & self._drop:
            raise ConfigError(f'"{min(self._keep & self._drop)}" is to be kept and dropped.')

    def said(self) -> dict[str, Any]:
        """Return the changes as plain data."""
        cast = {name: np.dtype(kind).str for name, kind in self._cast.items()}
        found = {"keep": sorted(self._keep), "drop": sorted(self._drop), "cast": cast}
        found |= {"units": dict(self._units), "rename": dict(self._rename)}
        return {name: value for name, value in found.items() if value}

    def of(self, fields: Mapping[str, Field]) -> dict[str, Field]:
        """Return the new fields of a mode, by their old names."""
        self._seen |= fields.keys()
        chosen = {
            name: field
            for name, field in fields.items()
            if name in RESERVED
            or ((not self._keep or name in self._keep) and name not in self._drop)
        }
        if not chosen.keys() - set(RESERVED):
            raise ConfigError(f"No field would be left of {listed(fields)}.")
        found = {
            name: replace(
                field,
                name=self._rename.get(name, name),
                dtype=self._cast.get(name, field.dtype),
                unit=self._units.get(name, field.unit),
                like=self._rename.get(field.like, field.like) if field.like in chosen else "",
            )
            for name, field in chosen.items()
        }
        names = [field.name for field in found.values()]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ConfigError(f'Two fields would be called "{min(twice)}".')
        return found

    def check_used(self) -> None:
        """Check that all fields that are named were found."""
        for name in sorted(self._named - self._seen):
            hint = nearest(name, sorted(self._seen))
            raise ConfigError(f'There is no field "{name}": {listed(sorted(self._seen))}.{hint}')
