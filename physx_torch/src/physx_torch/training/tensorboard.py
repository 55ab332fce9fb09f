"""TensorBoard: an observer that writes statistics and geometry for TensorBoard."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from physx_core import Visualizer
from physx_core.components import Event
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.typing import Array


class TensorBoard(Visualizer):
    """Writes numbers, histograms, point clouds and meshes to the session's ``stats/tensorboard``.

    ``physx stats SESSION --tensorboard`` shows them. TensorBoard draws at most a thousand points
    per curve, and writing one takes as long as a small batch, so only a limited number of points
    per second is written for batches, while ``stats/scalars.csv`` contains all of them.

    As `EnvironmentConfig.visualizer`, it also shows the points and meshes of environments.
    """

    def __init__(self, interval: float = 0.1, drawing_interval: float = 1.0) -> None:
        """Set the options.

        Args:
            interval: Shortest time in s between two points of a curve over batches.
            drawing_interval: Shortest time in s between two pictures of one drawn object.

        Raises:
            ConfigError: If a time is negative.
        """
        if interval < 0 or drawing_interval < 0:
            raise ConfigError("interval and drawing_interval must not be negative.")
        self._interval, self._drawing_interval = interval, drawing_interval
        self._writer: Any = None
        self._session, self._wrote = Path(), False
        self._waiting: dict[str, tuple[float, int]] = {}
        self._written = float("-inf")
        self._objects: dict[str, dict[str, Any]] = {}
        self._drawn: dict[str, float] = {}

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Start a file next to those of the session's earlier runs.

        Raises:
            MissingLibraryError: If TensorBoard is not installed.
        """
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise MissingLibraryError(
                "Writing for TensorBoard", "tensorboard", "tensorboard", "physx-torch"
            ) from error
        self._session, self._wrote = session_dir, False
        folder = session_dir / "stats" / "tensorboard"
        self._writer = SummaryWriter(str(folder), max_queue=1000, flush_secs=5)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Write the numbers; those of batches at a limited rate."""
        if self._writer is None:
            return
        self._wrote = True
        self._waiting.update((name, (value, step)) for name, value in values.items())
        now = time.monotonic()
        if timeline != "batch" or now - self._written >= self._interval:
            self._written = now
            self._write_waiting()

    def _write_waiting(self) -> None:
        for name, (value, step) in self._waiting.items():
            self._writer.add_scalar(name, value, step)
        self._waiting.clear()

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Write the distributions of the finite numbers, if there are any."""
        if self._writer is None:
            return
        for name, array in values.items():
            finite = array[np.isfinite(array)]
            if finite.size:
                self._wrote = True
                self._writer.add_histogram(name, finite, step)

    def note(self, text: str) -> None:
        """Write the text to the text page."""
        if self._writer is not None:
            self._wrote = True
            self._writer.add_text("notes", text)

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Write the points and meshes of an environment; other objects are not supported."""
        for event in (one for several in events for one in several.each()):
            if event.kind not in ("points", "mesh"):
                continue
            tag = f"environment_{instance_id}/{event.name}"
            known = self._objects.setdefault(tag, {})
            known.update(event.values)
            now = time.monotonic()
            if now - self._drawn.get(tag, float("-inf")) >= self._drawing_interval:
                self._drawn[tag] = now
                self.add_mesh(
                    tag, known["positions"], known.get("cells"), known.get("color"), step=step
                )

    def add_mesh(
        self,
        name: str,
        positions: ArrayLike,
        cells: ArrayLike | None = None,
        color: Any = None,
        *,
        step: int = 0,
    ) -> None:
        """Write a mesh, or a point cloud.

        Args:
            name: Name of the object; a ``/`` separates groups.
            positions: Vertices or points, shape (n, 3), in m.
            cells: Indices of the vertices of each triangle, shape (m, 3); None: points.
            color: Red, green and blue in [0, 1], one for all points or shape (n, 3), or
                ``"#rrggbb"``. For other names, TensorBoard chooses a color.
            step: Position on the slider.
        """
        if self._writer is None:
            return
        self._wrote = True
        points = np.asarray(positions, np.float32)
        colors = _colors(color, len(points))
        self._writer.add_mesh(
            name,
            torch.from_numpy(points[np.newaxis]),
            None if colors is None else torch.from_numpy(colors[np.newaxis]),
            None if cells is None else torch.from_numpy(np.asarray(cells, np.int32)[np.newaxis]),
            global_step=step,
        )

    def close(self) -> None:
        """Write the remaining numbers and finish the file."""
        if self._writer is not None:
            self._write_waiting()
            self._writer.close()
            self._writer = None

    def outputs(self) -> Sequence[str]:
        """Return the folder of the files, if anything was written: see `Observer.outputs`."""
        if not self._wrote:
            return []
        shown = f"physx stats {shlex.quote(str(self._session))} --tensorboard"
        return [f"curves: {self._session / 'stats' / 'tensorboard'}  ({shown})"]


def _colors(color: Any, number: int) -> Array | None:
    """Return red, green and blue of each point, shape (number, 3), 0 to 255; None if unknown."""
    if isinstance(color, str):
        if not re.fullmatch("#[0-9a-fA-F]{6}", color):
            return None
        color = [int(color[first : first + 2], 16) / 255 for first in (1, 3, 5)]
    if color is None:
        return None
    values = np.asarray(color, np.float64)[..., :3]
    filled = np.broadcast_to(np.clip(values * 255, 0, 255), (number, 3))
    return np.ascontiguousarray(filled.astype(np.uint8))
