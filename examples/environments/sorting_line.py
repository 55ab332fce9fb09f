"""Two conveyors, crates, and a gantry with a suction cup."""

from __future__ import annotations

from pathlib import Path

from physx_sim import BodySettings, Box, Ground, JointSettings, Robot, Simulation, World

TOP = 0.35
"""Height of the belts, in m."""
ENTRY = (-0.7, 0.0, TOP + 0.05)
"""Where crates begin, in m."""
COLORS = {"first": "#556070", "second": "#70606a", "red": "#c23b3b", "blue": "#3b6fc2"}
VIEW = {"eye": (1.2, -1.0, 1.25), "target": (0.25, 0.25, 0.3)}


def line(crates: int) -> tuple[World, list[str]]:
    """Return belts, a gantry, and crates, every other one red; and the names of the crates."""
    servo = JointSettings(mode="position", gain=15.0)
    joints, urdf = {"across": servo, "down": servo}, Path(__file__).with_name("gantry.urdf")
    gantry = Robot(urdf, "gantry", position=(0.2, 0, 0.9), joints=joints)
    things = [
        Box(name=name, size=(2.0, 0.3, 0.1), static=True, position=(0.2, y, TOP - 0.05))
        for name, y in (("first", 0.0), ("second", 0.5))
    ]
    for number in range(crates):
        name, place = f"{'red' if number % 2 else 'blue'} {number}", (-3.0, 0.2 * number, 0.05)
        things.append(Box(name=name, size=(0.1, 0.1, 0.1), position=place, friction=0.6))
    world = World([gantry], 5e-3, objects=things, ground=Ground())
    return world, [thing.name for thing in things[2:]]


def drive(simulation: Simulation, belt: str, speed: float) -> None:
    """Let a belt run at a speed along x, in m/s."""
    simulation.set_body(belt, BodySettings(surface_velocity=(speed, 0, 0)))


def enter(simulation: Simulation, crate: str) -> None:
    """Put a hidden crate at the beginning of the first belt."""
    q, part = simulation.positions(), simulation.layout.parts[crate]
    q[part.positions][:3] = ENTRY
    simulation.set_state(q, simulation.velocities())
    simulation.set_body(crate, BodySettings(hidden=False))


def sorted_crates(simulation: Simulation, crates: list[str]) -> int:
    """Return how many crates fell off the end of the belt of their color."""
    x, _, z = simulation.body_poses(crates)[:, :3].T
    wanted = [crate.startswith("blue") for crate in crates]
    return int(((z < TOP) & ((x > 0.2) == wanted)).sum())
