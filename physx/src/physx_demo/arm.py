"""An arm that learns its own dynamics, in one file: change it, and run it again.

Two processes simulate an arm with two joints in random motions. A network learns from these
samples which torque a motion takes. Then three simulated arms follow a motion that the network has
never seen: with a weak joint controller (PD) alone, with the torque that the network predicts added
to it in each step, and with that of the exact model.

    python arm.py
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Prediction,
    Training,
)
from physx_core.toy import Linear

MASSES, LENGTHS, FRICTION = (1.0, 1.0), (0.5, 0.5), 0.2  # kg, m, N m s; masses at the tips
GRAVITY = 9.81  # m/s²
STIFFNESS, DAMPING = 60.0, 6.0  # of the joint controller, in N m/rad and N m s/rad
LIMITS = np.array([[1.5], [4.0], [12.0]])  # of random motions, in rad, rad/s, rad/s²
PERIOD, SUBSTEPS = 0.01, 10  # s
ROWS, STEPS, FRAMES = 12_000, 400, 80
COLORS = ("tab:red", "tab:blue", "tab:green")
NAMES = ("PD alone", "PD + network", "PD + exact model")


def bias(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the torque of gravity, inertia of motion, and friction, shape (2,), in N m."""
    (m1, m2), (l1, l2) = MASSES, LENGTHS
    h = m2 * l1 * l2 * np.sin(q[1])
    elbow = m2 * GRAVITY * l2 * np.sin(q[0] + q[1])
    shoulder = (m1 + m2) * GRAVITY * l1 * np.sin(q[0]) + elbow
    inertia = np.array([-h * (2 * v[0] + v[1]) * v[1], h * v[0] ** 2])
    return inertia + [shoulder, elbow] + FRICTION * v


def mass_matrix(q: np.ndarray) -> np.ndarray:
    """Return the inertia of the joints, shape (2, 2), in kg m²."""
    (m1, m2), (l1, l2) = MASSES, LENGTHS
    coupled = m2 * l1 * l2 * np.cos(q[1])
    outer = m2 * l2**2
    both = outer + coupled
    return np.array([[(m1 + m2) * l1**2 + outer + 2 * coupled, both], [both, outer]])


class Arm(Environment):
    """Each sample: a random motion (q, v, a) of the two joints, and the torque that it takes."""

    def create(self) -> None:
        """Nothing to prepare: each sample is a state of its own."""

    def init_database(self) -> None:
        """Define the two fields."""
        motion = Field("motion", (6,), unit="rad, rad, rad/s, rad/s, rad/s², rad/s²")
        self.define_training_fields([motion, Field("torque", (2,), unit="N m")])

    def step(self) -> None:
        """Draw a pose, a speed, and an acceleration, and find out which torque they take."""
        q, v, a = self.rng.uniform(-1, 1, (3, 2)) * LIMITS
        torque = mass_matrix(q) @ a + bias(q, v)
        self.set_training_data(motion=np.concatenate([q, v, a]), torque=torque)


class Features(Linear):
    """A network with one random layer: only its last layer is learned, by least squares."""

    def __init__(self, width: int = 500) -> None:
        """Choose the number of hidden units."""
        super().__init__("motion", "torque")
        rng = np.random.default_rng(0)
        weights = rng.normal(size=(6, width)) / 2 / LIMITS.repeat(2)[:, None]
        self.hidden = weights, rng.uniform(0, 2 * np.pi, width)

    def rows(self, data: Any) -> np.ndarray:
        """Return the hidden layer, shape (samples, width + 7)."""
        plain = super().rows(data)
        weights, shifts = self.hidden
        return np.concatenate([plain, np.cos(plain[:, :6] @ weights + shifts)], axis=1)


class Tracking(Arm):
    """Follows a motion; the instances differ in the torque that is added to the controller's."""

    def create(self) -> None:
        """Start on the motion."""
        self.q, self.v, _ = self.reference(0.0)
        self.name = NAMES[self.instance_id - 1]

    def init_database(self) -> None:
        """Define the fields of the motion, and what happens."""
        super().init_database()
        self.define_additional_fields([Field("angles", (2,), unit="rad")])

    def init_visualization(self) -> None:
        """Draw the arm, and where it should be."""
        self.factory.set_view(self.name, eye=[0, -3, 0], target=[0, 0, 0])
        for name, color in (("reference", "gray"), ("arm", "orange")):
            self.factory.add_lines(name, [[0, 0, 0], [0, 0, -1]], color=color, size=0.03)

    def reference(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the angles, speeds, and accelerations to follow, each of shape (2,)."""
        size, rate, phase = np.array([1.4, 0.9]), np.array([2.2, 3.1]), np.array([0.3, 1.1])
        angle = rate * time + phase
        return size * np.sin(angle), size * rate * np.cos(angle), -size * rate**2 * np.sin(angle)

    def step(self) -> None:
        """Add the torque for the wanted motion, and move for one period."""
        now = self.step_index * PERIOD
        q, v, a = self.reference(now)
        motion, added = np.concatenate([q, v, a]), np.zeros(2)
        if self.name == "PD + network":
            added = self.get_prediction(motion=motion)["torque"]
        elif self.name == "PD + exact model":
            added = mass_matrix(q) @ a + bias(q, v)
        self.set_training_data(motion=motion, torque=added)
        self.set_additional_data(angles=self.q)
        for number in range(SUBSTEPS):
            q, v, _ = self.reference(now + number * PERIOD / SUBSTEPS)
            torque = added + STIFFNESS * (q - self.q) + DAMPING * (v - self.v)
            a = np.linalg.solve(mass_matrix(self.q), torque - bias(self.q, self.v))
            self.v = self.v + PERIOD / SUBSTEPS * a
            self.q = self.q + PERIOD / SUBSTEPS * self.v
        if self.factory:
            self.factory.update_lines("reference", positions=places(q))
            self.factory.update_lines("arm", positions=places(self.q))


def joints(q: np.ndarray) -> np.ndarray:
    """Return where shoulder, elbow, and tip are, shape (..., 3, 2), in m."""
    angles = np.cumsum(q, axis=-1)
    links = np.stack([np.sin(angles), -np.cos(angles)], axis=-1) * np.array(LENGTHS)[:, None]
    return np.concatenate([np.zeros_like(links[..., :1, :]), np.cumsum(links, axis=-2)], axis=-2)


def places(q: np.ndarray) -> np.ndarray:
    """Return the joints in space, shape (3, 3), in m."""
    return np.insert(joints(q), 1, 0.0, axis=1)


def draw(reference: np.ndarray, angles: np.ndarray, film: Path) -> np.ndarray:
    """Write a film of the arms, and return how far off their tips are.

    Args:
        reference: The angles to follow, shape (steps, 2), in rad.
        angles: Those of each arm, shape (3, steps, 2), in rad.
        film: The file to write, for example ``film.gif``.

    Returns:
        The distances, shape (3, steps), in mm.
    """
    wanted, arms = joints(reference), joints(angles)
    errors = 1000 * np.linalg.norm(arms[:, :, 2] - wanted[:, 2], axis=-1)
    times = PERIOD * np.arange(len(reference))
    figure = Figure(figsize=(8, 4.2), dpi=90, layout="constrained")
    canvas, grid = FigureCanvasAgg(figure), figure.subplot_mosaic("012;333", height_ratios=(2.8, 1))
    grid["3"].set(xlim=(0, times[-1]), ylim=(0.02, 1000), yscale="log", xlabel="s")
    grid["3"].set(ylabel="error of the tip\nin mm")
    lines = []
    for name, color, axes in zip(NAMES, COLORS, grid.values(), strict=False):
        axes.set(title=name, xlim=(-0.9, 1), ylim=(-1.05, 0.75), aspect="equal")
        axes.axis("off")
        ghost = axes.plot([], [], "o-", color="silver", lw=11, ms=14)[0]
        arm = axes.plot([], [], "o-", color=color, lw=4, ms=7)[0]
        lines.append((ghost, arm, grid["3"].plot([], [], color=color)[0]))
    canvas.draw()
    blank = canvas.copy_from_bbox(figure.bbox)

    def picture(step: int) -> Image.Image:
        canvas.restore_region(blank)
        for (ghost, arm, curve), places, error in zip(lines, arms, errors, strict=True):
            ghost.set_data(*wanted[step].T)
            arm.set_data(*places[step].T)
            curve.set_data(times[: step + 1], error[: step + 1])
            for line in (ghost, arm, curve):
                figure.draw_artist(line)
        return Image.fromarray(np.array(canvas.buffer_rgba())).convert(
            "P", palette=Image.Palette.WEB
        )

    first, *others = map(picture, np.linspace(0, len(times) - 1, FRAMES).astype(int))
    duration = round(1000 * times[-1] / FRAMES)  # of a picture, in ms
    first.save(film, save_all=True, append_images=others, duration=duration, loop=0)
    return errors


def main(folder: Path = Path(), visualizer: str | None = None) -> Path:
    """Generate, train, predict, and draw; return the film.

    Args:
        folder: Where to write.
        visualizer: Shows the arms too, for example "rerun".
    """
    sessions = str(folder / "sessions")
    generation = DataGeneration(
        EnvironmentConfig(Arm, num_clients=min(2, os.cpu_count() or 1), seed=0),
        session_dir=sessions, session_name="arm", batch_nb=12, batch_size=ROWS // 12,
    )  # fmt: skip
    generation.execute()
    training = Training(
        NetworkConfig(Features, data_type="float64"), DatasetConfig(generation.session.path),
        session_dir=sessions, session_name="network", epoch_nb=1, batch_size=ROWS,
    )  # fmt: skip
    training.execute()
    prediction = Prediction(
        NetworkConfig(Features, data_type="float64"),
        EnvironmentConfig(
            Tracking, num_clients=len(NAMES), as_tcp_ip_client=False, visualizer=visualizer
        ),
        session_dir=sessions, session_name=training.session.name, step_nb=STEPS, record=True,
    )  # fmt: skip
    prediction.execute()
    with Dataset.open(training.session.path) as dataset:
        rows = dataset["prediction"]
        angles = rows["angles"][:].reshape(STEPS, len(NAMES), 2).swapaxes(0, 1)
        reference = rows["motion"][:].reshape(STEPS, len(NAMES), 6)[:, 0, :2]
    film = folder / "film.gif"
    errors = draw(reference, angles, film).mean(axis=1)
    print("mean error of the tip, on a motion that the network has never seen:")
    for name, error in zip(NAMES, errors, strict=True):
        print(f"  {name:18}{error:8.2f} mm")
    return film


if __name__ == "__main__":  # clients import this file
    main()
