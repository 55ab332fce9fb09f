"""Cases of contact and motion whose outcome is known, for `physics.py`.

Each returns one number for an engine: an error relative to theory, unless it says otherwise.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from physx_core import plugins
from physx_core.rotations import from_axis_angle
from physx_sim import (
    BodySettings,
    Box,
    Cylinder,
    Ground,
    HeightField,
    Robot,
    Simulation,
    Sphere,
    World,
    WorldObject,
    Wrench,
)
from physx_sim.errors import FeatureNotSupportedError

GRAVITY = 9.81
GIVES = {"dart": (1e-5, 2e-6), "pinocchio": (1e-5, 2e-6), "mujoco": (5e-4, 1.5e-4)}
"""How far a block gives way on a plate that swings sideways and upwards, in m, before it leaves."""
Case = Callable[[str], float]


def scene(engine: str, *objects: WorldObject, **options: object) -> Simulation:
    """Return a simulation of objects, on the ground unless it is given."""
    world = World(objects=objects, **{"ground": Ground(), **options})
    return plugins.resolve("backend", engine).build(world)


def moving(simulation: Simulation, *velocities: float) -> None:
    """Give the first velocities, the others are 0."""
    v = np.zeros(simulation.layout.nv)
    v[: len(velocities)] = velocities
    simulation.set_state(simulation.positions(), v)


def threshold(holds: Callable[[float], bool], theory: float = 1.0) -> float:
    """Return the relative error of the value at which something starts or ceases to hold."""
    low, high = 0.85, 1.15
    below = holds(theory * low)
    if holds(theory * high) == below:
        return math.inf
    while high - low > 2e-3:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(theory * middle) == below else (low, middle)
    return abs(0.5 * (low + high) - 1)


def tilted(angle: float) -> tuple[float, ...]:
    """Return gravity in a world whose ground is tilted down along x by an angle, in rad."""
    return GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle)


def energy(simulation: Simulation) -> float:
    """Return the energy of an object of 1 kg, in J."""
    q, v = simulation.positions(), simulation.velocities()
    return float(0.5 * v @ simulation.mass_matrix(q) @ v + GRAVITY * q[2])


# Impacts ----------------------------------------------------------------------------------------


def cradle(engine: str) -> float:
    """Newton's cradle of five elastic balls with gaps: the last one leaves, m/s of 1 m/s."""
    balls = [
        Sphere(name=f"ball{i}", radius=0.05, restitution=1, friction=0, position=(0.101 * i, 0, 0))
        for i in range(5)
    ]
    with scene(engine, *balls, gravity=(0, 0, 0), ground=None) as simulation:
        moving(simulation, 1.0)
        simulation.step(400)
        found = simulation.velocities()[::6]
    return float(np.abs(found - [0, 0, 0, 0, 1]).max())


def zeno(engine: str) -> float:
    """Time until a bouncing ball rests, restitution 0.5, from 1 m."""
    ball = Sphere(name="ball", radius=0.05, restitution=0.5, position=(0, 0, 1.05))
    with scene(engine, ball) as simulation:
        last = 0.0
        for _ in range(2000):
            simulation.step()
            last = simulation.time if abs(simulation.velocities()[2]) > 0.02 else last
    return abs(last / (3 * math.sqrt(2 / GRAVITY)) - 1)


def percussion(engine: str) -> float:
    """Speed of turning of a free rod that is struck away from its center."""
    rod = Box(name="rod", size=(1, 0.02, 0.02))
    with scene(engine, rod, gravity=(0, 0, 0), ground=None) as simulation:
        simulation.apply_wrench(Wrench("rod", (0, 0, 100.0), point=(1 / 6, 0, 0), duration=1e-3))
        simulation.step()
        v = simulation.body_velocities(["rod"])[0]
    return abs(float(v[2] / v[4]) / (-(1 + 0.02**2) / 2) - 1)


def rod_on_peg(engine: str) -> float:
    """Speed of turning of a rod that falls on a peg, without bouncing."""
    rod = Box(name="rod", size=(1, 0.02, 0.02), position=(0, 0, 0.5))
    peg = Box(name="peg", size=(0.002, 0.2, 0.1), static=True, position=(0.3, 0, 0.4389))
    with scene(engine, rod, peg, gravity=(0, 0, 0), ground=None) as simulation:
        moving(simulation, 0, 0, -2.0)
        while abs(simulation.velocities()[4]) < 1e-6 and simulation.frame < 40:
            simulation.step()
        simulation.step(2)
        speed = abs(float(simulation.velocities()[4]))
    return abs(speed / (0.3 * 2 / ((1 + 0.02**2) / 12 + 0.3**2)) - 1)


# Friction ---------------------------------------------------------------------------------------


def block(**options: object) -> Box:
    """Return a flat block of 1 kg on the ground."""
    given = {"name": "block", "size": (0.2, 0.2, 0.1), "position": (0, 0, 0.05), "friction": 0.5}
    return Box(**{**given, **options})


def shaken(engine: str, axis: Sequence[float], pace: float, amplitude: float) -> float:
    """Return how far a block comes off a plate that swings along an axis, in m."""
    plate = Box(name="plate", size=(2, 2, 0.1), static=True, position=(0, 0, -0.05))
    with scene(engine, block(), plate, ground=None) as simulation:
        simulation.step(100)
        apart, first, direction = 0.0, None, np.array(axis)
        for step in range(round(2 * 2 * math.pi / pace / 1e-3)):
            speed = amplitude * pace * math.sin(pace * (step + 1) * 1e-3)
            simulation.set_body("plate", BodySettings(velocity=tuple(speed * direction)))
            simulation.step()
            poses = simulation.body_poses(["block", "plate"])[:, :3]
            relative = (poses[0] - poses[1]) @ direction
            first = relative if first is None else first
            apart = max(apart, abs(relative - first))
    return apart


def plate_sideways(engine: str) -> float:
    """Acceleration at which a block slips on a plate that swings sideways."""
    pace = 4 * math.pi
    held = 0.5 * GRAVITY / pace**2
    return threshold(lambda ratio: shaken(engine, (1, 0, 0), pace, ratio * held) < GIVES[engine][0])


def plate_upwards(engine: str) -> float:
    """Acceleration at which a block leaves a plate that swings upwards."""
    pace = 10 * math.pi
    held = GRAVITY / pace**2
    return threshold(lambda ratio: shaken(engine, (0, 0, 1), pace, ratio * held) < GIVES[engine][1])


def growing_force(engine: str) -> float:
    """Force at which a block slips."""
    with scene(engine, block(size=(0.4, 0.4, 0.1))) as simulation:
        simulation.step(50)
        profile = np.array([[0, 0, 0], [10.0, 0, 0]])
        simulation.apply_wrench(Wrench("block", profile, times=(0.0, 2.0), point=(0, 0, -0.05)))
        while abs(simulation.velocities()[0]) < 1e-4 and simulation.frame < 2000:
            simulation.step()
        return abs(5 * (simulation.time - 0.05) / (0.5 * GRAVITY) - 1)


def creep(engine: str) -> float:
    """Creep at 95 % of what friction holds, in µm/s."""
    with scene(engine, block(size=(0.4, 0.4, 0.1))) as simulation:
        simulation.step(100)
        before, force = simulation.positions(), 0.95 * 0.5 * GRAVITY
        pull = force * math.cos(0.5), force * math.sin(0.5), 0
        simulation.apply_wrench(Wrench("block", pull, point=(0, 0, -0.05)))
        simulation.step(2000)
        return 1e6 * math.hypot(*(simulation.positions() - before)[:2]) / 2


def creep_on_heights(engine: str) -> float:
    """Creep of a block on a height field of 20°, friction 0.5, in µm/s."""
    angle, x = math.radians(20), np.arange(41) * 0.1 - 2
    field = HeightField(math.tan(angle) * x[:, None] * np.ones(41))
    place = -0.051 * math.sin(angle), 0, 0.051 * math.cos(angle)
    turn = from_axis_angle((0, 1, 0), -angle)
    thing = block(size=(0.3, 0.2, 0.1), position=place, orientation=turn)
    with scene(engine, thing, ground=field) as simulation:
        simulation.step(500)
        before = simulation.positions()
        simulation.step(2000)
        return 1e6 * float(np.linalg.norm((simulation.positions() - before)[:3])) / 2


def toppling(engine: str) -> float:
    """Slope at which a tall box topples."""

    def stands(angle: float) -> bool:
        tall = block(size=(0.1, 0.1, 0.3), position=(0, 0, 0.15), friction=1.0)
        with scene(engine, tall, gravity=tilted(angle)) as simulation:
            simulation.step(3000)
            x, y = simulation.positions()[3:5]
            return bool(1 - 2 * (x * x + y * y) > 0.99)

    return threshold(stands, math.atan(1 / 3))


def groove(engine: str) -> float:
    """Slope at which a block slips along a V-groove, whose walls press more than its weight."""
    slant, friction = math.radians(45), 0.4

    def stays(angle: float) -> bool:
        walls = [
            Box(
                name=f"wall{side}",
                size=(4, 1, 0.2),
                static=True,
                position=(0, -0.1 * side * math.sin(slant), -0.1 * math.cos(slant)),
                orientation=from_axis_angle((1, 0, 0), -side * slant),
            )
            for side in (1, -1)
        ]
        turned = from_axis_angle((1, 0, 0), slant)
        place = 0, 0, 0.05 * math.sqrt(2)
        bar = block(size=(0.3, 0.1, 0.1), position=place, orientation=turned, friction=friction)
        with scene(engine, bar, *walls, ground=None, gravity=tilted(angle)) as simulation:
            simulation.step(500)
            return bool(abs(simulation.velocities()[0]) < 5e-3)

    return threshold(stays, math.atan(friction / math.sin(slant)))


def spinning_box(engine: str) -> float:
    """Lever of friction at a box that spins on its corners."""
    with scene(engine, block(size=(0.2, 0.2, 0.05), position=(0, 0, 0.025))) as simulation:
        simulation.step(50)
        moving(simulation, 0, 0, 0, 0, 0, 20.0)
        simulation.step(100)
        slowed = 20.0 - float(simulation.velocities()[5])
    lever = slowed / 0.1 * (0.2**2 / 6) / (0.5 * GRAVITY)
    return abs(lever / (0.2 / math.sqrt(2)) - 1)


def heavy_on_light(engine: str) -> float:
    """How far a box of 1000 kg sinks in one of 1 kg, in mm; with DART's `dantzig`."""
    objects = [
        Box(name=f"box{i}", size=(0.2, 0.2, 0.2), mass=mass, position=(0, 0, 0.1 + 0.2 * i))
        for i, mass in enumerate((1.0, 1000.0))
    ]
    solver = "dantzig" if engine == "dart" else None
    with scene(engine, *objects, solver=solver) as simulation:
        simulation.step(1000)
        return 1e3 * abs(float(simulation.positions()[9]) - 0.3)


# Rolling and spinning ---------------------------------------------------------------------------


def rolling_cylinder(engine: str) -> float:
    """Distance that a cylinder rolls in 2 s."""
    on_side = from_axis_angle((1, 0, 0), math.pi / 2)
    thing = Cylinder(
        name="cylinder", radius=0.1, length=0.1, position=(0, 0, 0.1), orientation=on_side
    )
    with scene(engine, thing) as simulation:
        simulation.step(50)
        moving(simulation, 1.0, 0, 0, 0, 0, -10.0)
        simulation.step(2000)
        return abs(float(simulation.positions()[0]) / 2 - 1)


def rolling_ball(engine: str) -> float:
    """Distance that a ball rolls in 5 s."""
    with scene(engine, Sphere(name="ball", radius=0.1, position=(0, 0, 0.1))) as simulation:
        simulation.step(50)
        moving(simulation, 1.0, 0, 0, 0, 10.0)
        simulation.step(5000)
        return abs(float(simulation.positions()[0]) / 5 - 1)


def braked(engine: str, **friction: float) -> float:
    """Time until a ball that rolls without slipping, or spins, stops."""
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 0.1), **friction)
    spins = "torsional_friction" in friction
    slowing = 0.01 * GRAVITY / (0.4 if spins else 1.4) / 0.1**2  # of the angular velocity
    with scene(engine, ball) as simulation:
        simulation.step(200)
        pace = 0.5 * slowing
        moving(simulation, *((0, 0, 0, 0, 0, pace) if spins else (0.1 * pace, 0, 0, 0, pace)))
        start = simulation.time
        while np.abs(simulation.velocities()[3:]).max() > 2e-3 * pace and simulation.time < 2:
            simulation.step()
        return abs((simulation.time - start) / 0.5 - 1)


def spinning_ball(engine: str) -> float:
    """Time until torsional friction stops a ball that spins."""
    return braked(engine, torsional_friction=0.01)


def braked_ball(engine: str) -> float:
    """Time until rolling friction stops a ball that rolls."""
    return braked(engine, rolling_friction=0.01)


_TOP = (
    '<robot name="top"><link name="top"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>'
    '<inertia ixx="2e-3" iyy="2e-3" izz="4e-3" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
)


def top(engine: str) -> float:
    """Precession of a fast top on a smooth floor, with steps of 0.25 ms."""
    tilt, spin, arm = 0.3, 200.0, 0.1
    rate = GRAVITY * arm / (4e-3 * spin)
    for _ in range(50):  # of the equation of steady precession
        rate = (
            GRAVITY * arm / (4e-3 * (spin + rate * math.cos(tilt)) - 2e-3 * rate * math.cos(tilt))
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "top.urdf"
        path.write_text(_TOP, encoding="utf-8")
        leaning = from_axis_angle((1, 0, 0), tilt)
        robot = Robot(
            path,
            fixed_base=False,
            feet={"top": 0.002},
            position=(0, 0, 0.002),
            orientation=leaning,
            friction=0.0,
        )
        world = World([robot], ground=Ground(), period=2.5e-4)
        simulation = plugins.resolve("backend", engine).build(world)
    with simulation:
        turn = np.array([0, rate * math.sin(tilt), spin + rate * math.cos(tilt)])
        moving(simulation, *-np.cross(turn, [0, 0, arm]), *turn)
        angles = []
        for _ in range(80):
            simulation.step(40)
            x, y, z, w = simulation.body_poses(["top"])[0, 3:]
            angles.append(math.atan2(y * z - w * x, x * z + w * y))
    turned = np.unwrap(angles)
    return abs(float(turned[-1] - turned[0]) / (0.01 * 79) / rate - 1)


def disk(engine: str) -> float:
    """Euler's disk: its energy after 3 s, which cannot be more, over that at the start, minus 1."""
    radius, thickness, tilt = 0.1, 0.01, 0.3
    height = radius * math.sin(tilt) + 0.5 * thickness * math.cos(tilt)
    thing = Cylinder(
        name="disk",
        radius=radius,
        length=thickness,
        position=(0, 0, height),
        orientation=from_axis_angle((1, 0, 0), tilt),
    )
    with scene(engine, thing) as simulation:
        pace = math.sqrt(4 * GRAVITY / (radius * math.sin(tilt)))
        moving(simulation, 0, 0, 0, 0, pace * math.sin(tilt))
        before = energy(simulation)
        simulation.step(3000)
        return energy(simulation) / before - 1


def dominoes(engine: str) -> float:
    """Speed at which a row of dominoes falls, in m/s."""
    row = [
        Box(
            name=f"domino{i}",
            size=(0.01, 0.03, 0.06),
            mass=0.01,
            position=(0.03 * i, 0, 0.03),
            friction=0.4,
        )
        for i in range(10)
    ]
    with scene(engine, *row) as simulation:
        simulation.step(100)
        push = Wrench("domino0", (0.08, 0, 0), point=(0, 0, 0.03), duration=0.05)
        simulation.apply_wrench(push)
        fallen: list[float] = []
        while len(fallen) < len(row) and simulation.frame < 2000:
            simulation.step()
            sines = np.abs(simulation.positions()[4::7])
            while len(fallen) < len(row) and sines[len(fallen)] > math.sin(math.radians(5)):
                fallen.append(simulation.time)
    return 0.03 * 5 / (fallen[9] - fallen[4]) if len(fallen) == len(row) else math.nan


CASES: dict[str, Case] = {
    "cradle of five balls": cradle,
    "bouncing ball": zeno,
    "struck rod": percussion,
    "rod on a peg": rod_on_peg,
    "plate that swings sideways": plate_sideways,
    "plate that swings upwards": plate_upwards,
    "growing force": growing_force,
    "toppling box": toppling,
    "V-groove": groove,
    "box that spins on its corners": spinning_box,
    "rolling cylinder": rolling_cylinder,
    "rolling ball": rolling_ball,
    "ball that spins until it stops": spinning_ball,
    "ball that rolls until it stops": braked_ball,
    "fast top": top,
    "creep at 95 % of friction, µm/s": creep,
    "creep on a height field, µm/s": creep_on_heights,
    "1000 kg on 1 kg, mm": heavy_on_light,
    "Euler's disk, growth of energy": disk,
}
ERROR = 0.01
"""Largest relative error of a case that is not named here."""
LIMITS: dict[str, float] = {
    "plate that swings sideways": 0.015,
    "creep at 95 % of friction, µm/s": 1.0,
    "creep on a height field, µm/s": 10.0,
    "1000 kg on 1 kg, mm": 0.1,
    "Euler's disk, growth of energy": 0.0,
}
"""Largest values of other cases; that of a plate is what tells slipping from giving way."""
KNOWN: dict[tuple[str, str], float] = {
    ("bouncing ball", "dart"): 0.02,
    ("plate that swings sideways", "mujoco"): 0.05,
    ("plate that swings upwards", "mujoco"): 0.05,
    ("V-groove", "mujoco"): 0.08,
    ("box that spins on its corners", "mujoco"): 0.1,
    ("Euler's disk, growth of energy", "mujoco"): 0.14,
}
"""Limits of engines that docs/contacts.md names."""


def table(engines: Sequence[str]) -> dict[str, float]:
    """Print all cases; return for each engine the largest result as a share of its limit."""
    worst = dict.fromkeys(engines, 0.0)
    print(f"{'against theory':34}" + "".join(f"{engine:>12}" for engine in engines))
    for name, case in CASES.items():
        row = ""
        for engine in engines:
            try:
                found = case(engine)
            except FeatureNotSupportedError:
                row += f"{'-':>12}"
                continue
            limit = KNOWN.get((name, engine), LIMITS.get(name, ERROR))
            # A limit of 0 is met by any decrease.
            share = found / limit if limit else 0.0 if found <= 0 else math.inf
            worst[engine] = max(worst[engine], share)
            row += f"{found:12.1e}"
        print(f"{name:34}{row}")
    speeds = {engine: dominoes(engine) for engine in engines}
    print(f"{'wave through dominoes, m/s':34}" + "".join(f"{x:12.3f}" for x in speeds.values()))
    return worst
