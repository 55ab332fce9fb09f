"""Probes: experiments that read what engines hold of contacts, which a task may never show.

What can move freely slides, or falls, from where an episode begins; the contacts say with which
coefficients. A difference of friction by 10 % is lost in a walk between engines, as each pushes
penetrating bodies apart in its own way, but not here.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from physx_agree.laboratory import Laboratory
from physx_agree.models import Held, Repair
from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim import Part, Simulation, World

Pair = tuple[str, str]
"""Names of two robots or objects that touch, or of one and a static body."""

_SETTLING, _SLIDING, _FALLING = 0.3, 0.1, 0.3
"""How long each part of a probe takes, in s."""
_SPEED, _SLOWEST = 2.0, 1.0
"""At which speed bodies slide and fall, and above which a point counts as sliding, in m/s: where
contacts are soft, friction at lower speeds is not all that it can be."""
_STEADY = 0.9
"""Cosine of the angle by which a sliding point may turn in a step."""
_LIFT = 0.02
"""How far above its first place a body falls from, in m."""
_FRICTION, _RESTITUTION = 0.03, 0.05
"""Differences, relative and absolute, that are not the engines' own errors."""


def friction_differences(one: Laboratory, other: Laboratory) -> list[Held]:
    """Return which pairs slide with other coefficients of friction."""
    first, second = frictions(one), frictions(other)
    found = []
    for pair in first.keys() & second.keys():
        ratio = second[pair] / max(first[pair], 1e-9)
        if abs(ratio - 1.0) > _FRICTION:
            text = f"friction of {' on '.join(pair)}: {first[pair]:.3g} | {second[pair]:.3g}"
            found.append(Held("friction of contacts", text, _sliding(pair, ratio)))
    return sorted(found, key=lambda held: held.text)


def restitution_differences(one: Laboratory, other: Laboratory) -> list[Held]:
    """Return which pairs bounce with other coefficients of restitution."""
    first, second = restitutions(one), restitutions(other)
    found = []
    for pair in first.keys() & second.keys():
        e, e_other = first[pair], second[pair]
        if abs(e - e_other) > _RESTITUTION:
            text = f"restitution of {' on '.join(pair)}: {e:.2g} | {e_other:.2g}"
            found.append(Held("restitution", text, _bouncing(pair, e, e_other)))
    return sorted(found, key=lambda held: held.text)


def _sliding(pair: Pair, ratio: float) -> Repair:
    """Return what divides the friction of both bodies by a ratio; a contact uses the smaller."""

    def repair(one: World, other: World) -> tuple[World, World]:
        return one, _changed(other, pair, lambda thing: {"friction": _friction(thing) / ratio})

    return repair


def _friction(thing: Any) -> float:
    return 1.0 if thing.friction is None else float(thing.friction)


def _bouncing(pair: Pair, e: float, e_other: float) -> Repair:
    """Return what gives the first body of the engine that bounces less more restitution."""
    low, high = sorted((e, e_other))

    def more(thing: Any) -> dict[str, float]:
        return {"restitution": thing.restitution * high / low if thing.restitution else high}

    def repair(one: World, other: World) -> tuple[World, World]:
        if e < e_other:
            return _changed(one, pair[:1], more), other
        return one, _changed(other, pair[:1], more)

    return repair


def _changed(
    world: World, names: Sequence[str], changes: Callable[[Any], dict[str, float]]
) -> World:
    def new(thing: Any) -> Any:
        if thing is None or getattr(thing, "name", "ground") not in names:
            return thing
        return dataclasses.replace(thing, **changes(thing))

    return dataclasses.replace(
        world,
        robots=[new(each) for each in world.robots],
        objects=[new(each) for each in world.objects],
        ground=new(world.ground),
    )


# Experiments ------------------------------------------------------------------------------------


def frictions(lab: Laboratory) -> dict[Pair, float]:
    """Return the coefficients of friction with which bodies slide, by pair."""
    simulation, found = lab.simulation, defaultdict(list)
    for part in _free(simulation):
        for direction in ((1.0, 0.0, 0.0), (0.8, 0.6, 0.0)):
            _begin(lab)
            simulation.step(_count(simulation, _SETTLING))
            _push(simulation, part, _SPEED * np.array(direction))
            for _ in range(_count(simulation, _SLIDING)):
                for pair, ratio in _ratios(simulation):
                    found[pair].append(ratio)
    return {pair: float(np.median(ratios)) for pair, ratios in found.items() if len(ratios) > 1}


def restitutions(lab: Laboratory) -> dict[Pair, float]:
    """Return the coefficients of restitution with which falling bodies bounce, by pair."""
    simulation, found = lab.simulation, {}
    for part in _free(simulation):
        _begin(lab)
        q = simulation.positions()
        q[part.positions.start + 2] += _LIFT
        simulation.set_state(q, np.zeros(simulation.layout.nv))
        _push(simulation, part, np.array([0.0, 0.0, -_SPEED]))
        for _ in range(_count(simulation, _FALLING)):
            q, v = simulation.positions(), simulation.velocities()
            simulation.step(1)
            contacts = simulation.contacts()
            forces = (contacts["force"] * contacts["normal"]).sum(axis=1)
            if len(forces) and forces.max() > 0:
                hit = contacts[int(forces.argmax())]
                fall = simulation.period * np.array(lab.world.gravity)
                before = (_relative(simulation, hit, q, v) + fall) @ hit["normal"]
                now = simulation.velocities()
                after = _relative(simulation, hit, q, now) @ hit["normal"]
                if before < -0.5 * _SPEED:
                    found[_pair(simulation, hit)] = max(float(-after / before), 0.0)
                break
    return found


def _free(simulation: Simulation) -> list[Part]:
    touching = "contacts" in simulation.features
    return [part for part in simulation.layout.parts.values() if part.floating and touching]


def _count(simulation: Simulation, seconds: float) -> int:
    return max(1, round(seconds / simulation.period))


def _begin(lab: Laboratory) -> None:
    lab.simulation.restore(dataclasses.replace(lab.first, native=(), engine=""))
    lab.simulation.set_commands(np.zeros(len(lab.simulation.layout.joints)))


def _push(simulation: Simulation, part: Part, velocity: Vector) -> None:
    """Give all of a body a velocity, in m/s, in the world frame."""
    q, v = simulation.positions(), simulation.velocities()
    begin = part.positions.start
    turn = to_matrix(q[begin + 3 : begin + 7])
    v[part.velocities] = 0.0
    v[part.velocities.start : part.velocities.start + 3] = turn.T @ velocity
    simulation.set_state(q, v)


def _ratios(simulation: Simulation) -> Iterator[tuple[Pair, float]]:
    """Step, and yield the ratio of tangential to normal force at each point that keeps sliding."""
    ends = [(simulation.positions(), simulation.velocities())]
    simulation.step(1)
    ends.append((simulation.positions(), simulation.velocities()))
    contacts = simulation.contacts()
    forces = (contacts["force"] * contacts["normal"]).sum(axis=1)
    for contact, force in zip(contacts, forces, strict=True):
        normal, total = contact["normal"], contact["force"]
        slips = [_relative(simulation, contact, *end) for end in ends]
        before, after = (slip - (slip @ normal) * normal for slip in slips)
        slides = before @ after > _STEADY * np.linalg.norm(before) * np.linalg.norm(after)
        if slides and np.linalg.norm(after) > _SLOWEST and force > 0.05 * forces.max() > 0:
            yield _pair(simulation, contact), float(np.linalg.norm(total - force * normal) / force)


def _relative(simulation: Simulation, contact: Any, q: Vector, v: Vector) -> Vector:
    """Return the velocity of the first body relative to the second at a contact, in m/s."""
    found = np.zeros(3)
    layout = simulation.layout
    for body, sign in ((contact["body_a"], 1.0), (contact["body_b"], -1.0)):
        if body < len(layout.bodies):
            [pose] = simulation.body_poses([layout.bodies[body]], q)
            [motion] = simulation.body_velocities([layout.bodies[body]], q, v)
            arm = contact["point"] - pose[:3]
            found += sign * (motion[:3] + np.cross(motion[3:], arm))
    return found


def _pair(simulation: Simulation, contact: Any) -> Pair:
    layout = simulation.layout
    names = []
    for body in (int(contact["body_a"]), int(contact["body_b"])):
        owner = [name for name, p in layout.parts.items() if p.bodies.start <= body < p.bodies.stop]
        names.append(owner[0] if owner else layout.names[body])
    return names[0], names[1]
