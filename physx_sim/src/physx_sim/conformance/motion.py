"""Checks of the motion of bodies that touch nothing."""

from __future__ import annotations

import math

import numpy as np

from physx_sim import Simulation, Wrench
from physx_sim.conformance.worlds import (
    GRAVITY,
    PENDULUM_INERTIA,
    PENDULUM_LENGTH,
    PENDULUM_MASS,
    PERIOD,
    arm,
    ball,
    build,
    busy,
    need,
    pendulum,
    state_of,
)
from physx_testing.subject import Check, Subject, expect, expect_close, expect_equal

_STEPS = 500


def _falls(subject: Subject) -> None:
    gravity = np.array([0.3, -0.2, -GRAVITY])
    with build(subject, ball(gravity=tuple(gravity))) as simulation:
        begin = simulation.positions()[:3].copy()
        expect_close(begin, [0, 0, 2.0], 1e-12, "a ball does not start where the world says")
        simulation.step(_STEPS)
        wanted = begin + gravity * PERIOD**2 * _STEPS * (_STEPS + 1) / 2
        expect_close(
            simulation.positions()[:3],
            wanted,
            1e-9,
            "a falling ball is not where semi-implicit Euler steps take it: off",
        )
        expect_close(
            simulation.velocities()[:3],
            gravity * PERIOD * _STEPS,
            1e-9,
            "the velocity of a falling ball is off",
        )
        frames, time = simulation.frame, simulation.time
        expect(frames == _STEPS, f"after {_STEPS} steps frame is {frames}")
        expect(math.isclose(time, _STEPS * PERIOD), f"after {_STEPS} steps time is {time} s")


def _energy(simulation: Simulation) -> float:
    """Return the pendulum's energy relative to that between its lowest and highest point."""
    (angle,), (rate,) = simulation.positions(), simulation.velocities()
    weight = PENDULUM_MASS * GRAVITY * PENDULUM_LENGTH
    return float(0.5 * PENDULUM_INERTIA * rate**2 / weight - math.cos(angle))


def _swings(subject: Subject) -> None:
    with build(subject, pendulum()) as simulation:
        simulation.set_state(np.array([1.0]), np.zeros(1))
        begin, worst = _energy(simulation), 0.0
        crossings, before = 0, 1.0
        for _ in range(300):
            simulation.step(10)
            worst = max(worst, abs(_energy(simulation) - begin))
            angle = float(simulation.positions()[0])
            crossings += (angle < 0) != (before < 0)
            before = angle
        expect(
            worst < 3e-3,
            f"a pendulum without friction changes its energy by {worst:.2g} of its weight times "
            "its length in 3 s; semi-implicit Euler steps of 1 ms: less than 3e-3",
        )
        expect(
            crossings == 4, f"in 3 s a pendulum crosses its lowest point {crossings} times, not 4"
        )


def _swings_precisely(subject: Subject) -> None:
    need(subject, "rk4")
    with build(subject, pendulum(integrator="rk4")) as simulation:
        simulation.set_state(np.array([1.0]), np.zeros(1))
        begin = _energy(simulation)
        simulation.step(2000)
        error = abs(_energy(simulation) - begin)
        expect(error < 1e-8, f"with rk4 a pendulum changes its energy by {error:.2g} in 2 s")


def _one_step(subject: Subject) -> None:
    for seed in range(3):
        with build(subject, arm()) as simulation:
            positions, velocities = state_of(simulation, seed)
            torques = np.array([3.0, -2.0, 1.0])
            simulation.set_state(positions, velocities)
            simulation.set_torques(torques)
            simulation.step()
            rates = simulation.forward_dynamics(positions, velocities, torques)
            after = velocities + PERIOD * rates
            expect_close(
                simulation.velocities(), after, 1e-7, "a step does not follow forward_dynamics()"
            )
            expect_close(
                simulation.positions(),
                positions + PERIOD * after,
                1e-7,
                "a step does not move the positions with the new velocities: off",
            )


def _many_steps(subject: Subject) -> None:
    with build(subject, busy(subject)) as one, build(subject, busy(subject)) as other:
        one.step(60)
        for _ in range(60):
            other.step()
        expect_equal(
            {"positions": other.positions(), "velocities": other.velocities()},
            {"positions": one.positions(), "velocities": one.velocities()},
            "60 calls of step() and one call of step(60) differ",
        )


def _holds_torques(subject: Subject) -> None:
    with build(subject, arm(gravity=(0.0, 0.0, 0.0))) as simulation:
        layout = simulation.layout
        simulation.set_torques(np.array([1.0, 0.0, 0.0]))
        simulation.step(5)
        first = float(simulation.velocities()[0])
        simulation.step(5)
        second = float(simulation.velocities()[0])
        expect(
            first > 0 and second > 1.8 * first,
            f"a torque is not held: after 5 steps the joint turns at {first:.3g} rad/s, after 10 "
            f"at {second:.3g}",
        )
        simulation.set_torques(np.full(3, 1e6))
        expect_close(
            simulation.commands(),
            layout.max_torque,
            1e-9,
            "torques are not clipped to the joints' limits: commands() differ",
        )


def _places(subject: Subject) -> None:
    with build(subject, pendulum()) as simulation:
        for angle in (0.0, 0.7, -2.0):
            simulation.set_state(np.array([angle]), np.array([0.5]))
            wanted = [-math.sin(angle), 0.0, -math.cos(angle)]
            (pose,) = simulation.body_poses(["tip"])
            expect_close(pose[:3], wanted, 1e-9, f"at {angle} rad the tip is misplaced: off")
            expect(pose[6] >= 0, f"the quaternion of a pose has a negative w: {pose[3:]}")
            turn = [0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)]
            expect_close(
                pose[3:],
                np.array(turn) * (1 if turn[3] >= 0 else -1),
                1e-9,
                f"at {angle} rad the tip's orientation is off",
            )
            (velocity,) = simulation.body_velocities(["tip"])
            moving = [-0.5 * math.cos(angle), 0.0, 0.5 * math.sin(angle), 0.0, 0.5, 0.0]
            expect_close(velocity, moving, 1e-9, "the velocity of the tip is off")


def _accelerations(subject: Subject) -> None:
    need(subject, "accelerations")
    with build(subject, arm()) as simulation:
        expect(
            not simulation.accelerations().any(), "before the first step accelerations are not 0"
        )
        simulation.set_state(*state_of(simulation))
        before = simulation.velocities().copy()
        simulation.step()
        expect_close(
            simulation.accelerations(),
            (simulation.velocities() - before) / PERIOD,
            1e-6,
            "accelerations() are not the velocity change divided by the period",
        )


def _wrenches(subject: Subject) -> None:
    need(subject, "wrenches")
    world = ball(gravity=(0.0, 0.0, 0.0))
    with build(subject, world) as simulation:
        number = simulation.apply_wrench(Wrench("ball", force=(1.0, 0.0, 2.0)))
        simulation.step(100)
        simulation.remove_wrench(number)
        simulation.step(50)
        expect_close(
            simulation.velocities()[:3],
            [100 * PERIOD / 0.5, 0, 200 * PERIOD / 0.5],
            1e-9,
            "1 N and 2 N for 0.1 s do not give a ball of 0.5 kg the expected momentum",
        )


def _hooks(subject: Subject) -> None:
    need(subject, "hooks")
    with build(subject, ball()) as simulation:
        called: list[int] = []

        def hook(given: Simulation) -> None:
            called.append(given.frame)

        simulation.add_hook(hook, every=3)
        simulation.step(7)
        simulation.remove_hook(hook)
        simulation.step(3)
        expect(called == [0, 3, 6], f"a hook for every third step was called at frames {called}")


CHECKS: dict[str, Check] = {
    "falls as semi-implicit Euler steps do": _falls,
    "keeps the energy of a pendulum": _swings,
    "keeps the energy of a pendulum with rk4": _swings_precisely,
    "steps as its forward dynamics say": _one_step,
    "steps many times at once": _many_steps,
    "holds torques, up to the limits": _holds_torques,
    "knows where bodies are and how they move": _places,
    "measures accelerations": _accelerations,
    "applies wrenches": _wrenches,
    "calls hooks": _hooks,
}
