"""Films of simulations, several side by side, rendered without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from physx_core import plugins
from physx_core.components import Factory
from physx_gym import WorldDrawing, write_film
from physx_rerun import RerunVisualizer
from physx_sim import Simulation, World


class Scene:
    """A simulation as seen by a camera.

    Args:
        simulation: The simulation.
        world: Its world.
        title: Title of its window.
        eye: Position of the camera, in m.
        target: What it looks at, in m.
        colors: Colors of boxes, by the first word of their names.
    """

    def __init__(
        self,
        simulation: Simulation,
        world: World,
        title: str,
        eye: Sequence[float],
        target: Sequence[float],
        colors: Mapping[str, str] | None = None,
    ) -> None:
        self.factory, self.simulation, self.frames = Factory(), simulation, []
        view, engine = {"eye": eye, "target": target}, plugins.resolve("backend", "dart")
        self.drawing = WorldDrawing(
            self.factory, world, engine, simulation.layout, title, follow=False, view=view
        )
        self.drawing.show(simulation)
        for thing in world.objects:
            color = (colors or {}).get(thing.name.partition(" ")[0])
            if color:
                self.factory.update_box(thing.name, color=color)

    def add(self) -> None:
        """Add a picture of the simulation as it is."""
        self.drawing.show(self.simulation)
        self.frames.append(self.factory.take_events())


def save(path: Path, scenes: Sequence[Scene], size: tuple[int, int], rate: float = 10.0) -> None:
    """Write scenes side by side as a film (.webp), or only the picture in the middle.

    Args:
        path: The file.
        scenes: One or more.
        size: Width and height of each one's picture.
        rate: Pictures per second.
    """
    count = min(len(scene.frames) for scene in scenes)
    shown = range(count) if path.suffix == ".webp" else [count // 2]
    rows = zip(*(_pictures(scene, shown, size) for scene in scenes), strict=True)
    write_film((np.hstack(row) for row in rows), path, rate)


def _pictures(scene: Scene, shown: Sequence[int], size: tuple[int, int]) -> list[np.ndarray]:
    viewer, found = RerunVisualizer(mode="offscreen", save=False, picture_size=size), []
    with TemporaryDirectory() as folder, closing(viewer):
        viewer.open("film", Path(folder), 1)
        for step in range(max(shown) + 1):
            viewer.events(1, step, scene.frames[step])
            if step in shown:
                found.append(viewer.capture())
    return found
