"""Part of `viewer.py`: pictures of a robot without a graphics card, and replays of samples.

Pictures of the quadruped, 640 x 480, are rendered alternately with simplified meshes, which lack
small details, and with the original ones, each frame after a step. The driver's own time is that of
a picture of a scene in which nothing changed. The replay is a separate command, startup included;
it alternates with a bare program that reads the same points with h5py and logs them one by one with
Rerun.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np
from measure import claim

import physx_gym  # noqa: F401 - registers the environments
from physx_core import DataGeneration, Environment, EnvironmentConfig

FRAMES, ROUNDS, TIMES = 10, 5, 3
SAMPLES, POINTS = 10_000, 100
BARE = """
import sys, h5py, rerun as rr
with h5py.File(sys.argv[1]) as file:
    found = []
    file.visititems(lambda _, item: found.append(item) if isinstance(item, h5py.Dataset) else None)
    points = max(found, key=lambda item: item.size)[:]
rr.init("bare")
rr.save(sys.argv[2])
for step, each in enumerate(points):
    rr.set_time("step", sequence=step)
    rr.log("points", rr.Points3D(each, radii=0.01))
"""
SIMPLE, WHOLE = "without small details", "meshes as they are"


class Cloud(Environment):
    """Random points, or the stored ones."""

    def create(self) -> None:
        """Nothing is simulated."""

    def init_database(self) -> None:
        """Define the points."""
        self.define_training_fields([("points", np.ndarray)])

    def init_visualization(self) -> None:
        """Draw the points."""
        self.factory.add_points("points", np.zeros((POINTS, 3)), size=0.01)

    def step(self) -> None:
        """Show the next points."""
        stored = self.sample
        points = self.rng.random((POINTS, 3)) if stored is None else stored["points"]
        self.set_training_data(points=points)
        self.factory.update_points("points", positions=points)


class Film:
    """A quadruped that is rendered after every step."""

    def __init__(self, detail: float) -> None:
        """Render the first picture."""
        self.env = gymnasium.make("physx/Quadruped-v0", render_mode="rgb_array").unwrapped
        self.env.viewer_kwargs["detail"] = detail
        self.env.reset(seed=0)
        self.env.render()

    def rate(self, *, moves: bool = True) -> float:
        """Return pictures per second."""
        action = np.zeros(12)
        begin = time.perf_counter()
        for _ in range(FRAMES):
            if moves:
                self.env.step(action)
            self.env.render()
        return FRAMES / (time.perf_counter() - begin)

    def driver(self) -> float:
        """Return the time of a picture of an unchanged scene, in s."""
        offscreen = self.env._own_renderer._viewer._offscreen
        scene = offscreen._camera.wait_for_position("picture", 0)
        begin = time.perf_counter()
        for _ in range(FRAMES):
            offscreen._camera.screenshot(scene)
        return (time.perf_counter() - begin) / FRAMES


def films() -> list[bool]:
    """Measure pictures of the quadruped."""
    begun = time.perf_counter()
    scenes = {SIMPLE: Film(3.0), WHOLE: Film(0.0)}
    rates: dict[str, list[float]] = {name: [] for name in scenes}
    drivers = []
    for _ in range(ROUNDS):
        for name, film in scenes.items():
            rates[name].append(film.rate())
        drivers.append(scenes[SIMPLE].driver())
    for film in scenes.values():
        film.env.close()
    print(f"Pictures of the quadruped, 640 x 480 ({time.perf_counter() - begun:.0f} s)")
    middle = {name: statistics.median(values) for name, values in rates.items()}
    for name, values in rates.items():
        print(f"  {name:24} {middle[name]:7.2f} a second  [{min(values):.2f} .. {max(values):.2f}]")
    ratio, driver = middle[SIMPLE] / middle[WHOLE], statistics.median(drivers)
    print(f"  the driver's own time is {1000 * driver:.0f} ms a picture")
    if (alone := 1 / (driver * middle[WHOLE])) < TIMES:
        print(
            f"  {ratio:.2f} times as many; the driver alone, at a scene at rest, {alone:.2f} times"
        )
        return []
    return [claim("times as many", ratio, at_least=TIMES)]


def replays() -> list[bool]:
    """Measure ``physx replay``."""
    with tempfile.TemporaryDirectory() as name:
        config = EnvironmentConfig(Cloud, as_tcp_ip_client=False, seed=0)
        run = DataGeneration(
            config, session_dir=name, batch_nb=20, batch_size=SAMPLES // 20, quiet=True
        )
        run.execute()
        words = [sys.executable, "-m", "physx_core.cli", "replay", str(run.session.path)]
        words += [f"{Path(__file__).resolve()}:Cloud", "--environment.visualizer", "rerun"]
        words += ["--environment.no-as-tcp-ip-client", "--quiet", "--session-dir", name]
        (points,) = (run.session.path / "dataset").glob("*_points_0.h5")
        bare = [sys.executable, "-c", BARE, str(points), str(Path(name) / "bare.rrd")]
        times: dict[str, list[float]] = {"physx replay": [], "bare h5py and Rerun": []}
        for _ in range(ROUNDS):
            for each, command in zip(times, (words, bare), strict=True):
                begin = time.perf_counter()
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                times[each].append(time.perf_counter() - begin)
    print(f"Replay of {SAMPLES} samples of {POINTS} points")
    for each, values in times.items():
        low, middle, high = min(values), statistics.median(values), max(values)
        print(f"  {each:24} {middle:7.2f} s  [{low:.2f} .. {high:.2f}]")
    return [claim("s, start-up included", statistics.median(times["physx replay"]), at_most=1.5)]
