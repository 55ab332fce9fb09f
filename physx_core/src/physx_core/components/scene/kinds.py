"""Kinds of objects: their options, and which of them belong together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from physx_core.components.scene.options import (
    Check,
    Numbers,
    choice,
    color,
    colormap_name,
    flag,
    folders,
    image,
    lines,
    number,
    text,
    texts,
)

SYMBOLS = ("circle", "cross", "diamond", "plus", "square", "star", "triangle")
"""Shapes of flat symbols."""

_POINTS, _POSITIVE, _ANY = Numbers((None, 3)), number(0.0), number(-math.inf)
_LOOK: dict[str, Check] = {
    "color": color,
    "alpha": number(0.0, or_equal=True, high=1.0),
    "visible": flag,
    "in_view": flag,
}
_COLORED: dict[str, Check] = {
    "colormap": colormap_name,
    "vmin": _ANY,
    "vmax": _ANY,
    "color_bar": flag,
}
_FIELD: dict[str, Check] = {"scalar_field": Numbers((None,)), **_COLORED}
_POSE: dict[str, Check] = {"position": Numbers((3,)), "orientation": Numbers((4,))}
_SOLID: dict[str, Check] = {**_LOOK, **_POSE, "wireframe": flag, "size": _POSITIVE, "label": text}


@dataclass(frozen=True)
class Kind:
    """A kind of object.

    Attributes:
        required: Options that adding one needs, and their checks.
        optional: Other options, and their checks.
        aligned: Options whose leading axes must have the same length, if they are set.
        fixed: Options that cannot be changed.
    """

    required: Mapping[str, Check]
    optional: Mapping[str, Check]
    aligned: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ("color_bar", "in_view")
    options: Mapping[str, Check] = field(init=False)

    def __post_init__(self) -> None:
        """Join the options."""
        object.__setattr__(self, "options", {**self.required, **self.optional})

    @cached_property
    def changeable(self) -> Mapping[str, Check]:
        """Options that can be changed, and their checks."""
        return {name: check for name, check in self.options.items() if name not in self.fixed}


RESETTABLE = frozenset({"alpha", "color", "label", "scalar_field", "size", "vmax", "vmin"})
"""Options that None resets to their default."""

EMPTY_IS_UNSET = frozenset({"labels", "orientations", "scalar_field"})
"""Options that an empty value unsets, unless they are required."""

KINDS: dict[str, Kind] = {
    "mesh": Kind(
        {"positions": _POINTS, "cells": Numbers((None, 3), np.int32)},
        {**_LOOK, **_FIELD, "wireframe": flag, "size": _POSITIVE},
        ("positions", "scalar_field"),
    ),
    "points": Kind(
        {"positions": _POINTS},
        {**_LOOK, **_FIELD, "size": _POSITIVE, "labels": texts},
        ("positions", "scalar_field", "labels"),
    ),
    "arrows": Kind(
        {"positions": _POINTS, "vectors": _POINTS},
        {**_LOOK, **_FIELD, "size": _POSITIVE, "labels": texts},
        ("positions", "vectors", "scalar_field", "labels"),
    ),
    "symbols": Kind(
        {"positions": _POINTS},
        {
            **_LOOK,
            **_FIELD,
            "orientations": _POINTS,
            "symbol": choice(*SYMBOLS),
            "size": _POSITIVE,
            "labels": texts,
        },
        ("positions", "orientations", "scalar_field", "labels"),
    ),
    "markers": Kind(
        {"mesh": text, "indices": Numbers((None,), np.int32)},
        {
            **_LOOK,
            **_FIELD,
            "symbol": choice(*SYMBOLS),
            "size": _POSITIVE,
            "labels": texts,
        },
        ("indices", "scalar_field", "labels"),
        ("mesh", "color_bar", "in_view"),
    ),
    "lines": Kind(
        {"positions": lines},
        {**_LOOK, "size": _POSITIVE, "labels": texts},
        ("positions", "labels"),
    ),
    "box": Kind({"half_sizes": Numbers((3,))}, _SOLID),
    "sphere": Kind({"radius": _POSITIVE}, _SOLID),
    "capsule": Kind({"radius": _POSITIVE, "length": number(0.0, or_equal=True)}, _SOLID),
    "cylinder": Kind({"radius": _POSITIVE, "length": _POSITIVE}, _SOLID),
    "height_field": Kind(
        {"heights": Numbers((None, None)), "spacing": Numbers((2,))},
        {
            **_LOOK,
            **_FIELD,
            **_POSE,
            "scalar_field": Numbers((None, None)),
            "wireframe": flag,
            "size": _POSITIVE,
        },
        ("heights", "scalar_field"),
    ),
    "slice": Kind(
        {"values": Numbers((None, None)), "spacing": Numbers((2,))},
        {**_LOOK, **_COLORED, **_POSE},
    ),
    "volume": Kind(
        {"values": Numbers((None, None, None)), "spacing": Numbers((3,))},
        {**_LOOK, **_COLORED, **_POSE},
    ),
    "image": Kind({"image": image}, {}),
    "text": Kind({"content": text}, {}),
    "scalars": Kind(
        {"labels": texts},
        {"values": Numbers((None,), np.float64), "unit": text},
        ("labels", "values"),
        ("labels", "unit"),
    ),
    "robot": Kind(
        {"urdf": text, "bodies": texts},
        {**_LOOK, "package_dirs": folders, "poses": Numbers((None, 7), np.float64)},
        ("bodies", "poses"),
        ("urdf", "bodies", "package_dirs", "in_view"),
    ),
    "controls": Kind(
        {"labels": texts, "pulls": texts},
        {each: Numbers((None,), np.float64) for each in ("low", "high", "values")},
        ("labels", "low", "high", "values"),
    ),
    "view": Kind({"title": text}, {"eye": Numbers((3,)), "target": Numbers((3,)), "follow": text}),
}
"""All kinds of objects by name."""
