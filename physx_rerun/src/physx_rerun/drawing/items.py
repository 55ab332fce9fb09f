"""Item: a drawn object, with the state needed to draw later changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from physx_core.typing import Array


@dataclass
class Item:
    """A drawn object.

    Attributes:
        kind: Kind of the object.
        name: Name of the object.
        entity: Path of the object's entity.
        frame: Name of the object's frame; None: it is not drawn yet.
        values: All options set so far.
        is_new: Whether all of it has to be drawn.
        bodies: Indices of its bodies among those of the instance.
        limits: Smallest and largest value of its scalar field so far.
        barred: Limits shown by its color bar.
        edges: Pairs of vertices of a wireframe mesh, shape (edges, 2).
        grid: Numbers of points along the axes, if it is a grid.
        seen: Points that it has had since the last flush.
        shapes: Shapes of a robot.
    """

    kind: str
    name: str
    entity: str = ""
    frame: str | None = None
    values: dict[str, Any] = field(default_factory=dict)
    is_new: bool = True
    bodies: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    limits: tuple[float, float] = (np.inf, -np.inf)
    barred: tuple[float, float] | None = None
    edges: Array | None = None
    grid: tuple[int, ...] = ()
    seen: list[Array] = field(default_factory=list)
    shapes: list[Any] = field(default_factory=list)

    @property
    def is_hidden(self) -> bool:
        """Whether it is hidden."""
        return self.values.get("visible") is False

    @property
    def in_view(self) -> bool:
        """Whether the camera keeps it in view."""
        return self.values.get("in_view") is not False

    @property
    def alpha(self) -> float:
        """The object's opacity."""
        alpha = self.values.get("alpha")
        return 1.0 if alpha is None else alpha

    @property
    def colormap(self) -> str:
        """Name of the object's colormap."""
        return self.values.get("colormap") or "viridis"

    def widen(self, shown: Array) -> tuple[float, float]:
        """Return the limits of its colors: those that were set, else the extremes so far."""
        self.limits = (
            min(self.limits[0], float(shown.min())),
            max(self.limits[1], float(shown.max())),
        )
        low, high = self.values.get("vmin"), self.values.get("vmax")
        return self.limits[0] if low is None else low, self.limits[1] if high is None else high
