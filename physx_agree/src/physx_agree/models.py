"""Models: masses, friction and more that engines hold, read back from their dynamics.

Mass matrix and inverse dynamics are linear in masses, centers of mass, moments of inertia, rotors,
dampings, frictions, stiffnesses and gravity (C. G. Atkeson, C. H. An and J. M. Hollerbach,
"Estimation of inertial parameters of manipulator loads and links", 1986), so the difference
between two engines says which of them differ, and by how much: no simulation is needed, and what is
found does not depend on which states an episode visits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim import JointSettings, Robot, Simulation, World
from physx_sim.engines import RigidBody, read_parts

_CONFIGURATIONS, _STATES = 8, 24
_TOLERANCE = 1e-7
"""Relative difference up to which two engines hold the same."""
_MOST = 6
"""Largest number of differences that are looked for at once."""
_NEARLY = 1.05
"""Largest ratio of remaining differences at which the simpler explanation is preferred."""

Repair = Callable[[World, World], tuple[World, World]]
"""Returns two worlds, on both engines, without a difference between the engines."""


@dataclass(frozen=True)
class Held:
    """Something that two engines hold differently.

    Attributes:
        kind: Such as ``"damping"``.
        text: What it is, with its values or their difference.
        repair: Makes them equal, if descriptions can; else None.
    """

    kind: str
    text: str
    repair: Repair | None = None


@dataclass(frozen=True)
class _Candidate:
    """A possible difference: directions in which equations may differ, and what they mean."""

    columns: Vector
    held: Callable[[Vector], Held]


def mass_differences(one: Simulation, other: Simulation, world: World) -> list[Held]:
    """Return which inertias and rotors differ, from the mass matrices.

    Args:
        one: A world on an engine.
        other: The same on another engine.
        world: Its description.
    """
    places = _positions(one, world)
    rows = np.triu_indices(one.layout.nv)
    matrices = [one.mass_matrix(q) for q in places]
    wanted = np.array([m[rows] for m in matrices])
    found = np.array([other.mass_matrix(q)[rows] for q in places])
    candidates = [*_inertias(one, world, places, rows), *_rotors(one, len(places), rows)]
    return _explain((found - wanted).ravel(), candidates, float(np.abs(wanted).max()))


def force_differences(one: Simulation, other: Simulation, world: World) -> list[Held]:
    """Return which forces of gravity, springs, damping and friction differ; see above."""
    layout, rng = one.layout, np.random.default_rng(1)
    places, zero = _positions(one, world, _STATES), np.zeros(layout.nv)
    still = np.array([_bias(other, q, zero) - _bias(one, q, zero) for q in places])
    scale = max(float(np.abs([_bias(one, q, zero) for q in places]).max()), 1e-3)
    candidates = [*_gravity(one, world, places), *_springs(one, places)]
    found = _explain(still.ravel(), candidates, scale)
    speeds = list(rng.uniform(-1.0, 1.0, (len(places), layout.nv)))
    own = np.array([_bias(one, q, v) for q, v in zip(places, speeds, strict=True)])
    moving = np.array([_bias(other, q, v) for q, v in zip(places, speeds, strict=True)]) - own
    scale = max(float(np.abs(own).max()), 1e-3)
    resistances = list(_resistances(one, np.array(speeds)))
    return found + _explain((moving - still).ravel(), resistances, scale)


def _bias(simulation: Simulation, q: Vector, v: Vector) -> Vector:
    return simulation.inverse_dynamics(q, v, np.zeros(len(v)))


def _positions(simulation: Simulation, world: World, count: int = _CONFIGURATIONS) -> list[Vector]:
    """Return positions of joints at random within their limits, and bases in any orientation."""
    layout, rng = simulation.layout, np.random.default_rng(0)
    lower = np.maximum(layout.lower, -1.0)
    upper = np.maximum(np.minimum(layout.upper, 1.0), lower)
    first, found = simulation.positions(), []
    for _ in range(count):
        q = first.copy()
        q[list(layout.position_index.values())] = rng.uniform(lower, upper)
        for part in layout.parts.values():
            if part.floating:
                turn = rng.normal(size=4)
                begin = part.positions.start
                q[begin + 3 : begin + 7] = turn / np.linalg.norm(turn)
        found.append(q)
    return found


# Directions -------------------------------------------------------------------------------------


def _inertias(
    one: Simulation, world: World, places: Sequence[Vector], rows: Any
) -> Iterator[_Candidate]:
    """Yield for each link the scale of its inertia, and its ten inertial parameters."""
    for name, body, owner in bodies_of(one, world):
        blocks = np.array([_of_parameters(one, name, q)[(slice(None), *rows)] for q in places])
        columns = blocks.transpose(0, 2, 1).reshape(-1, 10)
        if not np.abs(columns).max() > 0:
            continue
        described = _parameters(body)
        yield _Candidate(
            columns @ described[:, None],
            lambda x, name=name, owner=owner: _scaled(name, owner, float(x[0])),  # type: ignore[misc]
        )
        yield _Candidate(
            columns,
            lambda x, name=name: Held("inertia", f"center or moments of {name}"),  # type: ignore[misc]
        )


def _rotors(one: Simulation, count: int, rows: Any) -> Iterator[_Candidate]:
    for joint, place in one.layout.velocity_index.items():
        column = np.tile(((rows[0] == place) & (rows[1] == place)).astype(float), count)
        yield _Candidate(column[:, None], _of_joint("armature", joint, "kg m²"))


def _gravity(one: Simulation, world: World, places: Sequence[Vector]) -> Iterator[_Candidate]:
    columns = np.zeros((len(places), one.layout.nv, 3))
    for name, body, _ in bodies_of(one, world):
        for number, q in enumerate(places):
            columns[number] -= body.mass * one.jacobian(name, q, body.center.tolist())[:3].T
    yield _Candidate(columns.reshape(-1, 3), _changed_gravity)


def _springs(one: Simulation, places: Sequence[Vector]) -> Iterator[_Candidate]:
    for joint, place in one.layout.velocity_index.items():
        index = one.layout.position_index[joint]
        columns = np.zeros((len(places), one.layout.nv, 2))
        columns[:, place, 0] = [q[index] for q in places]
        columns[:, place, 1] = 1.0
        yield _Candidate(columns.reshape(-1, 2)[:, :1], _of_joint("stiffness", joint, "N m/rad"))
        yield _Candidate(columns.reshape(-1, 2), _of_joint("stiffness", joint, "N m/rad"))


def _resistances(one: Simulation, speeds: Vector) -> Iterator[_Candidate]:
    for kind, values, unit in (
        ("damping", speeds, "N m s/rad"), ("friction", np.sign(speeds), "N m"),
    ):  # fmt: skip
        for joint, place in one.layout.velocity_index.items():
            columns = np.zeros(speeds.shape)
            columns[:, place] = values[:, place]
            yield _Candidate(columns.reshape(-1, 1), _of_joint(kind, joint, unit))


def bodies_of(simulation: Simulation, world: World) -> list[tuple[str, RigidBody, tuple[str, str]]]:
    """Return each link: its name in the layout, it, its robot's or object's name and its own."""
    found = []
    for movable in read_parts(world).movables:
        names = simulation.layout.bodies[simulation.layout.parts[movable.name].bodies]
        for name, body in zip(names, movable.model.bodies, strict=True):
            found.append((name, body, (movable.name, body.name)))
    return found


def _parameters(body: RigidBody) -> Vector:
    """Return mass, first moments, and moments xx, xy, xz, yy, yz, zz about the origin."""
    x = body.center
    inertia = body.inertia + body.mass * (x @ x * np.eye(3) - np.outer(x, x))
    return np.array([body.mass, *(body.mass * x), *inertia[np.triu_indices(3)]])


def _of_parameters(simulation: Simulation, body: str, q: Vector) -> Vector:
    """Return the derivatives of the mass matrix by a link's parameters, shape (10, nv, nv)."""
    turn = to_matrix(simulation.body_poses([body], q)[0, 3:])
    jacobian = simulation.jacobian(body, q)
    linear, angular = turn.T @ jacobian[:3], turn.T @ jacobian[3:]
    found = [linear.T @ linear]
    for axis in np.eye(3):
        cross = np.cross(np.eye(3), axis)  # rows e_i x axis; so linear' [w x c] = linear' cross' w
        mixed = linear.T @ cross.T @ angular
        found.append(mixed + mixed.T)
    for first, second in zip(*np.triu_indices(3), strict=True):
        product = np.outer(angular[first], angular[second])
        found.append(product if first == second else product + product.T)
    return np.array(found)


# Which of them ----------------------------------------------------------------------------------


def _explain(residual: Vector, candidates: Sequence[_Candidate], scale: float) -> list[Held]:
    """Return the fewest candidates that explain a difference, one after the other."""
    enough = _TOLERANCE * scale * np.sqrt(len(residual))
    chosen: list[_Candidate] = []
    left = residual
    while np.linalg.norm(left) > enough and len(chosen) < _MOST:
        fits = [(each, _remaining(residual, [*chosen, each])) for each in candidates]
        best = min((rest for _, rest in fits), default=np.inf)
        if not best < 0.9 * np.linalg.norm(left):
            break
        limit = max(_NEARLY * best, enough)
        simplest = min(
            ((each, rest) for each, rest in fits if rest <= limit),
            key=lambda pair: (pair[0].columns.shape[1], pair[1]),
        )
        chosen.append(simplest[0])
        left = _rest(residual, chosen)
    chosen = _needed(residual, chosen, enough)
    if not chosen:
        large = np.linalg.norm(left) > enough
        return [Held("smooth", "the smooth dynamics, by no parameter")] if large else []
    columns = np.hstack([each.columns for each in chosen])
    solution = np.linalg.lstsq(columns, residual, rcond=None)[0]
    ends = np.cumsum([each.columns.shape[1] for each in chosen])[:-1]
    parts = np.split(solution, ends)
    return [each.held(part) for each, part in zip(chosen, parts, strict=True)]


def _needed(residual: Vector, chosen: list[_Candidate], enough: float) -> list[_Candidate]:
    """Return the chosen ones without those that later ones make superfluous."""
    limit = max(_NEARLY * _remaining(residual, chosen), enough) if chosen else 0.0
    for each in list(chosen):
        others = [one for one in chosen if one is not each]
        if others and _remaining(residual, others) <= limit:
            chosen = others
    return chosen


def _rest(residual: Vector, chosen: Sequence[_Candidate]) -> Vector:
    columns = np.hstack([each.columns for each in chosen])
    solution = np.linalg.lstsq(columns, residual, rcond=None)[0]
    return np.asarray(residual - columns @ solution)


def _remaining(residual: Vector, chosen: Sequence[_Candidate]) -> float:
    return float(np.linalg.norm(_rest(residual, chosen)))


# What they mean, and how worlds become equal ----------------------------------------------------


def _scaled(name: str, owner: tuple[str, str], change: float) -> Held:
    def repair(one: World, other: World) -> tuple[World, World]:
        return one, _with_factor(other, owner, 1.0 / (1.0 + change))

    return Held("mass", f"mass and moments of {name}: {100 * change:+.3g} %", repair)


def _with_factor(world: World, owner: tuple[str, str], factor: float) -> World:
    name, link = owner
    robots = [
        dataclasses.replace(
            robot,
            mass_factors={**robot.mass_factors, link: factor * robot.mass_factors.get(link, 1.0)},
        )
        if robot.name == name else robot
        for robot in world.robots
    ]  # fmt: skip
    objects = [
        dataclasses.replace(each, mass=factor * each.mass) if each.name == name else each
        for each in world.objects
    ]
    return dataclasses.replace(world, robots=robots, objects=objects)


def _of_joint(kind: str, joint: str, unit: str) -> Callable[[Vector], Held]:
    def held(solution: Vector) -> Held:
        change = float(solution[0])

        def repair(one: World, other: World) -> tuple[World, World]:
            if change > 0:
                return _with_more(one, joint, kind, change), other
            return one, _with_more(other, joint, kind, -change)

        return Held(kind, f"{kind} of {joint}: {change:+.4g} {unit}", repair)

    return held


def _with_more(world: World, joint: str, kind: str, more: float) -> World:
    """Return a world in which a joint has more of a resistance."""
    robots = list(world.robots)
    owner, slash, name = joint.partition("/")
    several = len(robots) > 1 and slash
    for place, robot in enumerate(robots):
        if not several or robot.name == owner:
            own = name if several else joint
            robots[place] = dataclasses.replace(
                robot, joints=_more_of(robot, world, own, kind, more)
            )
    return dataclasses.replace(world, robots=robots)


def _more_of(
    robot: Robot, world: World, joint: str, kind: str, more: float
) -> Mapping[str, JointSettings]:
    [model] = [each.model for each in read_parts(world).movables if each.name == robot.name]
    [known] = [each for each in model.joints if each.name == joint]
    settings: Any = robot.joints.get(joint, JointSettings())
    more += float(getattr(known, kind))
    return {**robot.joints, joint: dataclasses.replace(settings, **{kind: more})}


def _changed_gravity(change: Vector) -> Held:
    def repair(one: World, other: World) -> tuple[World, World]:
        return one, dataclasses.replace(other, gravity=tuple((other.gravity - change).tolist()))

    text = ", ".join(f"{value:+.4g}" for value in change)
    return Held("gravity", f"gravity: {text} m/s²", repair)
