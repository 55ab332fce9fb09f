"""Free motion against closed solutions, on both engines."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physx_sim import Box, Cylinder, Ground, Sphere, World


@pytest.mark.parametrize(("amplitude", "accuracy"), [(0.5, 1e-5), (3.0, 1e-5)])
def test_the_period_of_a_pendulum_is_that_of_the_elliptic_integral(
    backend, bar, amplitude, accuracy
):
    mean, other = 1.0, math.cos(amplitude / 2)
    for _ in range(8):  # the arithmetic-geometric mean
        mean, other = (mean + other) / 2, math.sqrt(mean * other)
    period = 2 * math.pi * math.sqrt(0.6 / (2 * 9.81 * 0.5)) / mean
    with backend.build(World([bar()], integrator="rk4")) as simulation:
        simulation.set_state([amplitude], [0.0])
        crossings: list[float] = []
        before = amplitude
        while len(crossings) < 2:
            simulation.step()
            now = simulation.positions()[0]
            if before > 0 >= now or before < 0 <= now:
                crossings.append(simulation.time - 1e-3 * now / (now - before))
            before = now
        np.testing.assert_allclose(2 * (crossings[1] - crossings[0]), period, rtol=accuracy)


@pytest.mark.slow
def test_a_symmetric_body_precesses_at_its_rate(backend):
    rod = Cylinder(name="rod", radius=0.1, length=0.6)
    with backend.build(World(objects=[rod], gravity=(0, 0, 0), integrator="rk4")) as simulation:
        across, along = simulation.mass_matrix(simulation.positions()).diagonal()[[3, 5]]
        v = np.array([0, 0, 0, 2.0, 0, 5.0])
        simulation.set_state(simulation.positions(), v)
        simulation.step(2000)
        angle = (along - across) / across * 5.0 * 2.0
        expected = [2 * math.cos(angle), 2 * math.sin(angle), 5.0]
        np.testing.assert_allclose(simulation.velocities()[3:], expected, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["euler", pytest.param("rk4", marks=pytest.mark.faults)])
def test_a_tumbling_body_keeps_its_energy_for_ten_seconds(backend, integrator):
    """About the middle axis it turns over again and again."""
    box = Box(name="box", size=(0.4, 0.2, 0.1))
    with backend.build(
        World(objects=[box], gravity=(0, 0, 0), integrator=integrator)
    ) as simulation:
        mass = simulation.mass_matrix(simulation.positions())[3:, 3:]
        v = np.array([0.1, 0.2, 0.3, 0.08, 8.0, 0.05])
        simulation.set_state(simulation.positions(), v)
        simulation.step(10_000)
        w = simulation.velocities()[3:]
        error = abs(w @ mass @ w / (v[3:] @ mass @ v[3:]) - 1)
        assert error < (1e-9 if integrator == "rk4" else 0.05)


@pytest.mark.parametrize(("restitution", "accuracy"), [(1.0, 0.01), (0.5, 0.02)])
def test_a_ball_bounces_from_the_ground_by_its_own_restitution(backend, restitution, accuracy):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 1.1), restitution=restitution)
    with backend.build(World(objects=[ball], ground=Ground())) as simulation:
        heights = []
        for _ in range(1400):
            simulation.step()
            heights.append(simulation.positions()[2] - 0.1)
        np.testing.assert_allclose(max(heights[500:]), restitution**2, rtol=accuracy)
