"""Vortices in a periodic square of water."""

from __future__ import annotations

import numpy as np

from physx_core import Environment, Field

POINTS = 24  # along each side of the square
SIZE = 2  # approximate number of vortices along each side


class Vortices(Environment):
    """Vorticity of a plane flow -> vorticity one second later.

    The Navier-Stokes equation w_t + u.grad(w) = nu lap(w) with u = (psi_y, -psi_x), lap(psi) = -w,
    in a periodic square of 1 m, with Fourier modes, the upper third dropped, and Runge-Kutta steps.
    """

    independent_episodes, episode_steps = True, 1
    STEPS, PERIOD = 10, 0.1  # steps per sample, and the length of each in s
    VISCOSITY = 5e-4  # m2/s

    def create(self) -> None:
        waves = 2 * np.pi * np.fft.fftfreq(POINTS, 1 / POINTS)  # rad/m
        waves = np.stack(np.meshgrid(waves, waves, indexing="ij"))
        self.slope, self.squares = 1j * waves, (waves**2).sum(0)
        self.kept = abs(waves).max(0) < 2 * np.pi * POINTS / 3
        self.inverse = (self.squares > 0) / np.maximum(self.squares, 1)
        self.spectrum = np.exp(-self.squares / (2 * (2 * np.pi * SIZE) ** 2)) * (self.squares > 0)

    def init_database(self) -> None:
        of = {"shape": (POINTS, POINTS, 1), "axes": ("x", "y", "channel"), "unit": "1/s"}
        self.define_training_fields([Field("now", **of), Field("later", like="now", **of)])

    def change(self, modes: np.ndarray) -> np.ndarray:
        """Return how fast the modes of the vorticity change, shape (POINTS, POINTS)."""
        flow_y, flow_x = self.slope * self.inverse * modes
        speed = np.fft.ifft2(np.stack([flow_x, -flow_y])).real
        carried = np.fft.fft2((speed * np.fft.ifft2(self.slope * modes).real).sum(0))
        return -(self.kept * carried) - self.VISCOSITY * self.squares * modes

    def step(self) -> None:
        modes = np.fft.fft2(self.rng.standard_normal((POINTS, POINTS))) * self.spectrum * self.kept
        modes /= np.fft.ifft2(modes).real.std()
        now, h = np.fft.ifft2(modes).real, self.PERIOD
        for _ in range(self.STEPS):
            a = self.change(modes)
            b = self.change(modes + h / 2 * a)
            c = self.change(modes + h / 2 * b)
            modes = modes + h / 6 * (a + 2 * b + 2 * c + self.change(modes + h * c))
        later = np.fft.ifft2(modes).real
        self.set_training_data(now=now[..., None], later=later[..., None])
