"""Features: the columns of LeRobot's frames, each of one field or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.errors import ConfigError, listed
from physx_core.fields import Field
from physx_core.typing import Array, Batch
from physx_formats.errors import ExchangeError
from physx_formats.files.roles import OBSERVATION, Roles
from physx_formats.table import Table, is_picture

VERSION = "v3.0"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot adds to each frame, with its timestamp."""
_PICTURES = f"{OBSERVATION}images."
_MOST_AXES = 5
_NAMED = ("action", "next.reward", "next.done", "next.success")


@dataclass(frozen=True)
class Feature:
    """A column of the frames: one field, or several concatenated."""

    name: str
    fields: tuple[Field, ...]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its values."""
        return np.dtype(self.fields[0].dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame; a single number is a vector of length 1."""
        if len(self.fields) == 1:
            return self.fields[0].shape or (1,)
        return (sum(width_of(of) for of in self.fields),)

    @property
    def is_video(self) -> bool:
        """Whether it is stored as a video: observations that are pictures are."""
        single = len(self.fields) == 1 and is_picture(self.fields[0])
        return single and self.name.startswith(OBSERVATION)

    def of(self, rows: Batch) -> Array:
        """Return the frames of rows, shape (rows, *shape)."""
        count = len(rows[self.fields[0].name])
        parts = [rows[of.name].reshape(count, *(of.shape or (1,))) for of in self.fields]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def describe(self) -> dict[str, Any]:
        """Return its entry in ``info.json``, without that of a video."""
        return {
            "dtype": "video" if self.is_video else self.dtype.name,
            "shape": list(self.shape),
            "names": ["height", "width", "channels"] if self.is_video else self._names(),
            "unit": ", ".join(dict.fromkeys(of.unit for of in self.fields if of.unit)),
            "fields": [of.name for of in self.fields],
        }

    def _names(self) -> list[str] | None:
        if len(self.shape) > 1:
            return None
        return [
            of.name if width_of(of) == 1 else f"{of.name}_{place}"
            for of in self.fields
            for place in range(width_of(of))
        ]

    def check(self) -> None:
        """Check that LeRobot has a place for it."""
        names = " and ".join(f'"{of.name}"' for of in self.fields)
        if self.dtype.kind == "c" or 0 in self.shape or len(self.shape) > _MOST_AXES:
            raise ExchangeError(
                f"LeRobot has no feature for the field {names} of type {self.dtype} and shape "
                f"{self.shape}: it takes real numbers with 1 to {_MOST_AXES} axes."
            )
        if len(self.fields) > 1 and any(
            len(of.shape or (1,)) > 1 or of.dtype != self.dtype for of in self.fields
        ):
            raise ExchangeError(
                f'A LeRobot feature is one vector: the fields {names} of "{self.name}" must be '
                "vectors of the same type."
            )
        if self.name.startswith(_PICTURES) and not self.is_video:
            raise ExchangeError(
                f'"{self.name}" must be one field of pictures, of type uint8 and shape (height, '
                f"width, 3), but {names} is of type {self.dtype} and shape {self.shape}. Define "
                f'the field as Field({names}, (height, width, 3), "uint8").'
            )


def width_of(field: Field) -> int:
    """Return the number of components of a vector; a single number has one."""
    width: int = (field.shape or (1,))[0]
    return width


def find_features(table: Table, roles: Roles, named: Mapping[str, Sequence[str]]) -> list[Feature]:
    """Return the columns of the frames by the roles of the fields, and those that are named."""
    fields = table.fields
    features = [Feature(_observation(fields[name]), (fields[name],)) for name in roles.observations]
    if len(features) == 1 and not named and not features[0].is_video:
        features = [Feature("observation.state", features[0].fields)]
    if roles.actions:
        features.append(Feature("action", tuple(fields[name] for name in roles.actions)))
    if roles.rewards:
        features.append(Feature("next.reward", (fields[roles.rewards],)))
    for name, of in named.items():
        if not (name.startswith(OBSERVATION) or name in _NAMED):
            raise ConfigError(
                f'LeRobot has no feature "{name}". It has: {listed(_NAMED)}, {OBSERVATION}NAME.'
            )
        if "/" in name:
            raise ConfigError(f'The feature "{name}" needs a name without "/".')
        if not of or any(each.name == name for each in features):
            raise ConfigError(f'The feature "{name}" has {"two lots of" if of else "no"} fields.')
        features.append(Feature(name, tuple(fields[each] for each in of)))
    used = {of.name for feature in features for of in feature.fields}
    features += [Feature(f"info.{n}", (of,)) for n, of in fields.items() if n not in used]
    for feature in features:
        feature.check()
    return features


def _observation(field: Field) -> str:
    """Return the name of a field as an observation; LeRobot's are flat but for pictures."""
    return f"{_PICTURES if is_picture(field) else OBSERVATION}{field.name}"
