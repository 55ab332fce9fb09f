"""One object of each kind, to be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.components import Factory

ROBOT = Path(__file__).with_name("robot.urdf")
_SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
_SOLID = {"position": [0.5, 0.2, 1.0], "orientation": [0.0, 0.0, 1.0, 0.0]}
_GRID = np.linspace(0.0, 1.0, 24)


@dataclass(frozen=True)
class Sample:
    """An object of one kind.

    Attributes:
        kind: The kind.
        given: Options to add it with.
        changes: Options to change afterwards.
        needs: Kinds of objects that must already exist.
    """

    kind: str
    given: Mapping[str, Any]
    changes: Mapping[str, Any]
    needs: tuple[str, ...] = ()

    def add(self, factory: Factory) -> None:
        """Add the object, named after its kind."""
        for kind in self.needs:
            OBJECTS[kind].add(factory)
        if self.kind == "view":
            factory.set_view(**self.given)
        else:
            getattr(factory, f"add_{self.kind}")(self.kind, **self.given)

    def move(self, factory: Factory) -> None:
        """Change the object."""
        if self.changes:
            getattr(factory, f"update_{self.kind}")(self.kind, **self.changes)


def _sample(kind: str, given: Any, changes: Any, *needs: str) -> tuple[str, Sample]:
    return kind, Sample(kind, given, changes, needs)


OBJECTS: Mapping[str, Sample] = dict(
    (
        _sample(
            "mesh",
            {"positions": _SQUARE, "cells": [[0, 1, 2], [0, 2, 3]], "scalar_field": [0, 1, 2, 3]},
            {"positions": _SQUARE + 1, "scalar_field": [3, 2, 1, 0]},
        ),
        _sample("points", {"positions": _SQUARE, "color": "tomato"}, {"positions": _SQUARE[:2]}),
        _sample(
            "arrows",
            {"positions": _SQUARE, "vectors": _SQUARE + 1},
            {"positions": _SQUARE + 1, "vectors": _SQUARE},
        ),
        _sample("symbols", {"positions": _SQUARE, "symbol": "star"}, {"positions": _SQUARE + 1}),
        _sample("markers", {"mesh": "mesh", "indices": [0, 2]}, {"color": "blue"}, "mesh"),
        _sample(
            "lines",
            {"positions": [_SQUARE, _SQUARE[:2]], "labels": ["around", "along"]},
            {"positions": [_SQUARE + 1, _SQUARE[:3]]},
        ),
        _sample("box", {"half_sizes": [0.5, 0.2, 0.1], "label": "crate"}, _SOLID),
        _sample("sphere", {"radius": 0.3, "alpha": 0.5}, {"radius": 0.4, **_SOLID}),
        _sample("capsule", {"radius": 0.1, "length": 0.5}, _SOLID),
        _sample("cylinder", {"radius": 0.1, "length": 0.5, "wireframe": True}, _SOLID),
        _sample(
            "height_field",
            {"heights": np.outer(_GRID, _GRID), "spacing": [0.1, 0.1]},
            {"heights": np.outer(_GRID, 1 - _GRID)},
        ),
        _sample(
            "slice",
            {"values": np.outer(_GRID, _GRID), "spacing": [0.1, 0.1], "color_bar": True},
            {"values": np.outer(_GRID, 1 - _GRID)},
        ),
        _sample(
            "volume",
            {"values": np.multiply.outer(np.outer(_GRID, _GRID), _GRID), "spacing": [0.1] * 3},
            {"position": [1.0, 0.0, 0.0]},
        ),
        _sample(
            "image",
            {"image": np.outer(_GRID, _GRID)},
            {"image": np.zeros((24, 24, 3), np.uint8)},
        ),
        _sample("text", {"content": "# Title"}, {"content": "*text*"}),
        _sample("scalars", {"labels": ["x", "y"]}, {"values": [1.0, 2.0]}),
        _sample(
            "robot",
            {"urdf": str(ROBOT), "bodies": ["base", "arm"]},
            {"poses": [[0, 0, 0, 0, 0, 0, 1], [0, 0, 1, 0, 0, 0, 1]]},
        ),
        _sample(
            "controls",
            {"labels": ["mass"], "low": [0.5], "high": [2.0], "values": [1.0], "pulls": ["robot"]},
            {},
            "robot",
        ),
        _sample("view", {"title": "scene", "eye": [3.0, 3.0, 3.0], "target": [0.0, 0.0, 0.0]}, {}),
    )
)
"""An object of each kind, by kind."""


def add_all(factory: Factory) -> None:
    """Add an object of each kind."""
    for sample in OBJECTS.values():
        if not sample.needs:
            sample.add(factory)
    factory.add_markers("markers", "mesh", [0, 2])


def move_all(factory: Factory) -> None:
    """Change each object."""
    for sample in OBJECTS.values():
        sample.move(factory)
