"""The cost of visualization: drawing in every step, to a file and to a viewer that hangs.

An empty environment moves 20 boxes and sets 10 scalars in every step, as a data generation in this
process does. The time of its loop without a factory is subtracted. The frozen viewer is a real one,
stopped before the first row arrives. The recording's size is compared with that of its numbers: 7
numbers of 32 bits per body and 64 bits per scalar. The bodies slide and turn on a plane; for
comparison, the size is also printed for bodies whose numbers are all random.
"""

from __future__ import annotations

import os
import signal
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measure import claim, finish
from viewer_robots import films, replays

from physx_core.components import Factory
from physx_rerun.viewer.viewer import Viewer
from physx_rerun.visualizer import RerunVisualizer

BODIES, SCALARS = 20, 10
STEPS, ROUNDS = 2000, 9
SIZED = 20_000  # steps of the recording whose size is measured
RAW = BODIES * 7 * 4 + SCALARS * 8  # bytes per step

NAMES = [f"box {number}" for number in range(BODIES)]


def one_by_one(
    factory: Factory, positions: np.ndarray, orientations: np.ndarray, scalars: np.ndarray
) -> None:
    """Move the bodies one by one."""
    for name, position, orientation in zip(NAMES, positions, orientations, strict=True):
        factory.update_box(name, position=position, orientation=orientation)
    factory.update_scalars("scalars", scalars)


def at_once(
    factory: Factory, positions: np.ndarray, orientations: np.ndarray, scalars: np.ndarray
) -> None:
    """Move the bodies in one call."""
    factory.update_many("box", NAMES, {"position": positions, "orientation": orientations})
    factory.update_scalars("scalars", scalars)


Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Positions, orientations and scalars of a step."""


def sliding(rng: np.random.Generator) -> Motion:
    """Return a step of bodies on a plane."""
    angles, height = rng.uniform(-np.pi, np.pi, BODIES), np.full(BODIES, 0.1)
    positions = np.column_stack([rng.random((BODIES, 2)), height])
    turns = [0 * angles, 0 * angles, np.sin(angles / 2), np.cos(angles / 2)]
    return positions, np.column_stack(turns), rng.random(SCALARS)


def tumbling(rng: np.random.Generator) -> Motion:
    """Return a step of bodies in the air."""
    turns = rng.standard_normal((BODIES, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return rng.random((BODIES, 3)), turns, rng.random(SCALARS)


class Scene:
    """An open recording of the bodies and the scalars."""

    def __init__(
        self, folder: Path, motion: Callable[..., Motion] = sliding, **options: object
    ) -> None:
        """Open it and add the objects."""
        self.visualizer = RerunVisualizer(**options)
        self.visualizer.open("run", folder, 1)
        self.factory = Factory()
        for name in NAMES:
            self.factory.add_box(name, [0.1, 0.1, 0.1])
        self.factory.add_scalars("scalars", [f"s{number}" for number in range(SCALARS)])
        self.moves = [motion(np.random.default_rng(number)) for number in range(500)]
        self.step = 0

    def run(self, draw: Callable[..., None], steps: int) -> float:
        """Draw steps, and return the time that each adds, in ms."""
        begin = time.perf_counter()
        for _ in range(steps):
            draw(self.factory, *self.moves[self.step % len(self.moves)])
            self.step += 1
            self.visualizer.events(1, self.step, self.factory.take_events())
        drawn = time.perf_counter() - begin
        begin = time.perf_counter()
        for step in range(steps):
            self.moves[step % len(self.moves)]
        return (drawn - (time.perf_counter() - begin)) / steps * 1000


def to_a_file(folder: Path) -> list[bool]:
    """Measure drawing to a file."""
    scene = Scene(folder)
    times: dict[str, list[float]] = {"one by one": [], "update_many": []}
    for number in range(ROUNDS + 1):
        for name, draw in (("one by one", one_by_one), ("update_many", at_once)):
            took = scene.run(draw, STEPS)
            if number:
                times[name].append(took)
    scene.visualizer.close()
    print(f"{BODIES} moving bodies and {SCALARS} scalars, added to a step")
    for name, values in times.items():
        low, middle, high = min(values), statistics.median(values), max(values)
        print(f"  {name:28} {middle:8.4f} ms  [{low:.4f} .. {high:.4f}]")
    return [
        claim("to a file, ms", statistics.median(times["one by one"]), at_most=0.08),
        claim(
            "to a file with update_many, ms", statistics.median(times["update_many"]), at_most=0.05
        ),
    ]


def with_a_frozen_viewer(folder: Path) -> list[bool]:
    """Measure drawing to a file and to a viewer that hangs all the time."""
    viewer = Viewer(0, ("--save", str(folder / "received.rrd")))
    viewer.wait_until_ready()
    scene = Scene(folder, mode="connect", address=viewer.address)
    os.kill(viewer.process.pid, signal.SIGSTOP)
    try:
        scene.run(one_by_one, STEPS)
        times = [scene.run(one_by_one, STEPS) for _ in range(ROUNDS)]
        begin = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene.visualizer.close()
        closed = time.perf_counter() - begin
    finally:
        os.kill(viewer.process.pid, signal.SIGCONT)
        viewer.end()
    print("The same with a viewer that is frozen all the time")
    return [
        claim("to a file and a frozen viewer, ms", statistics.median(times), at_most=0.1),
        claim("end of the run, s", closed, at_most=3.0),
    ]


def size(folder: Path) -> list[bool]:
    """Compare the size of a recording with that of its numbers."""
    print(f"Recording of {SIZED} steps, bytes to bytes of its numbers")
    ratios = {}
    for motion in (tumbling, sliding):
        path = folder / f"{motion.__name__}.rrd"
        scene = Scene(folder, motion, path=path)
        scene.run(at_once, SIZED)
        scene.visualizer.close()
        ratios[motion.__name__] = path.stat().st_size / (SIZED * RAW)
        print(f"  {motion.__name__:28} {ratios[motion.__name__]:8.2f}")
    return [claim("of sliding bodies", ratios["sliding"], at_most=1.2)]


def main() -> None:
    """Measure and print."""
    met: list[bool] = []
    for part in (to_a_file, with_a_frozen_viewer, size):
        with tempfile.TemporaryDirectory() as name:
            met += part(Path(name))
    finish([*met, *films(), *replays()])


if __name__ == "__main__":
    main()
