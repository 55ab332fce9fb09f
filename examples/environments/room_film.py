"""Turns what a client knows about the room into a film."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from environments.room import APPLES, SIZE, WALLS
from PIL import Image

from physx_core.components import Factory
from physx_rerun import RerunVisualizer
from physx_sim.engines import find_robot

BODIES = "base", "caster_fork", "caster_wheel", "left_wheel", "right_wheel"


class Film:
    """Pictures of an episode, rendered without a display.

    Args:
        scenes: The info of each step, from the environment's `reset` and `step`.
    """

    def __init__(self, scenes: list[dict[str, np.ndarray]]) -> None:
        self.scenes, self.factory = scenes, Factory()
        self.factory.set_view("Find the apples", eye=(0.0, -4.9, 5.6), target=(0.0, -0.35, 0.0))
        floor = {"half_sizes": (SIZE / 2, SIZE / 2, 0.01), "position": (0.0, 0.0, -0.01)}
        self.factory.add_box("floor", color="#66705a", **floor)
        for wall in WALLS:
            half = np.array(wall.size) / 2
            self.factory.add_box(wall.name, half, position=wall.position, color="#b8a890")
        for number in range(APPLES):
            self.factory.add_sphere(f"apple {number}", 0.13, color="#d62f2f")
        self.factory.add_robot("robot", str(find_robot("wheeled_base")), BODIES)
        self.factory.add_lines("way", np.zeros((2, 3)), color="#ffd34d", size=0.015)

    def place(self, scene: dict[str, np.ndarray], way: np.ndarray) -> None:
        """Show the room as reported in a scene, and the path so far, shape (n, 3) in m."""
        self.factory.update_robot("robot", poses=scene["poses"])
        self.factory.update_lines("way", positions=way * [1, 1, 0] + [0, 0, 0.02])
        for number, (place, eaten) in enumerate(zip(scene["places"], scene["eaten"], strict=True)):
            look = {"position": (*place, 0.13), "visible": not eaten}
            self.factory.update_sphere(f"apple {number}", **look)

    def save(self, path: Path, every: int = 8) -> None:
        """Write every `every`-th scene and the last one as a film (.webp), or only the last one."""
        last, pictures = len(self.scenes) - 1, []
        steps = [*range(0, last, every), last] if path.suffix == ".webp" else [last]
        way = np.array([scene["poses"][0, :3] for scene in self.scenes])
        viewer = RerunVisualizer(mode="offscreen", save=False, picture_size=(480, 360))
        with TemporaryDirectory() as folder, closing(viewer):
            viewer.open("room", Path(folder), 1)
            for step in steps:
                self.place(self.scenes[step], way[: max(step + 1, 2)])
                viewer.events(1, step, self.factory.take_events())
                pictures.append(Image.fromarray(viewer.capture()))
        film = {"save_all": True, "append_images": pictures[1:], "duration": 100, "loop": 0}
        pictures[0].save(path, **(film if path.suffix == ".webp" else {}))
