"""Parting: where two engines differ after one physics step from equal states, and through what.

Differences are measured in the norm of the mass matrix, ``sqrt(d' M d)``, whose square is twice
a kinetic energy: it does not depend on how joints are numbered or measured. The floor of a step is
how far an engine is from itself, if it repeats the step without what it remembers of earlier ones.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from physx_agree.episodes import Episode
from physx_agree.laboratory import Laboratory, Moment, Outcome
from physx_core.typing import Records, Vector
from physx_sim import World

FLOORS = 10.0
"""A step parts engines if they differ by more than this times the floor."""
_ROUNDING = 1e-8
"""Relative difference of velocities that is not the engines' own rounding."""
_HELPS = 0.2
"""Share of a difference that an intervention must remove to be kept."""
_TOUCHES = 1e-9
"""Depth below which bodies only touch, in m."""


@dataclass(frozen=True, eq=False)
class Floor:
    """What an engine makes of each step of an episode when it repeats it, shape (steps, ...) each.

    Attributes:
        masses: Mass matrices.
        floor: How far the first engine is from itself without its memory, in sqrt(J).
        bound: Up to which difference a step does not part engines, in sqrt(J).
    """

    masses: Vector
    floor: Vector
    bound: Vector

    @classmethod
    def of(cls, lab: Laboratory, episode: Episode) -> Floor:
        """Repeat the steps of an episode on the engine that it was recorded on."""
        moments, recorded = episode.moments, episode.velocities
        masses = np.array([lab.simulation.mass_matrix(each.positions) for each in moments])
        repeated = np.array([lab.step(each).velocities for each in moments])
        floor: Vector = norms(masses, repeated - recorded)
        size: Vector = norms(masses, recorded)
        return cls(masses, floor, FLOORS * floor + _ROUNDING * (1 + size))


def norms(masses: Vector, differences: Vector) -> Vector:
    """Return the norms of differences of velocities, shape (n,), in sqrt(J).

    Args:
        masses: Mass matrices, shape (n, nv, nv).
        differences: Shape (n, nv).
    """
    squares = np.einsum("ni,nij,nj->n", differences, masses, differences)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


def _norm(mass: Vector, difference: Vector) -> float:
    return math.sqrt(max(float(difference @ mass @ difference), 0.0))


# Through what -----------------------------------------------------------------------------------

LIMIT, GAP, RECOVERY = "limit", "contact gap", "recovery of penetration"
FRICTION, CONTACTS, SOLVER = "friction law", "contact set", "contact solver"
INTEGRATOR, UNEXPLAINED = "integrator", "unexplained"

TEXTS = {
    LIMIT: "how joints are stopped at their limits",
    GAP: "how far apart or how deep the same bodies are",
    RECOVERY: "how bodies that penetrate each other are pushed apart",
    FRICTION: "how friction acts where the coefficients are equal",
    CONTACTS: "which points touch",
    SOLVER: "which impulses act at the same points",
    INTEGRATOR: "how a smooth motion is advanced",
}

Both = tuple[Moment, Moment]


class Anatomy:
    """Removes one possible cause after the other from steps, and sees what is left.

    Each cause is removed from the states in which the engines begin, or from the world on both
    engines: joints are moved off their limits, bodies lifted until they only touch, friction is
    taken away, everything is lifted clear. What then no longer parts them was the cause.
    """

    def __init__(self, one: Laboratory, other: Laboratory, gap: float) -> None:
        """Prepare.

        Args:
            one: The first engine.
            other: The second engine.
            gap: How much deeper the same bodies are on the second engine, in m.
        """
        self._labs, self._gap = (one, other), gap
        self._made: dict[str, tuple[Laboratory, Laboratory]] = {}

    def __enter__(self) -> Anatomy:
        return self

    def __exit__(self, *ignored: object) -> None:
        for labs in self._made.values():
            for lab in labs:
                lab.close()

    def shares(self, moment: Moment) -> dict[str, float]:
        """Return how much of the difference after a step each cause makes, in sqrt(J)."""
        both, labs = (moment, moment), self._labs
        before = self._apart(labs, both)
        found: dict[str, float] = {}
        for kind, remove in (
            (LIMIT, self._off_limits), (GAP, self._same_gap), (RECOVERY, self._touching),
        ):  # fmt: skip
            changed = remove(both)
            if changed is not None:
                after = self._apart(labs, changed)
                if after < (1 - _HELPS) * before:
                    found[kind], before, both = before - after, after, changed
        rest = self._of_worlds(labs, both, before)
        rest[LIMIT] = rest.get(LIMIT, 0.0) + found.get(LIMIT, 0.0)
        return found | rest

    def _of_worlds(
        self, labs: tuple[Laboratory, Laboratory], both: Both, before: float
    ) -> dict[str, float]:
        found = {}
        if self._contacts(labs, both):
            without = self._frictionless()
            after = self._apart(without, both)
            if after < (1 - _HELPS) * before:
                found[FRICTION], before, labs = before - after, after, without
            outcomes = self._outcomes(labs, both)
            clear = self._clear(both)
            after = self._apart(labs, clear)
            if after < (1 - _HELPS) * before:
                same = _touching_pairs(outcomes[0]) == _touching_pairs(outcomes[1])
                found[SOLVER if same else CONTACTS] = before - after
                before, both = after, clear
        return found | self._in_the_air(labs, self._clear(both), before)

    def _in_the_air(
        self, labs: tuple[Laboratory, Laboratory], both: Both, before: float
    ) -> dict[str, float]:
        """Split what is left where nothing touches: limits that contacts hid, smooth motion."""
        found = {}
        changed = self._off_limits(both)
        if changed is not None:
            after = self._apart(labs, changed)
            if after < (1 - _HELPS) * before:
                found[LIMIT], before, both = before - after, after, changed
        after = self._in_half_steps(labs, both)
        if after < (1 - _HELPS) * before:
            found[INTEGRATOR], before = before - after, after
        return found | {UNEXPLAINED: before}

    def _apart(self, labs: tuple[Laboratory, Laboratory], both: Both) -> float:
        mass = labs[0].simulation.mass_matrix(both[0].positions)
        first, second = self._outcomes(labs, both)
        return _norm(mass, second.velocities - first.velocities)

    def _outcomes(self, labs: tuple[Laboratory, Laboratory], both: Both) -> list[Outcome]:
        return [lab.step(moment) for lab, moment in zip(labs, both, strict=True)]

    def _contacts(self, labs: tuple[Laboratory, Laboratory], both: Both) -> bool:
        return any(len(outcome.contacts) for outcome in self._outcomes(labs, both))

    def _off_limits(self, both: Both) -> Both | None:
        """Return states in which no joint reaches a limit, if one does."""
        layouts = [lab.simulation.layout for lab in self._labs]
        lower = np.maximum(*(layout.lower for layout in layouts))
        upper = np.minimum(*(layout.upper for layout in layouts))
        period = self._labs[0].simulation.period
        index = list(layouts[0].position_index.values())
        speed = list(layouts[0].velocity_index.values())
        q, v = both[0].positions.copy(), both[0].velocities.copy()
        outcomes = self._outcomes(self._labs, both)
        fastest = np.abs([v[speed], *(each.velocities[speed] for each in outcomes)]).max(axis=0)
        margin = 2.0 * period * fastest + 1e-3
        near = (q[index] < lower + margin) | (q[index] > upper - margin)
        fast = fastest > 0.8 * np.minimum(*(layout.max_velocity for layout in layouts))
        if not (near | fast).any():
            return None
        width = np.minimum(upper - lower, 2.0)
        inside = np.clip(q[index], lower + 0.5 * width, upper - 0.5 * width)
        most = np.minimum(0.1 * width / period, 0.3 * fastest)
        q[index] = np.where(near, inside, q[index])
        v[speed] = np.where(near | fast, np.clip(v[speed], -most, most), v[speed])
        changes = {"positions": q, "velocities": v}
        return both[0].but(**changes), both[1].but(**changes)

    def _same_gap(self, both: Both) -> Both | None:
        if abs(self._gap) < 1e-6:
            return None
        return both[0], self._lifted(both[1], lambda _: self._gap)

    def _touching(self, both: Both) -> Both | None:
        """Return states in which penetrating bodies only touch, if any do."""
        contacts = self._labs[0].step(both[0]).contacts
        layout = self._labs[0].simulation.layout

        def depth(bodies: slice) -> float:
            mine = _of_bodies(contacts, bodies)
            return float(contacts["depth"][mine].max(initial=0.0))

        free = [part.bodies for part in layout.parts.values() if part.floating]
        if not any(depth(bodies) > _TOUCHES for bodies in free):
            return None
        first, second = (self._lifted(moment, depth) for moment in both)
        return first, second

    def _clear(self, both: Both) -> Both:
        parts = list(self._labs[0].simulation.layout.parts.values())
        heights = {part.bodies.start: 3.0 * (1 + n) for n, part in enumerate(parts)}
        first, second = (self._lifted(each, lambda b: heights[b.start]) for each in both)
        return first, second

    def _lifted(self, moment: Moment, height: Callable[[slice], float]) -> Moment:
        q = moment.positions.copy()
        for part in self._labs[0].simulation.layout.parts.values():
            if part.floating:
                q[part.positions.start + 2] += height(part.bodies)
        return moment.but(positions=q)

    def _frictionless(self) -> tuple[Laboratory, Laboratory]:
        return self._changed("frictionless", self._labs, _slippery)

    def _changed(
        self, how: str, labs: tuple[Laboratory, Laboratory], change: Callable[[World], World]
    ) -> tuple[Laboratory, Laboratory]:
        """Return laboratories with changed worlds, which are built once."""
        key = f"{how} {self._labs.index(labs[0]) if labs[0] in self._labs else 'changed'}"
        if key not in self._made:
            first, second = (lab.with_world(change(lab.world)) for lab in labs)
            self._made[key] = first, second
        return self._made[key]

    def _in_half_steps(self, labs: tuple[Laboratory, Laboratory], both: Both) -> float:
        """Return the difference after two steps of half the period."""
        first, second = self._changed("halved", labs, _halved)
        mass = first.simulation.mass_matrix(both[0].positions)
        return _norm(mass, second.step(both[1], 2).velocities - first.step(both[0], 2).velocities)


def _halved(world: World) -> World:
    return dataclasses.replace(world, period=0.5 * world.period)


def _slippery(world: World) -> World:
    return dataclasses.replace(
        world,
        robots=[dataclasses.replace(each, friction=0.0) for each in world.robots],
        objects=[dataclasses.replace(each, friction=0.0) for each in world.objects],
        ground=None if world.ground is None else dataclasses.replace(world.ground, friction=0.0),
    )


def _touching_pairs(outcome: Outcome) -> dict[tuple[int, int], int]:
    """Return at how many points each pair of bodies touches."""
    found: dict[tuple[int, int], int] = {}
    for contact in outcome.contacts:
        pair = int(contact["body_a"]), int(contact["body_b"])
        found[pair] = found.get(pair, 0) + 1
    return found


def _of_bodies(contacts: Records, bodies: slice) -> Vector:
    inside = [
        (contacts[side] >= bodies.start) & (contacts[side] < bodies.stop)
        for side in ("body_a", "body_b")
    ]
    return np.asarray(inside[0] | inside[1])


def gap_between(one: Laboratory, other: Laboratory, moments: Sequence[Moment]) -> float:
    """Return how much deeper the same bodies are on the second engine, in m: the median; 0: none.

    Only pairs that touch at as many points on both count.
    """
    deeper: list[float] = []
    for moment in moments:
        first, second = one.step(moment), other.step(moment)
        counts = _touching_pairs(first)
        for pair, count in _touching_pairs(second).items():
            if counts.get(pair) == count:
                ends = [_depths(each.contacts, pair) for each in (first, second)]
                deeper += (ends[1] - ends[0]).tolist()
    if len(deeper) < 4:
        return 0.0
    low, middle, high = np.quantile(deeper, (0.25, 0.5, 0.75))
    consistent = high - low < 0.2 * abs(middle)
    return float(middle) if consistent else 0.0


def _depths(contacts: Records, pair: tuple[int, int]) -> Vector:
    mine = (contacts["body_a"] == pair[0]) & (contacts["body_b"] == pair[1])
    return np.sort(contacts["depth"][mine])
