"""Probes: experiments that read what engines hold of contacts, which a task may never show.

What can move freely slides, or falls, from where an episode begins; the contacts say with which
coefficients. A difference of friction by 10 % is lost in a walk between engines, as each pushes
penetrating bodies apart in its own way, but not here.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from physx_agree.laboratory import Laboratory
from physx_agree.models import Held
from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim import Part, Simulation, World

Pair = tuple[str, str]
"""Names of two robots or objects that touch, or of one and a static body."""

_SETTLING, _SLIDING, _FALLING = 0.3, 0.1, 0.3
"""How long each part of a probe takes, in s."""
_SPEED, _SLOWEST = 1.0, 0.1
"""At which speed bodies slide and fall, and above which a point counts as sliding, in m/s."""
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
            found.append(Held("friction of contacts", text, _scaling("friction", pair, ratio)))
    return sorted(found, key=lambda held: held.text)


def restitution_differences(one: Laboratory, other: Laboratory) -> list[Held]:
    """Return which pairs bounce with other coefficients of restitution."""
    first, second = restitutions(one), restitutions(other)
    found = []
    for pair in first.keys() & second.keys():
        e, e_other = first[pair], second[pair]
        if abs(e - e_other) > _RESTITUTION:
            text = f"restitution of {' on '.join(pair)}: {e:.2g} | {e_other:.2g}"
            ratio = e_other / e if min(e, e_other) > _RESTITUTION else e_other * np.inf
            found.append(Held("restitution", text, _scaling("restitution", pair, ratio, e)))
    return sorted(found, key=lambda held: held.text)


def _scaling(option: str, pair: Pair, ratio: float, value: float = 0.0) -> Any:
    """Return a repair that divides an option of both bodies, or of the first of them, by a ratio.

    A contact uses the smaller friction, but the product of the restitutions. An infinite ratio
    stands for a restitution that only one engine has.
    """
    changed = pair if option == "friction" else pair[:1]

    def new(thing: Any) -> Any:
        if thing is None or getattr(thing, "name", "ground") not in changed:
            return thing
        now = getattr(thing, option)
        return dataclasses.replace(
            thing, **{option: now / ratio if np.isfinite(ratio) else max(value, 0.0)}
        )

    def repair(one: World, other: World) -> tuple[World, World]:
        return one, dataclasses.replace(
            other,
            robots=[new(each) for each in other.robots],
            objects=[new(each) for each in other.objects],
            ground=new(other.ground),
        )

    return repair


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
                simulation.step(1)
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
                before = _relative(simulation, hit, q, v) @ hit["normal"]
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
    """Yield the ratio of tangential to normal force at each sliding point."""
    contacts = simulation.contacts()
    forces = (contacts["force"] * contacts["normal"]).sum(axis=1)
    q, v = simulation.positions(), simulation.velocities()
    for contact, force in zip(contacts, forces, strict=True):
        normal, total = contact["normal"], contact["force"]
        slip = _relative(simulation, contact, q, v)
        slip = slip - (slip @ normal) * normal
        if force > 0.05 * forces.max() > 0 and np.linalg.norm(slip) > _SLOWEST:
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
