"""Three operators to learn: heat in a ring, heat in a plate of triangles, pictures made sharp."""

from __future__ import annotations

import numpy as np

from physx_core import Environment, Field

POINTS = 64  # points of the ring
PLATE = 9  # nodes along each side of the plate
PIXELS = 32  # along each side of a picture


class Ring(Environment):
    """Temperature and conductivity of a closed ring of 1 m -> temperature a while later.

    The heat equation u_t = (k u_x)_x in finite volumes, by implicit Euler steps.
    """

    STEPS, PERIOD = 10, 4e-4  # implicit steps, and the length of one in s

    def create(self) -> None:
        self.places = np.arange(POINTS) / POINTS

    def smooth(self, modes: int) -> np.ndarray:
        """Return a random periodic function, shape (POINTS,)."""
        waves = 2 * np.pi * np.arange(1, modes + 1)[:, None] * self.places
        amplitudes = self.rng.standard_normal((2, modes)) / np.sqrt(modes)
        return amplitudes[0] @ np.sin(waves) + amplitudes[1] @ np.cos(waves)

    def init_database(self) -> None:
        self.define_training_fields(
            [Field("before", (2, POINTS), unit="K, m2/s"), Field("after", (1, POINTS), unit="K")]
        )

    def step(self) -> None:
        temperature, conductivity = self.smooth(12), np.exp(self.smooth(4))
        between = (conductivity + np.roll(conductivity, -1)) / 2 * POINTS**2
        flow = np.diag(between) @ (np.roll(np.eye(POINTS), 1, axis=1) - np.eye(POINTS))
        one_step = np.linalg.inv(np.eye(POINTS) - self.PERIOD * (flow - np.roll(flow, 1, axis=0)))
        after = np.linalg.matrix_power(one_step, self.STEPS) @ temperature
        self.set_training_data(before=np.stack([temperature, conductivity]), after=after[None])


def plate() -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n, 2) in m and triangles (m, 3) of an irregular mesh on a square of 1 m."""
    axis = np.linspace(0, 1, PLATE)
    nodes = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    shift = np.random.default_rng(0).uniform(-0.3, 0.3, nodes.shape) / (PLATE - 1)
    nodes[1:-1, 1:-1] += shift[1:-1, 1:-1]
    numbers = np.arange(PLATE**2).reshape(PLATE, PLATE)
    a, b, c, d = numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]
    triangles = [np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]
    return nodes.reshape(-1, 2), np.concatenate([t.reshape(-1, 3) for t in triangles])


class Plate(Environment):
    """Temperature and conductivity on the nodes of a mesh -> temperature a while later.

    The heat equation in linear finite elements with lumped masses, by implicit Euler steps.
    """

    STEPS, PERIOD = 4, 5e-4

    def create(self) -> None:
        nodes, self.triangles = plate()
        corners = nodes[self.triangles]
        sides = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        areas = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
        self.stiffness = sides @ sides.transpose(0, 2, 1) / (4 * areas[:, None, None])
        self.masses = np.zeros(len(nodes))
        np.add.at(self.masses, self.triangles, areas[:, None] / 3)

    def init_database(self) -> None:
        count = PLATE**2
        self.define_training_fields(
            [Field("before", (count, 2), unit="K, m2/s"), Field("after", (count, 1), unit="K")]
        )

    def step(self) -> None:
        count = PLATE**2
        temperature = self.rng.standard_normal(count)
        conductivity = np.exp(self.rng.standard_normal(count) / 2)
        parts = self.stiffness * conductivity[self.triangles].mean(axis=1)[:, None, None]
        stiffness = np.zeros((count, count))
        np.add.at(stiffness, (self.triangles[:, :, None], self.triangles[:, None, :]), parts)
        one_step = np.linalg.inv(np.eye(count) + self.PERIOD * stiffness / self.masses[:, None])
        after = np.linalg.matrix_power(one_step, self.STEPS) @ temperature
        self.set_training_data(
            before=np.stack([temperature, conductivity], axis=-1), after=after[:, None]
        )


class Picture(Environment):
    """A blurred picture of discs -> the sharp one."""

    WIDTH = 1.5  # standard deviation of the blur in pixels

    def create(self) -> None:
        frequencies = np.fft.fftfreq(PIXELS)
        squares = frequencies[:, None] ** 2 + frequencies[None, :] ** 2
        self.blur = np.exp(-2 * (np.pi * self.WIDTH) ** 2 * squares)
        self.places = np.stack(np.indices((PIXELS, PIXELS)), axis=-1)

    def init_database(self) -> None:
        self.define_training_fields(
            [Field("blurred", (PIXELS, PIXELS, 1)), Field("sharp", (PIXELS, PIXELS, 1))]
        )

    def step(self) -> None:
        sharp = np.zeros((PIXELS, PIXELS))
        for center in self.rng.uniform(0, PIXELS, (6, 2)):
            inside = np.linalg.norm(self.places - center, axis=-1) < self.rng.uniform(2, 7)
            sharp[inside] = self.rng.uniform(0.2, 1)
        blurred = np.fft.ifft2(np.fft.fft2(sharp) * self.blur).real
        self.set_training_data(blurred=blurred[..., None], sharp=sharp[..., None])
