"""Checks of bodies that touch each other or reach their joint limits."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from physx_sim import Box, Ground, Simulation, Sphere, World
from physx_sim.conformance.worlds import GRAVITY, PERIOD, arm, ball, box, build, need
from physx_testing.subject import Check, Subject, expect, expect_close


def _rests(subject: Subject) -> None:
    need(subject, "contacts")
    with build(subject, box(0.11)) as simulation:
        expect(len(simulation.contacts()) == 0, "a box in the air has contacts")
        simulation.step(1500)
        height = float(simulation.positions()[2])
        expect(abs(height - 0.1) < 3e-3, f"a box of 0.2 m rests at {height:.4f} m, not at 0.1 m")
        expect_close(simulation.velocities() + 1, np.ones(6), 1e-2, "a box does not come to rest")
        total = np.zeros(3)
        for _ in range(20):
            simulation.step()
            contacts = simulation.contacts()
            expect(len(contacts) > 0, "a box that rests on the ground has no contacts")
            total += contacts["force"].sum(axis=0) / 20
        expect_close(
            total, [0, 0, 2 * GRAVITY], 1e-2, "forces on a box at rest do not equal its weight: off"
        )
        names = simulation.layout.names
        for contact in contacts:
            pair = (names[contact["body_a"]], names[contact["body_b"]])
            expect(pair == ("box", "ground"), f"the box on the ground touches as {pair}")
            expect(contact["normal"][2] > 0.99, f"the normal is {contact['normal']}, not up")
            expect(abs(contact["depth"]) < 1e-2, f"the box penetrates by {contact['depth']:.3g} m")
            expect(abs(contact["point"][2]) < 1e-2, f"it touches at {contact['point']}")


def _tilted(angle: float) -> tuple[float, float, float]:
    return (GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle))


def _slides(subject: Subject) -> None:
    need(subject, "contacts")
    friction, steps = 0.5, 400
    for factor in (0.9, 1.3):
        angle = math.atan(factor * friction)
        with build(subject, box(friction=friction, gravity=_tilted(angle))) as simulation:
            simulation.step(steps)
            way = float(simulation.positions()[0])
        pull = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
        wanted = max(0.0, 0.5 * pull * (steps * PERIOD) ** 2)
        expect(
            abs(way - wanted) < 0.1 * wanted + 3e-3,
            f"on a slope of {factor} times its coefficient of friction a box slides {way:.4f} m in "
            f"{steps * PERIOD:g} s, not {wanted:.4f}",
        )


def _bounces(subject: Subject) -> None:
    need(subject, "restitution")
    for restitution in (0.0, 0.6):
        thrown = Sphere(
            name="ball", radius=0.1, mass=0.5, position=(0, 0, 0.6), restitution=restitution
        )
        world = World(objects=[thrown], ground=Ground(), period=PERIOD)
        with build(subject, world) as simulation:
            least, most = 0.0, 0.0
            for _ in range(500):
                simulation.step()
                speed = float(simulation.velocities()[2])
                least, most = min(least, speed), max(most, speed)
        expect(
            abs(-most / least - restitution) < 0.03,
            f"a ball with a restitution of {restitution} comes back with {-most / least:.3f} of "
            "its speed",
        )


def _stacks(subject: Subject) -> None:
    need(subject, "body_contacts")
    low = Box(name="low", size=(0.3, 0.3, 0.2), mass=4.0, position=(0, 0, 0.1))
    high = Box(name="high", size=(0.2, 0.2, 0.2), mass=1.0, position=(0, 0, 0.301))
    world = World(objects=[low, high], ground=Ground(), period=PERIOD)
    with build(subject, world) as simulation:
        simulation.step(800)
        places = {name: float(simulation.body_poses([name])[0][2]) for name in ("low", "high")}
        expect(
            abs(places["low"] - 0.1) < 5e-3 and abs(places["high"] - 0.3) < 5e-3,
            f"two stacked boxes rest at {places} m, not at 0.1 and 0.3 m",
        )
    with build(subject, dataclasses.replace(world, contacts="static")) as simulation:
        simulation.step(800)
        height = float(simulation.body_poses(["high"])[0][2])
        expect(
            height < 0.2,
            f'with contacts="static" boxes only touch the ground, but one stays at {height:.3f} m',
        )


def _limits(subject: Subject) -> None:
    need(subject, "limits")
    with build(subject, arm(gravity=(0.0, 0.0, 0.0))) as simulation:
        for sign, limits in ((1, simulation.layout.upper), (-1, simulation.layout.lower)):
            simulation.set_torques(sign * np.array([3.0, 2.0, 5.0]))
            simulation.step(1500)
            beyond = sign * (simulation.positions() - limits)
            expect(
                beyond.max() < 0.02,
                f"torques push the joints beyond their limits, by {np.round(beyond, 3).tolist()}",
            )
            expect(
                beyond.min() > -0.3,
                f"torques towards the limits leave the joints at {simulation.positions().tolist()}",
            )


def _ball_on_ground() -> World:
    return dataclasses.replace(ball(), ground=Ground(), contacts="all")


def _rays(subject: Subject) -> None:
    need(subject, "raycast")
    with build(subject, _ball_on_ground()) as simulation:
        simulation.step()  # some engines place shapes only then
        begins, ends = [[0, 0, 4.0], [3, 0, 4.0], [0, 0, 4.0]], [[0, 0, 1.0], [3, 0, -1], [0, 0, 5]]
        hits = simulation.raycast(np.array(begins), np.array(ends))
        names = simulation.layout.names
        found = [names[hit["body"]] if hit["hit"] else "" for hit in hits]
        expect(
            found == ["ball", "ground", ""],
            f"rays at a ball, at the ground, and at nothing hit {found}",
        )
        expect_close(
            hits[0]["point"], [0, 0, 2.1], 1e-3, "a ray hits the wrong point of a ball: off"
        )
        expect_close(hits[1]["fraction"], 0.8, 1e-3, "a ray hits the ground too early or late: off")


def _untouched(subject: Subject) -> None:
    need(subject, "contacts")
    with build(subject, box(contacts="none")) as simulation:
        simulation.step(100)
        _expect_falling(simulation)


def _expect_falling(simulation: Simulation) -> None:
    height = float(simulation.positions()[2])
    expect(
        height < 0.08,
        f'with contacts="none" a box must fall through the ground, but is at {height} m',
    )


CHECKS: dict[str, Check] = {
    "rests on the ground with its weight": _rests,
    "holds and slides by its friction": _slides,
    "bounces by its restitution": _bounces,
    "lets things touch each other": _stacks,
    "lets things pass where there are no contacts": _untouched,
    "stops joints at their limits": _limits,
    "hits with rays": _rays,
}
